"""`echelon live`: a closed loop that runs while one turns its knobs."""

from typing import Annotated

import typer

from echelon.apps.cli.console import ScenarioArgument


def live(
    scenario: ScenarioArgument,
    set_: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="KEY=VALUE", help="Change a value before it runs."),
    ] = None,
    port: Annotated[
        int | None, typer.Option(help="Serve on this port, or the next free one.")
    ] = None,
    browser: Annotated[bool, typer.Option(help="Open a browser.")] = True,
) -> None:
    """Run a scenario in real time in the browser, with knobs that show what is promised."""
    from echelon.experiments.scenario.scenario import load_scenario
    from echelon.output.viewer.page import check_page

    checked = load_scenario(scenario, set_ or [])
    check_page()
    from echelon.apps.cli.view_command import keep_serving
    from echelon.apps.live.server import live as make_ready
    from echelon.apps.live.server import serve_live

    session, html = make_ready(checked)
    server = serve_live(session, html, port)
    session.start()
    try:
        keep_serving(server, port, browser)
    finally:
        session.end()
