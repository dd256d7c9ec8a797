"""What tests of hulls share: a quadrotor and boxes for it, values at points, who lies in a hull."""

import math

import jax
import jax.numpy as jnp
import numpy as np

from echelon_ranges import Box
from echelon_ranges.jaxpr import float64

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


def values(jacobian, states, inputs, fractions):
    """The Jacobian in float64 at points of a box, given as fractions (..., n + m) of its sides."""
    lower, upper = (np.concatenate([a, b]) for a, b in zip(states, inputs, strict=True))
    points = np.clip(lower + np.asarray(fractions) * (upper - lower), lower, upper)
    n = len(states[0])
    with float64():
        return np.asarray(jax.vmap(jacobian)(*map(jnp.asarray, (points[:, :n], points[:, n:]))))


def points_of(states, inputs, seed, count=200):
    """Fractions of the sides of a box, many of them on its faces."""
    rng = np.random.default_rng(seed)
    return np.clip(rng.uniform(-0.3, 1.3, (count, len(states[0]) + len(inputs[0]))), 0.0, 1.0)


def assert_supported(hull, matrices, seed=0, rounding=1e-14):
    """No linear functional is larger at a matrix than at all vertices together with the error."""
    rng = np.random.default_rng(seed)
    flat = hull.vertices.reshape(len(hull.vertices), -1)
    functionals = [
        *np.eye(flat.shape[1]),
        *-np.eye(flat.shape[1]),
        *rng.normal(size=(200, flat.shape[1])),
    ]
    C = np.array(functionals)
    size = 1.0 + np.abs(flat).max()
    limit = (flat @ C.T).max(axis=0) + np.abs(C) @ hull.error.ravel()
    over = matrices.reshape(len(matrices), -1) @ C.T - limit
    assert (over <= rounding * size * np.abs(C).sum(axis=1)).all()
