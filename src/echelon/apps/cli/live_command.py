"""`echelon live`: a closed loop in real time, with controls in the browser."""

from pathlib import Path
from typing import Annotated

import typer

from echelon.apps.cli.options import BrowserOption, PortOption, SetOption
from echelon.apps.cli.status import STATUS


def live(
    scenario: Annotated[
        str,
        typer.Argument(
            help="The name of a bundled scenario, a YAML file, or the folder of a run, which "
            "continues from its last state."
        ),
    ],
    set_: SetOption = None,
    port: PortOption = None,
    browser: BrowserOption = True,
) -> None:
    """Run a scenario in real time in the browser, with controls that show what is guaranteed."""
    from echelon.experiments.scenario.scenario import load_scenario
    from echelon.output.archive.folder import when_written
    from echelon.output.viewer.page import check_page

    loaded = load_scenario(scenario, set_ or [])
    check_page()
    STATUS.begin(f"preparing {loaded.name} for the browser, which takes up to a minute")
    from echelon.apps.cli.console import warn
    from echelon.apps.cli.view_command import keep_serving
    from echelon.apps.live.server import live as make_ready
    from echelon.apps.live.server import serve_live
    from echelon.experiments.results.recording import recording_of
    from echelon.output.archive.load_folder import load

    # A bundled scenario wins over a folder of its name, and a folder may hold no run yet.
    folder = Path(scenario) if loaded.folder == Path(scenario) else None
    run = recording_of(load(folder)) if folder is not None and when_written(folder) else None
    session, html = make_ready(loaded, run, STATUS.counter("parts"))
    warn(session.swarm.warnings)
    server = serve_live(session, html, port)
    session.start()
    try:
        keep_serving(server, port, browser)
    finally:
        session.end()
