"""Numbers that follow from the stored frames of a run, and the two agents that came closest."""

import abc
from collections.abc import Sequence
from typing import NamedTuple, TypeAlias

import numpy as np
from jaxtyping import Bool, Float, Int

from echelon.agents.network.switching import Schedule
from echelon.core.types import Array


class ClosestPair(NamedTuple):
    """Two agents when they were closest to each other.

    Attributes:
        distance: between them, m.
        agents: their numbers, ascending.
        time: s.
        frames: of how many stored frames it is; None if it is of all steps.
    """

    distance: float
    agents: tuple[int, int]
    time: float
    frames: int | None = None

    @classmethod
    def of(cls, places: Float[np.ndarray, "N k"], time: float) -> "ClosestPair":
        """Return the closest of two agents or more at places (m), at a time (s)."""
        from scipy.spatial import KDTree

        # Of places whose squares are beyond floats a tree knows no distances.
        exponent = max(0, int(np.frexp(np.abs(places).max())[1]))
        scaled = np.ldexp(places, -exponent)
        away, near = map(np.asarray, KDTree(scaled).query(scaled, k=2))
        first = int(away[:, 1].argmin())
        # Agents in one place come in any order.
        other = next(int(agent) for agent in near[first] if agent != first)
        with np.errstate(over="ignore"):
            distance = float(np.ldexp(np.linalg.norm(scaled[first] - scaled[other]), exponent))
        return cls(distance, (min(first, other), max(first, other)), time)

    def touch(self, radius: float | None) -> bool:
        """Return whether agents of a radius (m) touched; None has no size."""
        return radius is not None and self.distance < 2.0 * radius

    def sentence(self, radius: float | None, unit: str = "m") -> str:
        """Return who was closest, how close and when, beside the size of agents of a radius (m)."""
        (one, other), near = self.agents, f"{self.distance:.3g} {unit}".rstrip()
        when = f"{self.time:.4g} s"
        if self.frames is not None:
            when += f" in the {self.frames} stored frames"
        size = ""
        if radius is not None:
            sizes = (f"{x} {unit}".rstrip() for x in (f"{radius:.2g}", f"{2.0 * radius:.3g}"))
            size = "; agents of radius {} touch below {}".format(*sizes)
        if self.touch(radius):
            return (
                f"Warning: agents {one} and {other} came within {near} at {when}{size}, "
                "and the simulation lets them pass through each other."
            )
        return f"Smallest distance: {near}, agents {one} and {other} at {when}{size}."


_FEW = 8
"""Agents up to which comparing all pairs is faster than a search for the nearest."""


FrameChoice: TypeAlias = slice | Sequence[int] | Int[Array, " F"]
"""Which frames."""


