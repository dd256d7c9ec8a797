"""`echelon run --view`: a run in the browser while it is computed."""

import contextlib
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, final

from echelon.apps.cli.stop import STOP
from echelon.apps.cli.view_command import show_address, wait
from echelon.core.errors import OutputError

if TYPE_CHECKING:
    from echelon.experiments.scenario.build import Experiment
    from echelon.experiments.scenario.scenario import Scenario
    from echelon.simulation.engine.record import Stretch


@final
class WatchedRun:
    """A run that pages are fed with; what they cannot show ends nothing.

    Args:
        scenario: of the run.
        built: what it builds.
    """

    def __init__(self, scenario: "Scenario", built: "Experiment") -> None:
        """Foresee it."""
        from echelon.experiments.results.foreseen import foreseen
        from echelon.experiments.results.lyapunov import goes_both_ways, potential
        from echelon.guarantees.promises.promise import promise
        from echelon.output.viewer.growing import Growing
        from echelon.simulation.engine.prepare import prepare

        prepared = prepare(*built)
        parts, settings = prepared.parts, prepared.problem.settings
        told = promise(parts, settings).as_mapping()
        self.run = foreseen(parts, settings, prepared.problem.states, scenario.name, told)
        P = parts.drive.metric(parts.model)
        # Of a law that turns, P stands in axes that turn too, and V is told at the end.
        turns = getattr(getattr(parts.drive, "follower", None), "turning", False)
        shown = P if goes_both_ways(parts.graph) and not turns else None
        self.potential = shown if shown is None else potential(parts.model, parts.graph, shown)
        self.page = Growing(self.run)

    def add(self, stretch: "Stretch") -> None:
        """Show a stretch that was computed."""
        from echelon.experiments.results.foreseen import so_far

        # What was lost has no place, and a page says so at the end.
        if stretch.finite:
            with contextlib.suppress(OutputError):
                self.page.add(so_far(self.run, stretch, self.potential))

    def show_all(self, folder: Path) -> None:
        """Show the run that is done, until Ctrl-C."""
        from echelon.output.archive.open_folder import open_run

        with STOP.hold(said=""):
            self.page.finish(open_run(folder))
            print("echelon: the run is done, and its page stays. Ctrl-C ends.", file=sys.stderr)
            wait()


@contextlib.contextmanager
def watching(scenario: "Scenario", built: "Experiment") -> Iterator[WatchedRun]:
    """Serve the page of a run that begins, and open a browser."""
    from echelon.output.viewer.growing import serve_growing
    from echelon.output.viewer.serve import serving

    watched = WatchedRun(scenario, built)
    server = serve_growing(watched.page, None)
    with serving(server) as address:
        show_address(server, address, None, browser=True)
        yield watched
