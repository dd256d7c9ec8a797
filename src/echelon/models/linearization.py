"""The linear system that a model is near its trim, in normalized inputs."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from echelon.core.kept import kept
from echelon.core.numerics import precision
from echelon.core.types import Array, State
from echelon.models.model import ControlAffine


class Linearization(NamedTuple):
    """A (n, n) and B (n, m) of the deviation from the trim, float64."""

    A: Array
    B: Array

    def with_inner(self, K: Array | None) -> "Linearization":
        """Return A - B K and B, the system with the inner loop v = -K (x - x*) + w closed.

        Args:
            K: (m, n); None where there is no inner loop.
        """
        return self if K is None else Linearization(self.A - self.B @ K, self.B)


@kept
def linearize(model: ControlAffine) -> Linearization:
    """Return A = d(f + g u*)/dx and B = g S at the trim, read-only.

    They are computed once for a model, in float64 whatever the caller's precision.
    """
    # Gains are kept in files, so they must not depend on the precision of the run that needs them.
    with precision("float64"):
        A, B = _slopes(model, jnp.asarray(np.asarray(model.trim[0], float)))
    return Linearization(_freeze(A), _freeze(B))


@eqx.filter_jit
def _slopes(model: ControlAffine, x: State) -> tuple[jax.Array, jax.Array]:
    return jax.jacfwd(model.normalized_drift)(x), model.normalized_input_map(x)


@kept
def trim_slopes(model: ControlAffine) -> Array:
    """Return u*_k dg_k/dx at the trim, (m, n, n), read-only: what each trim input puts into A."""
    with precision("float64"):
        slopes = _input_slopes(model, jnp.asarray(np.asarray(model.trim[0], float)))
    # d(g u*)/dx = sum_k u*_k dg_k/dx: an input scaled by s scales its own term alone.
    u = np.asarray(model.trim[1], np.float64)
    return _freeze(u[:, None, None] * np.moveaxis(np.asarray(slopes), 1, 0))


@eqx.filter_jit
def _input_slopes(model: ControlAffine, x: State) -> jax.Array:
    return jax.jacfwd(model.input_map)(x)


def _freeze(values: jax.Array | Array) -> Array:
    """Return a float64 copy that nobody can write to, since many callers share it."""
    array = np.array(values, np.float64)
    array.setflags(write=False)
    return array
