"""`echelon export`: a run's numbers for other programs."""

from pathlib import Path
from typing import Annotated

import typer

from echelon.apps.cli.view_command import ForceOption, RunArgument, check_target


def export(
    run: RunArgument,
    to: Annotated[str, typer.Option("--to", help="csv, parquet, npz or mat.")] = "csv",
    out: Annotated[Path | None, typer.Option(help="The file; default run.csv and so on.")] = None,
    force: ForceOption = False,
) -> None:
    """Write a run's states, inputs and errors for pandas, NumPy, MATLAB or a spreadsheet."""
    from echelon.output.archive.export import export as write
    from echelon.output.archive.open_folder import open_run

    file = Path(f"run.{to}") if out is None else out
    check_target(file, force)
    write(open_run(run), file, to)
    print(f"- Written to {file}: {file.stat().st_size / 1e6:.2f} MB.")
