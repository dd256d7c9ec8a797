"""Evaluation of a traced function (a jaxpr) on polynomials instead of numbers.

An array of floats is a NumPy array of `Polynomial`, integers and booleans stay numbers. What only
moves entries about is done by JAX itself, on the entries' places.
"""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from echelon._errors import GainError
from echelon._hull_algebra import Atoms, constant
from echelon._hull_rules import RULES, each, number

_INLINED = {
    "jit",
    "pjit",
    "closed_call",
    "core_call",
    "custom_jvp_call",
    "custom_vjp_call",
    "custom_vjp_call_jaxpr",
    "remat",
    "remat2",
    "checkpoint",
}
_MOVES = {
    "split",
    "rev",
    "pad",
    "gather",
    "scatter",
    "dynamic_slice",
    "dynamic_update_slice",
    "expand_dims",
    "tile",
}
_LINEAR = {"scatter-add", "scatter_add", "cumsum"}


def evaluate(closed: Any, operands: Sequence[np.ndarray], atoms: Atoms) -> list[np.ndarray]:
    """Return the results of a closed jaxpr for operands of polynomials, under 64-bit JAX.

    Raises:
        GainError: it uses a primitive that is not known, or one outside of its domain.
    """
    jaxpr, consts = getattr(closed, "jaxpr", closed), getattr(closed, "consts", ())
    values = dict(zip(jaxpr.constvars, (exact(c) for c in consts), strict=True))
    values |= dict(zip(jaxpr.invars, operands, strict=True))

    def read(variable: Any) -> np.ndarray:
        return exact(variable.val) if hasattr(variable, "val") else values[variable]

    for equation in jaxpr.eqns:
        results = _apply(equation, [read(v) for v in equation.invars], atoms)
        values |= dict(zip(equation.outvars, results, strict=True))
    return [read(v) for v in jaxpr.outvars]


def exact(value: Any) -> np.ndarray:
    """Return floats as constant polynomials, each taken exactly, and anything else as it is.

    Raises:
        GainError: a number is complex or not finite.
    """
    array = np.asarray(value)
    if array.dtype.kind in "biu":
        return array
    if array.dtype.kind == "c":
        raise GainError("the Jacobian of the model is complex, and must be real.")
    numbers = array.astype(np.float64)
    if not np.isfinite(numbers).all():
        raise GainError("the Jacobian of the model holds a constant that is not finite.")
    return each(constant, numbers)


def _apply(equation: Any, operands: list[np.ndarray], atoms: Atoms) -> list[np.ndarray]:
    name, params = equation.primitive.name, equation.params
    if name in _INLINED:
        inner = next(params[k] for k in ("jaxpr", "call_jaxpr", "fun_jaxpr") if k in params)
        return evaluate(inner, operands, atoms)
    if all(a.dtype != object for a in operands):
        return [exact(a) for a in _bound(equation, operands)]
    if name == "optimization_barrier":
        return operands
    if name in _MOVES:
        return _moved(equation, operands)
    if name in _LINEAR:
        return [_combined(equation, operands)]
    if name in RULES:
        return [RULES[name](atoms, params, *operands)]
    return _folded(equation, operands)


def _bound(equation: Any, operands: Sequence[Any]) -> list[np.ndarray]:
    """Return the results of a primitive for numbers."""
    results = equation.primitive.bind(*(jnp.asarray(a) for a in operands), **equation.params)
    return [np.asarray(r) for r in (results if equation.primitive.multiple_results else [results])]


def _folded(equation: Any, operands: list[np.ndarray]) -> list[np.ndarray]:
    """Return what an unknown primitive makes of parameters alone, in float64: parameters again."""
    values = [each(number, a) if a.dtype == object else a for a in operands]
    if any(v is None for a in values for v in a.flat):
        raise GainError(
            f"the Jacobian of the model uses `{equation.primitive.name}`, which the hull of "
            "Jacobians does not know; allowed are arithmetic, powers, trigonometric and hyperbolic "
            "functions, exponentials, logarithms, absolute values and choices by `where`."
        )
    numbers = [np.asarray(a, np.float64) if a.dtype == object else a for a in values]
    return [exact(a) for a in _bound(equation, numbers)]


def _labelled(operands: list[np.ndarray]) -> tuple[list[Any], list[np.ndarray]]:
    """Return all data entries in a row, and the operands with each entry's place in that row."""
    pool: list[Any] = []
    places = []
    for a in operands:
        if a.dtype == object or a.dtype == bool:
            places.append(np.arange(len(pool), len(pool) + a.size, dtype=float).reshape(a.shape))
            pool += list(a.flat)
        else:
            places.append(a)
    return pool, places


def _moved(equation: Any, operands: list[np.ndarray]) -> list[np.ndarray]:
    """Return the results of a primitive that copies entries and computes nothing."""
    pool, places = _labelled(operands)
    results = _bound(equation, places)
    if not all(np.isin(r, np.arange(len(pool))).all() for r in results):
        raise GainError("the Jacobian of the model reads outside of an array.")
    return [each(lambda k: pool[int(k)], r) for r in results]


def _combined(equation: Any, operands: list[np.ndarray]) -> np.ndarray:
    """Return the result of a primitive that adds entries, by what it does to unit vectors."""
    pool, places = _labelled(operands)

    def result(unit: jax.Array) -> jax.Array:
        data = [unit[jnp.asarray(a, int)] if a.dtype == float else jnp.asarray(a) for a in places]
        return equation.primitive.bind(*data, **equation.params)

    weights = np.asarray(jax.vmap(result)(jnp.eye(len(pool))))
    total = np.full(weights.shape[1:], constant(0), object)
    for entry, weight in zip(pool, weights, strict=True):
        total = total + each(lambda w, p=entry: constant(w) * p if w else constant(0), weight)
    return total
