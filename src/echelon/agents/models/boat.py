"""A boat under two thrusters: surge, sway and yaw, made for a speed at which it can be held."""

import jax.numpy as jnp

from echelon.agents.models.model import (
    ControlAffine,
    Heading,
    Limits,
    Pair,
    Rows,
    check_not_negative,
    check_positive,
    diagonal,
    wrap_angles,
)
from echelon.core.types import InputMap, Output, State


class Boat(ControlAffine):
    """A surface vessel in calm water, in surge u, sway v and yaw r about its pivot.

        m_u u' = m_v v r - d_u u + thrust
        m_v v' = -m_u u r - d_v v
        J r' = -d_r (1 + k |r|) r + moment

    Sideways nothing drives it, so at rest it cannot be stabilized; its trim moves at `speed`. The
    equations are of T. I. Fossen, Handbook of Marine Craft Hydrodynamics and Motion Control, 2021,
    with the masses, drags and thrusters of the Otter (2 m long, 6 knots) in his MSS toolbox. Left
    out are cross-flow drag, the coupling by the centre of gravity, and the Munk moment, so that the
    boat keeps its course by itself; the toolbox lets its users cancel that too.

    Args:
        speed: of the trim, m/s.
        surge_mass, sway_mass: with the water that moves along, kg.
        yaw_inertia: likewise, kg m^2.
        surge_drag, sway_drag: N s/m.
        yaw_drag: N m s.
        yaw_growth: k, s/rad.
        arm: of each thruster from the middle, m.
        forward, backward: largest thrust of one thruster, N.
    """

    speed: float = 2.0
    surge_mass: float = 60.3
    sway_mass: float = 137.5
    yaw_inertia: float = 43.1
    surge_drag: float = 77.6
    sway_drag: float = 137.5
    yaw_drag: float = 43.1
    yaw_growth: float = 10.0
    arm: float = 0.395
    forward: float = 119.7
    backward: float = 66.7

    state_names = ("x", "y", "heading", "u", "v", "r")
    state_units = ("m", "m", "rad", "m/s", "m/s", "rad/s")
    input_names = ("thrust", "moment")
    input_units = ("N", "N m")
    output_names = ("x", "y")
    position = ("x", "y")
    radius = 1.14
    state_groups = {"position": ("x", "y"), "velocity": ("u", "v")}
    heading = Heading("heading", (("x", "y"),))
    weights = ((4.3, 3.6, 24.0, 0.02, 0.02, 0.01), (1.0, 0.5))

    def __check_init__(self) -> None:
        """Check the parameters."""
        names = ("surge_mass", "sway_mass", "yaw_inertia", "arm", "forward", "backward")
        check_positive(self, **{name: getattr(self, name) for name in names})
        drags = ("surge_drag", "sway_drag", "yaw_drag", "yaw_growth")
        check_not_negative(self, **{name: getattr(self, name) for name in drags})

    @property
    def trim(self) -> Pair:
        """Straight ahead at `speed`."""
        still = (0.0, 0.0)
        return (0.0, 0.0, 0.0, self.speed, *still), (self.surge_drag * self.speed, 0.0)

    @property
    def input_scale(self) -> Rows:
        """S = diag(m_u, J), so that normalized inputs are accelerations."""
        return diagonal(self.surge_mass, self.yaw_inertia)

    @property
    def input_limits(self) -> Limits:
        """The thrusts of the right and the left thruster."""
        lever = 0.5 / self.arm
        low, high = (-self.backward,) * 2, (self.forward,) * 2
        return Limits(((0.5, lever), (0.5, -lever)), low, high)

    def drift(self, x: State) -> State:
        """Return f(x)."""
        _, _, heading, u, v, r = x
        c, s = jnp.cos(heading), jnp.sin(heading)
        surge = (self.sway_mass * v * r - self.surge_drag * u) / self.surge_mass
        sway = (-self.surge_mass * u * r - self.sway_drag * v) / self.sway_mass
        yaw = -self.yaw_drag * (1.0 + self.yaw_growth * jnp.abs(r)) * r / self.yaw_inertia
        return jnp.stack([u * c - v * s, u * s + v * c, r, surge, sway, yaw])

    def input_map(self, x: State) -> InputMap:
        """Return g, which is constant."""
        g = jnp.zeros((6, 2), x.dtype)
        return g.at[3, 0].set(1.0 / self.surge_mass).at[5, 1].set(1.0 / self.yaw_inertia)

    def output(self, x: State) -> Output:
        """Return the position."""
        return x[:2]

    def difference(self, x: State, y: State) -> State:
        """Return x - y with the heading wrapped."""
        return wrap_angles(x - y, 2)
