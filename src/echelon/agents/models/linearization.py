"""The linearization of a model at its trim, in normalized inputs."""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from echelon.agents.models.model import ControlAffine
from echelon.agents.models.secants import Gap, Sides, sides, stencil, units_at
from echelon.core.cache import memoize
from echelon.core.compiled import compiled_for_one_call
from echelon.core.numerics import precision
from echelon.core.trace import call_once_traced
from echelon.core.types import Array, Input, State, States


class Linearization(NamedTuple):
    """A (n, n) and B (n, m) of the deviation from the trim, float64."""

    A: Array
    B: Array

    def with_inner(self, K: Array | None) -> "Linearization":
        """Return A - B K and B, with an inner loop v = -K (x - x*) + w closed; K (m, n) or None."""
        return self if K is None else Linearization(self.A - self.B @ K, self.B)


class AtTrim(NamedTuple):
    """A model's functions at its trim (x*, u*), float64 and read-only.

    Attributes:
        drift, input_map, output: f (n,), g (n, m), h (q,).
        drift_slope, input_slope, output_slope: their Jacobians, with n as the last dimension more.
        delivered: the input that the actuators deliver for u*, (m,).
        kinks: (n, n) whether f + g u* has a kink in a state, by its values on both sides, or g
            jumps there.
        gap: the entry of the drift or the input map whose derivative by JAX differs most clearly
            from the slope of its values; None where none does.
    """

    drift: Array
    input_map: Array
    output: Array
    drift_slope: Array
    input_slope: Array
    output_slope: Array
    delivered: Array
    kinks: Array
    gap: Gap | None


@memoize
def at_trim(model: ControlAffine) -> AtTrim:
    """Return the functions of a model at its trim, in float64 whatever the caller's precision."""
    x, u = (np.asarray(part, float) for part in model.trim)
    # Gains are stored in files, so they must not depend on the precision of the run that uses them.
    with precision("float64"):
        units = _units(model)
        *values, around = map(_freeze, _evaluate(model, x, u, stencil(x, units)))
    derivatives = np.concatenate([values[3], values[4].reshape(-1, len(x))])
    slopes = sides(x, around)
    gap = slopes.gap(derivatives, units_at(x, units))
    return AtTrim(*values, kinks=_kinks(slopes, u, len(x)), gap=gap)  # pyright: ignore


def _units(model: ControlAffine) -> Array:
    """Return (n,) how much of each state its weight calls as large as one of the others."""
    Q = np.asarray(model.weights[0], float)
    diagonal = Q if Q.ndim == 1 else np.diag(Q)
    return np.sqrt(1.0 / np.where(diagonal > 0.0, diagonal, 1.0))


@compiled_for_one_call
def _evaluate(model: ControlAffine, x: State, u: Input, points: States) -> list[jax.Array]:
    functions = [
        functools.partial(call_once_traced, function)
        for function in (model.drift, model.input_map, model.output)
    ]
    slopes = [jax.jacfwd(function)(x) for function in functions]

    def entries(x: State) -> jax.Array:
        return jnp.concatenate([functions[0](x), functions[1](x).reshape(-1)])

    # Values around the trim show kinks and jumps, which the derivatives of a trace do not.
    around = jax.vmap(entries)(points)
    return [*(function(x) for function in functions), *slopes, model.limit(u), around]


def _kinks(slopes: Sides, u: Array, n: int) -> Array:
    """Return (n, n) whether an entry of f + g u* has a kink, or one of g a jump, in each state."""
    motion = slopes.combine(np.hstack([np.eye(n), np.kron(np.eye(n), u)]))
    maps = slopes.combine(np.eye(n + n * len(u))[n:])
    return motion.kinks(n) | maps.jumps()[:, :n].reshape(n, -1, n).any(axis=1)


@memoize
def linearize(model: ControlAffine) -> Linearization:
    """Return A = d(f + g u*)/dx and B = g S at the trim, read-only; computed once for a model."""
    trim = at_trim(model)
    B = trim.input_map @ np.asarray(model.input_scale, float)
    return Linearization(_freeze(trim.drift_slope + trim_slopes(model).sum(0)), _freeze(B))


def own_damping(model: ControlAffine) -> Array | None:
    """Return the feedback K (m, n) that a model declares as its `damping`; None if it has none.

    Of any other shape, `damping` is a parameter of the model, such as a coefficient of drag.
    """
    shape = len(model.input_names), len(model.state_names)
    if model.damping is None or np.shape(model.damping) != shape:
        return None
    return np.asarray(model.damping, float)


@memoize
def trim_slopes(model: ControlAffine) -> Array:
    """Return u*_k dg_k/dx at the trim, (m, n, n), read-only: the term of each trim input in A."""
    # d(g u*)/dx = sum_k u*_k dg_k/dx: an input scaled by s scales its own term alone.
    u = np.asarray(model.trim[1], float)
    return _freeze(u[:, None, None] * np.moveaxis(at_trim(model).input_slope, 1, 0))


def _freeze(values: jax.Array | Array) -> Array:
    """Return a read-only float64 copy, which many callers share."""
    array = np.array(values, np.float64)
    array.setflags(write=False)
    return array
