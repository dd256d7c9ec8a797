"""The unicycle described by its axle, and the same vehicle described by a point ahead of it."""

import jax
import jax.numpy as jnp

from echelon.agents.models.model import (
    ControlAffine,
    FlatBound,
    FlatChains,
    Heading,
    Pair,
    check_positive,
    diagonal,
    wrap_angles,
)
from echelon.core.types import Input, InputMap, State


def _drive(derivatives: jax.Array) -> tuple[State, Input]:
    """Return axle state (x, y, heading) and input (speed, turn rate) on a path, speed > 0."""
    (px, py), (vx, vy), (ax, ay) = derivatives
    speed = jnp.hypot(vx, vy)
    # The derivative of atan2(vy, vx).
    turn_rate = (vx * ay - vy * ax) / speed**2
    return jnp.stack([px, py, jnp.arctan2(vy, vx)]), jnp.stack([speed, turn_rate])


class Unicycle(ControlAffine):
    """xdot = v cos(heading), ydot = v sin(heading), headingdot = turn rate; metres and radians.

    Its linearization at rest cannot be stabilized (sideways motion), so Riccati gains do not exist
    for it; at a `speed` they do.

    Args:
        speed: of the trim, m/s.
    """

    speed: float = 0.0

    state_names = ("x", "y", "heading")
    state_units = ("m", "m", "rad")
    input_names = ("speed", "turn_rate")
    input_units = ("m/s", "rad/s")
    position = ("x", "y")
    state_groups = {"position": ("x", "y")}
    heading = Heading("heading", (("x", "y"),))
    flat_outputs = ("x", "y")
    flat_order = 2
    flat_chains = FlatChains((2, 2), (1, 0))
    # Where (x', y') is not 0 it has the heading's direction and the speed for its length.
    flat_bounds = (FlatBound(("x", "y"), 1, 0.0, "a speed above 0"),)

    @property
    def trim(self) -> Pair:
        """Straight ahead at `speed`."""
        return (0.0, 0.0, 0.0), (self.speed, 0.0)

    def initial_integrators(self, x: State, ahead: jax.Array) -> jax.Array:
        """Return the speed of what it follows, beyond that of the trim."""
        return jnp.hypot(*ahead[1])[None] - self.speed

    def drift(self, x: State) -> State:
        """Return f = 0."""
        return jnp.zeros_like(x)

    def input_map(self, x: State) -> InputMap:
        """Return g(x)."""
        c, s = jnp.cos(x[2]), jnp.sin(x[2])
        zero, one = jnp.zeros_like(c), jnp.ones_like(c)
        return jnp.stack([jnp.stack([c, zero]), jnp.stack([s, zero]), jnp.stack([zero, one])])

    def flat(self, derivatives: jax.Array) -> tuple[State, Input]:
        """Return the state and input that drive the path forward; the speed must not vanish."""
        return _drive(derivatives)

    def difference(self, x: State, y: State) -> State:
        """Return x - y with the heading wrapped."""
        return wrap_angles(x - y, 2)


class UnicyclePoint(ControlAffine):
    """A unicycle described by the point `ahead` metres in front of its axle, and its heading.

    With p the point: pdot = R(heading) (v, ahead w), headingdot = w. The normalized input
    (v, ahead w) is the point's velocity in the body frame, so that on positions g g^T is constant.
    As the inputs move the point at once, its chains leave the heading out: the law `stopping-point`
    is for `Unicycle`, the same vehicle.
    """

    ahead: float = 0.1

    state_names = ("x", "y", "heading")
    state_units = ("m", "m", "rad")
    input_names = ("speed", "turn_rate")
    input_units = ("m/s", "rad/s")
    position = ("x", "y")
    state_groups = {"position": ("x", "y")}
    heading = Heading("heading", (("x", "y"),))
    flat_outputs = ("x", "y")
    flat_order = 2

    def __check_init__(self) -> None:
        check_positive(self, ahead=self.ahead)

    @property
    def input_scale(self) -> tuple[tuple[float, ...], ...]:
        """S = diag(1, 1 / ahead)."""
        # With ahead w as the input g is a rotation on positions, so that g g' = I there.
        return diagonal(1.0, 1.0 / self.ahead)

    def drift(self, x: State) -> State:
        """Return f = 0."""
        return jnp.zeros_like(x)

    def input_map(self, x: State) -> InputMap:
        """Return g(x)."""
        c, s = jnp.cos(x[2]), jnp.sin(x[2])
        zero, one = jnp.zeros_like(c), jnp.ones_like(c)
        rows = [[c, -self.ahead * s], [s, self.ahead * c], [zero, one]]
        return jnp.stack([jnp.stack(row) for row in rows])

    def flat(self, derivatives: jax.Array) -> tuple[State, Input]:
        """Return the state and input whose axle drives the path forward.

        The speed must not vanish.
        """
        axle, u = _drive(derivatives)
        point = axle[:2] + self.ahead * jnp.stack([jnp.cos(axle[2]), jnp.sin(axle[2])])
        return jnp.append(point, axle[2]), u

    def difference(self, x: State, y: State) -> State:
        """Return x - y with the heading wrapped."""
        return wrap_angles(x - y, 2)
