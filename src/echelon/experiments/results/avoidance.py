"""How near agents came that keep apart, and when they held each other back, over all steps."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from echelon.simulation.engine.result import Result
from echelon.simulation.step.meter import steps_per_slice


class Avoidance(NamedTuple):
    """Numbers of B slices of a run; heights are divided by the ellipsoid's height over its width.

    Attributes:
        times: at which each slice begins, s.
        distance: the least distance between two agents in it, m.
        active: pairs of agents of which one changed the other's rate, each way, on average.
        touching: the distance at which ellipsoids touch, m.
        kept: the distance that hulls keep, m.
    """

    times: Float[np.ndarray, " B"]
    distance: Float[np.ndarray, " B"]
    active: Float[np.ndarray, " B"]
    touching: float
    kept: float

    @property
    def least(self) -> float:
        """The least distance, m."""
        return float(self.distance.min())

    @property
    def last(self) -> float | None:
        """The beginning of the last slice in which an agent was held back, s; None if none was."""
        held = np.flatnonzero(self.active)
        return float(self.times[held[-1]]) if len(held) else None

    def sentence(self) -> str:
        """Return them in a sentence."""
        text = f"Smallest scaled distance: {self.least:.4g} m; agents touch at "
        text += f"{self.touching:.4g} m, and their hulls keep {self.kept:.4g} m. "
        if self.last is None:
            return f"{text}No agent was held back."
        first = self.times[np.flatnonzero(self.active)[0]]
        return f"{text}Agents held each other back between {first:.3g} s and {self.last:.3g} s."


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
        safety.touching,
        safety.distance,
    )
