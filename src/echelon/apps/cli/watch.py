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
    """A run whose page shows each part as soon as it is computed; a fault of the page ends nothing.

    Args:
        scenario: of the run.
        experiment: that it describes.
    """

    def __init__(self, scenario: "Scenario", experiment: "Experiment") -> None:
        """Prepare the page, as far as it is known before the run."""
        from echelon.experiments.results.lyapunov import fixed_metric, potential
        from echelon.experiments.results.recording import foreseen
        from echelon.guarantees.promises.promise import promise
        from echelon.output.viewer.growing import Growing
        from echelon.simulation.engine.prepare import prepare

        prepared = prepare(*experiment)
        parts, settings = prepared.parts, prepared.problem.settings
        self.formation = parts.formation
        guarantee = promise(parts, settings).as_mapping()
        self.run = foreseen(parts, settings, prepared.problem.states, scenario.name, guarantee)
        # The V of a P that turns is computed only at the end.
        P = None if parts.formation.motion is not None else fixed_metric(parts)
        self.potential = None if P is None else potential(parts.model, parts.graph, P)
        self.page = Growing(self.run)

    def add(self, stretch: "Stretch") -> None:
        """Show a part that was computed."""
        from echelon.experiments.results.recording import so_far

        # An agent without finite numbers cannot be drawn; the page says so at the end.
        if stretch.finite:
            with contextlib.suppress(OutputError):
                self.page.add(so_far(self.run, stretch, self.potential, self.formation))

    def show_all(self, folder: Path) -> None:
        """Show the complete run until Ctrl-C."""
        from echelon.experiments.results.recording import recording_of
        from echelon.output.archive.load_folder import load
        from echelon.output.archive.run_folder import report_beside
        from echelon.output.reports.run_report import whole_report

        with STOP.hold(message=""):
            run = recording_of(load(folder))
            self.page.finish(run, whole_report(run, report_beside(folder)))
            print(
                "echelon: complete; the page is still served. Ctrl-C quits.",
                file=sys.stderr,
            )
            wait()


@contextlib.contextmanager
def watching(scenario: "Scenario", experiment: "Experiment") -> Iterator[WatchedRun]:
    """Serve the page of a run that is about to start, and open a browser."""
    from echelon.output.viewer.growing import serve_growing
    from echelon.output.viewer.serve import serving

    watched = WatchedRun(scenario, experiment)
    server = serve_growing(watched.page, None)
    with serving(server) as address:
        show_address(server, address, None, browser=True)
        yield watched
