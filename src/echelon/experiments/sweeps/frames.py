"""Stored states and inputs of the runs of a sweep: every K-th step of each run."""

from collections.abc import Iterable
from pathlib import Path

import numpy as np

from echelon.core.types import JsonObject
from echelon.experiments.results.dataset import labelled_parts
from echelon.experiments.results.labelled import Labelled, Variables
from echelon.experiments.sweeps.frame_shape import NAMES, StoredFrames
from echelon.experiments.sweeps.plan import Sweep

_CHUNK = 500_000
"""Numbers of a run that are read together from its file, 4 MB."""


def labelled_frames(plan: Sweep, axes: Variables, values: StoredFrames) -> Labelled:
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
    plan: Sweep, axes: Variables, batches: Iterable[tuple[int, StoredFrames]], file: Path
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
