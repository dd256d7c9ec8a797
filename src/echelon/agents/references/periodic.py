"""References that come back: the paper's lemniscate, a figure eight and a circle."""

import jax
import jax.numpy as jnp

from echelon.agents.references.reference import Reference, check_finite, yaw_at
from echelon.core.types import Scalar

_Vector = tuple[float, ...]


def _at(center: _Vector, across: jax.Array, along: jax.Array, yaw: jax.Array) -> jax.Array:
    """Return the point (across, along, 0) from the center, with its yaw."""
    cx, cy, cz = center
    # Plain numbers would stack in a type of their own, and not in that of t.
    still = jnp.zeros_like(across)
    return jnp.stack([cx + across, cy + along, cz + still, yaw + still])


class Lemniscate(Reference):
    """The loop of the paper, a lemniscate.

    center + (ax cos th / (1 + sin^2 th), ay sin th cos th / (1 + sin^2 th)), th = rate t + phase.

    The defaults are the fit of the drawn curve; center and amplitude in m, rate in rad/s, phase and
    yaw in rad, yaw_rate in rad/s. The center has three numbers for agents in a plane too, which
    leave its height out.
    """

    center: _Vector = (0.25, 0.25, 1.0)
    # Of equal amplitudes it is Bernoulli's; the drawn curve is stretched, fitted to 1.4 mm rms.
    amplitude: _Vector = (1.25, 3.54)
    rate: float = 0.646
    phase: float = 0.0
    yaw: float = 0.0
    yaw_rate: float = 0.0

    def __check_init__(self) -> None:
        """Refuse what is not finite."""
        _check_periodic(self)
        check_finite(self, amplitude=(self.amplitude, 2))

    def __call__(self, t: Scalar) -> jax.Array:
        """Return the point at time t."""
        s, c = jnp.sin(self.rate * t + self.phase), jnp.cos(self.rate * t + self.phase)
        ax, ay = self.amplitude
        return _at(self.center, ax * c / (1.0 + s**2), ay * s * c / (1.0 + s**2), yaw_at(self, t))


class FigureEight(Reference):
    """center + (ax sin th, ay sin 2 th), th = rate t + phase.

    Center and amplitude are in m, rate in rad/s, phase and yaw in rad, yaw_rate in rad/s. The
    center has three numbers for agents in a plane too, which leave its height out.
    """

    center: _Vector = (0.0, 0.0, 1.0)
    amplitude: _Vector = (1.0, 0.5)
    # 2 pi / 8: once round in 8 s.
    rate: float = 0.785398
    phase: float = 0.0
    yaw: float = 0.0
    yaw_rate: float = 0.0

    def __check_init__(self) -> None:
        """Refuse what is not finite."""
        _check_periodic(self)
        check_finite(self, amplitude=(self.amplitude, 2))

    def __call__(self, t: Scalar) -> jax.Array:
        """Return the point at time t."""
        angle = self.rate * t + self.phase
        ax, ay = self.amplitude
        return _at(self.center, ax * jnp.sin(angle), ay * jnp.sin(2.0 * angle), yaw_at(self, t))


class Circle(Reference):
    """center + radius (cos th, sin th), th = rate t + phase.

    Center and radius are in m, rate in rad/s, phase and yaw in rad, yaw_rate in rad/s. The center
    has three numbers for agents in a plane too, which leave its height out.
    """

    center: _Vector = (0.0, 0.0, 1.0)
    radius: float = 1.0
    rate: float = 0.5
    phase: float = 0.0
    yaw: float = 0.0
    yaw_rate: float = 0.0

    def __check_init__(self) -> None:
        """Refuse what is not finite."""
        _check_periodic(self)
        check_finite(self, radius=(self.radius, None))

    def __call__(self, t: Scalar) -> jax.Array:
        """Return the point at time t."""
        angle = self.rate * t + self.phase
        return _at(
            self.center,
            self.radius * jnp.cos(angle),
            self.radius * jnp.sin(angle),
            yaw_at(self, t),
        )


def _check_periodic(reference: Lemniscate | FigureEight | Circle) -> None:
    check_finite(
        reference,
        center=(reference.center, 3),
        rate=(reference.rate, None),
        phase=(reference.phase, None),
        yaw=(reference.yaw, None),
        yaw_rate=(reference.yaw_rate, None),
    )
