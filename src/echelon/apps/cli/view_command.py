"""`echelon view`: a run in the browser."""

import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from echelon.apps.cli.stop import STOP
from echelon.core.errors import OutputError

if TYPE_CHECKING:
    from http.server import ThreadingHTTPServer

RunArgument = Annotated[
    Path, typer.Argument(metavar="RUN", help="The folder of a run, or its `run.nc`.")
]
ForceOption = Annotated[bool, typer.Option("--force", help="Replace a file that exists.")]


def view(
    run: RunArgument,
    html: Annotated[
        Path | None, typer.Option(help="Write one self-contained page to this file instead.")
    ] = None,
    port: Annotated[
        int | None, typer.Option(help="Serve on this port, or the next free one.")
    ] = None,
    browser: Annotated[bool, typer.Option(help="Open a browser.")] = True,
    force: ForceOption = False,
) -> None:
    """Show a run in the browser: in space, with errors, V and inputs in step; or write the page."""
    from echelon.output.viewer.page import check_page

    # Before the run is read, which takes longer.
    check_page()
    if html is not None:
        check_target(html, force)
    from echelon.output.archive.open_folder import open_run
    from echelon.output.viewer.replay import replay_page

    page = replay_page(open_run(run)).encode()
    if html is None:
        show_page(page, port, browser)
        return
    from echelon.core.files import write_atomic

    try:
        write_atomic(html, page)
    except OSError as error:
        raise OutputError(f"`{html}` cannot be written: {error.strerror or error}.") from error
    print(f"- Written to {html}: {len(page) / 1e6:.2f} MB, one file that needs no network.")


def check_target(file: Path, force: bool) -> None:
    """Check that a file can be written without the loss of another.

    Raises:
        OutputError: it is a folder, or exists and is not to be replaced.
    """
    if file.is_dir():
        raise OutputError(f"`{file}` is a folder, and the output must be a file.")
    if file.is_file() and not force:
        raise OutputError(f"the file `{file}` exists; choose another, or `--force` to replace it.")
    if not file.resolve().parent.is_dir():
        raise OutputError(f"`{file.parent}` is no folder to write `{file.name}` into.")


def show_page(page: bytes, port: int | None, browser: bool) -> None:
    """Serve a page until Ctrl-C."""
    from echelon.output.viewer.serve import Handler, serve

    class RunPage(Handler):
        """The page of this run."""

    RunPage.page = page
    keep_serving(serve(RunPage, port), port, browser)


def keep_serving(server: "ThreadingHTTPServer", port: int | None, browser: bool) -> None:
    """Say where a page is, open a browser if there is one, and serve until Ctrl-C."""
    from echelon.output.viewer.serve import serving

    with serving(server) as address, STOP.hold(said=""):
        show_address(server, address, port, browser)
        wait()


def show_address(
    server: "ThreadingHTTPServer", address: str, port: int | None, browser: bool
) -> None:
    """Say where a page is, and open a browser if there is one."""
    from echelon.output.viewer.serve import PORT, open_browser

    asked, got = PORT if port is None else port, server.server_address[1]
    if asked not in (got, 0):
        print(f"echelon: port {asked} is in use, so {got} is taken.", file=sys.stderr)
    opened = browser and open_browser(address)
    where = "" if opened or not browser else " in a browser; none could be opened from here"
    print(f"echelon: {address} shows it{where}. Ctrl-C ends.", file=sys.stderr, flush=True)


def wait() -> None:
    """Wait until Ctrl-C."""
    while STOP.number is None:
        time.sleep(0.1)
    # That is how a page is left, and no interruption.
    STOP.number = None
