"""Numbers that follow from the stored frames of a run, computed now or read from its dataset."""

import abc
from collections.abc import Sequence
from typing import NamedTuple, Protocol, TypeAlias

import numpy as np
from jaxtyping import Float, Int

from echelon.core.types import Array

_FEW = 8
"""Agents up to which comparing all pairs is faster than a search for the nearest."""


class ClosestPair(NamedTuple):
    """Two agents when they were closest to each other.

    Attributes:
        distance: between them, m.
        agents: their numbers, ascending.
        time: of the stored frame, s.
    """

    distance: float
    agents: tuple[int, int]
    time: float

    @classmethod
    def of(cls, places: Float[Array, "N k"], time: float) -> "ClosestPair":
        """Return the closest of two agents or more at places (m), at a time (s)."""
        from scipy.spatial import KDTree

        away, near = map(np.asarray, KDTree(places).query(places, k=2))
        first = int(away[:, 1].argmin())
        # Agents in one place come in any order.
        other = next(int(agent) for agent in near[first] if agent != first)
        distance = float(np.linalg.norm(places[first] - places[other]))
        return cls(distance, (min(first, other), max(first, other)), time)

    def touch(self, radius: float | None) -> bool:
        """Return whether agents of a radius (m) touched; None has no size."""
        return radius is not None and self.distance < 2.0 * radius

    def sentence(self, radius: float | None) -> str:
        """Return who was closest, how close and when, beside the size of agents of a radius (m)."""
        one, other = self.agents
        size = "" if radius is None else f"agents of radius {radius:.2g} m touch below"
        if radius is not None and self.touch(radius):
            return (
                f"Warning: agents {one} and {other} came within {self.distance:.3g} m at "
                f"{self.time:.4g} s; {size} {2.0 * radius:.3g} m, and the simulation lets them "
                "pass through each other."
            )
        text = f"Smallest distance: {self.distance:.3g} m, agents {one} and {other} at "
        text += f"{self.time:.4g} s"
        return f"{text}; {size} {2.0 * radius:.3g} m." if radius is not None else f"{text}."


_Some: TypeAlias = slice | Sequence[int] | Int[Array, " F"]
"""Which frames."""


class _Frames(Protocol):
    """What the numbers are computed from."""

    @property
    def times(self) -> Float[Array, " T"]: ...

    @property
    def states(self) -> Float[Array, "T N n"]: ...

    @property
    def offsets(self) -> Float[Array, "N n"]: ...

    @property
    def nearest(self) -> Int[Array, " N"]: ...

    @property
    def position(self) -> tuple[int, ...]: ...

    @property
    def measured(self) -> tuple[int, ...]: ...

    def deviations(self, frames: _Some = slice(None)) -> Float[Array, "F N n"]: ...

    def goal_distances(self, frames: _Some = slice(None)) -> Float[Array, "F N"]: ...

    def least_distances(self, frames: _Some = slice(None)) -> Float[Array, " F"] | None: ...

    def approaches(self, last: int = 0) -> list[ClosestPair]: ...


class FrameNumbers(abc.ABC):
    """Numbers of T frames of N agents with n states, of a `Result` and of a `Recording`."""

    @property
    def measured(self: _Frames) -> tuple[int, ...]:
        """Indices of the states that errors are measured on: the position if any, else all."""
        return self.position or tuple(range(self.offsets.shape[1]))

    @property
    def length_unit(self: _Frames) -> str:
        """The unit of errors: m for a position, nothing for abstract states."""
        return "m" if self.position else ""

    @property
    def errors(self: _Frames) -> Float[Array, "T N n"]:
        """Deviation of each agent from its goal relative to its nearest leader.

        The leaders' rows are zero.
        """
        return self.deviations()

    @property
    def formation_errors(self: _Frames) -> Float[Array, "T N"]:
        """Each agent's distance from its goal."""
        return self.goal_distances()

    def deviations(self: _Frames, frames: _Some = slice(None)) -> Float[Array, "F N n"]:
        """Return `errors` in some frames."""
        # delta_i = y_i - y_0 (theory page), which V and the certified set are written in.
        y = self.states[frames] - self.offsets
        return y - y[:, self.nearest]

    def goals(self: _Frames, frames: _Some = slice(None)) -> Float[Array, "F N n"]:
        """Return the states that the agents would have without errors, in some frames."""
        return self.states[frames] - self.deviations(frames)

    def goal_distances(self: _Frames, frames: _Some = slice(None)) -> Float[Array, "F N"]:
        """Return `formation_errors` in some frames."""
        # Where a square overflows, the length is infinite.
        with np.errstate(over="ignore", invalid="ignore"):
            return np.linalg.norm(self.deviations(frames)[:, :, list(self.measured)], axis=2)

    def least_distances(self: _Frames, frames: _Some = slice(None)) -> Float[Array, " F"] | None:
        """Return the smallest distance between two agents in frames, NaN if one is not finite.

        None without a position.
        """
        if not self.position:
            return None
        places = self.states[frames][:, :, list(self.position)]
        least = np.full(len(places), np.nan)
        finite = np.isfinite(places).all(axis=(1, 2))
        least[finite] = _least(places[finite])
        return least

    def closest_pair(self: _Frames) -> ClosestPair | None:
        """Return which agents were closest to each other in the stored frames, and when.

        None without a position, a second agent or a frame of finite numbers.
        """
        pairs = self.approaches(1)
        return pairs[-1] if pairs else None

    def approaches(self: _Frames, last: int = 0) -> list[ClosestPair]:
        """Return the pairs that were closer than any in a frame before, all or the last ones."""
        least = self.least_distances() if self.states.shape[1] > 1 else None
        if least is None:
            return []
        least = np.where(np.isfinite(least), least, np.inf)
        before = np.minimum.accumulate(np.concatenate([[np.inf], least[:-1]]))
        frames, columns = np.flatnonzero(least < before)[-last:], list(self.position)
        return [ClosestPair.of(self.states[k][:, columns], float(self.times[k])) for k in frames]


def _least(places: Float[Array, "T N k"]) -> Float[Array, " T"]:
    if places.shape[1] <= _FEW:
        i, j = np.triu_indices(places.shape[1], 1)
        with np.errstate(over="ignore", invalid="ignore"):
            return np.linalg.norm(places[:, i] - places[:, j], axis=2).min(axis=1)
    from scipy.spatial import KDTree

    return np.array([KDTree(points).query(points, k=2)[0][:, 1].min() for points in places])
