"""The folder of a run: dataset, scenario, summary, report and figures."""

import json
from pathlib import Path

from echelon.core.errors import OutputError
from echelon.core.files import write_atomic
from echelon.core.types import PathLike
from echelon.experiments.results.dataset import labelled, save_dataset, summary
from echelon.experiments.results.recording import recording
from echelon.experiments.scenario.build import build, note_origin
from echelon.experiments.scenario.scenario import KEPT, load_scenario
from echelon.output.archive.chunks import Chunks
from echelon.output.archive.folder import DATA, GAIN, SUMMARY, claim_folder, write_errors
from echelon.output.reports.run_report import report
from echelon.simulation.engine.result import Result
from echelon.simulation.engine.simulate import reassemble
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
    place = claim_folder(name, None if folder is None else Path(folder), force)
    # A run from Python has no scenario file.
    if "scenario_text" in result.provenance:
        with write_errors(place):
            write_atomic(place / KEPT, result.provenance["scenario_text"])
    write_findings(result, place, figures)
    Chunks(place).remove()
    return place


def load_run(folder: PathLike) -> Result:
    """Return what was computed of a run that was stopped before its horizon.

    A complete run is in its `run.nc`, which `open_run` and xarray read.

    Args:
        folder: of the run, as `echelon run` created it.

    Raises:
        OutputError: the folder holds no unfinished run.
        ScenarioError: its scenario cannot be read.
    """
    place = Path(folder)
    if not Chunks(place).exist:
        if (place / DATA).is_file():
            raise OutputError(f"the run in `{place}` is complete; open its `{DATA}`.")
        raise OutputError(f"`{place}` holds no unfinished run; give the folder of one.")
    scenario = load_scenario(place / KEPT)
    return note_origin(reassemble(*build(scenario), Chunks(place).read()), scenario)


def write_findings(result: Result, folder: Path, figures: bool = True) -> None:
    """Write the dataset of a run, then summary, report and figures.

    Raises:
        OutputError: a file cannot be written.
    """
    with write_errors(folder):
        # The data first, so that a figure that fails loses nothing.
        data = labelled(result)
        save_dataset(data, folder / DATA)
        # NaN is not JSON, and other parsers refuse it.
        content = json.dumps(summary(result), indent=2, allow_nan=False)
        write_atomic(folder / SUMMARY, content + "\n")
        write_atomic(folder / "report.txt", report(result) + "\n")
        if result.drive.gain is not None:
            save_gain(result.drive.gain, result.model, result.graph, folder / GAIN)
        if figures and len(result.times):
            # Here, since matplotlib takes long to load and only figures need it.
            from echelon.output.plots.run_figures import save_figures

            save_figures(recording(data.arrays(), data.attributes), folder)
