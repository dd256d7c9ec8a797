"""A rigid body in space: ZYX Euler angles zeta = (roll, pitch, yaw), body rates and motors."""

import math
from collections.abc import Callable
from typing import TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Float

from echelon.agents.models.model import (
    ControlAffine,
    FlatBound,
    FlatChains,
    Heading,
    check_positive,
    default,
    wrap_angles,
)
from echelon.core.errors import ModelError
from echelon.core.types import Input, Output, Scalar, State

# Body to world is Rz(yaw) Ry(pitch) Rx(roll).

Vector: TypeAlias = Float[jax.Array, " 3"]


def check_moments(owner: object, inertia: tuple[float, ...]) -> None:
    """Raise `ModelError` unless an inertia is three positive moments."""
    if not isinstance(inertia, (tuple, list)) or len(inertia) != 3:
        raise ModelError(
            f"`inertia` of `{type(owner).__name__}` is {inertia}, and must be three moments "
            "(Ixx, Iyy, Izz) in kg m^2."
        )
    check_positive(owner, **{f"inertia[{k}]": moment for k, moment in enumerate(inertia)})


def check_inertia(inertia: tuple[float, float, float]) -> None:
    """Raise `ModelError` if a principal moment (kg m^2) exceeds the sum of the other two."""
    # Ixx + Iyy - Izz = int 2 z^2 dm >= 0 for each axis, with equality for a flat plate: hence the
    # slack.
    total = sum(inertia)
    for axis, moment in zip("xyz", inertia, strict=True):
        if 2.0 * moment > total * (1.0 + 1e-12):
            raise ModelError(
                f"`inertia` is {tuple(inertia)} kg m^2, and no rigid body has that: "
                f"I{axis}{axis} = {moment:.6g} exceeds the sum of the other two, "
                f"{total - moment:.6g}; use the identified values `crazyflie`, "
                "or set `allow_unphysical` to keep it."
            )


def free_spin(inertia: tuple[float, float, float], omega: Vector) -> Vector:
    """Return -J^-1 (omega x J omega), the angular acceleration without torque."""
    # Euler's equations: in principal axes J is diagonal, and each axis has one number of it.
    J = jnp.asarray(inertia, omega.dtype)
    before, after = jnp.roll(J, 1), jnp.roll(J, -1)
    return (after - before) / J * jnp.roll(omega, -1) * jnp.roll(omega, 1)


def thrust_axis(zeta: Vector) -> Vector:
    """Return the body z axis in the world frame, R e3."""
    # The third column of Rz(yaw) Ry(pitch) Rx(roll).
    (sr, sp, sy), (cr, cp, cy) = jnp.sin(zeta), jnp.cos(zeta)
    return jnp.stack([cr * sp * cy + sr * sy, cr * sp * sy - sr * cy, cr * cp])


def body_axes(zeta: Vector) -> Float[jax.Array, "3 3"]:
    """Return R, whose columns are the body's axes in the world frame."""
    (sr, sp, sy), (cr, cp, cy) = jnp.sin(zeta), jnp.cos(zeta)
    ahead = jnp.stack([cp * cy, cp * sy, -sp])
    left = jnp.stack([sr * sp * cy - cr * sy, sr * sp * sy + cr * cy, sr * cp])
    return jnp.stack([ahead, left, thrust_axis(zeta)], axis=1)


def euler_rates(zeta: Vector, omega: Vector) -> Vector:
    """Return zetadot = W(zeta) omega (rad/s) from the body rate; singular at pitch +-90 deg."""
    sr, cr = jnp.sin(zeta[0]), jnp.cos(zeta[0])
    p, q, r = omega
    # The yaw rate, of which sin(pitch) turns into roll.
    turn = (sr * q + cr * r) / jnp.cos(zeta[1])
    return jnp.stack([p + jnp.sin(zeta[1]) * turn, cr * q - sr * r, turn])


def body_rates(zeta: Vector, zeta_dot: Vector) -> Vector:
    """Return the body rate omega = W(zeta)^-1 zetadot, rad/s."""
    (sr, sp), (cr, cp) = jnp.sin(zeta[:2]), jnp.cos(zeta[:2])
    roll, pitch, yaw = zeta_dot
    return jnp.stack([roll - sp * yaw, cr * pitch + sr * cp * yaw, cr * cp * yaw - sr * pitch])


