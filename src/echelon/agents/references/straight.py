"""Straight references: a fixed point and a line at constant velocity."""

import jax
import jax.numpy as jnp

from echelon.agents.references.reference import Reference, check_finite, in_space, yaw_at
from echelon.core.types import Scalar

_Vector = tuple[float, ...]


class Hover(Reference):
    """One point (m) with a yaw (rad) that grows by yaw_rate (rad/s)."""

    position: _Vector = (0.0, 0.0, 1.0)
    yaw: float = 0.0
    yaw_rate: float = 0.0

    def __check_init__(self) -> None:
        """Refuse what is not finite."""
        check_finite(self, position=(self.position, 3), **_turning(self))

    def __call__(self, t: Scalar) -> jax.Array:
        """Return the point."""
        # In the precision of t, which is that of the run.
        return in_space(jnp.asarray(self.position, t.dtype), yaw_at(self, t))


class Line(Reference):
    """start + velocity t, in m and m/s, with a yaw (rad) that grows by yaw_rate (rad/s)."""

    start: _Vector = (0.0, 0.0, 1.0)
    velocity: _Vector = (1.0, 0.0, 0.0)
    yaw: float = 0.0
    yaw_rate: float = 0.0

    def __check_init__(self) -> None:
        """Refuse what is not finite."""
        check_finite(self, start=(self.start, 3), velocity=(self.velocity, 3), **_turning(self))

    def __call__(self, t: Scalar) -> jax.Array:
        """Return the point at time t."""
        return in_space(
            jnp.asarray(self.start, t.dtype) + t * jnp.asarray(self.velocity, t.dtype),
            yaw_at(self, t),
        )


def _turning(path: Hover | Line) -> dict[str, object]:
    return {"yaw": (path.yaw, None), "yaw_rate": (path.yaw_rate, None)}
