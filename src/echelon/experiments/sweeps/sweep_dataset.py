"""A sweep as one labelled dataset."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from echelon.core.errors import Outcome
from echelon.core.provenance import versions
from echelon.core.types import Array
from echelon.experiments.scenario.yaml import inline_yaml
from echelon.experiments.sweeps.axes import Axis
from echelon.experiments.sweeps.numbers import (
    MISSING,
    NUMBERS,
    OF_AGENT,
    OUTCOMES,
    REFUSED,
    UNIT,
    WORDS,
)
from echelon.experiments.sweeps.plan import Sweep

if TYPE_CHECKING:
    import xarray as xr

    from echelon.experiments.sweeps.workers import SweepBatch

_Z = 1.96
"""Of a normal distribution, within which 95 % lie."""
_UNITS = {"settling_time": "s", "worst_settling_time": "s", "promise_rate": "1/s"}
_ERRORS = (
    *("rmse", "steady_rmse", "final_error", "leader_rmse", "leader_steady_rmse"),
    *("formation_rmse", "formation_steady_rmse", "worst_final_error"),
)
_WHAT = {
    "outcome": "how the run ended",
    "promised": "whether anything was promised, before the run",
    "warnings": "what of the run is probably not meant, a line each",
    "formation_rmse": "root mean square of the followers' errors, over all steps and followers",
    "formation_steady_rmse": "the same in the steady window",
    "worst_final_error": "error of the follower that is farthest from its goal at the end",
    "worst_settling_time": "when the last follower's error came below 1 cm for good",
    "saturated": "fraction of steps in which a limit changed the input",
    "saturation_fraction": "the same, of all agents",
    "promise_rate": "rate at which errors are promised to shrink",
    "promise_against": "what stands against any promise",
    "certified_radius": "r of the certified set: sum_i delta_i'P delta_i <= r^2",
    "start_size": "r on which the run starts",
}


def dataset_of(plan: Sweep, batches: "Sequence[SweepBatch]") -> "xr.Dataset":
    """Return the batches of a sweep as a dataset; runs that none holds are `missing`.

    Dimensions are the keys that vary, in their order, and `agent`. `outcome` is a number whose
    meanings stand in its attributes.
    """
    import xarray as xr

    agents = max([0, *(batch.columns["saturated"].shape[1] for batch in batches)])
    keys = [axis.key for axis in plan.axes]
    variables: dict[str, Any] = {}
    for name, fill in (*_FILLS.items(), *((name, np.nan) for name in OF_AGENT)):
        inner = name in OF_AGENT
        whole = np.full((plan.count, agents) if inner else plan.count, fill)
        whole = whole.astype(np.int8 if name in _CODES else object if name in WORDS else float)
        for batch in batches:
            part, rows = batch.columns[name], slice(batch.first, batch.first + batch.runs)
            whole[(rows, slice(part.shape[1])) if inner else rows] = part
        dims = (*keys, "agent") if inner else keys
        variables[name] = (dims, _arranged(plan, whole), _attributes(name))
    _measure(variables)
    coordinates = {axis.key: _values(axis) for axis in plan.axes} | {"agent": np.arange(agents)}
    told = {f"version_{name}": text for name, text in versions().items()}
    told |= {"scenario": plan.scenario.name, "scenario_text": plan.scenario.text}
    told["over"] = "\n".join(axis.text for axis in plan.axes)
    return xr.Dataset(variables, coordinates, told)


def _measure(variables: dict[str, Any]) -> None:
    """Give errors their unit in the place of the column that says it, where all runs have one."""
    found = {str(unit) for unit in variables.pop(UNIT)[1].ravel() if unit}
    for name in _ERRORS if found == {"m"} else ():
        variables[name][2]["units"] = "m"


_CODES = ("outcome", "promised")
_FILLS: dict[str, Any] = {"outcome": MISSING, "promised": 0}
_FILLS |= dict.fromkeys(NUMBERS, np.nan) | dict.fromkeys(WORDS, "")


def _arranged(plan: Sweep, whole: Array) -> Array:
    """Return what stands in the order of computing in the order of the axes."""
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


def _attributes(name: str) -> dict[str, Any]:
    found: dict[str, Any] = {"long_name": _WHAT[name]} if name in _WHAT else {}
    if name in _UNITS:
        found["units"] = _UNITS[name]
    if name == "outcome":
        codes = {MISSING: "missing", REFUSED: "refused"}
        codes |= {k: each.name.lower() for each, k in OUTCOMES.items()}
        found["flag_values"] = np.array([*codes], np.int8)
        found["flag_meanings"] = " ".join(codes.values())
    return found


def succeeded(dataset: "xr.Dataset", error: float | None = None) -> "xr.DataArray":
    """Return where runs reached their horizon with all followers settled, or below an error.

    Args:
        dataset: of a sweep.
        error: what every follower's final error must be below; to have settled (below 1 cm for
            good) when left out.
    """
    reached = dataset["outcome"] == OUTCOMES[Outcome.COMPLETED]
    if error is None:
        return reached & dataset["worst_settling_time"].notnull()
    return reached & (dataset["worst_final_error"] < error)


def share_bounds(count: Any, total: Any) -> tuple[Any, Any]:
    """Return the interval of a probability behind `count` of `total` at 95 % (Wilson, 1927)."""
    share, spread = count / total, _Z**2 / total
    middle = (share + spread / 2) / (1 + spread)
    half = _Z * np.sqrt(share * (1 - share) / total + spread / (4 * total)) / (1 + spread)
    return np.clip(middle - half, 0.0, 1.0), np.clip(middle + half, 0.0, 1.0)
