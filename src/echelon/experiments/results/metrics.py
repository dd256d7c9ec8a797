"""The numbers of a run: the errors of the paper's Table II, settling times, effort and more."""

import jax
import numpy as np
from jaxtyping import Float

from echelon.agents.models.model import ControlAffine
from echelon.core.compiled import cached_jit
from echelon.core.errors import Outcome, check_kind
from echelon.core.numerics import precision
from echelon.core.types import Array
from echelon.experiments.results.agent_metrics import (
    EdgeMetrics,
    FollowerMetrics,
    LeaderMetrics,
    Metrics,
)
from echelon.simulation.engine.result import Result, finite_or_none
from echelon.simulation.step.meter import SETTLED, output_error


def metrics(result: Result) -> Metrics:
    """Return the numbers of a run; means are over all its steps, whatever frames were stored."""
    check_kind("result", result, Result)
    exists = result.outcome is not Outcome.DIVERGED and bool(result.sums.steps[0] > 0)
    with np.errstate(over="ignore", invalid="ignore"):
        return Metrics(
            leaders=_leaders(result, exists),
            followers=_followers(result, exists),
            edges=_edges(result, exists),
            closest=result.closest,
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
    desired = result.reference + result.offsets_in()[..., leader, :]
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
    has_errors = exists and result.reference is not None

    def one(k: int, agent: int) -> LeaderMetrics:
        saturated = float(result.saturated[agent])
        if not has_errors:
            return LeaderMetrics(None, None, dict.fromkeys(names), agent, saturated)
        steps, steady = result.steps_present[:, agent]
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
    last = result.goal_distances([-1])[0] if exists and len(result.times) else None
    counts = result.steps_present
    nothing = FollowerMetrics(0, None, None, None, None, 0.0)
    return tuple(
        nothing._replace(agent=agent, saturated=float(saturated[agent]))
        if last is None
        else FollowerMetrics(
            agent=agent,
            rmse=_root_mean(sums.errors[0, agent], counts[0, agent]),
            steady_rmse=_root_mean(sums.errors[1, agent], counts[1, agent]),
            settling_time=_settling_time(result, agent, float(last[agent])),
            effort=_root_mean(sums.effort[agent], counts[0, agent]),
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
    first, settings = float(result.sums.unsettled[agent]) + 1.0, result.settings
    if result.presence is not None:
        there = settings.dt * np.arange(int(result.sums.steps[0]) + 1)
        assert result.schedule is not None and result.schedule.present is not None
        steps = np.flatnonzero(result.schedule.present[result.schedule.rows(there), agent])
        # Of one that was lost the last error is that before.
        if not len(steps) or first > steps[-1]:
            return None
        first = max(first, float(steps[0]))
    return first * settings.dt


def _edges(result: Result, exists: bool) -> tuple[EdgeMetrics, ...]:
    steps = result.steps_with(result.graph.edges)[0] * exists
    pairs = ((int(i), int(j)) for i, j in result.graph.edges)
    return tuple(
        EdgeMetrics(pair, _root_mean(total, count))
        for pair, total, count in zip(pairs, result.sums.spacing, steps, strict=True)
    )
