"""The numbers of the agents and edges of a run, and which agents represent many."""

from collections.abc import Callable, Sequence
from typing import Annotated, NamedTuple, TypeVar

import numpy as np

from echelon.experiments.results.quantity import ERROR, Quantity
from echelon.simulation.engine.frame_numbers import ClosestPair


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
        Quantity("root mean square of the formation error", ERROR, column="RMSE{unit}\n(all)"),
    ]
    steady_rmse: Annotated[
        float | None,
        Quantity(
            "root mean square of the formation error in the steady window",
            ERROR,
            column="steady{unit}\n(last {window:.3g} s)",
        ),
    ]
    settling_time: Annotated[
        float | None,
        Quantity(
            "time after which the error stays below 1 cm, or 0.01 without a position",
            "s",
            column="within {settled}\nfrom, s",
            key="settling_time_s",
            absent="never",
        ),
    ]
    effort: Annotated[
        float | None, Quantity("root mean square of the normalized input", column="effort")
    ]
    saturated: Annotated[
        float,
        Quantity(
            "fraction of steps in which a limit changed the input",
            column="saturated,\n% steps",
            scale=100.0,
            digits=3,
        ),
    ]


class EdgeMetrics(NamedTuple):
    """Root-mean-square of (actual minus desired distance) on one edge."""

    edge: tuple[int, int]
    distance_rmse: float | None


class Metrics(NamedTuple):
    """All numbers of a run; what does not exist is None, never NaN.

    Errors are of the position (m) where the model has one, else of the whole state. A run that
    diverged has no errors. The closest pair is that of all steps, or of the stored `frames`.
    """

    leaders: tuple[LeaderMetrics, ...]
    followers: tuple[FollowerMetrics, ...]
    edges: tuple[EdgeMetrics, ...]
    closest: ClosestPair | None
    saturation_fraction: float
    steady_window: float

    @property
    def leader(self) -> LeaderMetrics:
        """The numbers of the first leader."""
        return self.leaders[0]

    @property
    def minimum_distance(self) -> float | None:
        """The smallest distance between two agents, m; `closest` says over what."""
        return None if self.closest is None else self.closest.distance

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
