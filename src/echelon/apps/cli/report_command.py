"""`echelon report`: a run as one HTML page."""

from pathlib import Path
from typing import Annotated

import typer

from echelon.apps.cli.options import OverwriteOption, RunArgument
from echelon.apps.cli.tables import write_file
from echelon.apps.cli.terminal import STATUS
from echelon.output.archive.folder import claim_file


def report(
    run: RunArgument,
    out: Annotated[Path, typer.Option(help="Output file.")] = Path("report.html"),
    force: OverwriteOption = False,
) -> None:
    """Write a run as one HTML page: table, guarantee, figures, scenario, versions, citation."""
    claim_file(out, force)
    STATUS.begin(f"reading {run}")
    from echelon.output.archive.load_folder import load
    from echelon.output.archive.report_page import report_page

    page = report_page(load(run), run if run.is_dir() else None)
    write_file(out, page, "{}, one self-contained file")
