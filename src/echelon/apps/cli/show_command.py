"""`echelon view`, `live`, `plot` and `video`: a run in the browser, in figures, and as a video."""

import re
import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from echelon.apps.cli import tables
from echelon.apps.cli.options import (
    BesideOption,
    BrowserOption,
    OverwriteOption,
    PortOption,
    RunArgument,
    SetOption,
)
from echelon.apps.cli.terminal import STATUS, STOP
from echelon.core.errors import OutputError, listing
from echelon.output.archive.folder import (
    DATA,
    check_exists,
    claim_file,
    claim_files,
    newest_run,
    write_errors,
)
from echelon.output.plots.figure_files import NAMES, check_names, save

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from echelon_flight.page_server import Handler

_KINDS = ("png", "pdf", "svg")
_DPI = 30, 1200
_WIDTHS = 320, 3840
"""Pixels across a video."""


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
    paths = runs
    if not paths:
        paths = [newest_run()]
        print(f"echelon: showing `{paths[0]}`, the newest run.", file=sys.stderr)
    STATUS.begin(f"reading {' and '.join(map(str, paths))}")
    from echelon.experiments.results.recording import recording_of
    from echelon.output.archive.run_folder import load, report_beside
    from echelon.output.reports.run_report import whole_report
    from echelon.output.viewer.replay import replay_page

    opened = [recording_of(load(path)) for path in paths]
    reports = [whole_report(*each) for each in zip(opened, map(report_beside, paths), strict=True)]
    if len(paths) > 1:
        # Both may be of one scenario.
        folders = [path.resolve().parent if path.name == DATA else path.resolve() for path in paths]
        pairs = zip(opened, folders, strict=True)
        opened = [replace(run, name=folder.name) for run, folder in pairs]
    page = replay_page(*opened, reports=reports).encode()
    if html is None:
        from echelon_flight.page_server import Handler

        class RunPage(Handler):
            """The page of this run."""

        RunPage.page = page
        keep_serving(RunPage, port, browser)
        return
    tables.write_file(html, page, "{}, one self-contained file")


def keep_serving(page: "type[Handler]", port: int | None, browser: bool) -> None:
    """Print the address of a page, open a browser if there is one, and serve until Ctrl-C."""
    preferred = page.port if port is None else port
    with page.serving(preferred) as address, STOP.hold():
        show_address(address, preferred, browser)
        wait()


def show_address(address: str, preferred: int, browser: bool) -> None:
    """Print the address of a page, and open a browser if there is one."""
    import webbrowser

    actual = int(address.rstrip("/").rpartition(":")[2])
    if preferred not in (actual, 0):
        print(f"echelon: port {preferred} is in use; using {actual}.", file=sys.stderr)
    try:
        failed = browser and not webbrowser.open(address)
    except webbrowser.Error:
        failed = True
    hint = " No browser could be started: open this address in one." if failed else ""
    print(f"echelon: serving {address}.{hint} Ctrl-C quits.", file=sys.stderr, flush=True)


def wait() -> None:
    """Wait until Ctrl-C."""
    while STOP.number is None:
        time.sleep(0.1)
    # Ctrl-C is the way to leave a page, so the exit code is 0.
    STOP.number = None


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
    from echelon.apps.live.server import live as make_ready
    from echelon.apps.live.server import live_page
    from echelon.experiments.results.recording import recording_of
    from echelon.output.archive.run_folder import load

    # A bundled scenario wins over a folder of its name, and a folder may hold no run yet.
    folder = Path(scenario) if loaded.folder == Path(scenario) else None
    run = recording_of(load(folder)) if folder is not None and when_written(folder) else None
    session, html = make_ready(loaded, run, STATUS.counter("parts"))
    tables.warn(session.swarm.warnings)
    session.start()
    try:
        keep_serving(live_page(session, html), port, browser)
    finally:
        session.end()


