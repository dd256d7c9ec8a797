"""Stored states and inputs of the runs of a sweep: every K-th step of each run."""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple, TypeAlias

import numpy as np

from echelon.core.errors import ScenarioError
from echelon.core.types import Array, JsonObject
from echelon.experiments.results.labelled import Labelled, Variables
from echelon.experiments.results.labelled_parts import labelled_parts
from echelon.experiments.scenario.build import Experiment
from echelon.simulation.engine.grid import ChunkGrid
from echelon.simulation.engine.result import Result

if TYPE_CHECKING:
    from echelon.experiments.sweeps.plan import Sweep

StoredFrames: TypeAlias = Mapping[str, Array]
"""`states` (runs, T, N, n) and `inputs` (runs, T, N, m); NaN where a run has none."""
NAMES = ("states", "inputs")
_CHUNK = 500_000
"""Numbers of a run that are read together from its file, 4 MB."""


class FrameShape(NamedTuple):
    """What the runs of a sweep that stores states have in common.

    Attributes:
        times: (T,) s.
        states, inputs: names.
        agents: their number N.
    """

    times: tuple[float, ...]
    states: tuple[str, ...]
    inputs: tuple[str, ...]
    agents: int

    @classmethod
    def of(cls, experiment: Experiment, every: int) -> "FrameShape":
        """Return the shape of a run that stores every so-manieth step."""
        parts, settings = experiment
        grid = ChunkGrid(settings._replace(store_every=every), 1)
        steps = np.arange(settings.steps + 1)
        times = settings.dt * steps[grid.stored(steps)]
        model = parts.model
        return cls(tuple(times), model.state_names, model.input_names, parts.graph.agents)

    @property
    def numbers(self) -> int:
        """How many numbers are stored of each run."""
        return len(self.times) * self.agents * (len(self.states) + len(self.inputs))

    def check(self, other: "FrameShape", key: str) -> None:
        """Check that a value of a key leaves the shape as it is.

        Raises:
            ScenarioError: it does not.
        """
        if self != other:
            raise ScenarioError(
                f"--over {key}: its values change the agents, states or times of a run, and runs "
                "whose states are stored must have them in common; leave `--keep-states` out."
            )

    def stored(self, results: Sequence[Result | None]) -> StoredFrames:
        """Return the frames of some runs; None of those that could not be built."""
        sizes = (len(self.states), len(self.inputs))
        frames = {
            name: np.full((len(results), len(self.times), self.agents, size), np.nan)
            for name, size in zip(NAMES, sizes, strict=True)
        }
        for k, result in enumerate(results):
            if result is not None:
                for name, whole in frames.items():
                    whole[k, : len(result.times)] = getattr(result, name)
        return frames


def labelled_frames(plan: "Sweep", axes: Variables, values: StoredFrames) -> Labelled:
    """Return arrays of all runs, with a dimension for each key, as a dataset.

    Args:
        plan: of the sweep.
        axes: the values of each key.
        values: `states` and `inputs` (key, .., time, agent, state / input).
    """
    assert plan.frames is not None
    fixed = labelled_parts(*plan.first_built).coordinates
    labels = ("agent", "state", "state_unit", "input", "input_unit")
    keys = tuple(axis.key for axis in plan.axes)
    variables = {
        name: ((*keys, "time", "agent", name.removesuffix("s")), values[name]) for name in NAMES
    }
    time = ("time", np.array(plan.frames.times), {"units": "s"})
    coordinates = {**axes, "time": time, **{name: fixed[name] for name in labels}}
    attributes: JsonObject = {"scenario": plan.scenario.name, "scenario_text": plan.scenario.text}
    return Labelled(variables, coordinates, attributes)


def write_frames(
    plan: "Sweep", axes: Variables, batches: Iterable[tuple[int, StoredFrames]], file: Path
) -> None:
    """Write the frames of a sweep run by run, each a chunk of its own, which few of fit in memory.

    Raises:
        OSError: the file cannot be written.
    """
    import h5netcdf

    assert plan.frames is not None
    shape = (len(plan.frames.times), plan.frames.agents)
    sizes = zip(NAMES, (len(plan.frames.states), len(plan.frames.inputs)), strict=True)
    # A number for each place, which takes no memory.
    nothing = {name: np.broadcast_to(np.nan, (*plan.shape, *shape, n)) for name, n in sizes}
    labelled = labelled_frames(plan, axes, nothing)
    with h5netcdf.File(file, "w") as stored:
        for name in NAMES:
            over, whole = labelled.variables[name]
            for dimension, size in zip(over, whole.shape, strict=True):
                if dimension not in stored.dimensions:
                    stored.dimensions[dimension] = size
            times = max(1, min(whole.shape[-3], _CHUNK // (whole.shape[-2] * whole.shape[-1])))
            chunk = (*[1] * len(plan.shape), times, *whole.shape[-2:])
            stored.create_variable(name, over, float, fillvalue=np.nan, chunks=chunk)
        for first, frames in batches:
            for k, run in enumerate(plan.runs(first, len(frames[NAMES[0]]))):
                for name in NAMES:
                    stored.variables[name][run.place] = frames[name][k]
        labelled._replace(variables={}).write(stored)
