"""The numbers of a run: the errors of the paper's Table II, and what else an engineer asks for."""

from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from echelon.core.errors import Outcome
from echelon.core.numerics import precision
from echelon.core.types import Array
from echelon.engine.result import Result, finite_or_none
from echelon.models.model import ControlAffine

SETTLED = 0.01
"""A follower has settled when its error stays below this: 1 cm for a position."""


class LeaderMetrics(NamedTuple):
    """Root-mean-square deviation of the leader from its reference; None without a reference."""

    rmse: float | None
    steady_rmse: float | None
    rmse_by_output: dict[str, float | None]


class FollowerMetrics(NamedTuple):
    """One follower's formation error: the length of the vector to its goal relative to its leader.

    `settling_time` (s) is when the error has come below 1 cm for good. `effort` is the
    root-mean-square of the normalized input about the trim. `saturated` is the fraction of steps in
    which a limit acted.
    """

    agent: int
    rmse: float | None
    steady_rmse: float | None
    settling_time: float | None
    effort: float | None
    saturated: float


class EdgeMetrics(NamedTuple):
    """Root-mean-square of (actual minus wanted distance) on one edge."""

    edge: tuple[int, int]
    distance_rmse: float | None


class Metrics(NamedTuple):
    """All numbers of a run; what does not exist is None, never NaN.

    Errors are of the position (m) where the model has one, else of the whole state. A run that
    diverged has no errors.
    """

    leader: LeaderMetrics
    followers: tuple[FollowerMetrics, ...]
    edges: tuple[EdgeMetrics, ...]
    minimum_distance: float | None
    saturation_fraction: float
    steady_window: float

    @property
    def worst_steady(self) -> float | None:
        """The largest steady error of a follower."""
        values = [f.steady_rmse for f in self.followers if f.steady_rmse is not None]
        return max(values) if values else None


def metrics(result: Result, steady_window: float | None = None) -> Metrics:
    """Return the numbers of a run.

    Args:
        result: the run.
        steady_window: length of the last part of the run that counts as steady, s; a fifth of the
            horizon when left out.
    """
    window = result.settings.horizon / 5.0 if steady_window is None else steady_window
    exists = result.outcome is not Outcome.DIVERGED and len(result.times) > 0
    steady = result.times >= result.times[-1] - window - 1e-9 if exists else np.zeros(0, bool)
    with np.errstate(over="ignore", invalid="ignore"):
        return Metrics(
            leader=_leader(result, steady, exists),
            followers=_followers(result, steady, exists),
            edges=_edges(result, exists),
            minimum_distance=_minimum_distance(result),
            saturation_fraction=float(result.saturated.mean()),
            steady_window=window,
        )


def formation_errors(result: Result) -> Array:
    """Return each agent's error length over time, (T, N), in the result's unit."""
    return np.linalg.norm(result.errors[:, :, list(result.measured)], axis=2)


def output_errors(result: Result) -> Array | None:
    """Return the first leader's output minus the reference's, (T, q); None without a reference."""
    if result.reference is None or not len(result.times):
        return None
    leader = result.graph.leaders[0]
    wanted = result.reference + result.formation.offsets[leader]
    with precision("float64"):
        return np.asarray(
            _output_errors(result.model, jnp.asarray(result.states[:, leader]), jnp.asarray(wanted))
        )


@eqx.filter_jit
def _output_errors(model: ControlAffine, x: jax.Array, wanted: jax.Array) -> jax.Array:
    # The state's own difference, which may wind angles, decides how far apart the two outputs are.
    def one(x: jax.Array, wanted: jax.Array) -> jax.Array:
        return model.output(wanted + model.difference(x, wanted)) - model.output(wanted)

    return jax.vmap(one)(x, wanted)


def _rms(values: Array) -> float | None:
    """Return the root of the mean of squares over the first axis, summed over the others."""
    if not len(values):
        return None
    squares = (values**2).reshape(len(values), -1).sum(axis=1)
    return finite_or_none(np.sqrt(squares.mean()))


def _leader(result: Result, steady: Array, exists: bool) -> LeaderMetrics:
    errors = output_errors(result) if exists else None
    if errors is None or result.reference is None:
        return LeaderMetrics(None, None, dict.fromkeys(result.model.output_names))
    leader = result.graph.leaders[0]
    wanted = result.reference + result.formation.offsets[leader]
    off = (result.states[:, leader] - wanted)[:, list(result.measured)]
    by_output = {name: _rms(errors[:, k]) for k, name in enumerate(result.model.output_names)}
    return LeaderMetrics(_rms(off), _rms(off[steady]), by_output)


def _followers(result: Result, steady: Array, exists: bool) -> tuple[FollowerMetrics, ...]:
    errors = formation_errors(result)
    return tuple(
        FollowerMetrics(
            agent=agent,
            rmse=_rms(errors[:, agent]) if exists else None,
            steady_rmse=_rms(errors[steady, agent]) if exists else None,
            settling_time=_settling_time(result.times, errors[:, agent]) if exists else None,
            effort=_effort(result, agent) if exists else None,
            saturated=float(result.saturated[agent]),
        )
        for agent in result.graph.followers
    )


def _settling_time(times: Array, error: Array) -> float | None:
    """Return the first time from which on the error stays below 1 cm, or None."""
    above = np.flatnonzero(~(error <= SETTLED))
    if not len(above):
        return 0.0
    return None if above[-1] == len(times) - 1 else float(times[above[-1] + 1])


def _effort(result: Result, agent: int) -> float | None:
    scale = np.asarray(result.model.input_scale, float)
    deviation = result.inputs[:, agent] - np.asarray(result.model.trim[1], float)
    return _rms(np.linalg.solve(scale, deviation.T).T)


def _edges(result: Result, exists: bool) -> tuple[EdgeMetrics, ...]:
    measured = list(result.measured)
    p, goals = result.states[:, :, measured], result.formation.offsets[:, measured]

    def deviation(i: int, j: int) -> Array:
        return np.linalg.norm(p[:, i] - p[:, j], axis=1) - np.linalg.norm(goals[i] - goals[j])

    pairs: Sequence[tuple[int, int]] = [(int(i), int(j)) for i, j in result.graph.edges]
    return tuple(EdgeMetrics(pair, _rms(deviation(*pair)) if exists else None) for pair in pairs)


def _minimum_distance(result: Result) -> float | None:
    """Return the smallest distance between two agents over all frames; None without a position."""
    axes = result.model.position_indices()
    if not axes or not len(result.times):
        return None
    from scipy.spatial import KDTree

    nearest = [
        KDTree(points).query(points, k=2)[0][:, 1].min()
        for points in result.states[:, :, list(axes)]
    ]
    return finite_or_none(min(nearest))
