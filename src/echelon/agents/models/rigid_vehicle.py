"""Rigid vehicles in space under thrust: the names, units, output and heading that they share."""

import math

import equinox as eqx
import jax.numpy as jnp

from echelon.agents.models.heading import Heading
from echelon.agents.models.model import (
    ControlAffine,
    FlatBound,
    FlatChains,
    check_positive,
    default,
    wrap_angles,
)
from echelon.core.types import Output, State

# z'' = (T/m) cos(roll) cos(pitch) - g, and none of the three factors passes 0 unless z'' passes -g.
# Each vehicle declares bound and chains itself: a proof reads no declaration of a base class whose
# motion it does not have (`declarations.py`).
UPRIGHT = default(
    lambda vehicle: (FlatBound(("z",), 2, -vehicle.gravity, "roll and pitch within 90 deg"),)
)
"""`flat_bounds` of a vehicle: its thrust stays above 0, its roll and pitch within 90 degrees."""
THRUST_TWICE = FlatChains((4, 4, 4, 2), (2, 0, 0, 0))
"""`flat_chains` of a vehicle: with two integrators before the thrust."""


class RigidVehicle(ControlAffine):
    """A vehicle that a thrust along its body z axis lifts and three further inputs turn; abstract.

    The first 12 states are position (m), velocity (m/s), ZYX Euler angles (rad) and the rates of
    the attitude (rad/s). A subclass names the states and the inputs.
    """

    gravity: eqx.AbstractVar[float]

    state_units = ("m",) * 3 + ("m/s",) * 3 + ("rad",) * 3 + ("rad/s",) * 3
    output_names = ("x", "y", "z", "yaw")
    position = ("x", "y", "z")
    chart = {"pitch": (-math.pi / 2, math.pi / 2)}
    heading = Heading("yaw", (("x", "y"), ("vx", "vy")))
    # One over the square of what counts as much: 1 m, 2 m/s, 0.7 rad, 5 rad/s; 5 m/s^2, 20 rad/s^2.
    weights = ((1.0,) * 3 + (0.25,) * 3 + (2.0,) * 3 + (0.04,) * 3, (1 / 25,) + (1 / 400,) * 3)
    flat_outputs = ("x", "y", "z", "yaw")
    # The path's second derivative sets the attitude, whose second derivative is the input.
    flat_order = 4

    def __check_init__(self) -> None:
        """Refuse a gravity that is not positive."""
        check_positive(self, gravity=self.gravity)

    def output(self, x: State) -> Output:
        """Return position and yaw."""
        return jnp.concatenate([x[:3], x[8:9]])

    def difference(self, x: State, y: State) -> State:
        """Return x - y with the angles the shorter way round."""
        return wrap_angles(x - y, 6, 7, 8)
