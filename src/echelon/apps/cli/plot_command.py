"""`echelon plot`: the figures of a run, drawn again from its data."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from echelon.apps.cli.options import OverwriteOption, RunArgument
from echelon.apps.cli.status import STATUS
from echelon.core.errors import OutputError, listing
from echelon.output.archive.folder import claim_files, write_errors
from echelon.output.plots.figure_files import NAMES, check_names, save

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_KINDS = ("png", "pdf", "svg")
_LEAST, _MOST = 30, 1200


def plot(
    run: RunArgument,
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
    """Draw a run's figures again, as PNG, PDF and SVG."""
    if dpi is not None and not _LEAST <= dpi <= _MOST:
        raise OutputError(f"`--dpi` is {dpi}, and must be from {_LEAST} to {_MOST}.")
    names = NAMES if what is None else tuple(filter(None, map(str.strip, what.split(","))))
    check_names(names)
    STATUS.begin(f"reading {run}")
    folder = (run if run.is_dir() else run.parent) / "figures" if out is None else out
    drawings = _drawings(run, names, paper)
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


def _drawings(run: Path, names: Sequence[str], paper: bool) -> "dict[str, Figure]":
    """Return the figures of a run in all sizes, by the names of their files."""
    from echelon.output.archive.load_folder import load
    from echelon.output.plots.run_figures import figures
    from echelon.output.plots.style import ONE_COLUMN, SCREEN, TWO_COLUMNS

    result = load(run)
    pages = {"_one_column": ONE_COLUMN, "_two_columns": TWO_COLUMNS} if paper else {"": SCREEN}
    return {
        f"{name}{suffix}": figure
        for suffix, page in pages.items()
        for name, figure in figures(result, names, page).items()
    }
