"""Numbers that follow from the stored frames of a run, computed now or read from its dataset."""

import abc
from collections.abc import Sequence
from typing import Protocol, TypeAlias

import numpy as np
from jaxtyping import Float, Int

from echelon.core.types import Array
from echelon.simulation.engine.closest_pair import ClosestPair

_FEW = 8
"""Agents up to which comparing all pairs is faster than a search for the nearest."""


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

    def approaches(self) -> list[ClosestPair]: ...


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
        pairs = self.approaches()
        return pairs[-1] if pairs else None

    def approaches(self: _Frames) -> list[ClosestPair]:
        """Return the pairs that were closer than any in a frame before, in the order of time."""
        if not self.position or self.states.shape[1] < 2 or not len(self.times):
            return []
        places, pairs = self.states[:, :, list(self.position)], list[ClosestPair]()
        least, bound = np.inf, -np.inf
        for k, motion in enumerate(_approach(places)):
            # No pair is closer than the closest of an earlier frame less what two agents moved.
            bound = bound - motion if np.isfinite(motion) else -np.inf
            if bound > least or not np.isfinite(places[k]).all():
                continue
            pair = ClosestPair.of(places[k], float(self.times[k]))
            bound = pair.distance
            if bound < least:
                least = bound
                pairs.append(pair)
        return pairs


def _approach(places: Float[Array, "T N k"]) -> Float[Array, " T"]:
    """Return by how much a distance between two agents can shrink up to each frame, at most."""
    with np.errstate(over="ignore", invalid="ignore"):
        # What all agents do together changes no distance.
        steps = np.diff(places - places.mean(axis=1, keepdims=True), axis=0, prepend=places[:1])
        steps[0] = 0.0
        return 2.0 * np.linalg.norm(steps, axis=2).max(axis=1)


def _least(places: Float[Array, "T N k"]) -> Float[Array, " T"]:
    if places.shape[1] <= _FEW:
        i, j = np.triu_indices(places.shape[1], 1)
        with np.errstate(over="ignore", invalid="ignore"):
            return np.linalg.norm(places[:, i] - places[:, j], axis=2).min(axis=1)
    from scipy.spatial import KDTree

    return np.array([KDTree(points).query(points, k=2)[0][:, 1].min() for points in places])
