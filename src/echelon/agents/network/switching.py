"""Switching graphs: stretches of time, each with its weights of all edges."""

from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple, TypeAlias

import numpy as np

from echelon.agents.network.edges import check_edges, count_agents, split_weights
from echelon.core.errors import GraphError
from echelon.core.types import Array

Stretch: TypeAlias = tuple[float, Iterable[Sequence[float]]]
"""Start (s) and edges of a stretch of time."""
ROUNDED = 1e-9
"""Share of a step by which rounding may put a switch before the step that it belongs to."""
_MOST_PERIODS = 20
"""After so many periods at most, their rounding to steps is to repeat."""


class Schedule(NamedTuple):
    """When which weights hold.

    Attributes:
        starts: (S,) s, ascending from 0: the start of each row of weights.
        weights: (S, E), not negative: 0 where an edge is absent.
        period: s, after which the rows repeat; None where the last row holds for ever.
        present: (S, N) who is there; None where all always are.
        nearest: (S, N) the leader that each agent follows; None where that never changes.
    """

    starts: Array
    weights: Array
    period: float | None
    present: Array | None = None
    nearest: Array | None = None

    @property
    def last(self) -> Array:
        """The rows that repeat, or the one that holds for ever."""
        return self.weights if self.period is not None else self.weights[-1:]

    def row(self, t: float) -> int:
        """Return which row holds at a time (s)."""
        return int(self.rows(t))

    def rows(self, times: Array | float) -> Array:
        """Return which rows hold at times (T,) (s)."""
        # Rounded before the modulus: a time just below the period belongs to the first row.
        times = np.asarray(times, float) + ROUNDED
        times = times if self.period is None else times % self.period
        return np.searchsorted(self.starts, times, side="right") - 1

    def switches(self, dt: float, horizon: float, first: int = 0) -> tuple[Array, Array]:
        """Return first steps (K,) and rows (K,) over a horizon (s), from period `first` on."""
        rounds = 1 if self.period is None else int(np.floor(horizon / self.period)) + 1
        begins = (first + np.arange(rounds)) * (self.period or 0.0)
        times = (begins[:, None] + self.starts).reshape(-1)
        steps = np.ceil(times / dt - ROUNDED).astype(np.int64)
        rows = np.tile(np.arange(len(self.starts)), rounds)
        # Of two switches at one step the later one counts.
        last = np.append(np.diff(steps) > 0, True)
        return steps[last], rows[last]

    def in_steps(self, dt: float) -> "Schedule | None":
        """Return the schedule as it runs in steps of dt (s), to which switches are rounded up.

        Rows that are shorter than a step may be left out. None where the rounding repeats only
        after many periods, or never.
        """
        periods, span = 1, np.inf
        if self.period is not None:
            counts = self.period / dt * np.arange(1, _MOST_PERIODS + 1)
            # Of periods of more steps than numbers have nothing is known.
            counts = counts[counts < 2.0**53]
            whole = np.flatnonzero(np.abs(counts - np.round(counts)) <= ROUNDED + 4e-16 * counts)
            if not len(whole):
                return None
            periods = int(whole[0]) + 1
            span = round(float(counts[whole[0]]))
        steps, rows = self.switches(dt, (periods - 0.5) * (self.period or 0.0))
        # What begins at the end belongs to the next period.
        steps, rows = steps[steps < span], rows[steps < span]
        here = (None if part is None else part[rows] for part in (self.present, self.nearest))
        period = None if span == np.inf else span * dt
        return Schedule(steps * dt, self.weights[rows], period, *here)

    def spans(self) -> Iterator[str]:
        """Yield the time span of each row, in words."""
        ends = [*self.starts[1:].tolist(), self.period]
        for start, end in zip(self.starts.tolist(), ends, strict=True):
            yield f"from {start:g} s on" if end is None else f"from {start:g} to {end:g} s"


def unite(
    stretches: Sequence[Stretch], agents: int | None, period: float | None, directed: bool
) -> tuple[Array, Array, int, Schedule]:
    """Return all edges (E, 2), largest weights (E,), agents, schedule; or raise `GraphError`."""
    starts = np.array([at for at, _ in stretches], float)
    _check_times(starts, period)
    read = [split_weights(edges) for _, edges in stretches]
    agents = count_agents(np.concatenate([pairs for pairs, _ in read]), agents)
    places: dict[tuple[int, int], int] = {}
    checked = [check_edges(*edges, agents, directed) for edges in read]
    for pairs, _ in checked:
        for pair in pairs.tolist():
            places.setdefault((pair[0], pair[1]), len(places))
    rows = np.zeros((len(stretches), len(places)))
    for row, (pairs, weights) in zip(rows, checked, strict=True):
        row[[places[i, j] for i, j in pairs.tolist()]] = weights
    rows.setflags(write=False)
    starts.setflags(write=False)
    pairs = np.array(list(places), np.int64).reshape(-1, 2)
    return pairs, rows.max(axis=0), agents, Schedule(starts, rows, period)


def _check_times(starts: Array, period: float | None) -> None:
    ascending = len(starts) and starts[0] == 0.0 and np.isfinite(starts).all()
    if not ascending or (np.diff(starts) <= 0.0).any():
        listed = ", ".join(f"{at:g}" for at in starts[:8])
        raise GraphError(
            f"the graph switches at {listed or 'no time'} s, and times must ascend from 0, the "
            "first."
        )
    if period is not None and not starts[-1] < period < np.inf:
        raise GraphError(
            f"`period` is {period:g} s, and must be longer than the last switch, at "
            f"{starts[-1]:g} s."
        )
