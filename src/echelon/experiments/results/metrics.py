"""The numbers of a run: the errors of the paper's Table II, settling times, effort and more.

Of agents that keep apart also how near they came, and when they held each other back.
"""

import dataclasses
import functools
import math
from collections.abc import Sequence
from typing import Any, NamedTuple, TypeVar, final

import jax
import numpy as np
from jaxtyping import Float

from echelon.agents.models.model import ControlAffine
from echelon.core.compiled import cached_jit
from echelon.core.digits import about, at_most, finite_or_none
from echelon.core.errors import Outcome, check_kind
from echelon.core.numerics import precision
from echelon.core.statement import Hypothesis
from echelon.core.types import Array, JsonObject
from echelon.experiments.results.run_numbers import (
    AGENT_NUMBERS,
    RUN_NUMBERS,
    Appearance,
    EdgeMetrics,
    FollowerMetrics,
    LeaderMetrics,
    Metrics,
)
from echelon.guarantees.promises.coverage import covered
from echelon.guarantees.promises.promise import Guarantee, guarantee
from echelon.simulation.engine.result import Result
from echelon.simulation.step.meter import SETTLED, output_error, steps_per_slice

ROUNDING = 1e-4
"""Below its limit by this a distance still counts as kept, m: pages round places."""


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
    """`last` is the error in the last stored frame, after the last step in the sums."""
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


_Truth = TypeVar("_Truth")


def arrived(completed: _Truth, settled_from: Any, by: float = math.inf) -> _Truth:
    """Return whether runs reached their horizon, and all followers settled by a time.

    Args:
        completed: whether each run reached its horizon: a truth, or an array of them.
        settled_from: its `worst_settling_time`, s; NaN if a follower never settled.
        by: the time, s.
    """
    settled: Any = settled_from <= by  # false of NaN
    return completed & settled


def _edges(result: Result, exists: bool) -> tuple[EdgeMetrics, ...]:
    steps = result.steps_with(result.graph.edges)[0] * exists
    pairs = ((int(i), int(j)) for i, j in result.graph.edges)
    return tuple(
        EdgeMetrics(pair, _root_mean(total, count))
        for pair, total, count in zip(pairs, result.sums.spacing, steps, strict=True)
    )


class Ellipsoid(NamedTuple):
    """An upright ellipsoid about each agent, in which distances between agents are scaled.

    Attributes:
        radius: horizontal, m.
        height: from its middle to its top, m.
        limit: the scaled distance that agents should keep, m: that of their hulls, or of touching.
    """

    radius: float
    height: float
    limit: float

    @property
    def touching(self) -> float:
        """The scaled distance at which two touch, m."""
        return 2.0 * self.radius

    def radii(self, coordinates: Sequence[str]) -> Float[Array, " d"]:
        """Return the radii along a position's coordinates, m."""
        return np.array([self.height if x == "z" else self.radius for x in coordinates])

    def too_near(
        self, places: Float[Array, "N d"], coordinates: Sequence[str]
    ) -> Float[Array, " N"]:
        """Return 2 for agents whose ellipsoid overlaps another, 1 below the limit, else 0."""
        scaled = places * self.radius / self.radii(coordinates)
        apart = np.linalg.norm(scaled[:, None] - scaled, axis=2)
        np.fill_diagonal(apart, np.inf)
        # Absent agents are nowhere.
        least = np.where(np.isfinite(apart), apart, np.inf).min(axis=1)
        return (least < self.limit - ROUNDING) * 1.0 + (least < self.touching)


class Avoidance(NamedTuple):
    """Numbers of B slices of a run, none before it runs; distances are scaled.

    Attributes:
        times: at which each slice begins, s.
        distance: the least distance between two agents in it, m.
        active: pairs of agents of which one changed the other's rate, each way, on average.
    """

    times: Float[np.ndarray, " B"]
    distance: Float[np.ndarray, " B"]
    active: Float[np.ndarray, " B"]
    ellipsoid: Ellipsoid

    @property
    def least(self) -> float:
        """The least distance, m."""
        return float(self.distance.min())

    @property
    def last(self) -> float | None:
        """The beginning of the last slice in which an agent was held back, s; None if none was."""
        held = np.flatnonzero(self.active)
        return float(self.times[held[-1]]) if len(held) else None

    def over(self, times: Float[Array, " T"], values: Float[Array, " B"]) -> Float[Array, " T"]:
        """Return values of slices at times (s)."""
        return values[np.searchsorted(self.times, times, side="right") - 1]

    def sentence(self) -> str:
        """Return them in a sentence."""
        text = f"Smallest scaled distance: {about(self.least, 4)} m; agents touch at "
        text += f"{about(self.ellipsoid.touching, 4)} m, and their hulls keep "
        text += f"{at_most(self.ellipsoid.limit, 4)} m. "
        if self.last is None:
            return f"{text}No agent was held back."
        first, last = (about(float(t)) for t in self.times[np.flatnonzero(self.active)][[0, -1]])
        return f"{text}Agents held each other back between {first} s and {last} s."


