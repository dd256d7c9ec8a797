"""`echelon video`: a run as MP4 or GIF."""

from pathlib import Path
from typing import Annotated

import typer

from echelon.apps.cli.view_command import ForceOption, RunArgument, check_target
from echelon.core.errors import OutputError


def video(
    run: RunArgument,
    file: Annotated[Path, typer.Argument(help="The video, ending in .mp4 or .gif.")],
    speed: Annotated[float, typer.Option(help="How many times as fast as it was.")] = 1.0,
    force: ForceOption = False,
) -> None:
    """Draw a run as a video, without a browser."""
    if not 0.01 <= speed <= 100.0:
        raise OutputError(f"`--speed` is {speed:g}, and must be from 0.01 to 100.")
    check_target(file, force)
    from echelon.output.archive.open_folder import open_run
    from echelon.output.plots.video import encoder, save_video

    # Before the run is read: who has no ffmpeg need not wait.
    encoder()
    try:
        pictures = save_video(open_run(run), file, speed)
    except OSError as error:
        raise OutputError(f"`{file}` cannot be written: {error.strerror or error}.") from error
    print(f"- Written to {file}: {pictures} pictures, {file.stat().st_size / 1e6:.2f} MB.")
