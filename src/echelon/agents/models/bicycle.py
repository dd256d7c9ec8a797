"""A kinematic bicycle: a car or a bicycle whose wheels do not slip, made for a speed."""

import jax
import jax.numpy as jnp
import numpy as np

from echelon.agents.models.model import (
    ControlAffine,
    Heading,
    Limits,
    Pair,
    check_positive,
    wrap_angles,
)
from echelon.core.types import Input, InputMap, Output, State


class Bicycle(ControlAffine):
    """x' = v cos(heading), y' = v sin(heading), heading' = v tan(steering) / L, at the rear axle.

    The inputs are the rates of speed and steering angle. The equations are of R. Rajamani, Vehicle
    Dynamics and Control, 2012, chapter 2; wheelbase and limits are those of the F1TENTH car (1:10)
    in its public simulator. Wheels that slip, and the end stop of the steering (there .42 rad), are
    left out.

    Args:
        speed: of the trim, m/s; at 0 it cannot be stabilized.
        wheelbase: L, m.
        acceleration: the largest, m/s^2, both ways.
        steering_rate: the largest, rad/s.
    """

    speed: float = 2.0
    wheelbase: float = 0.33
    acceleration: float = 9.51
    steering_rate: float = 3.2

    state_names = ("x", "y", "heading", "speed", "steering")
    state_units = ("m", "m", "rad", "m/s", "rad")
    input_names = ("acceleration", "steering_rate")
    input_units = ("m/s^2", "rad/s")
    output_names = ("x", "y")
    position = ("x", "y")
    radius = 0.3
    state_groups = {"position": ("x", "y")}
    heading = Heading("heading", (("x", "y"),))
    chart = {"steering": (-0.5 * np.pi, 0.5 * np.pi)}
    weights = ((1.0, 1.0, 1.0, 1.0, 1.0), (1.0, 1.0))
    flat_outputs = ("x", "y")
    flat_order = 3

    def __check_init__(self) -> None:
        """Check the parameters."""
        names = ("wheelbase", "acceleration", "steering_rate")
        check_positive(self, **{name: getattr(self, name) for name in names})

    @property
    def trim(self) -> Pair:
        """Straight ahead at `speed`."""
        return (0.0, 0.0, 0.0, self.speed, 0.0), (0.0, 0.0)

    @property
    def input_limits(self) -> Limits:
        """Both rates are limited both ways."""
        high = (self.acceleration, self.steering_rate)
        return Limits(((1.0, 0.0), (0.0, 1.0)), (-high[0], -high[1]), high)

    def drift(self, x: State) -> State:
        """Return f(x)."""
        _, _, heading, v, steering = x
        zero = jnp.zeros_like(v)
        turn = v * jnp.tan(steering) / self.wheelbase
        return jnp.stack([v * jnp.cos(heading), v * jnp.sin(heading), turn, zero, zero])

    def input_map(self, x: State) -> InputMap:
        """Return g, which is constant."""
        return jnp.eye(5, 2, -3, dtype=x.dtype)

    def output(self, x: State) -> Output:
        """Return the position."""
        return x[:2]

    def flat(self, derivatives: jax.Array) -> tuple[State, Input]:
        """Return the state and input that drive the path forward; the speed must not vanish."""
        p, d1, d2, d3 = derivatives

        def cross(a: jax.Array, b: jax.Array) -> jax.Array:
            return a[0] * b[1] - a[1] * b[0]

        v = jnp.hypot(*d1)
        rate = d1 @ d2 / v
        # The steering angle has the tangent L curvature.
        bend = self.wheelbase * cross(d1, d2) / v**3
        bending = self.wheelbase * cross(d1, d3) / v**3 - 3.0 * bend * rate / v
        steering = jnp.stack([v, jnp.arctan(bend)])
        x = jnp.concatenate([p, jnp.arctan2(d1[1], d1[0])[None], steering])
        return x, jnp.stack([rate, bending / (1.0 + bend**2)])

    def difference(self, x: State, y: State) -> State:
        """Return x - y with the heading wrapped."""
        return wrap_angles(x - y, 2)
