"""Quadrotors under controllers of their own: computed torque, and a Crazyflie's attitude."""

from typing import Any

import jax
import jax.numpy as jnp

from echelon.agents.models.model import FlatChains, Limits, check_positive, diagonal
from echelon.agents.models.rigid_body import (
    THRUST_TWICE,
    UPRIGHT,
    RigidVehicle,
    attitude_along,
    lift_along,
    thrust_axis,
)
from echelon.core.errors import ModelError, check_name
from echelon.core.numerics import derivatives as derivatives_of
from echelon.core.types import Input, InputMap, Scalar, State

# An inner loop on board cancels the attitude dynamics, so that Euler-angle accelerations become the
# input. Gains made for these agents say what formation laws can promise above such a loop.

EULER_GROUPS = {
    "position": ("x", "y", "z"),
    "velocity": ("vx", "vy", "vz"),
    "attitude": ("roll", "pitch", "yaw"),
    "rate": ("roll_rate", "pitch_rate", "yaw_rate"),
}
EULER_STATES = tuple(name for group in EULER_GROUPS.values() for name in group)


def flown_along(path: jax.Array, gravity: float) -> tuple[State, jax.Array, jax.Array]:
    """Return the 12 states that fly a path (5, 4), the thrust with its rate (2,), and zetaddot."""
    lift, now = lift_along(path, gravity), jnp.zeros((), path.dtype)

    def thrust(s: Scalar) -> Scalar:
        return jnp.linalg.norm(lift(s)) - gravity

    # Euler angles and their rates are states here, so that no body rate comes between.
    zeta, rate, bend = derivatives_of(attitude_along(path, gravity), now, 2)
    x = jnp.concatenate([path[0, :3], path[1, :3], zeta, rate])
    return x, derivatives_of(thrust, now, 1), bend


class QuadrotorEuler(RigidVehicle):
    """pdot = v, vdot = R(zeta) e3 (g + a) - g e3, zetaddot = input.

    12 states: position (m), velocity (m/s), Euler angles (rad), Euler-angle rates (rad/s). Inputs:
    thrust over mass minus gravity, a (m/s^2), and Euler-angle accelerations (rad/s^2). The thrust
    column of g still turns with the attitude; see `QuadrotorThrust` for a constant g.
    """

    gravity: float = 9.81

    state_names = EULER_STATES
    state_groups = EULER_GROUPS
    input_names = ("thrust", "roll_acceleration", "pitch_acceleration", "yaw_acceleration")
    input_units = ("m/s^2",) + ("rad/s^2",) * 3
    flat_chains, flat_bounds = THRUST_TWICE, UPRIGHT

    def drift(self, x: State) -> State:
        """Return f(x)."""
        # f is the motion at a = 0, a thrust of m g along the body axis.
        lift = self.gravity * (thrust_axis(x[6:9]) - jnp.array([0.0, 0.0, 1.0], x.dtype))
        return jnp.concatenate([x[3:6], lift, x[9:12], jnp.zeros(3, x.dtype)])

    def input_map(self, x: State) -> InputMap:
        """Return g(x); only the thrust column depends on x."""
        nothing = jnp.zeros((3, 4), x.dtype)
        lift = jnp.pad(thrust_axis(x[6:9])[:, None], ((0, 0), (0, 3)))
        spin = jnp.pad(jnp.eye(3, dtype=x.dtype), ((0, 0), (1, 0)))
        return jnp.concatenate([nothing, lift, nothing, spin])

    def flat(self, derivatives: jax.Array) -> tuple[State, Input]:
        """Return the state and input that fly a path (x, y, z, yaw) with derivatives, (5, 4)."""
        x, thrust, bend = flown_along(derivatives, self.gravity)
        return x, jnp.append(thrust[0], bend)


