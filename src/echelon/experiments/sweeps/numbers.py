"""The numbers that a sweep records of each run: its errors, how it ended and what is guaranteed.

A further number is one more entry of `NUMBERS`, or of `FollowerMetrics` for one of each agent.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from echelon.core.errors import Outcome
from echelon.core.statement import Hypothesis
from echelon.core.types import Array, JsonObject
from echelon.experiments.results.metrics import (
    ERROR,
    FollowerMetrics,
    Metrics,
    Quantity,
    metrics,
    quantities,
)
from echelon.guarantees.promises.promise import Promise
from echelon.simulation.engine.result import Result

REFUSED, MISSING = -1, -2
"""In place of an outcome: of a run whose parts cannot be built, and of one that is still to do."""
OUTCOMES = {outcome: code for code, outcome in enumerate(Outcome)}


class _RunNumbers(NamedTuple):
    """What numbers of a run are computed from.

    Attributes:
        result: the run.
        metrics: of the run.
        promise: of its parts.
        agents: each number of an agent, (N,); NaN for leaders.
    """

    result: Result
    metrics: Metrics
    promise: Promise
    agents: Mapping[str, Array]

    def followers(self, name: str) -> Array:
        """Return a number of the followers."""
        return self.agents[name][list(self.result.graph.followers)]

    def root_mean(self, name: str) -> float:
        """Return the root mean square of a number of the followers."""
        return np.sqrt(np.mean(self.followers(name) ** 2))

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


AGENT_NUMBERS = quantities(FollowerMetrics) | {
    "final_error": Quantity("formation error at the end", ERROR)
}
NUMBERS: Mapping[str, Quantity] = {
    "formation_rmse": Quantity(
        "root mean square of the followers' errors, over all steps and followers",
        ERROR,
        "formation RMSE",
        lambda run: run.root_mean("rmse"),
    ),
    "formation_steady_rmse": Quantity(
        "the same in the steady window", ERROR, of=lambda run: run.root_mean("steady_rmse")
    ),
    "worst_final_error": Quantity(
        "error of the follower that is farthest from its goal at the end",
        ERROR,
        "worst final error",
        lambda run: run.followers("final_error").max(),
    ),
    "worst_settling_time": Quantity(
        "time after which the errors of all followers stay below 1 cm",
        "s",
        "settling time",
        lambda run: run.followers("settling_time").max(),
    ),
    "leader_rmse": Quantity(
        "root mean square of the first leader's error",
        ERROR,
        of=lambda run: run.metrics.leader.rmse,
    ),
    "leader_steady_rmse": Quantity(
        "the same in the steady window", ERROR, of=lambda run: run.metrics.leader.steady_rmse
    ),
    "saturation_fraction": Quantity(
        "mean over all agents of `saturated`", of=lambda run: run.metrics.saturation_fraction
    ),
    "promise_rate": Quantity(
        "rate at which errors are guaranteed to decay", "1/s", of=lambda run: run.promise.rate
    ),
    "certified_radius": Quantity(
        "r of the certified set: sum_i delta_i'P delta_i <= r^2",
        of=lambda run: run.certified_radius,
    ),
    "start_size": Quantity("r on which the run starts", of=lambda run: run.start_size),
}
SUMMARIZED = ("formation_rmse", "worst_final_error", "worst_settling_time")
"""The numbers that reports and figures show the distribution of."""
UNIT = "error_unit"
WORDS = (
    *("message", "promise_kind", "promise_theorem", "promise_against", "engine", "warnings"),
    UNIT,
)
Columns = Mapping[str, Array]
"""Of some runs: an array (runs,) for each number, and (runs, agents) for those of an agent."""


def numbers_of(result: Result, promise: Promise) -> JsonObject:
    """Return the numbers of a run; what does not exist is NaN."""
    numbers = metrics(result)
    agents = {name: np.full(result.graph.agents, np.nan) for name in AGENT_NUMBERS}
    if result.outcome is not Outcome.DIVERGED and len(result.times):
        followers = list(result.graph.followers)
        agents["final_error"][followers] = result.formation_errors[-1][followers]
    for follower in numbers.followers:
        for name in quantities(FollowerMetrics):
            agents[name][follower.agent] = _number(getattr(follower, name))
    agents["saturated"] = result.saturated
    run = _RunNumbers(result, numbers, promise, agents)
    computed = {name: _number(each.of(run)) for name, each in NUMBERS.items() if each.of}
    return {
        **agents,
        **computed,
        "outcome": OUTCOMES[result.outcome],
        "message": "" if result.outcome is Outcome.COMPLETED else result.message,
        "engine": result.engine,
        "warnings": "\n".join(result.warnings),
        UNIT: result.unit,
        "promised": int(promise.promised),
        "promise_kind": str(promise.kind) if promise.promised else "",
        "promise_theorem": "" if promise.theorem is None else str(promise.theorem),
        "promise_against": "; ".join(promise.reasons),
    }


def refused(why: str) -> JsonObject:
    """Return the columns of a run whose parts cannot be built."""
    return {"outcome": REFUSED, "message": why}


def _number(value: float | None) -> float:
    return np.nan if value is None else float(value)


def columns_of(rows: Sequence[JsonObject]) -> dict[str, Array]:
    """Return the columns of some runs, each with all names."""
    agents = max([0, *(len(row["saturated"]) for row in rows if "saturated" in row)])
    columns: dict[str, Array] = {
        "outcome": np.array([row["outcome"] for row in rows], np.int8),
        "promised": np.array([row.get("promised", 0) for row in rows], np.int8),
    }
    columns |= {name: np.array([row.get(name, np.nan) for row in rows], float) for name in NUMBERS}
    columns |= {name: np.array([row.get(name, "") for row in rows], str) for name in WORDS}
    for name in AGENT_NUMBERS:
        columns[name] = np.full((len(rows), agents), np.nan)
        for k, row in enumerate(rows):
            if name in row:
                columns[name][k, : len(row[name])] = row[name]
    return columns
