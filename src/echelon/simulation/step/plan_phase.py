"""The plan of leaders that wait for stragglers: how late it is, and at what pace it continues.

Its pace falls from 1 to 0 as the farthest follower is from a fifth of a distance to all of it off
its place. The leader's stopping point then moves along that of the path, so that followers are sent
its rate as ever.
"""

from typing import NamedTuple

import jax.numpy as jnp

from echelon.core.types import Array, PyTree, Scalar

_FREE, _QUICK = 0.2, 0.2
"""Share of the distance up to which nobody waits, and s in which the pace follows."""


class PlanPhase(NamedTuple):
    """Where leaders are on their plan: how late it is, s, and its pace, s per s."""

    late: Scalar
    pace: Scalar

    @classmethod
    def begin(cls, dtype: jnp.dtype) -> "PlanPhase":
        """Return the plan at the start."""
        return cls(jnp.zeros((), dtype), jnp.ones((), dtype))

    def after(self, away: Scalar, distance: Array, dt: Array | float) -> "PlanPhase":
        """Return the plan a step later.

        Args:
            away: how far the farthest follower is off its place.
            distance: at which the plan stands still.
            dt: the step, s.
        """
        most, span = (jnp.asarray(x, away.dtype) for x in (distance, dt))
        desired = jnp.clip((most - away) / ((1.0 - _FREE) * most), 0.0, 1.0)
        pace = desired + (self.pace - desired) * jnp.exp(-span / _QUICK)
        return PlanPhase(self.late + span * (1.0 - self.pace), pace)


class Followed(NamedTuple):
    """What leaders that wait follow in T frames, in JAX or NumPy: how late (T,) s, and (T, n)."""

    late: PyTree
    reference: PyTree
