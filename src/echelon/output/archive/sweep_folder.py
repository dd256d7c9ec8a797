"""The folder of a sweep: batches while it is computed, then the dataset and figures."""

import json
from pathlib import Path
from typing import TYPE_CHECKING, final

from echelon.core.files import INPUTS, write_atomic
from echelon.experiments.results.labelled import labelled
from echelon.experiments.scenario.scenario import SCENARIO_FILE, load_scenario
from echelon.experiments.sweeps.axes import read_axes
from echelon.experiments.sweeps.plan import Sweep
from echelon.experiments.sweeps.workers import SweepBatch
from echelon.output.archive.chunks import Chunks
from echelon.output.archive.folder import BATCHES, write_errors

if TYPE_CHECKING:
    import xarray as xr

_OVER = "over.json"


@final
class Batches:
    """The batches of a sweep in its folder, each in a file named by its first run.

    Args:
        folder: of the sweep.
    """

    def __init__(self, folder: Path) -> None:
        """Use a folder, which may not exist yet."""
        self.folder, self.chunks = folder, Chunks(folder, BATCHES)

    def begin(self, plan: Sweep) -> None:
        """Write the scenario and the axes, before anything is computed.

        Raises:
            OutputError: a file cannot be written.
        """
        over = json.dumps([axis.text for axis in plan.axes])
        self.chunks.begin(plan.scenario, {_OVER: over + "\n"})

    def plan(self) -> Sweep:
        """Return the sweep that was begun here.

        Raises:
            OutputError: there is none, or its inputs or versions changed.
        """
        self.chunks.check()
        over = json.loads((self.folder / INPUTS / _OVER).read_text("utf-8"))
        return Sweep(load_scenario(self.folder / SCENARIO_FILE), read_axes(over))

    def write(self, batch: SweepBatch) -> None:
        """Write a batch completely or not at all.

        Raises:
            OutputError: it cannot be written.
        """
        with write_errors(self.folder):
            self.chunks.store(batch.first, batch.columns)

    def read(self) -> list[SweepBatch]:
        """Return the batches that are stored completely."""
        names = (file.stem for file in self.chunks.place.glob("*.npz"))
        firsts = sorted(int(name) for name in names if name.isdigit())
        stored = ((first, self.chunks.stored(first)) for first in firsts)
        return [SweepBatch(first, columns) for first, columns in stored if columns is not None]


def write_sweep(data: "xr.Dataset", text: str, folder: Path, figures: bool = True) -> None:
    """Write the dataset of a sweep, its report and the figures.

    Raises:
        OutputError: a file cannot be written.
    """
    with write_errors(folder):
        # In memory first: on a full disk the HDF5 library would end the whole process.
        write_atomic(folder / "sweep.nc", labelled(data).netcdf())
        write_atomic(folder / "sweep.txt", text + "\n")
        if figures:
            # Here, since matplotlib takes long to load and only figures need it.
            from echelon.output.plots.sweep_figures import save_sweep_figures

            save_sweep_figures(data, folder)
