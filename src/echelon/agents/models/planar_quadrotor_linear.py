"""The planar quadrotor linearized about hover, of the paper's optimization baseline."""

import jax.numpy as jnp
import numpy as np

from echelon.agents.models.model import ControlAffine, Limits, check_positive, diagonal
from echelon.core.types import InputMap, Output, State


class LinearPlanarQuadrotor(ControlAffine):
    """yddot = -g roll, zddot = -g + u1 / m, rollddot = u2 / Ixx: hover's linearization.

    The input u1 is the whole thrust, not its deviation from hover. Mass and inertia are the
    Crazyflie's. The source prints neither; with these the published deviations come out.
    """

    mass: float = 0.028
    inertia: float = 16.571710e-6
    gravity: float = 9.81

    # The source's order: a coordinate, then its rate.
    state_names = ("y", "vy", "z", "vz", "roll", "roll_rate")
    state_units = ("m", "m/s", "m", "m/s", "rad", "rad/s")
    input_names = ("thrust", "torque")
    input_units = ("N", "N m")
    output_names = ("y", "z")
    position = ("y", "z")
    radius = 0.07  # of the Crazyflie with its propellers
    state_groups = {"position": ("y", "z"), "velocity": ("vy", "vz")}

    def __check_init__(self) -> None:
        """Refuse parameters that are not positive."""
        check_positive(self, mass=self.mass, inertia=self.inertia, gravity=self.gravity)

    @property
    def trim(self) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """Hover at the origin."""
        return (0.0,) * 6, (self.mass * self.gravity, 0.0)

    @property
    def input_scale(self) -> tuple[tuple[float, ...], ...]:
        """S = diag(m, Ixx)."""
        return diagonal(self.mass, self.inertia)

    @property
    def input_limits(self) -> Limits:
        """|u1| <= 1.2 m g and |u2| <= Ixx pi / 10, as printed."""
        # To both sides, as the source prints it, though no rotor can pull.
        high = (1.2 * self.mass * self.gravity, self.inertia * float(np.pi) / 10.0)
        return Limits(diagonal(1.0, 1.0), (-high[0], -high[1]), high)

    def drift(self, x: State) -> State:
        """Return f(x)."""
        zero, fall = jnp.zeros((), x.dtype), jnp.asarray(-self.gravity, x.dtype)
        return jnp.stack([x[1], -self.gravity * x[4], x[3], fall, x[5], zero])

    def input_map(self, x: State) -> InputMap:
        """Return g."""
        # Filled by NumPy, so that a trace sees one constant and no updates.
        g = np.zeros((6, 2))
        g[3, 0], g[5, 1] = 1.0 / self.mass, 1.0 / self.inertia
        return jnp.asarray(g, x.dtype)

    def output(self, x: State) -> Output:
        """Return y and z."""
        return x[0:3:2]
