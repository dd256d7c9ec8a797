"""The folder of a sweep: the batches that are done, and in the end the dataset and its figures."""

import json
from pathlib import Path
from typing import TYPE_CHECKING, final

from echelon.core.files import write_atomic
from echelon.experiments.scenario.scenario import KEPT, load_scenario
from echelon.experiments.sweeps.axes import read_axes
from echelon.experiments.sweeps.plan import Sweep
from echelon.experiments.sweeps.workers import SweepBatch
from echelon.output.archive.chunks import Chunks
from echelon.output.archive.folder import BATCHES, INPUTS, unwritable

if TYPE_CHECKING:
    import xarray as xr

_OVER = "over.json"


@final
class Batches:
    """What a sweep leaves in its folder while it lasts: a file a batch, named by its first run.

    Args:
        folder: of the sweep.
    """

    def __init__(self, folder: Path) -> None:
        """Take the folder."""
        self.folder, self.chunks = folder, Chunks(folder, BATCHES)

    def begin(self, plan: Sweep) -> None:
        """Write the scenario and what varies, before anything is computed.

        Raises:
            OutputError: a file cannot be written.
        """
        over = json.dumps([axis.text for axis in plan.axes])
        self.chunks.begin(plan.scenario, {_OVER: over + "\n"})

    def plan(self) -> Sweep:
        """Return the sweep that was begun here.

        Raises:
            OutputError: there is none, or it cannot go on to the same bits.
        """
        self.chunks.check()
        over = json.loads((self.folder / INPUTS / _OVER).read_text("utf-8"))
        return Sweep(load_scenario(self.folder / KEPT), read_axes(over))

    def write(self, batch: SweepBatch) -> None:
        """Write a batch, whole or not at all.

        Raises:
            OutputError: it cannot be written.
        """
        try:
            self.chunks.store(batch.first, batch.columns)
        except OSError as error:
            raise unwritable(self.folder, error) from error

    def read(self) -> list[SweepBatch]:
        """Return the batches that are whole."""
        names = (file.stem for file in self.chunks.place.glob("*.npz"))
        firsts = sorted(int(name) for name in names if name.isdigit())
        stored = ((first, self.chunks.stored(first)) for first in firsts)
        return [SweepBatch(first, columns) for first, columns in stored if columns is not None]


def write_sweep(data: "xr.Dataset", text: str, folder: Path, figures: bool = True) -> None:
    """Write the dataset of a sweep, what it shows in words, and the figures.

    Raises:
        OutputError: a file cannot be written.
    """
    try:
        # In memory first: on a disk that is full the library under it ends the whole process.
        write_atomic(folder / "sweep.nc", bytes(data.to_netcdf(None, engine="h5netcdf")))
        write_atomic(folder / "sweep.txt", text + "\n")
        if figures:
            # Here, since matplotlib takes long to load, and numbers alone need none of it.
            from echelon.output.plots.sweep_figures import save_sweep_figures

            save_sweep_figures(data, folder)
    except OSError as error:
        raise unwritable(folder, error) from error
