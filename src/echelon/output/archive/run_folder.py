"""The folder of a run: dataset, scenario, summary, report and figures."""

import json
from pathlib import Path

from echelon.core.files import write_atomic
from echelon.core.types import PathLike
from echelon.experiments.results.dataset import labelled, run_file
from echelon.experiments.results.recording import recording
from echelon.experiments.results.summary import summary
from echelon.experiments.scenario.scenario import SCENARIO_FILE
from echelon.output.archive.chunks import Chunks
from echelon.output.archive.folder import (
    DATA,
    GAIN,
    IN_PYTHON,
    REPORT,
    SUMMARY,
    claim_folder,
    write_errors,
)
from echelon.output.reports.run_report import report
from echelon.simulation.engine.result import Result
from echelon.synthesis.gains.gain_file import save_gain


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
    place = claim_folder(name, None if folder is None else Path(folder), force, how=IN_PYTHON)
    # A run from Python has no scenario file.
    if "scenario_text" in result.provenance:
        with write_errors(place):
            write_atomic(place / SCENARIO_FILE, result.provenance["scenario_text"])
            for each, content in result.files.items():
                (place / each).parent.mkdir(parents=True, exist_ok=True)
                write_atomic(place / each, content)
    write_findings(result, place, figures)
    Chunks(place).remove()
    return place


def report_beside(place: Path) -> str:
    """Return the report in the folder of a run, or beside its `run.nc`; empty without one."""
    folder = place.parent if place.name == DATA else place
    file = folder / REPORT
    return file.read_text("utf-8", "replace") if file.is_file() else ""


def write_findings(result: Result, folder: Path, figures: bool = True) -> None:
    """Write the dataset of a run, then summary, report and figures.

    Raises:
        OutputError: a file cannot be written.
    """
    with write_errors(folder):
        # The data first, so that a figure that fails loses nothing.
        data = labelled(result)
        write_atomic(folder / DATA, run_file(result, data))
        # NaN is not JSON, and other parsers refuse it.
        content = json.dumps(summary(result), indent=2, allow_nan=False)
        write_atomic(folder / SUMMARY, content + "\n")
        write_atomic(folder / REPORT, report(result) + "\n")
        if result.drive.gain is not None:
            save_gain(result.drive.gain, result.model, result.graph, folder / GAIN)
        if figures and len(result.times):
            # Here, since matplotlib takes long to load and only figures need it.
            from echelon.output.plots.run_figures import save_figures

            save_figures(recording(data.arrays(), data.attributes), folder)
