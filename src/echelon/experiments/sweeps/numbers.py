"""What is kept of a run in a sweep: how it ended, its errors, and what was promised of it."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from echelon.core.errors import Outcome
from echelon.core.statement import Hypothesis
from echelon.core.types import Array
from echelon.experiments.results.metrics import FollowerMetrics, formation_errors, metrics
from echelon.guarantees.promises.promise import Promise
from echelon.simulation.engine.result import Result

REFUSED, MISSING = -1, -2
"""In place of an outcome: of a run whose parts cannot be made, and of one that is still to do."""
OUTCOMES = {each: k for k, each in enumerate(Outcome)}

OF_AGENT = ("rmse", "steady_rmse", "final_error", "settling_time", "effort", "saturated")
NUMBERS = (
    "formation_rmse",
    "formation_steady_rmse",
    "worst_final_error",
    "worst_settling_time",
    "leader_rmse",
    "leader_steady_rmse",
    "saturation_fraction",
    "promise_rate",
    "certified_radius",
    "start_size",
)
UNIT = "error_unit"
WORDS = (
    *("message", "promise_kind", "promise_theorem", "promise_against", "engine", "warnings"),
    UNIT,
)
Columns = Mapping[str, Array]
"""Of some runs: an array (runs,) for each number, and (runs, agents) for those of an agent."""


def numbers_of(result: Result, promise: Promise) -> dict[str, Any]:
    """Return what is kept of a run; what does not exist is NaN."""
    found = metrics(result)
    of_agent = {name: np.full(result.graph.agents, np.nan) for name in OF_AGENT}
    known = result.outcome is not Outcome.DIVERGED and len(result.times)
    last = formation_errors(result)[-1] if known else of_agent["final_error"]
    of_agent["saturated"] = result.saturated
    for one in found.followers:
        _fill(of_agent, one, float(last[one.agent]))
    followers = list(result.graph.followers)
    size = {name: of_agent[name][followers] for name in OF_AGENT}
    return {
        **of_agent,
        "outcome": OUTCOMES[result.outcome],
        "message": "" if result.outcome is Outcome.COMPLETED else result.message,
        "formation_rmse": np.sqrt(np.mean(size["rmse"] ** 2)),
        "formation_steady_rmse": np.sqrt(np.mean(size["steady_rmse"] ** 2)),
        "worst_final_error": size["final_error"].max(),
        "worst_settling_time": size["settling_time"].max(),
        "leader_rmse": _number(found.leader.rmse),
        "leader_steady_rmse": _number(found.leader.steady_rmse),
        "saturation_fraction": found.saturation_fraction,
        "engine": result.engine,
        "warnings": "\n".join(result.warnings),
        UNIT: result.unit,
        **_promised(promise),
    }


def refused(why: str) -> dict[str, Any]:
    """Return what is kept of a run whose parts cannot be made."""
    return {"outcome": REFUSED, "message": why}


def _fill(of_agent: dict[str, Array], one: FollowerMetrics, last: float) -> None:
    for name, value in one._asdict().items():
        if name in of_agent:
            of_agent[name][one.agent] = _number(value)
    of_agent["final_error"][one.agent] = last


def _promised(promise: Promise) -> dict[str, Any]:
    theorem, found = promise.theorem, promise.certified if promise.promised else None
    starts = promise.hypotheses[Hypothesis.STARTS]
    return {
        "promised": int(promise.promised),
        "promise_kind": str(promise.kind) if promise.promised else "",
        "promise_theorem": "" if theorem is None else str(theorem),
        "promise_rate": _number(promise.rate),
        "promise_against": "; ".join(promise.reasons),
        "certified_radius": np.nan if found is None else found.radius,
        "start_size": _number(None if found is None else starts.number),
    }


def _number(value: float | None) -> float:
    return np.nan if value is None else float(value)


def columns_of(rows: Sequence[Mapping[str, Any]]) -> dict[str, Array]:
    """Return the columns of some runs, each with all names."""
    agents = max([0, *(len(row["saturated"]) for row in rows if "saturated" in row)])
    found: dict[str, Array] = {
        "outcome": np.array([row["outcome"] for row in rows], np.int8),
        "promised": np.array([row.get("promised", 0) for row in rows], np.int8),
    }
    found |= {name: np.array([row.get(name, np.nan) for row in rows], float) for name in NUMBERS}
    found |= {name: np.array([row.get(name, "") for row in rows], str) for name in WORDS}
    for name in OF_AGENT:
        found[name] = np.full((len(rows), agents), np.nan)
        for k, row in enumerate(rows):
            if name in row:
                found[name][k, : len(row[name])] = row[name]
    return found
