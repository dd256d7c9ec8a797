"""The linear system that a model is near its trim, in normalized inputs."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from echelon.agents.models.model import ControlAffine
from echelon.agents.models.secants import Gap, Sides, sides, stencil
from echelon.core.compiled import cached_jit
from echelon.core.memoize import memoize
from echelon.core.numerics import precision
from echelon.core.types import Array, Input, State, States


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


class AtTrim(NamedTuple):
    """A model's functions at its trim (x*, u*), float64 and read-only.

    Attributes:
        drift, input_map, output: f (n,), g (n, m), h (q,).
        drift_slope, input_slope, output_slope: their Jacobians, with n as the last dimension more.
        delivered: what the actuators make of u*, (m,).
        bends: (n, n) whether the slope of f + g u*, by its values on either side, jumps with a
            state; or where g does, for all inputs.
        gap: the entry of the drift or the input map whose derivative by JAX is most clearly not
            what its values show; None where there is none.
    """

    drift: Array
    input_map: Array
    output: Array
    drift_slope: Array
    input_slope: Array
    output_slope: Array
    delivered: Array
    bends: Array
    gap: Gap | None


@memoize
def at_trim(model: ControlAffine) -> AtTrim:
    """Return all that is asked of a model at its trim, compiled together.

    Compiling is most of the cost. It is computed once for a model, in float64 whatever the caller's
    precision.
    """
    x, u = (np.asarray(part, float) for part in model.trim)
    # Gains are kept in files, so they must not depend on the precision of the run that needs them.
    with precision("float64"):
        found = _evaluate(model, x, u, stencil(x))
    *there, around = map(_freeze, found)
    said, seen = np.concatenate([there[3], there[4].reshape(-1, len(x))]), sides(x, around)
    return AtTrim(*there, bends=_bends(seen, u), gap=seen.gap(said))  # pyright: ignore


@cached_jit
def _evaluate(model: ControlAffine, x: State, u: Input, points: States) -> list[jax.Array]:
    functions = (model.drift, model.input_map, model.output)
    slopes = [jax.jacfwd(function)(x) for function in functions]

    def entries(x: State) -> jax.Array:
        return jnp.concatenate([model.drift(x), model.input_map(x).reshape(-1)])

    # Values around the trim, which know what derivatives of a trace do not.
    around = jax.vmap(entries)(points)
    return [*(function(x) for function in functions), *slopes, model.limit(u), around]


def _bends(seen: Sides, u: Array) -> Array:
    """Return (n, n) where f + g u* bends, or g jumps, with which state."""
    n = seen.forward.shape[-1]
    below, above = (np.split(side, [n], axis=1) for side in seen)
    velocity = (
        side[0] + np.einsum("hikn,k->hin", side[1].reshape(2, n, -1, n), u)
        for side in (below, above)
    )
    bent = Sides(*velocity).bends()
    jumps = Sides(below[1], above[1]).jumps().reshape(n, -1, n).any(axis=1)
    return bent | jumps


@memoize
def linearize(model: ControlAffine) -> Linearization:
    """Return A = d(f + g u*)/dx and B = g S at the trim, read-only; computed once for a model."""
    there = at_trim(model)
    B = there.input_map @ np.asarray(model.input_scale, float)
    return Linearization(_freeze(there.drift_slope + trim_slopes(model).sum(0)), _freeze(B))


@memoize
def trim_slopes(model: ControlAffine) -> Array:
    """Return u*_k dg_k/dx at the trim, (m, n, n), read-only: what each trim input puts into A."""
    # d(g u*)/dx = sum_k u*_k dg_k/dx: an input scaled by s scales its own term alone.
    u = np.asarray(model.trim[1], float)
    return _freeze(u[:, None, None] * np.moveaxis(at_trim(model).input_slope, 1, 0))


def _freeze(values: jax.Array | Array) -> Array:
    """Return a float64 copy that nobody can write to, since many callers share it."""
    array = np.array(values, np.float64)
    array.setflags(write=False)
    return array
