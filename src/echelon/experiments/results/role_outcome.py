"""What became of the leaders and of the followers of a run: arrived, bounded or lost."""

import enum
import math
from collections.abc import Iterable
from typing import NamedTuple, final

import jax.numpy as jnp
import numpy as np

from echelon.core.digits import finite_or_none
from echelon.core.errors import Outcome
from echelon.core.numerics import precision
from echelon.core.types import JsonObject
from echelon.experiments.results.metrics import metrics
from echelon.simulation.engine.result import Result
from echelon.simulation.step.meter import SETTLED


@final
class Grade(enum.IntEnum):
    """The class of an outcome; a larger one is worse."""

    ARRIVED = 0
    BOUNDED = 1
    LOST = 2

    def __str__(self) -> str:
        return self.name.lower()


class RoleOutcome(NamedTuple):
    """How the leaders, or the followers, end.

    Attributes:
        grade: its class.
        error: RMS error of the worst agent in the steady window, in the unit of errors; None of a
            run that diverged, whose numbers mean nothing.
    """

    grade: Grade
    error: float | None

    def as_mapping(self) -> JsonObject:
        """Return it ready for JSON."""
        return {"class": str(self.grade), "error": self.error}


class RunOutcome(NamedTuple):
    """The outcomes of a run; None for a role without errors, such as a leader without a path."""

    leader: RoleOutcome | None
    followers: RoleOutcome | None

    @property
    def poor(self) -> bool:
        """Whether anybody did not arrive."""
        return any(role is not None and role.grade is not Grade.ARRIVED for role in self)


def grade_of(steady: float, end: float, start: float, extent: float) -> Grade:
    """Return the class of an outcome that is finite, from numbers in one unit.

    Args:
        steady: RMS error in the steady window.
        end: error in the last frame.
        start: error in the first frame.
        extent: size of the path, or of the formation.
    """
    if steady <= SETTLED and end <= SETTLED:
        return Grade.ARRIVED
    # Twice, since the last frame may be an overshoot. An agent that starts at its goal is not lost
    # at any error: it is as long as the error is smaller than what is flown.
    return Grade.LOST if not end <= 2.0 * max(start, extent) else Grade.BOUNDED


def run_outcome(result: Result) -> RunOutcome:
    """Return what became of the leaders and of the followers of a run."""
    leaders, followers = result.reference is not None, bool(result.graph.followers)
    if result.outcome is Outcome.DIVERGED or not len(result.times):
        lost = RoleOutcome(Grade.LOST, None)
        return RunOutcome(lost if leaders else None, lost if followers else None)
    numbers = metrics(result)
    return RunOutcome(
        _leaders(result, (row.steady_rmse for row in numbers.leaders)) if leaders else None,
        _followers(result, (row.steady_rmse for row in numbers.followers)) if followers else None,
    )


def _leaders(result: Result, steady: Iterable[float | None]) -> RoleOutcome | None:
    assert result.reference is not None
    measured = list(result.measured)
    path = np.asarray(result.reference)
    extent = float(np.linalg.norm((path - path[0])[:, measured], axis=1).max())
    with precision("float64"):
        away = [
            # A model's own difference, since an angle may have wound up.
            result.model.difference(jnp.asarray(x), jnp.asarray(row + offset))
            for x, row, offset in (
                (result.states[k, agent], path[k], result.offsets_in([k])[..., agent, :].ravel())
                for k in (0, -1)
                for agent in result.graph.leaders
            )
        ]
    start, end = np.linalg.norm(np.asarray(away)[:, measured], axis=1).reshape(2, -1)
    return _role(steady, start, end, extent)


def _followers(result: Result, steady: Iterable[float | None]) -> RoleOutcome | None:
    agents = list(result.graph.followers)
    start, end = result.goal_distances([0, -1])[:, agents]
    places = result.offsets_in([0]).reshape(-1, *result.offsets.shape)[0][:, list(result.measured)]
    return _role(steady, start, end, float(np.linalg.norm(places, axis=1).max()))


def _role(
    steady: Iterable[float | None], start: np.ndarray, end: np.ndarray, extent: float
) -> RoleOutcome | None:
    """Return the outcome of the worst agent; None where nobody was there in the steady window."""
    rows = [
        (grade_of(error, float(b), float(a), extent), error)
        for error, a, b in zip(steady, start, end, strict=True)
        if error is not None and math.isfinite(b)
    ]
    if not rows:
        return None
    return RoleOutcome(max(grade for grade, _ in rows), finite_or_none(max(e for _, e in rows)))
