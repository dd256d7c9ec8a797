"""Evaluation of a traced function (a jaxpr) on polynomials instead of numbers.

An array of floats is a NumPy array of `Polynomial`, integers and booleans stay numbers. What only
moves entries about is done by JAX itself, on the entries' places.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from echelon.core.errors import GainError
from echelon.core.jaxpr import ADDED, INLINED, MOVES, PLACED, added, bound, called, each, placed
from echelon.enclosure.polynomial import Atoms, constant
from echelon.enclosure.rules import RULES, number


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
    if name in INLINED:
        return evaluate(called(equation), operands, atoms)
    if all(a.dtype != object for a in operands):
        return [exact(a) for a in bound(equation, operands)]
    if name == "optimization_barrier":
        return operands
    if name in MOVES:
        return [MOVES[name](params, *operands)]
    if name in PLACED:
        return placed(equation, operands, _outside)
    if name in ADDED:
        return [added(equation, operands, constant)]
    if name in RULES:
        return [RULES[name](atoms, params, *operands)]
    return _folded(equation, operands)


def _outside() -> object:
    raise GainError("the Jacobian of the model reads outside of an array.")


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
    return [exact(a) for a in bound(equation, numbers)]
