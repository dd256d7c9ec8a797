"""Output shared by commands: progress, the guarantee of a run, and the files written."""

import contextlib
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from echelon.core.files import write_atomic
from echelon.output.archive.folder import write_errors

if TYPE_CHECKING:
    from rich.progress import ProgressColumn

    from echelon.experiments.scenario.build import Experiment


@contextlib.contextmanager
def show_progress(quiet: bool, unit: str = "steps") -> Iterator[Callable[[int, int], None]]:
    """Show steps and time left on standard error, if it is a terminal and not `quiet`."""
    if quiet or not sys.stderr.isatty():
        yield lambda done, total: None
        return
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeRemainingColumn,
    )

    columns: tuple[ProgressColumn, ...] = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn(f"{unit}, left"),
        TimeRemainingColumn(),
    )
    # Standard error, so that the bar is visible while the report goes into a file.
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task("simulating", total=None)
        yield lambda done, total: bar.update(task, completed=done, total=total)


def foretell(experiment: "Experiment", quiet: bool) -> None:
    """Print the guarantee of a run on a terminal; anywhere, if nothing is guaranteed."""
    if quiet:
        return
    from echelon.experiments.studies.forecast import forecast
    from echelon.guarantees.promises.promise import promise

    if sys.stderr.isatty() or not promise(*experiment).promised:
        print(f"echelon: {forecast(*experiment)}", file=sys.stderr, flush=True)


def print_folder(folder: Path) -> None:
    """Print the names of all files in a folder."""
    names = sorted(path.name + ("/" if path.is_dir() else "") for path in folder.iterdir())
    print(f"- Written to {folder}: {', '.join(names)}.")


def write_file(file: Path, content: bytes | str, remark: str = "{}") -> None:
    """Write a file, and print its size as `print_file` does.

    Raises:
        OutputError: it cannot be written.
    """
    with write_errors(file):
        write_atomic(file, content)
    print_file(file, remark)


def print_file(file: Path, remark: str) -> None:
    """Print the size of a file, with a remark that goes before it or after it."""
    print(f"- Written to {file}: {remark.format(f'{file.stat().st_size / 1e6:.2f} MB')}.")
