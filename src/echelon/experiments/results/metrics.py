"""The numbers of a run: the errors of the paper's Table II, settling times, effort and more."""

from collections.abc import Callable, Sequence
from typing import Annotated, Any, NamedTuple, TypeVar, get_args, get_type_hints

import jax
import numpy as np
from jaxtyping import Float

from echelon.agents.models.model import ControlAffine
from echelon.core.compiled import cached_jit
from echelon.core.errors import Outcome
from echelon.core.numerics import precision
from echelon.core.types import Array
from echelon.simulation.engine.result import Result, finite_or_none
from echelon.simulation.step.meter import SETTLED, output_error

ERROR = "error"
"""In place of a unit: that of the formation errors, `Result.unit`."""


class Quantity(NamedTuple):
    """How tables, figures and data sets present a number of a run or of an agent.

    Attributes:
        meaning: in data sets.
        unit: `ERROR` for the unit of formation errors; empty without one.
        label: of a column or an axis; in a column `{unit}`, `{window}` (s) and `{settled}` stand
            for those of the run.
        of: computes the number of a run of a sweep; None of an agent's, which `metrics` computes.
    """

    meaning: str
    unit: str = ""
    label: str = ""
    of: Callable[[Any], float | None] | None = None


def quantities(numbers: type) -> dict[str, Quantity]:
    """Return the quantities among the fields of a tuple of numbers, by name."""
    hints = get_type_hints(numbers, include_extras=True)
    marks = ((name, mark) for name, hint in hints.items() for mark in get_args(hint)[1:])
    return {name: mark for name, mark in marks if isinstance(mark, Quantity)}


class LeaderMetrics(NamedTuple):
    """Root-mean-square deviation of a leader from its reference; None without a reference.

    `saturated` is the fraction of steps in which a limit changed the input.
    """

    rmse: float | None
    steady_rmse: float | None
    rmse_by_output: dict[str, float | None]
    agent: int = 0
    saturated: float = 0.0


class FollowerMetrics(NamedTuple):
    """One follower's formation error: the length of the vector to its goal relative to its leader.

    `settling_time` (s) is the time after which the error stays below 1 cm. `effort` is the
    root-mean-square of the normalized input about the trim. `saturated` is the fraction of steps in
    which a limit changed the input. A further number is one more field with its `Quantity`.
    """

    agent: int
    rmse: Annotated[
        float | None,
        Quantity("root mean square of the formation error", ERROR, "RMSE{unit}\n(all)"),
    ]
    steady_rmse: Annotated[
        float | None,
        Quantity("the same in the steady window", ERROR, "steady{unit}\n(last {window:.3g} s)"),
    ]
    settling_time: Annotated[
        float | None,
        Quantity("time after which the error stays below 1 cm", "s", "within {settled}\nfrom, s"),
    ]
    effort: Annotated[
        float | None, Quantity("root mean square of the normalized input", "", "effort")
    ]
    saturated: Annotated[
        float,
        Quantity("fraction of steps in which a limit changed the input", "", "saturated,\n% steps"),
    ]


class EdgeMetrics(NamedTuple):
    """Root-mean-square of (actual minus desired distance) on one edge."""

    edge: tuple[int, int]
    distance_rmse: float | None


class Metrics(NamedTuple):
    """All numbers of a run; what does not exist is None, never NaN.

    Errors are of the position (m) where the model has one, else of the whole state. A run that
    diverged has no errors. The least distance is over the stored frames.
    """

    leaders: tuple[LeaderMetrics, ...]
    followers: tuple[FollowerMetrics, ...]
    edges: tuple[EdgeMetrics, ...]
    minimum_distance: float | None
    saturation_fraction: float
    steady_window: float

    @property
    def leader(self) -> LeaderMetrics:
        """The numbers of the first leader."""
        return self.leaders[0]

    @property
    def worst_steady(self) -> float | None:
        """The largest steady error of a follower."""
        values = [f.steady_rmse for f in self.followers if f.steady_rmse is not None]
        return max(values) if values else None


_Row = TypeVar("_Row")


