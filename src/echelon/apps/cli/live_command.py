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
            help="The name of a bundled scenario, a YAML file, or the folder of a run, which goes "
            "on from its last state."
        ),
    ],
    set_: SetOption = None,
    port: PortOption = None,
    browser: BrowserOption = True,
) -> None:
    """Run a scenario in real time in the browser, with controls that show what is guaranteed."""
    from echelon.experiments.scenario.scenario import SCENARIO_FILE, load_scenario
    from echelon.output.viewer.page import check_page

    folder = Path(scenario) if Path(scenario).is_dir() else None
    loaded = load_scenario(scenario if folder is None else folder / SCENARIO_FILE, set_ or [])
    check_page()
    STATUS.begin(f"preparing {loaded.name} for the browser, which takes up to a minute")
    from echelon.apps.cli.view_command import keep_serving
    from echelon.apps.live.server import live as make_ready
    from echelon.apps.live.server import serve_live
    from echelon.experiments.results.dataset import recording_of
    from echelon.output.archive.load_folder import load

    run = None if folder is None else recording_of(load(folder))
    session, html = make_ready(loaded, run, STATUS.counter("parts"))
    server = serve_live(session, html, port)
    session.start()
    try:
        keep_serving(server, port, browser)
    finally:
        session.end()
