"""A function written for JAX as an expression of CasADi.

JAX traces the function, and each equation of the trace is evaluated on CasADi's symbols. So one
model serves the simulation and the solvers. An array of floats that depend on symbols is a NumPy
array of scalar `SX`; all other arrays hold plain numbers, on which JAX computes itself.
"""

import functools
import operator
from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeAlias

import jax
import numpy as np

from echelon.core.errors import MissingExtraError, ModelError
from echelon.core.jaxpr import (
    ADDED,
    INLINED,
    MOVES,
    PLACED,
    added,
    bound,
    called,
    dot,
    each,
    placed,
)
from echelon.core.numerics import precision

Rule: TypeAlias = Callable[..., np.ndarray]
"""(casadi, parameters of the primitive, operands) -> result."""


def casadi() -> Any:
    """Return the library.

    Raises:
        MissingExtraError: it is not installed.
    """
    try:
        import casadi
    except ImportError:
        raise MissingExtraError(
            "optimal control needs casadi; "
            "install it with `pip install 'echelon-formation[optimal]'`."
        ) from None
    return casadi


def casadi_function(
    name: str, function: Callable[..., Any], *lengths: int, owner: str | None = None
) -> Any:
    """Return a `casadi.Function` of vectors that computes what a function for JAX does.

    Args:
        name: of the result, letters and digits.
        function: takes one float64 vector for each of `lengths` and returns an array of any shape,
            whose entries are the result in row-major order.
        lengths: of the vectors.
        owner: what the function belongs to, for messages; `name` when left out.

    Raises:
        MissingExtraError: casadi is not installed.
        ModelError: the function uses a primitive that is not known here.
    """
    ca = casadi()
    columns = [ca.SX.sym(f"a{k}", length) for k, length in enumerate(lengths)]
    operands = [_symbols(ca, column) for column in columns]
    result = evaluate(function, operands, owner or name)
    return ca.Function(name, columns, [ca.vertcat(*(ca.SX(e) for e in result.ravel()))])


def _symbols(ca: Any, column: Any) -> np.ndarray:
    entries = np.empty(column.shape[0], object)
    entries[:] = ca.vertsplit(column) if len(entries) else []
    return entries


def evaluate(
    function: Callable[..., Any], operands: Sequence[np.ndarray], owner: str
) -> np.ndarray:
    """Return the result of a function for arrays of symbols.

    Raises:
        ModelError: the function uses a primitive that is not known here.
    """
    ca = casadi()
    with precision("float64"):
        closed = jax.make_jaxpr(function)(*(np.zeros(a.shape) for a in operands))
        return _run(ca, owner, closed, operands)[0]


# ---- the walk ------------------------------------------------------------------------------------


def _run(ca: Any, owner: str, closed: Any, operands: Sequence[Any]) -> list[np.ndarray]:
    jaxpr, consts = getattr(closed, "jaxpr", closed), getattr(closed, "consts", ())
    values = dict(zip(jaxpr.constvars, map(np.asarray, consts), strict=True))
    values |= dict(zip(jaxpr.invars, operands, strict=True))

    def read(variable: Any) -> np.ndarray:
        return np.asarray(variable.val) if hasattr(variable, "val") else values[variable]

    for equation in jaxpr.eqns:
        results = _apply(ca, owner, equation, [read(v) for v in equation.invars])
        values |= dict(zip(equation.outvars, results, strict=True))
    return [read(v) for v in jaxpr.outvars]


def _apply(ca: Any, owner: str, equation: Any, operands: list[Any]) -> list[np.ndarray]:
    name, params = equation.primitive.name, equation.params
    if name in INLINED:
        return _run(ca, owner, called(equation), operands)
    if all(a.dtype != object for a in operands):
        return bound(equation, operands)
    if name == "optimization_barrier":
        return operands
    if name in MOVES:
        return [np.asarray(MOVES[name](params, *operands), object)]
    if name in PLACED:
        return placed(equation, operands, lambda: float("nan"))
    if name in ADDED:
        return [added(equation, operands, float)]
    if name in RULES:
        return [np.asarray(RULES[name](ca, params, *operands), object)]
    raise ModelError(
        f"`{owner}` uses `{name}`, which has no expression for the solvers; allowed are "
        "arithmetic, powers, trigonometric and hyperbolic functions, exponentials, logarithms, "
        "rounding, comparisons and choices by `where`."
    )


# ---- the rules -----------------------------------------------------------------------------------


def _plain(function: Callable[..., object]) -> Rule:
    return lambda ca, params, *arrays: each(function, *arrays)


def _named(name: str) -> Rule:
    return lambda ca, params, *arrays: each(getattr(ca, name), *arrays)


