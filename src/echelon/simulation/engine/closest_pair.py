"""The two agents of a run that came closest to each other, and what a report says of them."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float


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