class FrameNumbers(abc.ABC):
    """Numbers of T frames of N agents with n states, of a `Result` and of a `Recording`."""

    times: Float[Array, " T"]
    states: Float[Array, "T N n"]
    offsets: Float[Array, "N n"]
    nearest: Int[Array, " N"]
    schedule: Schedule | None
    position: tuple[int, ...]
    state_units: tuple[str, ...]

    @abc.abstractmethod
    def offsets_in(self, frames: FrameChoice = slice(None)) -> Float[Array, "*F N n"]:
        """Return the goal offsets in some frames, (F, N, n), or constant ones, (N, n)."""

    @property
    def measured(self) -> tuple[int, ...]:
        """Indices of the states that errors are measured on: the position if any, else all."""
        return self.position or tuple(range(self.offsets.shape[1]))

    @property
    def length_unit(self) -> str:
        """The unit of errors: m for a position in m, nothing for other units and states."""
        metres = all(self.state_units[k] in ("", "m") for k in self.position)
        return "m" if self.position and metres else ""

    @property
    def errors(self) -> Float[Array, "T N n"]:
        """Deviation of each agent from its goal relative to its nearest leader; 0 of leaders."""
        return self.deviations()

    @property
    def formation_errors(self) -> Float[Array, "T N"]:
        """Each agent's distance from its goal."""
        return self.goal_distances()

    @property
    def presence(self) -> Bool[Array, "T N"] | None:
        """Which agents are there in each frame; None where all always are."""
        schedule = self.schedule
        if schedule is None or schedule.present is None:
            return None
        return schedule.present[schedule.rows(self.times)]

    @property
    def nearest_then(self) -> Int[Array, "T N"]:
        """The leader that each agent follows in each frame."""
        schedule = self.schedule
        if schedule is None or schedule.nearest is None:
            return np.tile(self.nearest, (len(self.times), 1))
        return schedule.nearest[schedule.rows(self.times)]

    def deviations(self, frames: FrameChoice = slice(None)) -> Float[Array, "F N n"]:
        """Return `errors` in some frames; those of absent agents are zero."""
        # delta_i = y_i - y_0 (theory page), which V and the certified set are written in.
        y = self.states[frames] - self.offsets_in(frames)
        if self.presence is None:
            return y - y[:, self.nearest]
        away = y - np.take_along_axis(y, self.nearest_then[frames][:, :, None], axis=1)
        return np.where(self.presence[frames][:, :, None], away, 0.0)

    def goals(self, frames: FrameChoice = slice(None)) -> Float[Array, "F N n"]:
        """Return the states that the agents would have without errors, in some frames."""
        return self.states[frames] - self.deviations(frames)

    def goal_distances(self, frames: FrameChoice = slice(None)) -> Float[Array, "F N"]:
        """Return `formation_errors` in some frames."""
        # Where a square overflows, the length is infinite.
        with np.errstate(over="ignore", invalid="ignore"):
            return np.linalg.norm(self.deviations(frames)[:, :, list(self.measured)], axis=2)

    def least_distances(
        self, frames: FrameChoice = slice(None), scales: Float[Array, " d"] | float = 1.0
    ) -> Float[Array, " F"] | None:
        """Return the smallest distance between two agents in frames, NaN if one is not finite.

        None without a position. The position's coordinates are multiplied by `scales`.
        """
        if not self.position:
            return None
        places = self.states[frames][:, :, list(self.position)] * scales
        if self.presence is not None:
            here = self.presence[frames]
            each = (place[who] for place, who in zip(places, here, strict=True))
            some = (_least(place[None])[0] if len(place) > 1 else np.inf for place in each)
            return np.array([*some])
        least = np.full(len(places), np.nan)
        finite = np.isfinite(places).all(axis=(1, 2))
        least[finite] = _least(places[finite])
        return least

    def closest_pair(self, scales: Float[Array, " d"] | float = 1.0) -> ClosestPair | None:
        """Return which agents were closest to each other in the stored frames, and when.

        None without a position, a second agent or a frame of finite numbers.
        """
        pairs = self.approaches(scales)
        return pairs[-1] if pairs else None

    def approaches(self, scales: Float[Array, " d"] | float = 1.0) -> list[ClosestPair]:
        """Return the pairs that were closer than any in a frame before, in the order of time."""
        if not self.position or self.states.shape[1] < 2 or not len(self.times):
            return []
        places, pairs = self.states[:, :, list(self.position)] * scales, list[ClosestPair]()
        least, bound = np.inf, -np.inf
        if self.presence is not None:
            return _approaches_of_some(places, self.presence, self.times)
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


def _approaches_of_some(
    places: Float[Array, "T N k"], presence: Bool[Array, "T N"], times: Float[Array, " T"]
) -> list[ClosestPair]:
    pairs = list[ClosestPair]()
    for place, here, time in zip(places, presence, times.tolist(), strict=True):
        who = np.flatnonzero(here)
        if len(who) < 2 or not np.isfinite(place[who]).all():
            continue
        pair = ClosestPair.of(place[who], time)
        if not pairs or pair.distance < pairs[-1].distance:
            first, other = who[list(pair.agents)].tolist()
            pairs.append(pair._replace(agents=(first, other)))
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
