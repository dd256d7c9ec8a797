"""The folders of sweeps and comparisons: runs as they are computed, then datasets and figures."""

import csv
import hashlib
import io
import json
import math
import re
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, final

import numpy as np

from echelon.core.errors import OutputError
from echelon.core.files import INPUTS, make_atomic, write_atomic
from echelon.core.types import JsonObject
from echelon.experiments.results.dataset import save_dataset
from echelon.experiments.scenario.scenario import SCENARIO_FILE, Scenario, load_scenario
from echelon.experiments.studies.compare import Comparison, ComparisonRow
from echelon.experiments.studies.seed_comparison import (
    NUMBERS,
    SeedComparison,
    SeedRun,
    SeedStore,
)
from echelon.experiments.sweeps.plan import Sweep, read_axes
from echelon.experiments.sweeps.sweep_dataset import SweepBatch, axis_values, write_frames
from echelon.output.archive.chunks import Chunks
from echelon.output.archive.folder import BATCHES, FRAMES, RUNS, write_errors

if TYPE_CHECKING:
    import xarray as xr

_OVER, _COMPARED = "over.json", "compared.json"


@final
class Batches:
    """The batches of a sweep in its folder, each in a file named by its first run."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.chunks = folder, Chunks(folder, BATCHES)
        self.frames = Chunks(folder, f"{BATCHES}/frames")

    def begin(self, plan: Sweep) -> None:
        """Write the scenario and the axes, before anything is computed.

        Raises:
            OutputError: a file cannot be written.
        """
        over = {"over": [axis.text for axis in plan.axes], "keep_states": plan.every}
        self.chunks.begin(plan.scenario, {_OVER: json.dumps(over) + "\n"})
        if plan.frames is not None:
            with write_errors(self.folder):
                self.frames.place.mkdir(exist_ok=True)
            self._check_room(8 * plan.count * plan.frames.numbers)

    def _check_room(self, size: int) -> None:
        """Check that the disk has room for the frames, in batches and then in one file."""
        free = shutil.disk_usage(self.folder).free
        if 2 * size > free:
            raise OutputError(
                f"the states of all runs take {2 * size / 2**30:.3g} GiB, and {free / 2**30:.3g} "
                f"GiB are free in `{self.folder}`; store fewer, with a larger `--keep-states`."
            )

    def plan(self) -> Sweep:
        """Return the sweep that was begun here.

        Raises:
            OutputError: there is none, or its inputs or versions changed.
        """
        self.chunks.check()
        begun = json.loads((self.folder / INPUTS / _OVER).read_text("utf-8"))
        scenario = load_scenario(self.folder / SCENARIO_FILE)
        return Sweep(scenario, read_axes(begun["over"]), begun["keep_states"])

    def write(self, batch: SweepBatch) -> None:
        """Write a batch completely or not at all.

        Raises:
            OutputError: it cannot be written.
        """
        with write_errors(self.folder):
            # Frames first: a batch whose numbers are stored is complete.
            if batch.frames is not None:
                self.frames.store(batch.first, batch.frames)
            self.chunks.store(batch.first, batch.columns)

    def read(self) -> list[SweepBatch]:
        """Return the batches that are stored completely, without their frames."""
        names = (file.stem for file in self.chunks.place.glob("*.npz"))
        firsts = sorted(int(name) for name in names if name.isdigit())
        stored = ((first, self.chunks.stored(first)) for first in firsts)
        return [SweepBatch(first, columns) for first, columns in stored if columns is not None]

    def write_frames(self, plan: Sweep) -> None:
        """Write the frames of all runs into one file, if the sweep stores them.

        Raises:
            OutputError: it cannot be written, or the frames of a batch are damaged.
        """
        if plan.frames is None:
            return
        stored = ((batch.first, self._frames(batch.first)) for batch in self.read())
        with write_errors(self.folder):
            make_atomic(
                self.folder / FRAMES,
                lambda part: write_frames(plan, axis_values(plan), stored, part),
            )

    def _frames(self, first: int) -> JsonObject:
        frames = self.frames.stored(first)
        if frames is None:
            numbers = f"{self.chunks.place}/{first}.npz"
            raise OutputError(f"`{numbers}` has lost its states; delete it, and resume the sweep.")
        return frames


def write_sweep(data: "xr.Dataset", text: str, folder: Path, figures: bool = True) -> None:
    """Write the dataset of a sweep, its report and the figures.

    Raises:
        OutputError: a file cannot be written.
    """
    with write_errors(folder):
        # In memory first: on a full disk the HDF5 library would end the whole process.
        write_atomic(folder / "sweep.nc", bytes(data.to_netcdf(None, engine="h5netcdf")))
        write_atomic(folder / "sweep.txt", text + "\n")
        if figures:
            # Here, since matplotlib takes long to load and only figures need it.
            from echelon.output.plots.study_figures import save_sweep_figures

            save_sweep_figures(data, folder)


@final
class Flights:
    """The datasets of a comparison, each written as soon as its run is complete."""

    def __init__(self, folder: Path) -> None:
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


@final
class SeedBatches:
    """The runs of a comparison over seeds in its folder, from which it can be continued."""

    def __init__(self, folder: Path) -> None:
        self.chunks = Chunks(folder / RUNS, BATCHES)

    @property
    def store(self) -> SeedStore:
        """What keeps runs here, and reads them."""
        return SeedStore(self._read, self._write)

    def begin(self, scenario: Scenario, methods: Sequence[str], seeds: Sequence[int]) -> None:
        """Write the inputs, before anything is computed.

        Raises:
            OutputError: a file cannot be written.
        """
        inputs = {"methods": [*methods], "seeds": [*seeds], "laws": _digests(methods)}
        with write_errors(self.chunks.folder):
            self.chunks.place.mkdir(parents=True, exist_ok=True)
        self.chunks.begin(scenario, {_COMPARED: json.dumps(inputs) + "\n"})

    def begun(self) -> tuple[Scenario, tuple[str, ...], tuple[int, ...]]:
        """Return the scenario, the methods and the seeds of the comparison that was begun here.

        Raises:
            OutputError: there is none, or its inputs or versions changed.
        """
        self.chunks.check()
        folder = self.chunks.folder
        inputs = json.loads((folder / INPUTS / _COMPARED).read_text("utf-8"))
        now = _digests(inputs["methods"])
        for file in (file for file, digest in inputs["laws"].items() if now[file] != digest):
            raise OutputError(
                f"`{file}` is not the file with which the comparison in `{folder}` began, so it "
                "cannot be continued; begin a new one."
            )
        scenario = load_scenario(folder / SCENARIO_FILE)
        return scenario, tuple(inputs["methods"]), tuple(inputs["seeds"])

    def _read(self, number: int) -> list[SeedRun] | None:
        stored = self.chunks.stored(number)
        if stored is None:
            return None
        return [SeedRun(*run) for run in zip(*(stored[name].tolist() for name in SeedRun._fields))]

    def _write(self, number: int, runs: Sequence[SeedRun]) -> None:
        columns = dict(zip(SeedRun._fields, map(np.array, zip(*runs)), strict=True))
        self.chunks.store(number, columns)


def _digests(methods: Sequence[str]) -> dict[str, str]:
    """Return the SHA-256 of the files of users' laws; empty where one cannot be read."""
    files = (re.search(r"(?:python:\s*)?([^\"'{}]+\.py):", method) for method in methods)
    named = [Path(found[1]) for found in files if found is not None]
    content = ((file, file.read_bytes() if file.is_file() else b"") for file in named)
    return {str(file): data and hashlib.sha256(data).hexdigest() or "" for file, data in content}


