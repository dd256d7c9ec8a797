"""`echelon report`: a run as one HTML page."""

from pathlib import Path
from typing import Annotated

import typer

from echelon.apps.cli.view_command import ForceOption, RunArgument, check_target
from echelon.core.errors import OutputError


def report(
    run: RunArgument,
    out: Annotated[Path | None, typer.Option(help="The page; default report.html.")] = None,
    force: ForceOption = False,
) -> None:
    """Write a run as one HTML page: table, promise, figures, scenario, versions, how to cite."""
    file = Path("report.html") if out is None else out
    check_target(file, force)
    from echelon.core.files import write_atomic
    from echelon.output.archive.open_folder import open_run
    from echelon.output.archive.report_page import report_page

    page = report_page(open_run(run), run if run.is_dir() else None)
    try:
        write_atomic(file, page)
    except OSError as error:
        raise OutputError(f"`{file}` cannot be written: {error.strerror or error}.") from error
    print(f"- Written to {file}: {len(page) / 1e6:.2f} MB, one file that needs no network.")
