"""The quadrotor in a vertical plane, the agent of the optimization baseline (arXiv 2301.05841)."""

import jax
import jax.numpy as jnp
import numpy as np

from echelon.agents.models.model import (
    ControlAffine,
    FlatBound,
    FlatChains,
    Limits,
    check_positive,
    diagonal,
)
from echelon.agents.models.rigid_body import attitude_priority, fits, outer_radius
from echelon.core.types import Input, InputMap, Output, State

# Right and left pairs of motors; each pair counts as one rotor with twice the thrust.
_LEFT = (1.0, -1.0)


class PlanarQuadrotor(ControlAffine):
    """yddot = -(T/m) sin(roll), zddot = (T/m) cos(roll) - g, rollddot = tau / Ixx.

    States: y, z (m), roll (rad) and their rates; inputs: thrust T (N), torque tau (N m). The
    normalized input is (T/m - g, tau/Ixx). Each of the two motor pairs gives between 0 and
    `motor_thrust` newtons.
    """

    mass: float = 0.028
    inertia: float = 16.571710e-6
    gravity: float = 9.81
    # 0.046 m from the hub to a motor, over sqrt 2 along a body axis; 2 x 0.15975 N a pair.
    arm: float = 0.0325
    motor_thrust: float = 0.3195

    state_names = ("y", "z", "roll", "vy", "vz", "roll_rate")
    state_units = ("m", "m", "rad", "m/s", "m/s", "rad/s")
    input_names = ("thrust", "torque")
    input_units = ("N", "N m")
    output_names = ("y", "z")
    position = ("y", "z")
    state_groups = {
        "position": ("y", "z"),
        "velocity": ("vy", "vz"),
        "attitude": ("roll",),
        "rate": ("roll_rate",),
    }
    # One over the square of what counts as much: 1 m, 0.7 rad, 2 m/s, 5 rad/s; 5 m/s^2, 20 rad/s^2.
    weights = ((1.0, 1.0, 2.0, 0.25, 0.25, 0.04), (1 / 25, 1 / 400))
    flat_outputs = ("y", "z")
    # The path's second derivative sets the roll, whose second derivative is the torque.
    flat_order = 4
    flat_chains = FlatChains((4, 4), (2, 0))

    def __check_init__(self) -> None:
        names = ("mass", "inertia", "gravity", "arm", "motor_thrust")
        check_positive(self, **{name: getattr(self, name) for name in names})

    @property
    def radius(self) -> float:
        """The propellers' outer edge, 0.07 m of a Crazyflie."""
        return outer_radius(self.arm)

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
        """Each pair of motors gives between 0 and `motor_thrust`."""
        # T = f1 + f2 and tau = arm (f1 - f2), solved for the thrusts.
        rows = tuple((0.5, sign / (2.0 * self.arm)) for sign in _LEFT)
        return Limits(rows, (0.0,) * 2, (self.motor_thrust,) * 2)

    @property
    def flat_bounds(self) -> tuple[FlatBound, ...]:
        """Thrust stays above 0, and roll within 90 deg, where z'' stays above -g."""
        return (FlatBound(("z",), 2, -self.gravity, "roll within 90 deg"),)

    def drift(self, x: State) -> State:
        """Return f(x): the rates, and free fall."""
        fall = jnp.array([0.0, -self.gravity, 0.0], x.dtype)
        return jnp.concatenate([x[3:6], fall])

    def input_map(self, x: State) -> InputMap:
        """Return g(x): thrust along the body z axis, torque on the roll rate."""
        s, c = jnp.sin(x[2]), jnp.cos(x[2])
        zero, one = jnp.zeros_like(s), jnp.ones_like(s)
        lift = jnp.stack([-s, c, zero]) / self.mass
        spin = jnp.stack([zero, zero, one]) / self.inertia
        return jnp.concatenate([jnp.zeros((3, 2), x.dtype), jnp.stack([lift, spin], axis=1)])

    def output(self, x: State) -> Output:
        """Return y and z."""
        return x[:2]

    def flat(self, derivatives: jax.Array) -> tuple[State, Input]:
        """Return the state and input that fly a path (y, z) given up to its fourth derivative."""
        position, velocity, acceleration, jerk, snap = derivatives
        up = jnp.array([0.0, self.gravity], derivatives.dtype)

        def roll(s: jax.Array) -> jax.Array:
            # Taylor's polynomial of acceleration - gravity: roll is needed to its second derivative
            # at s = 0.
            lift = acceleration + up + s * jerk + 0.5 * s**2 * snap
            # The lift is (T/m) (-sin roll, cos roll).
            return jnp.arctan2(-lift[0], lift[1])

        def roll_rate(s: jax.Array) -> jax.Array:
            return jax.jvp(roll, (s,), (jnp.ones_like(s),))[1]

        now = jnp.zeros((), derivatives.dtype)
        rate, rate_dot = jax.jvp(roll_rate, (now,), (jnp.ones_like(now),))
        x = jnp.concatenate([position, roll(now)[None], velocity, rate[None]])
        return x, jnp.stack(
            [self.mass * jnp.linalg.norm(acceleration + up), self.inertia * rate_dot]
        )

    def limit(self, u: Input) -> Input:
        """Return what two rotors within [0, motor_thrust] deliver, attitude before collective."""
        left = jnp.asarray(_LEFT, u.dtype)
        tilt = u[1] * left / (2.0 * self.arm)
        commanded = u[0] / 2.0 + tilt
        f = attitude_priority(u[0] / 2.0, tilt, jnp.zeros_like(tilt), self.motor_thrust)
        delivered = jnp.stack([jnp.sum(f), self.arm * (left @ f)])
        # u itself where it fits: rounding of the mixing would count as saturation.
        return jnp.where(fits(commanded, self.motor_thrust), u, delivered)


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
    trim, input_scale = PlanarQuadrotor.trim, PlanarQuadrotor.input_scale  # pyright: ignore

    def __check_init__(self) -> None:
        check_positive(self, mass=self.mass, inertia=self.inertia, gravity=self.gravity)

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
