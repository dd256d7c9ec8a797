"""A quadrotor whose Jacobian tests of enclosures and of exact proofs bound, and boxes for it."""

import math

import jax
import jax.numpy as jnp
import numpy as np

from echelon.core.enclosure.hull import Box

TILT, YAW = math.radians(30.0), math.radians(20.0)
NO_INPUTS = Box(np.zeros(0), np.zeros(0))


def about_zero(*halves):
    return Box(-np.array(halves, float), np.array(halves, float))


def euler_rate_quadrotor(x, v):
    """The Jacobian of a quadrotor with thrust acceleration as a state: g is constant."""

    def velocity(x):
        (sr, sp, sy), (cr, cp, cy) = jnp.sin(x[6:9]), jnp.cos(x[6:9])
        axis = jnp.stack([cy * sp * cr + sy * sr, sy * sp * cr - cy * sr, cp * cr])
        lift = axis * (9.81 + x[12]) - jnp.array([0.0, 0.0, 9.81])
        return jnp.concatenate([x[3:6], lift, x[9:12], jnp.zeros(4)])

    return jax.jacfwd(velocity)(x)


def quadrotor_box(tilt=TILT, yaw=YAW, thrust=3.0):
    return about_zero(*[0.0] * 6, tilt, tilt, yaw, *[0.0] * 3, thrust)
