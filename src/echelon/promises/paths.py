"""What a leader's path asks at least of a derivative."""

from fractions import Fraction
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from echelon.core.errors import GainError
from echelon.core.kept import kept
from echelon.core.words import Kind
from echelon.enclosure.hull import Box, value_hull
from echelon.laws.stopping_point import StoppingLeader
from echelon.models.model import ControlAffine

_SAMPLES = 4001


class Least(NamedTuple):
    """The least value, and by which kind of argument."""

    value: float
    kind: Kind


@kept
def least_on_path(
    leader: StoppingLeader, model: ControlAffine, horizon: float, output: int, order: int
) -> Least:
    """Return what a derivative of an output of a leader's path is not below until the horizon (s).

    It is enclosed in rationals where the path is made of what has an enclosure, and else seen at
    samples.
    """

    def derivative(t: jax.Array, nothing: jax.Array) -> jax.Array:
        return leader.path(model, t[0])[order, output].reshape(1, 1)

    try:
        hull = value_hull(derivative, Box([Fraction(0)], [Fraction(horizon)]), Box([0.0], [0.0]))
        found = np.asarray(hull.vertices) - hull.error
        if np.isfinite(found).all():
            return Least(float(found.min()), Kind.PROOF)
    except GainError:
        pass
    times = jnp.linspace(0.0, horizon, _SAMPLES)
    values = jax.jit(jax.vmap(lambda t: leader.path(model, t)[order, output]))(times)
    return Least(float(values.min()), Kind.SAMPLES)