def representatives(rows: Sequence[_Row], error: Callable[[_Row], float]) -> list[_Row]:
    """Return the best, the median and the worst of some rows, which have errors."""
    ordered = sorted(rows, key=error)
    return [ordered[0], ordered[len(ordered) // 2], ordered[-1]]


def steady_error(row: LeaderMetrics | FollowerMetrics) -> float:
    """Return the steady error of an agent."""
    # An agent without one did not reach the steady window, and counts as the worst.
    return np.inf if row.steady_rmse is None else row.steady_rmse


def metrics(result: Result) -> Metrics:
    """Return the numbers of a run; means are over all its steps, whatever frames were stored."""
    exists = result.outcome is not Outcome.DIVERGED and bool(result.sums.steps[0] > 0)
    least = result.least_distances() if len(result.times) else None
    with np.errstate(over="ignore", invalid="ignore"):
        return Metrics(
            leaders=_leaders(result, exists),
            followers=_followers(result, exists),
            edges=_edges(result, exists),
            minimum_distance=None if least is None else finite_or_none(least.min()),
            saturation_fraction=float(result.saturated.mean()),
            steady_window=result.settings.window,
        )


def output_errors(result: Result, leader: int | None = None) -> Array | None:
    """Return a leader's output minus the reference's, (T, q); None without a reference.

    It is the first leader's unless one is given.
    """
    if result.reference is None or not len(result.times):
        return None
    leader = result.graph.leaders[0] if leader is None else leader
    desired = result.reference + result.formation.offsets[leader]
    with precision("float64"):
        return np.asarray(_output_errors(result.model, result.states[:, leader], desired))


@cached_jit
def _output_errors(
    model: ControlAffine, x: Float[jax.Array, "T n"], desired: Float[jax.Array, "T n"]
) -> Float[jax.Array, "T q"]:
    return jax.vmap(lambda x, desired: output_error(model, x, desired))(x, desired)


def _root_mean(total: float | np.floating, steps: float | np.floating) -> float | None:
    """Return the root of a mean of squares, from their sum; None where there is no mean."""
    return finite_or_none(np.sqrt(total / steps)) if steps > 0 else None


def _leaders(result: Result, exists: bool) -> tuple[LeaderMetrics, ...]:
    names, sums = result.model.output_names, result.sums
    has_errors, (steps, steady) = exists and result.reference is not None, sums.steps

    def one(k: int, agent: int) -> LeaderMetrics:
        saturated = float(result.saturated[agent])
        if not has_errors:
            return LeaderMetrics(None, None, dict.fromkeys(names), agent, saturated)
        outputs = (_root_mean(total, steps) for total in sums.outputs[k])
        return LeaderMetrics(
            _root_mean(sums.tracking[0, k], steps),
            _root_mean(sums.tracking[1, k], steady),
            dict(zip(names, outputs, strict=True)),
            agent,
            saturated,
        )

    return tuple(one(k, agent) for k, agent in enumerate(result.graph.leaders))


def _followers(result: Result, exists: bool) -> tuple[FollowerMetrics, ...]:
    sums, saturated = result.sums, result.saturated
    last = result.formation_errors[-1] if exists and len(result.times) else None
    nothing = FollowerMetrics(0, None, None, None, None, 0.0)
    return tuple(
        nothing._replace(agent=agent, saturated=float(saturated[agent]))
        if last is None
        else FollowerMetrics(
            agent=agent,
            rmse=_root_mean(sums.errors[0, agent], sums.steps[0]),
            steady_rmse=_root_mean(sums.errors[1, agent], sums.steps[1]),
            settling_time=_settling_time(result, agent, float(last[agent])),
            effort=_root_mean(sums.effort[agent], sums.steps[0]),
            saturated=float(saturated[agent]),
        )
        for agent in result.graph.followers
    )


def _settling_time(result: Result, agent: int, last: float) -> float | None:
    """Return the time after which the error stays below 1 cm, to a step, or None.

    `last` is the error in the last stored frame, after the last step in the sums.
    """
    if not last <= SETTLED:
        return None
    return float((result.sums.unsettled[agent] + 1) * result.settings.dt)


def _edges(result: Result, exists: bool) -> tuple[EdgeMetrics, ...]:
    steps = result.sums.steps[0] if exists else 0.0
    pairs = ((int(i), int(j)) for i, j in result.graph.edges)
    return tuple(
        EdgeMetrics(pair, _root_mean(total, steps))
        for pair, total in zip(pairs, result.sums.spacing, strict=True)
    )
