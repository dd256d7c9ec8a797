"""`echelon view`: a run in the browser."""

import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from echelon.apps.cli.console import write_file
from echelon.apps.cli.options import BrowserOption, OverwriteOption, PortOption
from echelon.apps.cli.status import STATUS
from echelon.apps.cli.stop import STOP
from echelon.core.errors import OutputError
from echelon.output.archive.folder import DATA, check_exists, claim_file

if TYPE_CHECKING:
    from http.server import ThreadingHTTPServer


def _check_runs(runs: list[Path] | None) -> list[Path] | None:
    if runs and len(runs) > 2:
        raise OutputError(f"got {len(runs)} runs; a page shows one, or two beside each other.")
    for run in runs or ():
        check_exists(run)
    return runs


def view(
    runs: Annotated[
        list[Path] | None,
        typer.Argument(
            metavar="[RUN] [RUN]",
            help="One run or two: their folders, or their `run.nc` (default: the newest in runs/).",
            callback=_check_runs,
        ),
    ] = None,
    html: Annotated[
        Path | None, typer.Option(help="Write a self-contained page to this file instead.")
    ] = None,
    port: PortOption = None,
    browser: BrowserOption = True,
    force: OverwriteOption = False,
) -> None:
    """Show a run in the browser, or two with the same clock; or write the page to a file."""
    from echelon.output.viewer.page import check_page

    # Before the run is read, which takes longer.
    check_page()
    if html is not None:
        claim_file(html, force)
    paths = runs or [_newest()]
    STATUS.begin(f"reading {' and '.join(map(str, paths))}")
    from echelon.experiments.results.recording import recording_of
    from echelon.output.archive.load_folder import load
    from echelon.output.archive.run_folder import report_beside
    from echelon.output.reports.run_report import whole_report
    from echelon.output.viewer.replay import replay_page

    opened = [recording_of(load(path)) for path in paths]
    reports = [whole_report(*each) for each in zip(opened, map(report_beside, paths), strict=True)]
    if len(paths) > 1:
        # Both may be of one scenario.
        opened = [replace(run, name=_label(path)) for run, path in zip(opened, paths, strict=True)]
    page = replay_page(*opened, reports=reports).encode()
    if html is None:
        show_page(page, port, browser)
        return
    write_file(html, page, "{}, one self-contained file")


def _label(path: Path) -> str:
    path = path.resolve()
    return path.parent.name if path.name == DATA else path.name


def _newest() -> Path:
    """Return the newest run in the folder of runs, and say which it is."""
    from echelon.output.archive.folder import newest_run

    run = newest_run()
    print(f"echelon: showing `{run}`, the newest run.", file=sys.stderr)
    return run


def show_page(page: bytes, port: int | None, browser: bool) -> None:
    """Serve a page until Ctrl-C."""
    from echelon.output.viewer.serve import Handler, serve

    class RunPage(Handler):
        """The page of this run."""

    RunPage.page = page
    keep_serving(serve(RunPage, port), port, browser)


def keep_serving(server: "ThreadingHTTPServer", port: int | None, browser: bool) -> None:
    """Print the address of a page, open a browser if there is one, and serve until Ctrl-C."""
    from echelon.output.viewer.serve import serving

    with serving(server) as address, STOP.hold(message=""):
        show_address(server, address, port, browser)
        wait()


def show_address(
    server: "ThreadingHTTPServer", address: str, port: int | None, browser: bool
) -> None:
    """Print the address of a page, and open a browser if there is one."""
    from echelon.output.viewer.serve import PORT, open_browser

    preferred, actual = PORT if port is None else port, server.server_address[1]
    if preferred not in (actual, 0):
        print(f"echelon: port {preferred} is in use; using {actual}.", file=sys.stderr)
    opened = browser and open_browser(address)
    failed = browser and not opened
    hint = " No browser could be started: open this address in one." if failed else ""
    print(f"echelon: serving {address}.{hint} Ctrl-C quits.", file=sys.stderr, flush=True)


def wait() -> None:
    """Wait until Ctrl-C."""
    while STOP.number is None:
        time.sleep(0.1)
    # Ctrl-C is the way to leave a page, so the exit code is 0.
    STOP.number = None
