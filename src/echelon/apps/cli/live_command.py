"""`echelon live`: a closed loop in real time, with controls in the browser."""

from echelon.apps.cli.options import BrowserOption, PortOption, ScenarioArgument, SetOption
from echelon.apps.cli.status import STATUS


def live(
    scenario: ScenarioArgument,
    set_: SetOption = None,
    port: PortOption = None,
    browser: BrowserOption = True,
) -> None:
    """Run a scenario in real time in the browser, with controls that show what is guaranteed."""
    from echelon.experiments.scenario.scenario import load_scenario
    from echelon.output.viewer.page import check_page

    loaded = load_scenario(scenario, set_ or [])
    check_page()
    STATUS.begin(f"preparing {loaded.name} for the browser, which takes up to a minute")
    from echelon.apps.cli.view_command import keep_serving
    from echelon.apps.live.server import live as make_ready
    from echelon.apps.live.server import serve_live

    session, html = make_ready(loaded, STATUS.counter("parts"))
    server = serve_live(session, html, port)
    session.start()
    try:
        keep_serving(server, port, browser)
    finally:
        session.end()