def write_comparison(
    comparison: Comparison | SeedComparison,
    summary: JsonObject,
    text: str,
    folder: Path,
    figures: bool = True,
) -> None:
    """Write the numbers of a comparison, its text and the figures; over seeds also a table.

    Raises:
        OutputError: a file cannot be written.
    """
    with write_errors(folder):
        content = json.dumps(summary, indent=2, allow_nan=False)
        write_atomic(folder / "comparison.json", content + "\n")
        write_atomic(folder / "comparison.txt", text + "\n")
        if isinstance(comparison, SeedComparison):
            write_atomic(folder / RUNS / "seeds.csv", _table(comparison))
        if figures:
            # Here, since matplotlib takes long to load and only figures need it.
            from echelon.output.plots.study_figures import save_comparison_figures

            save_comparison_figures(comparison, folder)


def _table(comparison: SeedComparison) -> str:
    """Return the numbers of all runs as CSV, a run in each line; empty where one has none."""
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow(["method", "seed", "outcome", *NUMBERS])
    for row in comparison.rows:
        columns = [row.numbers[name].tolist() for name in NUMBERS if row.numbers]
        for seed, outcome, *numbers in zip(comparison.seeds, row.outcomes, *columns):
            cells = ["" if math.isnan(number) else repr(number) for number in numbers]
            table.writerow([row.label, seed, outcome, *cells])
    return text.getvalue()