class QuadrotorThrust(RigidVehicle):
    """The same agent with its thrust as a 13th state, so that g is constant.

    pdot = v, vdot = R(zeta) e3 (g + a) - g e3, zetaddot = input, adot = input. The state a is
    thrust over mass minus gravity (m/s^2); its input is in m/s^3.
    """

    gravity: float = 9.81

    state_names = (*EULER_STATES, "thrust")
    state_units = (*RigidVehicle.state_units, "m/s^2")
    state_groups = EULER_GROUPS
    input_names = ("thrust_rate", "roll_acceleration", "pitch_acceleration", "yaw_acceleration")
    input_units = ("m/s^3",) + ("rad/s^2",) * 3
    flat_chains = FlatChains((4, 4, 4, 2), (1, 0, 0, 0))
    flat_bounds = UPRIGHT
    weights = ((*RigidVehicle.weights[0], 0.04), RigidVehicle.weights[1])

    def drift(self, x: State) -> State:
        """Return f(x)."""
        up = jnp.array([0.0, 0.0, self.gravity], x.dtype)
        # The thrust that turns is a state here, so it is in f, and g holds integrators alone.
        lift = thrust_axis(x[6:9]) * (self.gravity + x[12]) - up
        return jnp.concatenate([x[3:6], lift, x[9:12], jnp.zeros(4, x.dtype)])

    def input_map(self, x: State) -> InputMap:
        """Return g, constant."""
        spin = jnp.pad(jnp.eye(3, dtype=x.dtype), ((0, 0), (1, 0)))
        thrust = jnp.eye(4, dtype=x.dtype)[:1]
        return jnp.concatenate([jnp.zeros((9, 4), x.dtype), spin, thrust])

    def flat(self, derivatives: jax.Array) -> tuple[State, Input]:
        """Return the state and input that fly a path (x, y, z, yaw) with derivatives, (5, 4)."""
        x, thrust, bend = flown_along(derivatives, self.gravity)
        return jnp.append(x, thrust[0]), jnp.append(thrust[1], bend)


def _identified(mass: float, gain: float, stiffness: float, damping: float, command: float,
                yaw: float, motor: float = 0.12) -> dict[str, float]:  # fmt: skip
    attitude = {"stiffness": stiffness, "rate_damping": damping, "command_gain": command}
    return {
        "mass": mass,
        "thrust_gain": gain,
        **attitude,
        "yaw_damping": yaw,
        "motor_thrust": motor,
    }


# Linearized by hand, with inertia and motors of `crazyflie-2.1+` (`quadrotor.py`): a unit of the
# controller's output is a torque of 2 arm F / 65535 about x and y, and 4 F c / 65535 about z, its
# error of the attitude is twice the angle; kR = 70000, kw = 20000, kd_omega = 200, kw_z = 12000.
_FIRMWARE = _identified(0.029, 1.0, 412.3, 58.9, 412.3, 21.0)
ATTITUDE_PARAMETERS: dict[str, dict[str, float]] = {
    "cf2x-l250": _identified(0.0319, 0.97605781, 245.67, 17.32, 196.18, 25.63),
    "cf2x-p250": _identified(0.0318, 0.98275823, 319.14, 20.85, 263.30, 38.43),
    "cf2x-t350": _identified(0.0379, 1.00897793, 371.41695523, 29.26311118, 347.94260321,
                             29.74357219, 0.18),
    "firmware": _FIRMWARE,
}  # fmt: skip
"""Named parameter sets. The first three were identified from flights by the authors of crazyflow
(`so_rpy/params.toml`, learnsyslab, 2026), who fly the firmware's controller 2 (Mellinger): mass
with markers, propellers L250, P250, and the thrust upgrade kit. `firmware` is that controller's
default gains (Bitcraze, `controller_mellinger.c`, 2026), linearized without the motors' lag."""


