"""What the commands share: their common options, and what they show while they work."""

import contextlib
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from echelon.experiments.scenario.build import Experiment

JsonOption = Annotated[bool, typer.Option("--json", help="Print JSON instead of tables.")]
ScenarioArgument = Annotated[str, typer.Argument(help="A bundled scenario's name, or a YAML file.")]


@contextlib.contextmanager
def show_progress(
    quiet: bool, what: str = "steps"
) -> "Iterator[Callable[[int, int], None] | None]":
    """Show steps and time left on standard error while a run lasts, where someone watches."""
    if quiet or not sys.stderr.isatty():
        yield None
        return
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeRemainingColumn,
    )

    columns: tuple[Any, ...] = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn(f"{what}, left"),
        TimeRemainingColumn(),
    )
    # Standard error, so that the bar is seen while the report goes into a file.
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task("simulating", total=None)
        yield lambda done, total: bar.update(task, completed=done, total=total)


def foretell(built: "Experiment", quiet: bool) -> None:
    """Say on standard error what is promised of a run, and always if nothing is."""
    if quiet:
        return
    from echelon.experiments.studies.forecast import outlook
    from echelon.guarantees.promises.promise import promise

    if sys.stderr.isatty() or not promise(*built).promised:
        print(f"echelon: {outlook(*built)}", file=sys.stderr, flush=True)


def announce(quiet: bool) -> "Callable[[str], None]":
    """Return what tells on standard error which method is flying, where someone watches."""
    if quiet or not sys.stderr.isatty():
        return lambda label: None
    return lambda label: print(f"flying {label} ...", file=sys.stderr)


def written(folder: Path) -> str:
    """Return the names of what lies in a folder."""
    names = sorted(path.name + ("/" if path.is_dir() else "") for path in folder.iterdir())
    return ", ".join(names)
