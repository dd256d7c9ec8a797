"""The numbers of a run, each with its name, unit, labels and computation.

A further number is one more entry of `RUN_NUMBERS`, or of `AGENT_NUMBERS` for one of each follower.
Tables, JSON, data sets, figures and the glossary take it from here.
"""

import dataclasses
import functools
from collections.abc import Mapping
from typing import TYPE_CHECKING, final

import numpy as np
from jaxtyping import Float

from echelon.core.errors import Outcome
from echelon.core.statement import Hypothesis
from echelon.experiments.results.agent_metrics import FollowerMetrics, Metrics
from echelon.experiments.results.quantity import ERROR, Quantity, Shown, quantities

if TYPE_CHECKING:
    from echelon.core.types import JsonObject
    from echelon.experiments.results.avoidance import Avoidance
    from echelon.guarantees.promises.promise import Promise
    from echelon.simulation.engine.result import Result


@final
@dataclasses.dataclass(frozen=True, eq=False)
class RunNumbers:
    """A run with what its numbers are computed from.

    Attributes:
        result: the run.
        metrics: of the run.
        promise: of its parts.
        computing: computing time (s) for one agent and one second of the run, without compilation;
            None if it was not measured.
    """

    result: "Result"
    metrics: Metrics
    promise: "Promise"
    computing: float | None = None

    def number(self, name: str) -> float | None:
        """Return a number of `RUN_NUMBERS`; None if it does not exist or is more than one."""
        value = self._value(name)
        return None if isinstance(value, tuple) else value

    def _value(self, name: str) -> float | tuple[int, ...] | None:
        compute = RUN_NUMBERS[name].of
        value = None if compute is None else compute(self)
        return None if value is None or np.isnan(value).any() else value

    def json(self, where: Shown) -> "JsonObject":
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
    def avoidance(self) -> "Avoidance | None":
        """How agents kept apart; None where they do not."""
        # Not above: `echelon explain` needs the table below at once, and not what computes it.
        from echelon.experiments.results.avoidance import avoidance

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
        from echelon.guarantees.promises.promise import covered

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


