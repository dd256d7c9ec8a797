"""Output shared by commands: warnings and guarantee of a run, and the files written."""

import sys
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING

from echelon.apps.cli.status import STATUS
from echelon.core.files import write_atomic
from echelon.output.archive.folder import write_errors

if TYPE_CHECKING:
    from echelon.experiments.scenario.build import Experiment


def foretell(experiment: "Experiment", quiet: bool) -> None:
    """Print the warnings of a run, and its guarantee on a terminal or if nothing is guaranteed."""
    if quiet or STATUS.silent:
        return
    from echelon.experiments.studies.design import forecast
    from echelon.guarantees.promises.promise import promise
    from echelon.simulation.engine.prepare import prepare

    warn(prepare(*experiment).warnings)
    if sys.stderr.isatty() or not promise(*experiment).promised:
        print(f"echelon: {forecast(*experiment)}", file=sys.stderr, flush=True)


def warn(warnings: Iterable[str], quiet: bool = False) -> None:
    """Print warnings before what they warn of is computed, each on a line of standard error."""
    if not (quiet or STATUS.silent):
        for text in warnings:
            print(f"echelon: Warning: {text}", file=sys.stderr, flush=True)


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
