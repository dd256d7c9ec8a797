"""Motors with limits: how four (or two) thrusts share a commanded collective and torques.

Clipping each motor by itself changes the torques and flips vehicles. Attitude-priority mixing keeps
the torques: the collective gives way first, then yaw, and roll and pitch are scaled only when they
alone do not fit.
"""

import jax
import jax.numpy as jnp

from echelon.core.types import Input, Scalar

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
