"""The folder of a comparison: numbers, text, each run's dataset, and the figures."""

import json
from pathlib import Path
from typing import Any, final

from echelon.core.files import write_atomic
from echelon.experiments.results.dataset import save_dataset
from echelon.experiments.studies.compare import Comparison, ComparisonRow
from echelon.output.archive.folder import RUNS, unwritable


@final
class Flights:
    """The datasets of a comparison, each written as soon as it is there.

    Args:
        folder: of the comparison.
    """

    def __init__(self, folder: Path) -> None:
        """Begin with nothing that went wrong."""
        self.folder = folder
        self.error: OSError | None = None

    def write(self, row: ComparisonRow) -> None:
        """Write what a method flew; where that fails, the comparison goes on."""
        # A method that was refused or failed to begin has no run, and a row all the same.
        if row.flight is None:
            return
        try:
            (self.folder / RUNS).mkdir(parents=True, exist_ok=True)
            save_dataset(row.flight.result, self.folder / RUNS / f"{row.label}.nc")
        except OSError as error:
            # The first: what fails after it mostly fails of the same.
            self.error = self.error or error

    def check(self) -> None:
        """Check that all were written.

        Raises:
            OutputError: one could not be.
        """
        if self.error is not None:
            raise unwritable(self.folder, self.error) from self.error


def write_comparison(
    comparison: Comparison, summary: dict[str, Any], text: str, folder: Path, figures: bool = True
) -> None:
    """Write the numbers of a comparison, its text and the figures.

    Raises:
        OutputError: a file cannot be written.
    """
    try:
        content = json.dumps(summary, indent=2, allow_nan=False)
        write_atomic(folder / "comparison.json", content + "\n")
        write_atomic(folder / "comparison.txt", text + "\n")
        if figures:
            # Here, since matplotlib takes long to load, and numbers alone need none of it.
            from echelon.output.plots.comparison_figures import save_comparison_figures

            save_comparison_figures(comparison, folder)
    except OSError as error:
        raise unwritable(folder, error) from error
