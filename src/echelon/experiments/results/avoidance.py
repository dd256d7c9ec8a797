"""How near agents came that keep apart, and when they held each other back, over all steps."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from echelon.core.digits import about, at_most
from echelon.core.types import Array
from echelon.simulation.engine.result import Result
from echelon.simulation.step.meter import steps_per_slice

ROUNDING = 1e-4
"""Below its limit by this a distance still counts as kept, m: pages round places."""


class Ellipsoid(NamedTuple):
    """An upright ellipsoid about each agent, in which distances between agents are scaled.

    Attributes:
        radius: horizontal, m.
        height: from its middle to its top, m.
        limit: the scaled distance that agents should keep, m: that of their hulls, or of touching.
    """

    radius: float
    height: float
    limit: float

    @property
    def touching(self) -> float:
        """The scaled distance at which two touch, m."""
        return 2.0 * self.radius

    def radii(self, coordinates: Sequence[str]) -> Float[Array, " d"]:
        """Return the radii along a position's coordinates, m."""
        return np.array([self.height if x == "z" else self.radius for x in coordinates])

    def too_near(
        self, places: Float[Array, "N d"], coordinates: Sequence[str]
    ) -> Float[Array, " N"]:
        """Return 2 for agents whose ellipsoid overlaps another, 1 below the limit, else 0."""
        scaled = places * self.radius / self.radii(coordinates)
        apart = np.linalg.norm(scaled[:, None] - scaled, axis=2)
        np.fill_diagonal(apart, np.inf)
        # Absent agents are nowhere.
        least = np.where(np.isfinite(apart), apart, np.inf).min(axis=1)
        return (least < self.limit - ROUNDING) * 1.0 + (least < self.touching)


class Avoidance(NamedTuple):
    """Numbers of B slices of a run, none before it runs; distances are scaled.

    Attributes:
        times: at which each slice begins, s.
        distance: the least distance between two agents in it, m.
        active: pairs of agents of which one changed the other's rate, each way, on average.
        ellipsoid: about each agent.
    """

    times: Float[np.ndarray, " B"]
    distance: Float[np.ndarray, " B"]
    active: Float[np.ndarray, " B"]
    ellipsoid: Ellipsoid

    @property
    def least(self) -> float:
        """The least distance, m."""
        return float(self.distance.min())

    @property
    def last(self) -> float | None:
        """The beginning of the last slice in which an agent was held back, s; None if none was."""
        held = np.flatnonzero(self.active)
        return float(self.times[held[-1]]) if len(held) else None

    def over(self, times: Float[Array, " T"], values: Float[Array, " B"]) -> Float[Array, " T"]:
        """Return values of slices at times (s)."""
        return values[np.searchsorted(self.times, times, side="right") - 1]

    def sentence(self) -> str:
        """Return them in a sentence."""
        text = f"Smallest scaled distance: {about(self.least, 4)} m; agents touch at "
        text += f"{about(self.ellipsoid.touching, 4)} m, and their hulls keep "
        text += f"{at_most(self.ellipsoid.limit, 4)} m. "
        if self.last is None:
            return f"{text}No agent was held back."
        first, last = (about(float(t)) for t in self.times[np.flatnonzero(self.active)][[0, -1]])
        return f"{text}Agents held each other back between {first} s and {last} s."


def avoidance(result: Result) -> Avoidance | None:
    """Return how agents of a run kept apart; None where they do not."""
    safety, sums, settings = result.drive.safety, result.sums, result.settings
    if safety is None or not sums.steps[0]:
        return None
    each = steps_per_slice(settings)
    count = -(-int(sums.steps[0]) // each)
    begins = each * np.arange(count)
    steps = np.minimum(each, sums.steps[0] - begins)
    return Avoidance(
        begins * settings.dt,
        sums.separation[:, :count].min(axis=0),
        sums.avoidance[:, :count].sum(axis=0) / steps,
        Ellipsoid(safety.size[0], safety.size[2], safety.distance),
    )
