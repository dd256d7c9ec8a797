"""`echelon export`: a run's numbers for other programs."""

from pathlib import Path
from typing import Annotated

import typer

from echelon.apps.cli.console import write_file
from echelon.apps.cli.options import OverwriteOption, RunArgument
from echelon.apps.cli.status import STATUS
from echelon.output.archive.folder import claim_file


def export(
    run: RunArgument,
    to: Annotated[
        str, typer.Option("--to", help="csv, parquet, npz, mat, nc, json, html.")
    ] = "csv",
    out: Annotated[
        Path | None, typer.Option("--out", help="Output file (default: run.csv, run.npz, ...).")
    ] = None,
    force: OverwriteOption = False,
) -> None:
    """Write a run's states, inputs and errors for pandas, NumPy, MATLAB or a spreadsheet."""
    from echelon.output.archive.export import content_of

    content = content_of(to)
    file = Path(f"run.{to}") if out is None else out
    claim_file(file, force)
    STATUS.begin(f"reading {run}")
    from echelon.output.archive.load_folder import load

    write_file(file, content(load(run)))
