"""The Van der Pol oscillator, an agent unstable at the origin and bounded far from it."""

import jax.numpy as jnp

from echelon.agents.models.model import ControlAffine, FlatChains, check_not_negative
from echelon.core.types import InputMap, State


class VanDerPol(ControlAffine):
    """x1dot = x2, x2dot = damping (1 - x1^2) x2 - x1 + u; dimensionless."""

    damping: float = 1.0

    state_names = ("position", "velocity")
    input_names = ("force",)
    flat_chains, flat_bounds = FlatChains((2,), (0,)), ()

    def __check_init__(self) -> None:
        """Refuse a damping that is negative or not finite."""
        check_not_negative(self, damping=self.damping)

    def drift(self, x: State) -> State:
        """Return f(x)."""
        return jnp.stack([x[1], self.damping * (1.0 - x[0] ** 2) * x[1] - x[0]])

    def input_map(self, x: State) -> InputMap:
        """Return g = (0; 1)."""
        return jnp.array([[0.0], [1.0]], x.dtype)
