"""The folder of a comparison: numbers, text, the dataset of each run, and figures."""

import json
from pathlib import Path
from typing import final

from echelon.core.files import write_atomic
from echelon.core.types import JsonObject
from echelon.experiments.results.dataset import save_dataset
from echelon.experiments.studies.compare import Comparison, ComparisonRow
from echelon.output.archive.folder import RUNS, write_errors


@final
class Flights:
    """The datasets of a comparison, each written as soon as its run is complete.

    Args:
        folder: of the comparison.
    """

    def __init__(self, folder: Path) -> None:
        """Begin without an error."""
        self.folder = folder
        self.error: OSError | None = None

    def write(self, row: ComparisonRow) -> None:
        """Write the run of a method; the comparison continues if that fails."""
        # A method that was refused or failed to start has a row without a run.
        if row.flight is None:
            return
        try:
            (self.folder / RUNS).mkdir(parents=True, exist_ok=True)
            save_dataset(row.flight.result, self.folder / RUNS / f"{row.label}.nc")
        except OSError as error:
            # The first, since later errors mostly have the same cause.
            self.error = self.error or error

    def check(self) -> None:
        """Check that all datasets were written.

        Raises:
            OutputError: one was not.
        """
        with write_errors(self.folder):
            if self.error is not None:
                raise self.error


def write_comparison(
    comparison: Comparison, summary: JsonObject, text: str, folder: Path, figures: bool = True
) -> None:
    """Write the numbers of a comparison, its text and the figures.

    Raises:
        OutputError: a file cannot be written.
    """
    with write_errors(folder):
        content = json.dumps(summary, indent=2, allow_nan=False)
        write_atomic(folder / "comparison.json", content + "\n")
        write_atomic(folder / "comparison.txt", text + "\n")
        if figures:
            # Here, since matplotlib takes long to load and only figures need it.
            from echelon.output.plots.study_figures import save_comparison_figures

            save_comparison_figures(comparison, folder)
