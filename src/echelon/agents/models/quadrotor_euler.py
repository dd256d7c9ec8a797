"""Quadrotors under computed torque: the input map becomes constant, which global proofs need.

An inner loop on board cancels the attitude dynamics, so that Euler-angle accelerations become the
input. Gains made for these agents say what formation laws can promise above such a loop.
"""

import jax
import jax.numpy as jnp

from echelon.agents.models.model import FlatChains
from echelon.agents.models.rigid_body import attitude_along, lift_along, thrust_axis
from echelon.agents.models.rigid_vehicle import THRUST_TWICE, UPRIGHT, RigidVehicle
from echelon.core.numerics import derivatives as derivatives_of
from echelon.core.types import Input, InputMap, Scalar, State

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
        """Return the state and input that fly a path (x, y, z, yaw).

        The path is given with its first four derivatives, (5, 4).
        """
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
        """Return the state and input that fly a path (x, y, z, yaw).

        The path is given with its first four derivatives, (5, 4).
        """
        x, thrust, bend = flown_along(derivatives, self.gravity)
        return jnp.append(x, thrust[0]), jnp.append(thrust[1], bend)
