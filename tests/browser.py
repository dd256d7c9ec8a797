"""A real Chromium without a screen, and pages in it that fail on any fault or outside request."""

import contextlib
import shutil
import time
from types import SimpleNamespace

from playwright.sync_api import sync_playwright

NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
# Never `--use-angle=swiftshader`, which then draws the page itself too, at a third of the speed.
ARGUMENTS = ("--no-sandbox", "--disable-gpu-compositing", "--enable-unsafe-swiftshader")


@contextlib.contextmanager
def chromium():
    """A browser; `python3 dev.py browser` installs Debian's."""
    found = next(filter(None, map(shutil.which, NAMES)), None)
    assert found, "there is no Chromium; `python3 dev.py browser` installs Debian's"
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(
            executable_path=found, headless=True, args=list(ARGUMENTS)
        )
        yield browser
        browser.close()


@contextlib.contextmanager
def opened(browser, address, width=1280, height=720, **options):
    """A page once it is drawn; when it is left, nothing may have gone wrong in it."""
    size = {"width": width, "height": height}
    options.setdefault("offline", address.startswith("file:"))
    context = browser.new_context(viewport=size, **options)
    page, seen = context.new_page(), SimpleNamespace(faults=[], asked=[])
    page.on("pageerror", lambda error: seen.faults.append(str(error)))
    # Screenshots cause a warning of the driver, and only errors count.
    page.on("console", lambda told: told.type == "error" and seen.faults.append(told.text))
    page.on("request", lambda request: seen.asked.append(request.url))
    try:
        page.goto(address)
        until(lambda: page.evaluate("!!window.echelon") or seen.faults)
        yield page
    except AssertionError as fault:
        fault.add_note(f"faults in the page: {seen.faults}")
        raise
    finally:
        context.close()
    home = address.split("?")[0]
    outside = [x for x in seen.asked if not x.startswith((home, "blob:", "data:"))]
    assert seen.faults == [] and outside == []


def until(true, seconds=30.0):
    """Wait for something to become true."""
    end = time.monotonic() + seconds
    while not true():
        assert time.monotonic() < end, "it did not happen"
        time.sleep(0.02)
