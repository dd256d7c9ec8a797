"""A sweep as one labelled dataset: the columns of its runs, and stored states and inputs."""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from echelon.core.errors import Outcome
from echelon.core.files import versions
from echelon.core.types import Array, JsonObject
from echelon.experiments.results.dataset import labelled_parts
from echelon.experiments.results.labelled import Labelled, Variables
from echelon.experiments.results.metrics import RunNumbers, arrived, metrics
from echelon.experiments.results.run_numbers import AGENT_NUMBERS, ERROR, RUN_NUMBERS, Quantity
from echelon.experiments.scenario.scenario import key_label
from echelon.experiments.scenario.yaml import inline_yaml
from echelon.experiments.sweeps.plan import (
    AGENT_COLUMNS,
    NAMES,
    RUN_COLUMNS,
    UNIT,
    WORDS,
    Axis,
    FrameShape,
    StoredFrames,
    Sweep,
)
from echelon.guarantees.promises.promise import Guarantee
from echelon.simulation.engine.result import Result

if TYPE_CHECKING:
    import xarray as xr

REFUSED, MISSING = -1, -2
"""In place of an outcome: of a run whose parts cannot be built, and of one that is still to do."""
OUTCOMES = {outcome: code for code, outcome in enumerate(Outcome)}

Columns = Mapping[str, Array]
"""Of some runs: an array (runs,) for each number, and (runs, agents) for those of an agent."""


class SweepBatch(NamedTuple):
    """Consecutive runs of a sweep: the number of the first one, their numbers and their frames.

    `frames` is None if none are stored, or if they are in a file.
    """

    first: int
    columns: Columns
    frames: "StoredFrames | None" = None

    @property
    def runs(self) -> int:
        """The number of runs."""
        return len(self.columns["outcome"])


def numbers_of(result: Result, promise: Guarantee) -> JsonObject:
    """Return the numbers of a run; what does not exist is NaN."""
    run = RunNumbers(result, metrics(result), promise)
    agents = {name: np.full(result.graph.agents, np.nan) for name in AGENT_COLUMNS}
    for name, values in agents.items():
        values[list(result.graph.followers)] = run.followers(name)
    numbers = ((name, run.number(name)) for name in RUN_COLUMNS)
    return {
        **agents,
        **{name: np.nan if number is None else float(number) for name, number in numbers},
        "saturated": result.saturated,
        "outcome": OUTCOMES[result.outcome],
        "message": "" if result.outcome is Outcome.COMPLETED else result.message,
        "engine": result.engine,
        "warnings": "\n".join(result.warnings),
        UNIT: result.unit,
        "promised": int(promise.promised),
        "promise_verdict": str(promise.verdict),
        "promise_kind": str(promise.kind) if promise.promised else "",
        "promise_theorem": "" if promise.theorem is None else str(promise.theorem),
        "promise_against": "; ".join(promise.reasons + promise.conditions),
    }


def refused(why: str) -> JsonObject:
    """Return the columns of a run whose parts cannot be built."""
    return {"outcome": REFUSED, "message": why}


def columns_of(rows: Sequence[JsonObject]) -> dict[str, Array]:
    """Return the columns of some runs, each with all names."""
    agents = max([0, *(len(row["saturated"]) for row in rows if "saturated" in row)])
    columns: dict[str, Array] = {
        "outcome": np.array([row["outcome"] for row in rows], np.int8),
        "promised": np.array([row.get("promised", 0) for row in rows], np.int8),
    }
    columns |= {
        name: np.array([row.get(name, np.nan) for row in rows], float) for name in RUN_COLUMNS
    }
    columns |= {name: np.array([row.get(name, "") for row in rows], str) for name in WORDS}
    for name in AGENT_COLUMNS:
        columns[name] = np.full((len(rows), agents), np.nan)
        for k, row in enumerate(rows):
            if name in row:
                columns[name][k, : len(row[name])] = row[name]
    return columns


_Z = 1.96
"""Standard deviations within which 95 % of a normal distribution lie."""
_MEANINGS = {
    "outcome": "how the run ended",
    "promised": "whether anything was guaranteed before the run",
    "warnings": "settings of the run that are probably not intended, a line each",
    "promise_against": "why nothing is guaranteed, or what only the run can show",
    "promise_verdict": "whether the claim before the run is guaranteed, conditional, or none",
}
_QUANTITIES = {**AGENT_NUMBERS, **RUN_NUMBERS}