def plot(
    run: RunArgument,
    beside: BesideOption = None,
    what: Annotated[
        str | None, typer.Option(metavar="NAME,...", help=f"Only these: {', '.join(NAMES)}.")
    ] = None,
    paper: Annotated[
        bool, typer.Option("--paper", help="Sizes of one and two columns of a paper, in 8 pt.")
    ] = False,
    dpi: Annotated[
        int | None, typer.Option(help="Resolution of the PNG (default: 150, with --paper 300).")
    ] = None,
    out: Annotated[
        Path | None, typer.Option(help="Output folder (default: figures/ of the run).")
    ] = None,
    force: OverwriteOption = False,
) -> None:
    """Draw the figures of a run or a flight again, as PNG, PDF and SVG."""
    if dpi is not None and not _DPI[0] <= dpi <= _DPI[1]:
        raise OutputError(f"`--dpi` is {dpi}, and must be from {_DPI[0]} to {_DPI[1]}.")
    names = NAMES if what is None else tuple(filter(None, map(str.strip, what.split(","))))
    check_names(names)
    STATUS.begin(f"reading {run}")
    folder = (run if run.is_dir() else run.parent) / "figures" if out is None else out
    drawings = _drawings(run, names, paper, beside)
    if not drawings:
        raise OutputError("the run has no data for these figures.")
    # Figures in a run's own folder are replaced without a question.
    claim_files(folder, [f"{n}.{kind}" for n in drawings for kind in _KINDS], force or out is None)
    with write_errors(folder):
        STATUS.begin("drawing figures")
        show = STATUS.counter("files")
        paths = save(drawings, folder, _KINDS, dpi or (300 if paper else 150), show)
    stems = ", ".join(dict.fromkeys(path.stem for path in paths))
    print(f"- Written to {folder}: {stems}, each as {', '.join(k.upper() for k in _KINDS)}.")
    absent = [name for name in names if not {name, f"{name}_one_column"} & drawings.keys()]
    if what is not None and absent:
        print(f"- The run has no data for {listing(absent)}.")


def _drawings(
    run: Path, names: Sequence[str], paper: bool, beside: Path | None
) -> "dict[str, Figure]":
    from echelon.output.archive.run_folder import load
    from echelon.output.plots.run_figures import figures
    from echelon.output.plots.style import ONE_COLUMN, SCREEN, TWO_COLUMNS

    result = load(run)
    pages = {"_one_column": ONE_COLUMN, "_two_columns": TWO_COLUMNS} if paper else {"": SCREEN}
    drawings = {
        f"{name}{suffix}": figure
        for suffix, page in pages.items()
        for name, figure in figures(result, names, page).items()
    }
    if beside is not None:
        from echelon.experiments.results.beside import beside as compared
        from echelon.experiments.results.recording import recording_of
        from echelon.output.plots.beside_run import beside_figure

        both = compared(recording_of(result), recording_of(load(beside)))
        drawings |= {f"beside{x}": beside_figure(both, page) for x, page in pages.items()}
    return drawings


def video(
    run: RunArgument,
    file: Annotated[Path, typer.Argument(help="The video file, ending in .mp4 or .gif.")],
    speed: Annotated[float, typer.Option(help="Playback speed; 2 plays twice as fast.")] = 1.0,
    size: Annotated[
        str | None, typer.Option(metavar="WxH", help="Pixels (default: 960x540, of a GIF 640x360).")
    ] = None,
    fps: Annotated[
        float | None, typer.Option(help="Pictures a second (default: 25, of a GIF 12.5).")
    ] = None,
    begin: Annotated[
        float | None, typer.Option("--from", help="Begin at this time of the run, s.")
    ] = None,
    end: Annotated[
        float | None, typer.Option("--to", help="End at this time of the run, s.")
    ] = None,
    force: OverwriteOption = False,
) -> None:
    """Draw a run as a video, without a browser."""
    if not 0.01 <= speed <= 100.0:
        raise OutputError(f"`--speed` is {speed:g}, and must be from 0.01 to 100.")
    if fps is not None and not 1.0 <= fps <= 60.0:
        raise OutputError(f"`--fps` is {fps:g}, and must be from 1 to 60.")
    pixels = None if size is None else _pixels(size)
    claim_file(file, force, endings=(".mp4", ".gif"))
    STATUS.begin(f"reading {run}")
    from echelon.output.archive.run_folder import load
    from echelon.output.plots.video import encoder, save_video

    if file.suffix.lower() == ".mp4":
        # Before the run is read, so that a missing ffmpeg is reported at once.
        encoder()
    with write_errors(file):
        recording = load(run)
        STATUS.begin(f"drawing {file}")
        show = STATUS.counter("pictures")
        pictures = save_video(
            recording, file, speed, size=pixels, rate=fps, begin=begin, end=end, progress=show
        )
    tables.print_file(file, f"{pictures} pictures, {{}}")


def _pixels(size: str) -> tuple[int, int]:
    found = re.fullmatch(r"(\d{1,5})x(\d{1,5})", size)
    width, height = map(int, found.groups()) if found else (0, 0)
    fits = _WIDTHS[0] <= width <= _WIDTHS[1] and width / 3 <= height <= 1.5 * width
    if not fits or width % 2 or height % 2:
        raise OutputError(
            f"`--size` is `{size}`, and must be even numbers of pixels as in `960x540`, "
            f"{_WIDTHS[0]} to {_WIDTHS[1]} across and a third to 1.5 of that high."
        )
    return width, height
