"""A fixed wing in coordinated flight, in space, made for an airspeed in calm air."""

import jax
import jax.numpy as jnp
import numpy as np

from echelon.agents.models.model import (
    ControlAffine,
    Heading,
    Limits,
    Pair,
    Rows,
    check_positive,
    diagonal,
    wrap_angles,
)
from echelon.core.types import Input, InputMap, Output, State

_AXES = 3


class FixedWing(ControlAffine):
    """An airplane that turns by banking, without sideslip; V airspeed, n load, b bank, c climb.

        heading' = g n sin(b) / (V cos(c)),  c' = (g / V) (n cos(b) - cos(c)),
        V' = thrust - k V^2 - g sin(c),      b' = bank_rate

    Thrust is by mass (m/s^2) and n in weights. The equations are the guidance model of R. Beard and
    T. McLain, Small Unmanned Aircraft, 2012, chapter 9. Speed and limits are those of the Parrot
    Disco in ArduPilot (14 m/s, roll 55 deg at 75 deg/s); a glide ratio of 8 and a thrust of half
    the weight are assumed. Drag that grows with the load is left out.

    Args:
        airspeed: of the trim, m/s.
        glide: lift by drag at that speed.
        gravity: m/s^2.
        thrust: the largest, m/s^2.
        load: the largest, weights; the smallest is 0.
        bank_rate: the largest, rad/s.
    """

    airspeed: float = 14.0
    glide: float = 8.0
    gravity: float = 9.81
    thrust: float = 4.9
    load: float = 1.74
    bank_rate: float = 1.31

    state_names = ("x", "y", "z", "heading", "climb", "airspeed", "bank")
    state_units = ("m", "m", "m", "rad", "rad", "m/s", "rad")
    input_names = ("thrust", "load", "bank_rate")
    input_units = ("m/s^2", "", "rad/s")
    output_names = ("x", "y", "z")
    position = ("x", "y", "z")
    radius = 0.6
    state_groups = {"position": ("x", "y", "z")}
    heading = Heading("heading", (("x", "y"),))
    chart = dict.fromkeys(("climb", "bank"), (-0.5 * np.pi, 0.5 * np.pi))
    weights = ((0.04, 0.04, 0.04, 1.0, 1.0, 0.04, 1.0), (1.0, 1.0, 1.0))
    flat_outputs = ("x", "y", "z")
    flat_order = 3

    def __check_init__(self) -> None:
        """Check the parameters."""
        names = ("airspeed", "glide", "gravity", "thrust", "load", "bank_rate")
        check_positive(self, **{name: getattr(self, name) for name in names})

    @property
    def trim(self) -> Pair:
        """Level and straight flight at `airspeed`."""
        return (0.0, 0.0, 0.0, 0.0, 0.0, self.airspeed, 0.0), (self.gravity / self.glide, 1.0, 0.0)

    @property
    def input_scale(self) -> Rows:
        """S, so that the first two normalized inputs are accelerations."""
        return diagonal(1.0, 1.0 / self.gravity, 1.0)

    @property
    def input_limits(self) -> Limits:
        """Thrust, load and rate of bank."""
        low, high = (0.0, 0.0, -self.bank_rate), (self.thrust, self.load, self.bank_rate)
        return Limits(diagonal(1.0, 1.0, 1.0), low, high)

    def drift(self, x: State) -> State:
        """Return f(x)."""
        _, _, _, heading, climb, V, _ = x
        level, zero = V * jnp.cos(climb), jnp.zeros_like(V)
        along = level * jnp.cos(heading), level * jnp.sin(heading), V * jnp.sin(climb)
        sink = -self.gravity * jnp.cos(climb) / V
        slow = -self._drag(V) - self.gravity * jnp.sin(climb)
        return jnp.stack([*along, zero, sink, slow, zero])

    def input_map(self, x: State) -> InputMap:
        """Return g(x)."""
        _, _, _, _, climb, V, bank = x
        lift = self.gravity / V
        g = jnp.zeros((7, 3), x.dtype).at[5, 0].set(1.0).at[6, 2].set(1.0)
        g = g.at[3, 1].set(lift * jnp.sin(bank) / jnp.cos(climb))
        return g.at[4, 1].set(lift * jnp.cos(bank))

    def output(self, x: State) -> Output:
        """Return the position."""
        return x[:_AXES]

    def flat(self, derivatives: jax.Array) -> tuple[State, Input]:
        """Return the state and input that fly the path forward; the speed must not vanish."""
        p, *rates = derivatives

        def attitude(velocity: jax.Array, acceleration: jax.Array) -> jax.Array:
            ground, V = jnp.hypot(*velocity[:2]), jnp.sqrt(velocity @ velocity)
            heading, climb = jnp.arctan2(velocity[1], velocity[0]), jnp.arctan2(velocity[2], ground)
            # Lift carries the weight and bends the path, to the side and upwards.
            side = (velocity[0] * acceleration[1] - velocity[1] * acceleration[0]) / ground
            along = velocity @ acceleration / V
            up = (acceleration[2] - along * velocity[2] / V) * V / ground
            up = up + self.gravity * jnp.cos(climb)
            load = jnp.hypot(side, up) / self.gravity
            thrust = along + self._drag(V) + self.gravity * jnp.sin(climb)
            return jnp.stack([heading, climb, V, jnp.arctan2(side, up), thrust, load])

        now, then = jax.jvp(attitude, (rates[0], rates[1]), (rates[1], rates[2]))
        return jnp.concatenate([p, now[:4]]), jnp.append(now[4:], then[3])

    def difference(self, x: State, y: State) -> State:
        """Return x - y with the heading wrapped."""
        return wrap_angles(x - y, 3)

    def _drag(self, V: jax.Array) -> jax.Array:
        return self.gravity / self.glide * (V / self.airspeed) ** 2
