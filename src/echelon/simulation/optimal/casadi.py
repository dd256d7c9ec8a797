"""A function written for JAX as an expression of CasADi.

JAX traces the function, and each equation of the trace is evaluated on CasADi's symbols. So one
model serves the simulation and the solvers. An array of floats that depend on symbols is a NumPy
array of scalar `SX`; all other arrays hold plain numbers, on which JAX computes itself.
"""

import functools
import operator
from collections.abc import Callable, Mapping
from types import ModuleType
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
from jax.extend.core import JaxprEqn

from echelon.core.errors import MissingExtraError, ModelError
from echelon_ranges.jaxpr import Algebra, Rule, dot, entrywise, evaluate, map_entries, reduction

if TYPE_CHECKING:  # it comes with an extra
    from casadi import SX, Function

Expression: TypeAlias = "SX | float"
"""A symbol, or a number that depends on none."""


def casadi() -> ModuleType:
    """Return the library; raise `MissingExtraError` if it is not installed."""
    # Here, since it comes with an extra, and takes long to load.
    try:
        import casadi
    except ImportError:
        raise MissingExtraError(
            "optimal control needs casadi; "
            "install it with `pip install '.[optimal]'` in echelon's clone."
        ) from None
    return casadi


def casadi_function(
    name: str, function: Callable[..., object], *lengths: int, owner: str | None = None
) -> "Function":
    """Return a `casadi.Function` of vectors that computes what a function for JAX does.

    Args:
        name: of the result, letters and digits.
        function: takes one float64 vector for each of `lengths` and returns an array of any shape,
            whose entries are the result in row-major order.
        lengths: of the vectors.
        owner: of the function, for messages; `name` by default.

    Raises:
        MissingExtraError: casadi is not installed.
        ModelError: the function uses a primitive without a rule.
    """
    ca = casadi()
    # SX has a node for each scalar: a model of a dozen states is straight-line code, and is
    # differentiated entry by entry.
    columns = [ca.SX.sym(f"a{k}", length) for k, length in enumerate(lengths)]
    operands = [_symbols(ca, column) for column in columns]
    # A result that depends on no symbol is a plain number, which `SX(e)` converts.
    result = evaluate(function, operands, symbols(owner or name))[0]
    return ca.Function(name, columns, [ca.vertcat(*(ca.SX(e) for e in result.ravel()))])


def _symbols(ca: ModuleType, column: "SX") -> np.ndarray:
    # Filled afterwards: NumPy would take each SX for an array of its own.
    entries = np.empty(column.shape[0], object)
    entries[:] = ca.vertsplit(column) if len(entries) else []
    return entries


def symbols(owner: str) -> Algebra:
    """Return the algebra of CasADi's symbols; plain numbers stay numbers.

    Evaluating in it raises `ModelError` at a primitive without a rule.

    Args:
        owner: of the function that is evaluated, for that message.

    Raises:
        MissingExtraError: casadi is not installed.
    """

    def unknown(equation: JaxprEqn, operands: list[np.ndarray]) -> list[np.ndarray]:
        raise ModelError(
            f"`{owner}` uses `{equation.primitive.name}`, which has no expression for the solvers; "
            "allowed are arithmetic, powers, trigonometric and hyperbolic functions, exponentials, "
            "logarithms, rounding, comparisons and choices by `where`."
        )

    # What a gather reads beyond an array is not a number, as it is in JAX.
    return Algebra(_rules(casadi()), float, lambda numbers: numbers, lambda: float("nan"), unknown)


def _rules(ca: ModuleType) -> dict[str, Rule]:
    written: dict[str, Rule] = {
        "integer_pow": lambda params, x: map_entries(lambda value: value ** params["y"], x),
        # A symbol counts as finite, since its value is unknown; solvers report what is not.
        "is_finite": lambda params, x: np.full(x.shape, True),
        "round": functools.partial(_round, ca),
        "convert_element_type": functools.partial(_convert, ca),
        "dot_general": dot(0.0),
        "reduce_sum": reduction(operator.add, 0.0),
        "reduce_prod": reduction(operator.mul, 1.0),
        "reduce_max": reduction(ca.fmax, -np.inf),
        "reduce_min": reduction(ca.fmin, np.inf),
        "reduce_and": reduction(ca.logic_and, 1.0),
        "reduce_or": reduction(ca.logic_or, 0.0),
    }
    return {name: entrywise(function) for name, function in _functions(ca).items()} | written


def _functions(ca: ModuleType) -> dict[str, Callable[..., object]]:
    return {
        **{name: getattr(ca, name) for name in _SAME_NAME},
        **{name: getattr(operator, name) for name in ("lt", "le", "gt", "ge", "eq", "ne", "pow")},
        **{name: getattr(ca, f"logic_{name}") for name in ("and", "or", "not")},
        "div": operator.truediv,
        "rem": ca.fmod,
        "abs": ca.fabs,
        "max": ca.fmax,
        "min": ca.fmin,
        "clamp": lambda low, value, high: ca.fmin(ca.fmax(low, value), high),
        "rsqrt": lambda value: 1.0 / ca.sqrt(value),
        # CasADi's power of a negative number is not a number.
        "cbrt": lambda value: ca.sign(value) * ca.fabs(value) ** (1.0 / 3.0),
        "exp2": lambda value: ca.exp(np.log(2.0) * value),
        "logistic": lambda value: 1.0 / (1.0 + ca.exp(-value)),
        "select_n": functools.partial(_choose, ca),
    }


_SAME_NAME = ("sin", "cos", "tan", "asin", "acos", "atan", "sinh", "cosh", "tanh", "asinh")
_SAME_NAME += ("acosh", "atanh", "atan2", "exp", "expm1", "log", "log1p", "sqrt", "erf")
_SAME_NAME += ("sign", "floor", "ceil")


def _choose(
    ca: ModuleType, which: Expression, first: Expression, *others: Expression
) -> Expression:
    """Return the case whose number is chosen; JAX numbers them from zero."""
    if not isinstance(which, ca.SX):
        return (first, *others)[int(which)]
    # `if_else` evaluates all cases, as `where` does in JAX.
    result = first
    for number, case in enumerate(others, 1):
        result = ca.if_else(which == number, case, result)
    return result


def _round(ca: ModuleType, params: Mapping[str, int], x: np.ndarray) -> np.ndarray:
    """Round to the nearest whole number; halves to the even one, or away from zero."""
    to_even = int(params["rounding_method"]) == 1

    def one(value: Expression) -> Expression:
        # CasADi has no rounding; on the size alone, both sides of zero are alike.
        size = ca.fabs(value)
        low = ca.floor(size)
        odd = ca.fmod(low, 2.0) == 1.0
        tie = odd if to_even else True
        up = ca.logic_or(size - low > 0.5, ca.logic_and(size - low == 0.5, tie))
        return ca.sign(value) * (low + up)

    return map_entries(one, x)


def _convert(ca: ModuleType, params: Mapping[str, Any], x: np.ndarray) -> np.ndarray:
    """Return entries under another type; truth is one and falsehood zero among the symbols."""
    kind = np.dtype(params["new_dtype"]).kind
    if kind == "b":
        return map_entries(lambda value: value != 0.0, x)
    if kind in "iu":
        # Toward zero, as JAX converts.
        return map_entries(lambda value: ca.sign(value) * ca.floor(ca.fabs(value)), x)
    return x