class CrazyflieAttitude(RigidVehicle):
    """Crazyflie in space whose own controller holds a commanded attitude.

    pdot = v, vdot = R(zeta) e3 k T / m - g e3, rolldotdot = -a roll - b rolldot + c roll_command,
    pitch alike, yawdotdot = d (yaw_rate_command - yawdot).

    States: position (m), velocity (m/s), ZYX Euler angles (rad) and their rates (rad/s). Inputs:
    commanded roll and pitch (rad), yaw rate (rad/s) and thrust T (N). The coefficients are fits of
    flights: motors, filters and delays are in a, b and c, and a steady command of 0.1 rad is
    answered by 0.1 c / a.

    Raises:
        ModelError: a parameter is not positive.
    """

    mass: float = 0.0319
    gravity: float = 9.81
    thrust_gain: float = 0.97605781
    stiffness: float = 245.67
    rate_damping: float = 17.32
    command_gain: float = 196.18
    yaw_damping: float = 25.63
    motor_thrust: float = 0.12
    tilt_limit: float = 0.7
    yaw_rate_limit: float = 3.5

    state_names = EULER_STATES
    state_groups = EULER_GROUPS
    input_names = ("roll_command", "pitch_command", "yaw_rate_command", "thrust")
    input_units = ("rad", "rad", "rad/s", "N")
    flat_chains, flat_bounds = FlatChains((4, 4, 4, 2), (0, 0, 0, 2)), UPRIGHT
    weights = (RigidVehicle.weights[0], (1 / 400,) * 3 + (1 / 25,))
    radius = 0.07  # of the Crazyflie with its propellers

    @classmethod
    def named(cls, name: str, **changes: Any) -> "CrazyflieAttitude":
        """Return the Crazyflie of a named parameter set, one of `ATTITUDE_PARAMETERS`.

        `changes` replace fields of the set.

        Raises:
            ModelError: there is no such set.
        """
        sets = ATTITUDE_PARAMETERS
        check_name("the parameters of `CrazyflieAttitude` are", name, sets, ModelError)
        return cls(**{**sets[name], **changes})

    def __check_init__(self) -> None:
        names = ("mass", "thrust_gain", "stiffness", "rate_damping", "command_gain", "yaw_damping")
        limits = ("motor_thrust", "tilt_limit", "yaw_rate_limit")
        check_positive(self, **{name: getattr(self, name) for name in names + limits})

    @property
    def trim(self) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """Hover at the origin: the thrust that carries m g."""
        return (0.0,) * 12, (0.0, 0.0, 0.0, self.mass * self.gravity / self.thrust_gain)

    @property
    def input_scale(self) -> tuple[tuple[float, ...], ...]:
        """S, with which normalized inputs are accelerations, rad/s^2 and m/s^2."""
        turn = 1.0 / self.command_gain
        return diagonal(turn, turn, 1.0 / self.yaw_damping, self.mass / self.thrust_gain)

    @property
    def input_limits(self) -> Limits:
        """Commands within the limits, and thrusts that a packet can state."""
        # `send_setpoint_manual` writes 0 to 100 % as 10001 to 60000 of 65535.
        low, high = (4.0 * self.motor_thrust * share / 65535.0 for share in (10001.0, 60000.0))
        most = (self.tilt_limit, self.tilt_limit, self.yaw_rate_limit)
        least = tuple(-limit for limit in most)
        return Limits(diagonal(1.0, 1.0, 1.0, 1.0), (*least, low), (*most, high))

    def drift(self, x: State) -> State:
        """Return f(x): free fall, and the attitude without commands."""
        fall = jnp.array([0.0, 0.0, -self.gravity], x.dtype)
        tilt = -self.stiffness * x[6:8] - self.rate_damping * x[9:11]
        return jnp.concatenate([x[3:6], fall, x[9:12], tilt, -self.yaw_damping * x[11:12]])

    def input_map(self, x: State) -> InputMap:
        """Return g(x); only the thrust column depends on x."""
        nothing = jnp.zeros((3, 4), x.dtype)
        axis = thrust_axis(x[6:9])[:, None] * (self.thrust_gain / self.mass)
        lift = jnp.pad(axis, ((0, 0), (3, 0)))
        gains = jnp.array([self.command_gain, self.command_gain, self.yaw_damping], x.dtype)
        turn = jnp.pad(jnp.diag(gains), ((0, 0), (0, 1)))
        return jnp.concatenate([nothing, lift, nothing, turn])

    def flat(self, derivatives: jax.Array) -> tuple[State, Input]:
        """Return the state and input that fly a path (x, y, z, yaw) with derivatives, (5, 4)."""
        x, thrust, bend = flown_along(derivatives, self.gravity)
        back = self.stiffness * x[6:8] + self.rate_damping * x[9:11]
        tilt = (bend[:2] + back) / self.command_gain
        lift = (thrust[0] + self.gravity) * self.mass / self.thrust_gain
        return x, jnp.stack([*tilt, x[11] + bend[2] / self.yaw_damping, lift])