def avoidance(result: Result) -> Avoidance | None:
    """Return how agents of a run kept apart; None where they do not."""
    safety, sums, settings = result.drive.safety, result.sums, result.settings
    if safety is None or not sums.steps[0]:
        return None
    each = steps_per_slice(settings)
    count = -(-int(sums.steps[0]) // each)
    begins = each * np.arange(count)
    steps = np.minimum(each, sums.steps[0] - begins)
    return Avoidance(
        begins * settings.dt,
        sums.separation[:, :count].min(axis=0),
        sums.avoidance[:, :count].sum(axis=0) / steps,
        Ellipsoid(safety.size[0], safety.size[2], safety.distance),
    )


@final
@dataclasses.dataclass(frozen=True, eq=False)
class RunNumbers:
    """A run with what its numbers are computed from.

    Attributes:
        stated: what is guaranteed of it; computed when it is first needed, if None.
        computing: computing time (s) for one agent and one second of the run, without compilation;
            None if it was not measured.
    """

    result: Result
    metrics: Metrics
    stated: Guarantee | None = None
    computing: float | None = None

    @functools.cached_property
    def promise(self) -> Guarantee:
        """What is guaranteed of the run."""
        return self.stated or guarantee(self.result.parts, self.result.settings)

    def number(self, name: str) -> float | None:
        """Return a number of `RUN_NUMBERS`; None if it does not exist or is more than one."""
        value = self._value(name)
        return None if isinstance(value, tuple) else value

    def _value(self, name: str) -> float | tuple[int, ...] | None:
        compute = RUN_NUMBERS[name].of
        value = None if compute is None else compute(self)
        return None if value is None or np.isnan(value).any() else value

    def json(self, where: Appearance) -> JsonObject:
        """Return the numbers that appear somewhere, under their names in JSON."""
        return {
            quantity.key or name: self._value(name)
            for name, quantity in RUN_NUMBERS.items()
            if where in quantity.shown
        }

    def followers(self, name: str) -> Float[np.ndarray, " F"]:
        """Return a number of `AGENT_NUMBERS` of all followers; NaN where it does not exist."""
        compute = AGENT_NUMBERS[name].of
        if compute is not None:
            return compute(self)
        return np.array([getattr(follower, name) for follower in self.metrics.followers], float)

    def worst(self, name: str) -> float:
        """Return the largest number of a follower; NaN if one does not exist."""
        return float(self.followers(name).max())

    def root_mean(self, name: str) -> float:
        """Return the root mean square of a number of the followers."""
        return float(np.sqrt(np.mean(self.followers(name) ** 2)))

    def of_network(self, name: str) -> float | None:
        """Return a number of the messages; None in the ideal network."""
        return None if self.result.traffic is None else getattr(self.result.traffic, name)

    @functools.cached_property
    def avoidance(self) -> Avoidance | None:
        """How agents kept apart; None where they do not."""
        return avoidance(self.result)

    @functools.cached_property
    def first_and_last(self) -> Float[np.ndarray, "2 F"]:
        """The followers' formation errors in the first and the last frame."""
        followers = list(self.result.graph.followers)
        if self.result.outcome is Outcome.DIVERGED or not len(self.result.times):
            return np.full((2, len(followers)), np.nan)
        return self.result.goal_distances([0, -1])[:, followers]

    @property
    def covered(self) -> bool | None:
        """Whether the run kept to the conditions of its claim; None where no theorem claims any."""
        return covered(self.result, self.promise)

    @property
    def certified_radius(self) -> float | None:
        """The radius of the certified set; None where nothing is guaranteed on one."""
        certified = self.promise.certified if self.promise.promised else None
        return None if certified is None else certified.radius

    @property
    def start_size(self) -> float | None:
        """The radius of the starts; None without a certified set."""
        starts = self.promise.hypotheses[Hypothesis.STARTS]
        return None if self.certified_radius is None else starts.number
