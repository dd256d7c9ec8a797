"""The folder of a run: dataset, scenario, summary, report and figures."""

import json
from pathlib import Path
from typing import Any

from echelon.archive.folder import claim_folder, unwritable
from echelon.core.types import PathLike
from echelon.engine.result import Result
from echelon.reports.run import report
from echelon.results.dataset import save_dataset, summary
from echelon.results.lyapunov import lyapunov


def save_run(
    result: Result, folder: PathLike | None = None, figures: bool = True, force: bool = False
) -> Path:
    """Write all that `echelon run` writes, and return the folder.

    Args:
        result: the run.
        folder: new or empty; `runs/<name>-<time>` when left out.
        figures: whether to draw the figures, each as PNG and PDF.
        force: whether to replace an earlier run in the folder.

    Raises:
        OutputError: the folder holds something, or cannot be written.
    """
    name = result.provenance.get("scenario") or type(result.model).__name__
    place = claim_folder(name, None if folder is None else Path(folder), force)
    # The data first: a figure that fails then costs no run.
    write_data(result, place)
    write_findings(result, place, figures)
    return place


def write_data(result: Result, folder: Path) -> None:
    """Write a run's dataset and scenario: what must not be lost, before all else.

    Raises:
        OutputError: a file cannot be written.
    """
    try:
        # A run from Python has no scenario file.
        if "scenario_text" in result.provenance:
            text = result.provenance["scenario_text"]
            (folder / "scenario.yaml").write_text(text, "utf-8")
        save_dataset(result, folder / "run.nc")
    except OSError as error:
        raise unwritable(folder, error) from error


def write_findings(result: Result, folder: Path, figures: bool = True) -> dict[str, Any]:
    """Write what is made of a run: summary, report and figures; return the summary.

    Raises:
        OutputError: a file cannot be written.
    """
    numbers = summary(result)
    try:
        # NaN is no JSON: whoever reads the file with another parser would stop there.
        content = json.dumps(numbers, indent=2, allow_nan=False)
        (folder / "summary.json").write_text(content + "\n", "utf-8")
        (folder / "report.txt").write_text(report(result) + "\n", "utf-8")
        if figures and len(result.times):
            # Here, since matplotlib takes long to load, and a run without figures needs none of it.
            from echelon.plots.run import save_figures

            v = lyapunov(result)
            save_figures(result, folder, None if v is None else (v.value, v.rate))
    except OSError as error:
        raise unwritable(folder, error) from error
    return numbers
