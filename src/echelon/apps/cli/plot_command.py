"""`echelon plot`: the figures of a run, drawn again from its data."""

from pathlib import Path
from typing import Annotated

import typer

from echelon.apps.cli.view_command import ForceOption, RunArgument
from echelon.core.errors import OutputError

_KINDS = ("png", "pdf", "svg")
_LEAST, _MOST = 30, 1200


def plot(
    run: RunArgument,
    what: Annotated[
        str | None,
        typer.Option(
            metavar="NAME,...",
            help="Only these: leader_3d, trajectories, top_view, tracking, formation, inputs, "
            "states, distances, lyapunov, modes, network.",
        ),
    ] = None,
    paper: Annotated[
        bool, typer.Option("--paper", help="For one and for two columns of a page, 8 pt letters.")
    ] = False,
    dpi: Annotated[
        int | None, typer.Option(help="Of the PNG; default 150, with --paper 300.")
    ] = None,
    out: Annotated[
        Path | None, typer.Option(help="Output folder; default the run's own figures/.")
    ] = None,
    force: ForceOption = False,
) -> None:
    """Draw a run's figures again, at any time, as PNG, PDF and SVG."""
    if dpi is not None and not _LEAST <= dpi <= _MOST:
        raise OutputError(f"`--dpi` is {dpi}, and must be from {_LEAST} to {_MOST}.")
    from echelon.output.archive.open_folder import open_run
    from echelon.output.plots.figure_files import save
    from echelon.output.plots.run_figures import NAMES, figures
    from echelon.output.plots.style import ONE_COLUMN, SCREEN, TWO_COLUMNS

    recording = open_run(run)
    names = NAMES if what is None else tuple(filter(None, map(str.strip, what.split(","))))
    folder = (run if run.is_dir() else run.parent) / "figures" if out is None else out
    pages = {"_one_column": ONE_COLUMN, "_two_columns": TWO_COLUMNS} if paper else {"": SCREEN}
    made = {
        f"{name}{suffix}": figure
        for suffix, page in pages.items()
        for name, figure in figures(recording, names, page).items()
    }
    if not made:
        raise OutputError("the run has nothing to draw in these figures.")
    _check_folder(folder, [f"{name}.{kind}" for name in made for kind in _KINDS], out, force)
    try:
        paths = save(made, folder, _KINDS, dpi or (300 if paper else 150))
    except OSError as error:
        raise OutputError(f"`{folder}` cannot be written: {error.strerror or error}.") from error
    told = ", ".join(dict.fromkeys(path.stem for path in paths))
    print(f"- Written to {folder}: {told}, each as {', '.join(k.upper() for k in _KINDS)}.")


def _check_folder(folder: Path, names: list[str], out: Path | None, force: bool) -> None:
    """Check that no other file is lost; those in a run's own folder are drawn again."""
    if folder.exists() and not folder.is_dir():
        raise OutputError(f"`{folder}` is a file, and the output must be a folder.")
    taken = [name for name in names if out is not None and (folder / name).exists()]
    if taken and not force:
        raise OutputError(
            f"the file `{folder / taken[0]}` exists; choose another folder, or `--force` to "
            "replace it."
        )
