"""Straight and periodic references: a point, a line, the lemniscate, a figure eight, a circle."""

import abc

import equinox as eqx
import jax
import jax.numpy as jnp

from echelon.agents.references.reference import Reference, check_finite, in_space
from echelon.core.types import Scalar

_Vector = tuple[float, ...]


class Hover(Reference):
    """One point (m) with a yaw (rad) that grows by yaw_rate (rad/s)."""

    position: _Vector = (0.0, 0.0, 1.0)
    yaw: float = 0.0
    yaw_rate: float = 0.0

    def __check_init__(self) -> None:
        check_finite(self, position=(self.position, 3), **_turning(self))

    def __call__(self, t: Scalar) -> jax.Array:
        """Return the point at time t."""
        # In the precision of t, which is that of the run.
        return in_space(jnp.asarray(self.position, t.dtype), self.yaw + self.yaw_rate * t)


class Line(Reference):
    """start + velocity t, in m and m/s, with a yaw (rad) that grows by yaw_rate (rad/s)."""

    start: _Vector = (0.0, 0.0, 1.0)
    velocity: _Vector = (1.0, 0.0, 0.0)
    yaw: float = 0.0
    yaw_rate: float = 0.0

    def __check_init__(self) -> None:
        check_finite(self, start=(self.start, 3), velocity=(self.velocity, 3), **_turning(self))

    def __call__(self, t: Scalar) -> jax.Array:
        """Return the point at time t."""
        return in_space(
            jnp.asarray(self.start, t.dtype) + t * jnp.asarray(self.velocity, t.dtype),
            self.yaw + self.yaw_rate * t,
        )


def _turning(path: Hover | Line) -> dict[str, object]:
    return {"yaw": (path.yaw, None), "yaw_rate": (path.yaw_rate, None)}


class Periodic(Reference):
    """center + loop(th), th = rate t + phase, in a horizontal plane; abstract.

    Lengths are in m, rate in rad/s, phase and yaw in rad, yaw_rate in rad/s. The center has three
    numbers for agents in a plane too, which ignore its height.
    """

    center: eqx.AbstractVar[_Vector]
    rate: eqx.AbstractVar[float]
    phase: eqx.AbstractVar[float]
    yaw: eqx.AbstractVar[float]
    yaw_rate: eqx.AbstractVar[float]

    @abc.abstractmethod
    def loop(self, angle: Scalar) -> tuple[Scalar, Scalar]:
        """Return the point (x, y) of the loop about the center at an angle (rad)."""

    def __check_init__(self) -> None:
        names = ("rate", "phase", "yaw", "yaw_rate")
        check_finite(self, center=(self.center, 3), **{n: (getattr(self, n), None) for n in names})

    def __call__(self, t: Scalar) -> jax.Array:
        """Return the point at time t."""
        x, y = self.loop(self.rate * t + self.phase)
        cx, cy, cz = self.center
        # Plain numbers would stack in a type of their own, and not in that of t.
        zero = jnp.zeros_like(x)
        return jnp.stack([cx + x, cy + y, cz + zero, self.yaw + self.yaw_rate * t + zero])


class Lemniscate(Periodic):
    """The lemniscate of the paper, stretched.

    center + (ax cos th / (1 + sin^2 th), ay sin th cos th / (1 + sin^2 th)), th = rate t + phase.

    The defaults fit the drawn curve. Center and amplitude are in m, rate in rad/s, phase and yaw in
    rad, yaw_rate in rad/s. The center has three numbers for agents in a plane too, which ignore its
    height.
    """

    center: _Vector = (0.25, 0.25, 1.0)
    # With equal amplitudes it is Bernoulli's; the drawn curve is stretched, fitted to 1.4 mm rms.
    amplitude: _Vector = (1.25, 3.54)
    rate: float = 0.646
    phase: float = 0.0
    yaw: float = 0.0
    yaw_rate: float = 0.0

    def __check_init__(self) -> None:
        check_finite(self, amplitude=(self.amplitude, 2))

    def loop(self, angle: Scalar) -> tuple[Scalar, Scalar]:
        """Return the point (x, y) about the center at an angle (rad)."""
        s, c = jnp.sin(angle), jnp.cos(angle)
        ax, ay = self.amplitude
        return ax * c / (1.0 + s**2), ay * s * c / (1.0 + s**2)


class FigureEight(Periodic):
    """center + (ax sin th, ay sin 2 th), th = rate t + phase.

    Center and amplitude are in m, rate in rad/s, phase and yaw in rad, yaw_rate in rad/s. The
    center has three numbers for agents in a plane too, which ignore its height.
    """

    center: _Vector = (0.0, 0.0, 1.0)
    amplitude: _Vector = (1.0, 0.5)
    # 2 pi / 8: one period in 8 s.
    rate: float = 0.785398
    phase: float = 0.0
    yaw: float = 0.0
    yaw_rate: float = 0.0

    def __check_init__(self) -> None:
        check_finite(self, amplitude=(self.amplitude, 2))

    def loop(self, angle: Scalar) -> tuple[Scalar, Scalar]:
        """Return the point (x, y) about the center at an angle (rad)."""
        ax, ay = self.amplitude
        return ax * jnp.sin(angle), ay * jnp.sin(2.0 * angle)


class Circle(Periodic):
    """center + radius (cos th, sin th), th = rate t + phase.

    Center and radius are in m, rate in rad/s, phase and yaw in rad, yaw_rate in rad/s. The center
    has three numbers for agents in a plane too, which ignore its height.
    """

    center: _Vector = (0.0, 0.0, 1.0)
    radius: float = 1.0
    rate: float = 0.5
    phase: float = 0.0
    yaw: float = 0.0
    yaw_rate: float = 0.0

    def __check_init__(self) -> None:
        check_finite(self, radius=(self.radius, None))

    def loop(self, angle: Scalar) -> tuple[Scalar, Scalar]:
        """Return the point (x, y) about the center at an angle (rad)."""
        return self.radius * jnp.cos(angle), self.radius * jnp.sin(angle)
