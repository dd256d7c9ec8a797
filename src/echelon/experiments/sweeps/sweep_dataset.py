"""A sweep as one labelled dataset."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from echelon.core.errors import Outcome
from echelon.core.files import versions
from echelon.core.types import Array, JsonObject
from echelon.experiments.results.labelled import Labelled, Variables
from echelon.experiments.results.run_numbers import AGENT_NUMBERS, ERROR, RUN_NUMBERS, Quantity
from echelon.experiments.scenario.scenario import key_label
from echelon.experiments.scenario.yaml import inline_yaml
from echelon.experiments.sweeps.axes import Axis
from echelon.experiments.sweeps.frame_shape import FrameShape
from echelon.experiments.sweeps.frames import labelled_frames
from echelon.experiments.sweeps.numbers import (
    AGENT_COLUMNS,
    MISSING,
    OUTCOMES,
    REFUSED,
    RUN_COLUMNS,
    UNIT,
    WORDS,
)
from echelon.experiments.sweeps.plan import Sweep

if TYPE_CHECKING:
    import xarray as xr

    from echelon.experiments.sweeps.workers import SweepBatch

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


def dataset_of(plan: Sweep, batches: "Sequence[SweepBatch]") -> "xr.Dataset":
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
    """Return the values of each key."""
    return {axis.key: (axis.key, _values(axis), _key_attributes(axis.key)) for axis in plan.axes}


def _key_attributes(key: str) -> JsonObject:
    """Return what a key is, in words, with its unit."""
    words, unit = key_label(key)
    return {"long_name": words} | ({"units": unit} if unit else {})


def _all_frames(plan: Sweep, shape: FrameShape, batches: "Sequence[SweepBatch]") -> Labelled:
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
    """Return the values of an axis: numbers where all are, else text."""
    if isinstance(axis.values, range):
        return np.array(axis.values)
    numbers = all(isinstance(v, int | float) and not isinstance(v, bool) for v in axis.values)
    if numbers:
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
        return reached & dataset["worst_settling_time"].notnull()
    return reached & (dataset["worst_final_error"] < error)


def share_bounds(count: Any, total: Any) -> tuple[Any, Any]:
    """Return the 95 % interval (Wilson, 1927) of a probability, from `count` of `total`."""
    share, spread = count / total, _Z**2 / total
    middle = (share + spread / 2) / (1 + spread)
    half = _Z * np.sqrt(share * (1 - share) / total + spread / (4 * total)) / (1 + spread)
    return np.clip(middle - half, 0.0, 1.0), np.clip(middle + half, 0.0, 1.0)
