"""`echelon report`: all that is known of a run, as text."""

from pathlib import Path
from typing import Annotated

import typer

from echelon.apps.cli.options import OverwriteOption, RunArgument
from echelon.apps.cli.tables import write_file
from echelon.apps.cli.terminal import STATUS
from echelon.core.errors import OutputError
from echelon.core.gone import VALUES, gone
from echelon.output.archive.folder import claim_file


def report(
    run: RunArgument,
    out: Annotated[
        Path | None, typer.Option(metavar="FILE.txt", help="Write it to this file instead.")
    ] = None,
    force: OverwriteOption = False,
) -> None:
    """Print a run's numbers, the conditions of its guarantee, versions, and how to cite."""
    if out is not None:
        if ended := gone(VALUES, f"report --out {out.suffix.lower()}"):
            raise OutputError(f"a report as `{out.suffix}`{ended}")
        claim_file(out, force)
    STATUS.begin(f"reading {run}")
    from echelon.experiments.results.recording import recording_of
    from echelon.output.archive.run_folder import load, report_beside
    from echelon.output.reports.run_report import whole_report

    text = whole_report(recording_of(load(run)), report_beside(run))
    if out is None:
        print(text)
    else:
        write_file(out, text + "\n")
