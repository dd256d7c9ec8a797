"""`echelon video`: a run as MP4 or GIF."""

from pathlib import Path
from typing import Annotated

import typer

from echelon.apps.cli.console import print_file
from echelon.apps.cli.options import OverwriteOption, RunArgument
from echelon.apps.cli.status import STATUS
from echelon.core.errors import OutputError
from echelon.output.archive.folder import claim_file, write_errors


def video(
    run: RunArgument,
    file: Annotated[Path, typer.Argument(help="The video file, ending in .mp4 or .gif.")],
    speed: Annotated[float, typer.Option(help="Playback speed; 2 plays twice as fast.")] = 1.0,
    force: OverwriteOption = False,
) -> None:
    """Draw a run as a video, without a browser."""
    if not 0.01 <= speed <= 100.0:
        raise OutputError(f"`--speed` is {speed:g}, and must be from 0.01 to 100.")
    claim_file(file, force, endings=(".mp4", ".gif"))
    STATUS.begin(f"reading {run}")
    from echelon.output.archive.load_folder import load
    from echelon.output.plots.video import encoder, save_video

    # Before the run is read, so that a missing ffmpeg is reported at once.
    encoder()
    with write_errors(file):
        pictures = save_video(load(run), file, speed)
    print_file(file, f"{pictures} pictures, {{}}")
