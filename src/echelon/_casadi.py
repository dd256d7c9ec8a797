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
import jax.numpy as jnp
import numpy as np

from echelon._errors import MissingExtraError, ModelError
from echelon._numerics import precision

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
            "optimal control needs casadi; install it with `pip install 'echelon[optimal]'`."
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
    if name in _INLINED:
        inner = next(params[k] for k in ("jaxpr", "call_jaxpr", "fun_jaxpr") if k in params)
        return _run(ca, owner, inner, operands)
    if all(a.dtype != object for a in operands):
        return _bound(equation, operands)
    if name in RULES:
        return [np.asarray(RULES[name](ca, params, *operands), object)]
    if name in _MOVES:
        return _moved(equation, operands)
    if name in _SUMS:
        return [_added(equation, operands)]
    raise ModelError(
        f"`{owner}` uses `{name}`, which has no expression for the solvers; allowed are "
        "arithmetic, powers, trigonometric and hyperbolic functions, exponentials, logarithms, "
        "rounding, comparisons and choices by `where`."
    )


def _bound(equation: Any, operands: Sequence[Any]) -> list[np.ndarray]:
    """Return the results of a primitive for numbers."""
    results = equation.primitive.bind(*(jnp.asarray(a) for a in operands), **equation.params)
    return [np.asarray(r) for r in (results if equation.primitive.multiple_results else [results])]


