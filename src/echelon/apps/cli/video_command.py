"""`echelon video`: a run as MP4 or GIF."""

import re
from pathlib import Path
from typing import Annotated

import typer

from echelon.apps.cli.console import print_file
from echelon.apps.cli.options import OverwriteOption, RunArgument
from echelon.apps.cli.status import STATUS
from echelon.core.errors import OutputError
from echelon.output.archive.folder import claim_file, write_errors

_LEAST, _MOST = 320, 3840
"""Pixels across."""


def video(
    run: RunArgument,
    file: Annotated[Path, typer.Argument(help="The video file, ending in .mp4 or .gif.")],
    speed: Annotated[float, typer.Option(help="Playback speed; 2 plays twice as fast.")] = 1.0,
    size: Annotated[
        str | None,
        typer.Option(metavar="WxH", help="Pixels (default: 960x540, of a GIF 640x360)."),
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
    from echelon.output.archive.load_folder import load
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
    print_file(file, f"{pictures} pictures, {{}}")


def _pixels(size: str) -> tuple[int, int]:
    """Return width and height.

    Raises:
        OutputError: the text is no size that a video can have.
    """
    found = re.fullmatch(r"(\d{1,5})x(\d{1,5})", size)
    width, height = map(int, found.groups()) if found else (0, 0)
    fits = _LEAST <= width <= _MOST and width / 3 <= height <= 1.5 * width
    if not fits or width % 2 or height % 2:
        raise OutputError(
            f"`--size` is `{size}`, and must be even numbers of pixels as in `960x540`, "
            f"{_LEAST} to {_MOST} across and a third to 1.5 of that high."
        )
    return width, height
