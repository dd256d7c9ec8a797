"""The columns that a sweep records of each run: numbers, how it ended, what is guaranteed."""

from collections.abc import Mapping, Sequence

import numpy as np

from echelon.core.errors import Outcome
from echelon.core.types import Array, JsonObject
from echelon.experiments.results.metrics import RunNumbers, metrics
from echelon.experiments.results.run_numbers import AGENT_NUMBERS, RUN_NUMBERS, Shown, shown_in
from echelon.guarantees.promises.promise import Promise
from echelon.simulation.engine.result import Result

REFUSED, MISSING = -1, -2
"""In place of an outcome: of a run whose parts cannot be built, and of one that is still to do."""
OUTCOMES = {outcome: code for code, outcome in enumerate(Outcome)}


RUN_COLUMNS = tuple(shown_in(RUN_NUMBERS, Shown.SWEEP))
AGENT_COLUMNS = tuple(shown_in(AGENT_NUMBERS, Shown.SWEEP))
SUMMARIZED = tuple(shown_in(RUN_NUMBERS, Shown.DISTRIBUTION))
"""The numbers that reports and figures show the distribution of."""
UNIT = "error_unit"
WORDS = (
    *(
        "message",
        "promise_verdict",
        "promise_kind",
        "promise_theorem",
        "promise_against",
        "engine",
        "warnings",
    ),
    UNIT,
)
Columns = Mapping[str, Array]
"""Of some runs: an array (runs,) for each number, and (runs, agents) for those of an agent."""


def numbers_of(result: Result, promise: Promise) -> JsonObject:
    """Return the numbers of a run; what does not exist is NaN."""
    run = RunNumbers(result, metrics(result), promise)
    agents = {name: np.full(result.graph.agents, np.nan) for name in AGENT_COLUMNS}
    for name, values in agents.items():
        values[list(result.graph.followers)] = run.followers(name)
    return {
        **agents,
        **{name: _number(run.number(name)) for name in RUN_COLUMNS},
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


def _number(value: float | None) -> float:
    return np.nan if value is None else float(value)


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
