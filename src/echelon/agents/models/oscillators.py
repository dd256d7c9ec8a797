"""Small agents with a nonlinear drift: a damped pendulum and the Van der Pol oscillator."""

import jax.numpy as jnp

from echelon.agents.models.model import (
    ControlAffine,
    FlatChains,
    check_not_negative,
    check_positive,
)
from echelon.core.types import InputMap, State


class Pendulum(ControlAffine):
    """angledot = rate, ratedot = -stiffness sin(angle) - damping rate + u.

    `stiffness` is gravity over length, 1/s^2; `damping` is in 1/s; u is torque over inertia,
    rad/s^2.
    """

    damping: float = 0.5
    stiffness: float = 9.81

    state_names = ("angle", "rate")
    state_units = ("rad", "rad/s")
    input_names = ("torque",)
    input_units = ("rad/s^2",)
    flat_chains, flat_bounds = FlatChains((2,), (0,)), ()

    def __check_init__(self) -> None:
        check_positive(self, stiffness=self.stiffness)
        check_not_negative(self, damping=self.damping)

    def drift(self, x: State) -> State:
        """Return f(x)."""
        return jnp.stack([x[1], -self.stiffness * jnp.sin(x[0]) - self.damping * x[1]])

    def input_map(self, x: State) -> InputMap:
        """Return g = (0; 1)."""
        return jnp.array([[0.0], [1.0]], x.dtype)


class VanDerPol(ControlAffine):
    """x1dot = x2, x2dot = damping (1 - x1^2) x2 - x1 + u; dimensionless."""

    damping: float = 1.0

    state_names = ("position", "velocity")
    input_names = ("force",)
    flat_chains, flat_bounds = FlatChains((2,), (0,)), ()

    def __check_init__(self) -> None:
        check_not_negative(self, damping=self.damping)

    def drift(self, x: State) -> State:
        """Return f(x)."""
        return jnp.stack([x[1], self.damping * (1.0 - x[0] ** 2) * x[1] - x[0]])

    def input_map(self, x: State) -> InputMap:
        """Return g = (0; 1)."""
        return jnp.array([[0.0], [1.0]], x.dtype)
