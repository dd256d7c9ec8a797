"""The folder of a comparison: numbers, text, each run's dataset, and the figures."""

import json
from pathlib import Path
from typing import Any

from echelon.archive.folder import unwritable
from echelon.core.files import write_whole
from echelon.results.dataset import save_dataset
from echelon.studies.compare import Comparison


def write_comparison(
    comparison: Comparison, summary: dict[str, Any], text: str, folder: Path, figures: bool = True
) -> None:
    """Write a comparison: numbers, text, each run's dataset under `runs`, and the figures.

    Raises:
        OutputError: a file cannot be written.
    """
    try:
        (folder / "runs").mkdir(parents=True, exist_ok=True)
        for row in comparison.rows:
            # A method that was refused or failed to begin has no run, and a row all the same.
            if row.flight is not None:
                save_dataset(row.flight.result, folder / "runs" / f"{row.label}.nc")
        content = json.dumps(summary, indent=2, allow_nan=False)
        write_whole(folder / "comparison.json", content + "\n")
        write_whole(folder / "comparison.txt", text + "\n")
        if figures:
            # Here, since matplotlib takes long to load, and numbers alone need none of it.
            from echelon.plots.comparison import save_comparison_figures

            save_comparison_figures(comparison, folder)
    except OSError as error:
        raise unwritable(folder, error) from error