AGENT_NUMBERS: Mapping[str, Quantity] = quantities(FollowerMetrics) | {
    "start_error": Quantity(
        "formation error at the start",
        ERROR,
        column="error at the start{unit}",
        of=lambda run: run.first_and_last[0],
        shown=Shown(0),
    ),
    "final_error": Quantity(
        "formation error at the end",
        ERROR,
        column="at the end{unit}",
        of=lambda run: run.first_and_last[1],
    ),
}
_OF_NETWORK = Shown.SWEEP | Shown.COMPARISON | Shown.SUMMARY
RUN_NUMBERS: Mapping[str, Quantity] = {
    "formation_rmse": Quantity(
        "root mean square of the followers' errors, over all steps and followers",
        ERROR,
        "formation RMSE",
        of=lambda run: run.root_mean("rmse"),
        shown=Shown.SWEEP | Shown.DISTRIBUTION,
    ),
    "formation_steady_rmse": Quantity(
        "root mean square of the followers' errors in the steady window",
        ERROR,
        of=lambda run: run.root_mean("steady_rmse"),
    ),
    "worst_rmse": Quantity(
        "largest RMSE of a follower", ERROR, of=lambda run: run.worst("rmse"), shown=Shown(0)
    ),
    "worst_steady_rmse": Quantity(
        "largest RMSE of a follower in the steady window",
        ERROR,
        of=lambda run: run.metrics.worst_steady,
        shown=Shown(0),
    ),
    "worst_final_error": Quantity(
        "error of the follower that is farthest from its goal at the end",
        ERROR,
        "worst final error",
        of=lambda run: run.worst("final_error"),
        shown=Shown.SWEEP | Shown.DISTRIBUTION,
    ),
    "worst_settling_time": Quantity(
        "time after which the errors of all followers stay below 1 cm, or 0.01 without a position",
        "s",
        "settling time",
        of=lambda run: run.worst("settling_time"),
        shown=Shown.SWEEP | Shown.DISTRIBUTION | Shown.COMPARISON,
        key="settling_time_s",
        absent="never",
    ),
    "leader_rmse": Quantity(
        "root mean square of the first leader's error",
        ERROR,
        of=lambda run: run.metrics.leader.rmse,
        shown=Shown.SWEEP | Shown.COMPARISON,
    ),
    "leader_steady_rmse": Quantity(
        "root mean square of the first leader's error in the steady window",
        ERROR,
        of=lambda run: run.metrics.leader.steady_rmse,
        shown=Shown.SWEEP | Shown.COMPARISON,
    ),
    "effort": Quantity(
        "root mean square of the followers' normalized inputs about the trim",
        column="effort",
        # The mean of the squares: the root mean square of all inputs together.
        of=lambda run: run.root_mean("effort"),
        shown=Shown.COMPARISON,
    ),
    "saturation_fraction": Quantity(
        "mean over all agents of `saturated`",
        column="saturated,\n% steps",
        of=lambda run: run.metrics.saturation_fraction,
        shown=Shown.SWEEP | Shown.COMPARISON | Shown.SUMMARY,
        scale=100.0,
        digits=3,
    ),
    "minimum_distance": Quantity(
        "smallest distance between any two agents, over all steps",
        "m",
        column="smallest\ndistance",
        of=lambda run: run.metrics.minimum_distance,
        shown=Shown.COMPARISON | Shown.SUMMARY,
    ),
    "minimum_distance_time": Quantity(
        "time at which two agents were closest to each other",
        "s",
        of=lambda run: getattr(run.metrics.closest, "time", None),
        shown=Shown.SUMMARY,
        key="minimum_distance_time_s",
    ),
    "minimum_distance_frames": Quantity(
        "in how many stored frames that distance was found; null: over all steps",
        of=lambda run: getattr(run.metrics.closest, "frames", None),
        shown=Shown.SUMMARY,
    ),
    "closest_agents": Quantity(
        "the two agents that were closest to each other",
        of=lambda run: getattr(run.metrics.closest, "agents", None),
        shown=Shown.SUMMARY,
    ),
    "vehicle_radius": Quantity(
        "radius of an agent; closer than twice of it, two agents touch",
        "m",
        of=lambda run: run.result.radius,
        shown=Shown.SUMMARY,
    ),
    "computing": Quantity(
        "computing time for one agent and one second of the run",
        "s",
        column="computing,\nms per agent s",
        of=lambda run: run.computing,
        shown=Shown.COMPARISON,
        key="computing_s_per_agent_s",
        scale=1e3,
    ),
    "largest_age": Quantity(
        "largest age of a message in use, over all steps and links",
        "s",
        column="oldest message\nin use, s",
        of=lambda run: run.of_network("largest"),
        shown=_OF_NETWORK,
        key="largest_age_s",
    ),
    "mean_age": Quantity(
        "mean age of the messages in use, over all steps and links",
        "s",
        of=lambda run: run.of_network("mean"),
        shown=_OF_NETWORK,
        key="mean_age_s",
    ),
    "messages_sent": Quantity(
        "messages sent, each counted for every agent that uses it",
        of=lambda run: run.of_network("sent"),
        shown=_OF_NETWORK,
    ),
    "messages_lost": Quantity(
        "messages that were lost",
        column="messages\nlost",
        of=lambda run: run.of_network("lost"),
        shown=_OF_NETWORK,
    ),
    "messages_late": Quantity(
        "messages that arrived after a newer one of the same sender",
        of=lambda run: run.of_network("late"),
        shown=_OF_NETWORK,
    ),
    "scaled_distance": Quantity(
        "smallest scaled distance between two agents that keep apart, over all steps",
        "m",
        column="scaled\ndistance",
        of=lambda run: None if run.avoidance is None else run.avoidance.least,
        shown=Shown.SWEEP | Shown.SUMMARY,
    ),
    "held_back_until": Quantity(
        "time until which agents that keep apart held each other back",
        "s",
        of=lambda run: None if run.avoidance is None else run.avoidance.last,
        shown=Shown.SWEEP | Shown.SUMMARY,
    ),
    "promise_rate": Quantity(
        "rate at which errors are guaranteed to decay",
        "1/s",
        column="guaranteed,\n1/s",
        of=lambda run: run.promise.rate if run.promise.promised else None,
    ),
    "covered": Quantity(
        "whether every step of the run kept to what its theorem rests on, limits included",
        of=lambda run: run.covered,
        shown=Shown.SWEEP | Shown.SUMMARY,
    ),
    "certified_radius": Quantity(
        "r of the certified set: sum_i delta_i'P delta_i <= r^2",
        of=lambda run: run.certified_radius,
    ),
    "start_size": Quantity(
        "the r of the certified set's inequality at the start of the run",
        of=lambda run: run.start_size,
    ),
    "alternations": Quantity(
        "how many times an input of an agent jumped from one limit to the opposite one, at most",
        of=lambda run: int(run.result.chatter.max()),
        shown=Shown.SUMMARY,
    ),
}


def shown_in(table: Mapping[str, Quantity], where: Shown) -> dict[str, Quantity]:
    """Return the numbers of a table that appear somewhere."""
    return {name: quantity for name, quantity in table.items() if where in quantity.shown}
