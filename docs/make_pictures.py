"""Draw docs/assets/replay.png and live.png: the pages, as a real browser shows them.

Run it with `.venv/bin/python docs/make_pictures.py`; it needs Chromium, and takes a minute.
"""

import sys
from pathlib import Path

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE.parent / "tests"))

from browser import chromium, opened, until  # noqa: E402 - of the tests

import echelon as ech  # noqa: E402
from echelon.apps.live.server import live, live_page  # noqa: E402
from echelon.experiments.results.recording import recording_of  # noqa: E402
from echelon.output.viewer.replay import replay_page  # noqa: E402

SHORT = ("simulation.horizon=20", "simulation.store_every=4")


def main() -> None:
    """Run the paper's scenario, and take both pictures."""
    run = recording_of(ech.run(ech.load_scenario("paper", SHORT)))
    file = HERE / "assets" / "replay.html"
    file.write_text(replay_page(run), "utf-8")
    with chromium() as browser:
        with opened(browser, file.as_uri()) as page:
            page.evaluate("echelon.seek(echelon.run.frameOf(1.6))")
            page.wait_for_timeout(800)
            page.screenshot(path=HERE / "assets" / "replay.png")
        file.unlink()
        session, html = live(ech.load_scenario("paper"))
        session.start()
        with live_page(session, html).serving(0) as address, opened(browser, address) as page:
            until(lambda: page.evaluate("echelon.time") > 8.0, 90.0)
            until(lambda: page.evaluate("echelon.promise.state") == "holds", 90.0)
            page.evaluate("echelon.ask('kick', 2)")
            page.wait_for_timeout(900)
            # A slow machine is drawn coarsely until it rests.
            page.evaluate("echelon.ask('pause', true)")
            page.wait_for_timeout(900)
            page.set_viewport_size({"width": 1281, "height": 720})
            page.wait_for_timeout(400)
            page.screenshot(path=HERE / "assets" / "live.png")
        session.end()


if __name__ == "__main__":
    main()