def dataset_of(plan: Sweep, batches: Sequence[SweepBatch]) -> "xr.Dataset":
    """Return the batches of a sweep as a dataset; runs that are in no batch are `missing`.

    Dimensions are the keys that vary, in their order, and `agent`. `outcome` is a code whose
    meanings are in its attributes.
    """
    import xarray as xr

    agents = max([0, *(batch.columns["saturated"].shape[1] for batch in batches)])
    keys = [axis.key for axis in plan.axes]
    variables: Variables = {}
    for name, fill in (*_FILLS.items(), *((name, np.nan) for name in AGENT_COLUMNS)):
        inner = name in AGENT_COLUMNS
        whole = np.full((plan.count, agents) if inner else plan.count, fill)
        whole = whole.astype(np.int8 if name in _CODES else object if name in WORDS else float)
        for batch in batches:
            part, rows = batch.columns[name], slice(batch.first, batch.first + batch.runs)
            whole[(rows, slice(part.shape[1])) if inner else rows] = part
        dims = (*keys, "agent") if inner else keys
        variables[name] = (dims, _arranged(plan, whole), _attributes(name))
    _measure(variables)
    coordinates = axis_values(plan) | {"agent": np.arange(agents)}
    frames = [batch.frames for batch in batches if batch.frames is not None]
    if plan.frames is not None and frames and len(frames) == len(batches):
        stored = _all_frames(plan, plan.frames, batches)
        variables |= stored.variables
        coordinates |= stored.coordinates
    attributes = {f"version_{name}": text for name, text in versions().items()}
    attributes |= {"scenario": plan.scenario.name, "scenario_text": plan.scenario.text}
    attributes["over"] = "\n".join(axis.text for axis in plan.axes)
    return xr.Dataset(variables, coordinates, attributes)


def axis_values(plan: Sweep) -> Variables:
    """Return the values of each key, and what it is, in words, with its unit."""
    values: Variables = {}
    for axis in plan.axes:
        words, unit = key_label(axis.key)
        attributes = {"long_name": words} | ({"units": unit} if unit else {})
        values[axis.key] = (axis.key, _values(axis), attributes)
    return values


def _all_frames(plan: Sweep, shape: FrameShape, batches: Sequence[SweepBatch]) -> Labelled:
    """Return the frames of all batches in the order of the axes; NaN of runs in no batch."""
    whole = dict[str, Array]()
    for name, empty in shape.stored([]).items():
        rows = np.full((plan.count, *empty.shape[1:]), np.nan)
        for batch in batches:
            rows[batch.first : batch.first + batch.runs] = (batch.frames or {})[name]
        whole[name] = _arranged(plan, rows)
    return labelled_frames(plan, axis_values(plan), whole)


def _measure(variables: Variables) -> None:
    """Replace the column of the errors' unit by an attribute of errors, if all runs have m."""
    units = {str(unit) for unit in variables.pop(UNIT)[1].ravel() if unit}
    for name, quantity in _QUANTITIES.items():
        if quantity.unit == ERROR and name in variables and units == {"m"}:
            variables[name][2]["units"] = "m"


_CODES = ("outcome", "promised")
_FILLS: Variables = {"outcome": MISSING, "promised": 0}
_FILLS |= dict.fromkeys(RUN_COLUMNS, np.nan) | dict.fromkeys(WORDS, "")


def _arranged(plan: Sweep, whole: Array) -> Array:
    """Return rows in the order of computing as an array in the order of the axes."""
    order = plan.order
    slow = whole.reshape([plan.shape[k] for k in order] + list(whole.shape[1:]))
    back = [order.index(k) for k in range(len(order))]
    return slow.transpose([*back, *range(len(order), slow.ndim)])


def _values(axis: Axis) -> Array:
    numbers = (isinstance(v, int | float) and not isinstance(v, bool) for v in axis.values)
    if isinstance(axis.values, range) or all(numbers):
        return np.array(axis.values)
    values = [v if isinstance(v, str) else inline_yaml(v) for v in axis.values]
    return np.array(values, object)


def _attributes(name: str) -> JsonObject:
    quantity = _QUANTITIES.get(name, Quantity(_MEANINGS.get(name, "")))
    attributes: JsonObject = {"long_name": quantity.meaning} if quantity.meaning else {}
    if quantity.unit not in ("", ERROR):
        attributes["units"] = quantity.unit
    if name == "outcome":
        codes = {MISSING: "missing", REFUSED: "refused"}
        codes |= {code: outcome.name.lower() for outcome, code in OUTCOMES.items()}
        attributes["flag_values"] = np.array([*codes], np.int8)
        attributes["flag_meanings"] = " ".join(codes.values())
    return attributes


def succeeded(dataset: "xr.Dataset", error: float | None = None) -> "xr.DataArray":
    """Return which runs completed with all followers settled, or below an error.

    Args:
        dataset: of a sweep.
        error: bound on every follower's final error; if None, all followers must have settled
            (stay below 1 cm, or 0.01 without a position).
    """
    reached = dataset["outcome"] == OUTCOMES[Outcome.COMPLETED]
    if error is None:
        return arrived(reached, dataset["worst_settling_time"])
    return reached & (dataset["worst_final_error"] < error)


def share_bounds(count: Any, total: Any) -> tuple[Any, Any]:
    """Return the 95 % interval (Wilson, 1927) of a probability, from `count` of `total`."""
    share, spread = count / total, _Z**2 / total
    middle = (share + spread / 2) / (1 + spread)
    half = _Z * np.sqrt(share * (1 - share) / total + spread / (4 * total)) / (1 + spread)
    return np.clip(middle - half, 0.0, 1.0), np.clip(middle + half, 0.0, 1.0)


_CHUNK = 500_000
"""Numbers of a run that are read together from its file, 4 MB."""


def labelled_frames(plan: Sweep, axes: Variables, values: StoredFrames) -> Labelled:
    """Return arrays of all runs, with a dimension for each key, as a dataset.

    `values` are `states` and `inputs` (key, .., time, agent, state or input).
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