def _written(function: Callable[..., object]) -> Rule:
    """Return the rule of a function (casadi, entries)."""
    return lambda ca, params, *arrays: each(functools.partial(function, ca), *arrays)


def _chosen(ca: Any, which: Any, first: Any, *others: Any) -> Any:
    """Return the case whose number is chosen; JAX numbers them from zero."""
    if not isinstance(which, ca.SX):
        return (first, *others)[int(which)]
    result = first
    for number, case in enumerate(others, 1):
        result = ca.if_else(which == number, case, result)
    return result


def _rounded(ca: Any, params: Mapping[str, Any], x: np.ndarray) -> np.ndarray:
    """Round to the nearest whole number; halves to the even one, or away from zero."""
    to_even = int(params["rounding_method"]) == 1

    def one(value: Any) -> Any:
        size = ca.fabs(value)
        low = ca.floor(size)
        odd = ca.fmod(low, 2.0) == 1.0
        tie = odd if to_even else True
        up = ca.logic_or(size - low > 0.5, ca.logic_and(size - low == 0.5, tie))
        return ca.sign(value) * (low + up)

    return each(one, x)


def _convert(ca: Any, params: Mapping[str, Any], x: np.ndarray) -> np.ndarray:
    """Return entries under another type; truth is one and falsehood zero among the symbols."""
    kind = np.dtype(params["new_dtype"]).kind
    if kind == "b":
        return each(lambda value: value != 0.0, x)
    if kind in "iu":
        return each(lambda value: ca.sign(value) * ca.floor(ca.fabs(value)), x)
    return x


def _reduction(of_none: float, function: Callable[[Any], Callable[[Any, Any], Any]]) -> Rule:
    """Return the rule that joins the entries along axes two by two; what no entries make is given.

    Elsewhere that number is left out, since a solver would carry it along in every expression.
    """

    def reduce(ca: Any, params: Mapping[str, Any], x: np.ndarray) -> np.ndarray:
        for axis in sorted(params["axes"], reverse=True):
            some = x.shape[axis] > 0
            join = np.frompyfunc(function(ca), 2, 1)
            x = join.reduce(x, axis=axis) if some else join.reduce(x, axis=axis, initial=of_none)
        return x

    return reduce


_SAME_NAME = ("sin", "cos", "tan", "asin", "acos", "atan", "sinh", "cosh", "tanh", "asinh")
_SAME_NAME += ("acosh", "atanh", "atan2", "exp", "expm1", "log", "log1p", "sqrt", "erf")
_SAME_NAME += ("sign", "floor", "ceil")

RULES: dict[str, Rule] = {
    **{name: _named(name) for name in _SAME_NAME},
    "add": _plain(operator.add),
    "add_any": _plain(operator.add),
    "sub": _plain(operator.sub),
    "mul": _plain(operator.mul),
    "div": _plain(operator.truediv),
    "neg": _plain(operator.neg),
    "square": _plain(lambda value: value * value),
    "integer_pow": lambda ca, params, x: each(lambda value: value ** params["y"], x),
    "pow": _plain(operator.pow),
    "rsqrt": _written(lambda ca, value: 1.0 / ca.sqrt(value)),
    "cbrt": _written(lambda ca, value: ca.sign(value) * ca.fabs(value) ** (1.0 / 3.0)),
    "exp2": _written(lambda ca, value: ca.exp(np.log(2.0) * value)),
    "logistic": _written(lambda ca, value: 1.0 / (1.0 + ca.exp(-value))),
    "abs": _named("fabs"),
    "max": _named("fmax"),
    "min": _named("fmin"),
    "rem": _named("fmod"),
    "round": _rounded,
    "clamp": _written(lambda ca, low, value, high: ca.fmin(ca.fmax(low, value), high)),
    "lt": _plain(operator.lt),
    "le": _plain(operator.le),
    "gt": _plain(operator.gt),
    "ge": _plain(operator.ge),
    "eq": _plain(operator.eq),
    "ne": _plain(operator.ne),
    "and": _named("logic_and"),
    "or": _named("logic_or"),
    "not": _named("logic_not"),
    "is_finite": lambda ca, params, x: np.full(x.shape, True),
    "select_n": _written(_chosen),
    "convert_element_type": _convert,
    "dot_general": lambda ca, params, a, b: dot(params, a, b, 0.0),
    "reduce_sum": _reduction(0.0, lambda ca: operator.add),
    "reduce_prod": _reduction(1.0, lambda ca: operator.mul),
    "reduce_max": _reduction(-np.inf, lambda ca: ca.fmax),
    "reduce_min": _reduction(np.inf, lambda ca: ca.fmin),
    "reduce_and": _reduction(1.0, lambda ca: ca.logic_and),
    "reduce_or": _reduction(0.0, lambda ca: ca.logic_or),
}
"""What each primitive of JAX means for symbols."""