def tilt_towards(direction: Vector, yaw: Scalar) -> Vector:
    """Return the angles zeta with the given yaw whose thrust axis points along `direction`."""
    sy, cy = jnp.sin(yaw), jnp.cos(yaw)
    # With the yaw undone R e3 is (cos roll sin pitch, -sin roll, cos roll cos pitch).
    forward = cy * direction[0] + sy * direction[1]
    left = cy * direction[1] - sy * direction[0]
    # atan2 of the two legs keeps the derivative finite where an arcsine of a unit length would not.
    roll = jnp.arctan2(-left, jnp.hypot(forward, direction[2]))
    return jnp.stack([roll, jnp.arctan2(forward, direction[2]), yaw])


def lift_along(path: jax.Array, gravity: float) -> Callable[[Scalar], Vector]:
    """Return the thrust over mass (m/s^2), as a function of time from now, that flies a path.

    The path (x, y, z, ...) is given with its first four derivatives, (5, k); what is returned is
    right at 0 with its first two derivatives.
    """
    acceleration, jerk, snap = path[2:5, :3]
    up = jnp.array([0.0, 0.0, gravity], path.dtype)
    # Taylor's polynomial: the attitude is needed to its second derivative at 0, and no further.
    return lambda s: acceleration + up + s * jerk + 0.5 * s**2 * snap


def attitude_along(path: jax.Array, gravity: float) -> Callable[[Scalar], Vector]:
    """Return the angles zeta, as a function of time from now, that fly a path (x, y, z, yaw).

    The path is given with its first four derivatives, (5, 4); what is returned is right at 0 with
    its first two derivatives.
    """
    lift, yaw = lift_along(path, gravity), path[:3, 3]
    return lambda s: tilt_towards(lift(s), yaw[0] + s * yaw[1] + 0.5 * s**2 * yaw[2])


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
        check_positive(self, gravity=self.gravity)

    def output(self, x: State) -> Output:
        """Return position and yaw."""
        return jnp.concatenate([x[:3], x[8:9]])

    def difference(self, x: State, y: State) -> State:
        """Return x - y with the angles the shorter way round."""
        return wrap_angles(x - y, 6, 7, 8)


# Clipping each motor by itself changes the torques and flips vehicles. Attitude-priority mixing
# keeps the torques: the collective gives way first, then yaw, and roll and pitch are scaled only
# when they alone do not fit.

_REACH = 0.07 / 0.0325
"""Outer edge of the propellers over the motors' distance along a body axis, of a Crazyflie."""


def outer_radius(arm: float) -> float:
    """Return the radius (m) of a vehicle with propellers, from `arm` (m) along each body axis."""
    return _REACH * arm


def _largest_share(base: Input, extra: Input, maximum: float) -> Scalar:
    """Return the largest s in [0, 1] for which thrusts base + s extra span at most `maximum`."""
    # Two thrusts may differ by the maximum; only pairs whose difference grows with s bound it.
    margin = maximum - (base[:, None] - base[None, :])
    growth = extra[:, None] - extra[None, :]
    # The inner choice keeps a division by zero out of the derivative, where it would become NaN.
    bound = jnp.where(growth > 0.0, margin / jnp.where(growth > 0.0, growth, 1.0), jnp.inf)
    return jnp.clip(jnp.min(bound), 0.0, 1.0)


def fits(thrusts: Input, maximum: float) -> jax.Array:
    """Tell whether all thrusts are within [0, maximum], up to rounding."""
    # More than the rounding of the mixer's dozen operations; 1e-14 of the range in float64.
    slack = 64.0 * jnp.finfo(thrusts.dtype).eps * maximum
    return jnp.all((thrusts >= -slack) & (thrusts <= maximum + slack))


def attitude_priority(collective: Scalar, tilt: Input, yaw: Input, maximum: float) -> Input:
    """Return the motor thrusts, each within [0, maximum].

    Args:
        collective: commanded mean thrust of a motor, N.
        tilt: (motors,) thrust differences that make the roll and pitch torques, summing to zero, N.
        yaw: (motors,) those that make the yaw torque, summing to zero, N.
        maximum: largest thrust of one motor, N.
    """
    # Roll and pitch shrink together, which keeps the direction of their torque.
    tilt = tilt * _largest_share(jnp.zeros_like(tilt), tilt, maximum)
    torque = tilt + yaw * _largest_share(tilt, yaw, maximum)
    # The torques span at most the maximum, so that some collective fits.
    return jnp.clip(collective, -jnp.min(torque), maximum - jnp.max(torque)) + torque
