"""The linear system that a model is near its trim, in normalized inputs."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

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


def linearize(model: ControlAffine) -> Linearization:
    """Return A = d(f + g u*)/dx and B = g S at the trim."""
    x = jnp.asarray(np.asarray(model.trim[0], float))
    A, B = _slopes(model, x)
    return Linearization(np.asarray(A, np.float64), np.asarray(B, np.float64))


@eqx.filter_jit
def _slopes(model: ControlAffine, x: State) -> tuple[jax.Array, jax.Array]:
    return jax.jacfwd(model.normalized_drift)(x), model.normalized_input_map(x)


def trim_slopes(model: ControlAffine) -> Array:
    """Return u*_k dg_k/dx at the trim, (m, n, n): what each trim input puts into A."""
    x = jnp.asarray(np.asarray(model.trim[0], float))
    u = np.asarray(model.trim[1], np.float64)
    slopes = np.moveaxis(np.asarray(_input_slopes(model, x), np.float64), 1, 0)
    return u[:, None, None] * slopes


@eqx.filter_jit
def _input_slopes(model: ControlAffine, x: State) -> jax.Array:
    return jax.jacfwd(model.input_map)(x)
