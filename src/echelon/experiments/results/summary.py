"""The summary of a run as JSON: what its parts state, and what it observed."""

import math
from collections.abc import Callable, Sequence
from typing import TypeVar

import numpy as np

from echelon.core.types import JsonObject
from echelon.experiments.results.event_outcomes import event_outcomes
from echelon.experiments.results.metrics import RunNumbers, metrics
from echelon.experiments.results.run_numbers import (
    AGENT_NUMBERS,
    RUN_NUMBERS,
    Appearance,
    EdgeMetrics,
    Metrics,
    representatives,
    shown_in,
    steady_error,
)
from echelon.guarantees.promises.hypotheses import events_in_words
from echelon.guarantees.promises.promise import guarantee
from echelon.laws.law import gain_of
from echelon.simulation.engine.law_drive import Laws
from echelon.simulation.engine.parts import Parts
from echelon.simulation.engine.result import Result
from echelon.simulation.step.drive import Controller
from echelon.simulation.step.settings import Settings
from echelon.synthesis.gains.gain import Gain

_LISTED = 5_000
"""Most rows of a list in the summary; the dataset contains the numbers of all agents."""
_Row = TypeVar("_Row")


def statement(parts: Parts, settings: Settings, name: str) -> JsonObject:
    """Return the entries of a summary that follow from the parts of a run, without running it."""
    gain, spectrum = parts.drive.gain, parts.graph.spectrum()
    return {
        "scenario": name,
        "agents": parts.graph.agents,
        "unit": "m" if parts.model.position else "state",
        "horizon_s": settings.horizon,
        "dt_s": settings.dt,
        "seed": settings.seed,
        **parts.world.describe(parts.model),
        "gain": _gain_numbers(gain),
        "leader_gain": _gain_numbers(leader_gain_of(parts.drive)),
        "guarantee": guarantee(parts, settings).as_mapping(),
        **({"events": events_in_words(parts, guarantee(parts, settings))} if parts.events else {}),
        "lambda_min": spectrum.low,
        "lambda_max": spectrum.high,
    }


def _gain_numbers(gain: Gain | None) -> JsonObject | None:
    if gain is None:
        return None
    numbers = {"P": gain.P.tolist(), "R": gain.R.tolist()}
    return {"method": gain.method, "coupling": gain.coupling, **numbers}


def leader_gain_of(drive: Controller) -> Gain | None:
    """Return the leaders' own gain; None without one."""
    return gain_of(drive.leader) if isinstance(drive, Laws) else None


COVERED = "covered"
"""Of a guarantee, what only the run itself gives."""

_SHOWN = (x.key or name for name, x in shown_in(RUN_NUMBERS, Appearance.SUMMARY).items())
_NUMBERS = tuple(name for name in _SHOWN if name != COVERED)
OBSERVED = ("outcome", "leader", "leaders", "followers", "edges", *_NUMBERS)
OBSERVED += ("event_outcomes", "steady_window_s", "warnings", "engine", "wall_time_s", "versions")
"""The other entries of a summary, which only the run itself gives."""


def summary(result: Result, numbers: Metrics | None = None) -> JsonObject:
    """Return the run's summary as JSON data; numbers that do not exist are None."""

    def distance_error(edge: EdgeMetrics) -> float:
        return np.inf if edge.distance_rmse is None else edge.distance_rmse

    numbers = metrics(result) if numbers is None else numbers
    name = result.provenance.get("scenario", "")
    stated = guarantee(result.parts, result.settings)
    keys = {name: quantity.key or name for name, quantity in AGENT_NUMBERS.items()}
    outcomes = [outcome.as_mapping() for outcome in event_outcomes(result)]
    observed = RunNumbers(result, numbers, stated).json(Appearance.SUMMARY)
    follows = statement(result.parts, result.settings, name)
    return {
        **follows,
        # What follows from the parts, and whether this run kept to it.
        "guarantee": {**follows["guarantee"], COVERED: observed[COVERED]},
        "outcome": {"name": result.outcome.name.lower(), "message": result.message},
        "leader": numbers.leader._asdict(),
        "leaders": [leader._asdict() for leader in numbers.leaders],
        "followers": [
            {keys.get(name, name): value for name, value in row._asdict().items()}
            for row in _listed(numbers.followers, steady_error)
        ],
        "edges": [
            {"edge": list(row.edge), "distance_rmse": row.distance_rmse}
            for row in _listed(numbers.edges, distance_error)
        ],
        **{name: observed[name] for name in _NUMBERS},
        **({"event_outcomes": outcomes} if result.parts.events else {}),
        "steady_window_s": numbers.steady_window,
        "warnings": list(result.warnings),
        "engine": result.engine,
        "wall_time_s": result.wall_time if math.isfinite(result.wall_time) else None,
        "versions": {
            key[8:]: text for key, text in result.provenance.items() if key.startswith("version_")
        },
    }


def _listed(rows: Sequence[_Row], error: Callable[[_Row], float]) -> Sequence[_Row]:
    """Return all rows; if they are too many for JSON tools, the best, the median and the worst."""
    return rows if len(rows) <= _LISTED else representatives(rows, error)