_MOVES = {
    "copy",
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
_SUMS = {"scatter-add", "scatter_add", "cumsum"}


def _moved(equation: Any, operands: list[Any]) -> list[np.ndarray]:
    """Return the results of a primitive that copies entries: JAX moves their places about."""
    pool, places = _labelled(operands)
    # A place outside of an array is filled with what no place is, and read as not a number.
    pool.append(float("nan"))
    results = _bound(equation, places)
    wheres = [np.where((r >= 0) & (r < len(pool)), r, len(pool) - 1).astype(int) for r in results]
    return [_each(pool.__getitem__, where) for where in wheres]


def _added(equation: Any, operands: list[Any]) -> np.ndarray:
    """Return the result of a primitive that adds entries, by what it does to unit vectors."""
    pool, places = _labelled(operands)

    def result(unit: jax.Array) -> jax.Array:
        data = [unit[a.astype(int)] if a.dtype == float else jnp.asarray(a) for a in places]
        return equation.primitive.bind(*data, **equation.params)

    weights = np.asarray(jax.vmap(result)(jnp.eye(len(pool))))
    total = np.zeros(weights.shape[1:], object)
    for entry, weight in zip(pool, weights, strict=True):
        total = total + _each(lambda w, entry=entry: w * entry if w else 0.0, weight)
    return total


def _labelled(operands: Sequence[np.ndarray]) -> tuple[list[Any], list[np.ndarray]]:
    """Return all data entries in a row, and the operands with each entry's place in that row."""
    pool: list[Any] = []
    places = []
    for a in operands:
        if a.dtype.kind in "iu":
            places.append(a)
            continue
        places.append(np.arange(len(pool), len(pool) + a.size, dtype=float).reshape(a.shape))
        pool += list(a.flat)
    return pool, places


# ---- the rules -----------------------------------------------------------------------------------


def _each(function: Callable[..., object], *arrays: np.ndarray) -> np.ndarray:
    """Return a function of one entry of each array, entry by entry."""
    return np.asarray(np.frompyfunc(function, len(arrays), 1)(*arrays), dtype=object)


def _plain(function: Callable[..., object]) -> Rule:
    return lambda ca, params, *arrays: _each(function, *arrays)


def _named(name: str) -> Rule:
    return lambda ca, params, *arrays: _each(getattr(ca, name), *arrays)


def _written(function: Callable[..., object]) -> Rule:
    """Return the rule of a function (casadi, entries)."""
    return lambda ca, params, *arrays: _each(functools.partial(function, ca), *arrays)


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

    return _each(one, x)


def _convert(ca: Any, params: Mapping[str, Any], x: np.ndarray) -> np.ndarray:
    """Return entries under another type; truth is one and falsehood zero among the symbols."""
    kind = np.dtype(params["new_dtype"]).kind
    if kind == "b":
        return _each(lambda value: value != 0.0, x)
    if kind in "iu":
        return _each(lambda value: ca.sign(value) * ca.floor(ca.fabs(value)), x)
    return x


def _dot(ca: Any, params: Mapping[str, Any], a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the sum of products over contracted axes, batch axes first."""
    (contract_a, contract_b), (batch_a, batch_b) = params["dimension_numbers"]
    left, right = _front(a, batch_a, contract_a), _front(b, batch_b, contract_b)
    cut = len(batch_a)
    batch, rows, columns = left.shape[:cut], left.shape[cut:-1], right.shape[cut:-1]
    left = left.reshape(-1, int(np.prod(rows)), left.shape[-1])
    right = right.reshape(-1, int(np.prod(columns)), right.shape[-1])
    found = np.empty((len(left), left.shape[1], right.shape[1]), object)
    for i, j, k in np.ndindex(*found.shape):
        found[i, j, k] = sum((p * q for p, q in zip(left[i, j], right[i, k], strict=True)), 0.0)
    return found.reshape(batch + rows + columns)


def _front(x: np.ndarray, batch: Sequence[int], contracted: Sequence[int]) -> np.ndarray:
    """Return x with its batch axes first and its contracted axes last and merged."""
    free = [axis for axis in range(x.ndim) if axis not in (*batch, *contracted)]
    moved = x.transpose([*batch, *free, *contracted])
    return moved.reshape(*moved.shape[: len(batch) + len(free)], -1)


def _reduction(function: Callable[[Any], Callable[[Any, Any], Any]]) -> Rule:
    """Return the rule that joins the entries along axes two by two."""

    def reduce(ca: Any, params: Mapping[str, Any], x: np.ndarray) -> np.ndarray:
        kept = [axis for axis in range(x.ndim) if axis not in params["axes"]]
        rows = _front(x, [], params["axes"]).reshape(-1, x.size // max(1, _size(x, kept)))
        joined = [functools.reduce(function(ca), row) for row in rows]
        return _each(joined.__getitem__, np.arange(len(joined))).reshape([x.shape[k] for k in kept])

    return reduce


def _size(x: np.ndarray, axes: Sequence[int]) -> int:
    return int(np.prod([x.shape[axis] for axis in axes]))


def _broadcast(ca: Any, params: Mapping[str, Any], x: np.ndarray, *_: Any) -> np.ndarray:
    shape = [1] * len(params["shape"])
    for axis, size in zip(params["broadcast_dimensions"], x.shape, strict=True):
        shape[axis] = size
    return np.broadcast_to(x.reshape(shape), params["shape"])


def _slice(ca: Any, params: Mapping[str, Any], x: np.ndarray) -> np.ndarray:
    starts, ends = params["start_indices"], params["limit_indices"]
    steps = params["strides"] or [1] * x.ndim
    return x[tuple(slice(*cut) for cut in zip(starts, ends, steps, strict=True))]


_SAME_NAME = ("sin", "cos", "tan", "asin", "acos", "atan", "sinh", "cosh", "tanh", "asinh")
_SAME_NAME += ("acosh", "atanh", "atan2", "exp", "expm1", "log", "log1p", "sqrt", "erf")
_SAME_NAME += ("sign", "floor", "ceil")

RULES: dict[str, Rule] = {
    **{name: _named(name) for name in _SAME_NAME},
    **{name: lambda ca, params, x: x for name in ("reduce_precision", "stop_gradient")},
    "optimization_barrier": lambda ca, params, x: x,
    "add": _plain(operator.add),
    "add_any": _plain(operator.add),
    "sub": _plain(operator.sub),
    "mul": _plain(operator.mul),
    "div": _plain(operator.truediv),
    "neg": _plain(operator.neg),
    "square": _plain(lambda value: value * value),
    "integer_pow": lambda ca, params, x: _each(lambda value: value ** params["y"], x),
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
    "dot_general": _dot,
    "reduce_sum": _reduction(lambda ca: operator.add),
    "reduce_prod": _reduction(lambda ca: operator.mul),
    "reduce_max": _reduction(lambda ca: ca.fmax),
    "reduce_min": _reduction(lambda ca: ca.fmin),
    "reduce_and": _reduction(lambda ca: ca.logic_and),
    "reduce_or": _reduction(lambda ca: ca.logic_or),
    "broadcast_in_dim": _broadcast,
    "slice": _slice,
    "reshape": lambda ca, params, x: x.reshape(params["new_sizes"]),
    "squeeze": lambda ca, params, x: np.squeeze(x, tuple(params["dimensions"])),
    "transpose": lambda ca, params, x: x.transpose(params["permutation"]),
    "concatenate": lambda ca, params, *xs: np.concatenate(xs, axis=params["dimension"]),
    "stack": lambda ca, params, *xs: np.stack(xs, axis=params["axis"]),
}
"""What each primitive of JAX means for symbols."""
