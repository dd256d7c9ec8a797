"""Evaluation of JAX traces in any algebra, such as polynomials or symbols of a solver.

What an equation means for them is the `Algebra`, an argument of the walk. Entries other than
numbers are stored in NumPy arrays of objects; an array of another type holds numbers, on which
NumPy computes to the bit what JAX does, without compiling each shape anew, which takes JAX up to
100 ms; or else JAX itself. Equations that only call, move entries about or add them up mean the
same in every algebra, and are here.
"""

import contextlib
import functools
import hashlib
import math
import operator
import threading
from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import ClosedJaxpr, Jaxpr, JaxprEqn, Literal, Var

Params: TypeAlias = Mapping[str, Any]
"""The parameters of a primitive; each primitive has its own names and types."""

Rule: TypeAlias = Callable[..., np.ndarray]
"""(parameters of the primitive, operands) -> result, of which operands may be plain numbers."""


def _broadcast(params: Params, x: np.ndarray, *_: np.ndarray) -> np.ndarray:
    shape = [1] * len(params["shape"])
    for axis, size in zip(params["broadcast_dimensions"], x.shape, strict=True):
        shape[axis] = size
    return np.broadcast_to(x.reshape(shape), params["shape"])


def _slice(params: Params, x: np.ndarray) -> np.ndarray:
    starts, ends = params["start_indices"], params["limit_indices"]
    # JAX leaves strides out where all of them are 1.
    steps = params["strides"] or [1] * x.ndim
    return x[tuple(slice(*cut) for cut in zip(starts, ends, steps, strict=True))]


MOVES: dict[str, Rule] = {
    "broadcast_in_dim": _broadcast,
    "slice": _slice,
    "reshape": lambda params, x: x.reshape(params["new_sizes"]),
    "squeeze": lambda params, x: np.squeeze(x, tuple(params["dimensions"])),
    "transpose": lambda params, x: x.transpose(params["permutation"]),
    "concatenate": lambda params, *xs: np.concatenate(xs, axis=params["dimension"]),
    "stack": lambda params, *xs: np.stack(xs, axis=params["axis"]),
}
"""Primitives that only move entries, which may be of any kind."""


def _window(
    shape: Sequence[int],
    indices: np.ndarray,
    sizes: Sequence[int],
    axes: Sequence[int],
    batches: tuple[Sequence[int], Sequence[int]],
) -> tuple[list[np.ndarray], bool]:
    """Return the places along each axis that windows cover, and whether one was not within it.

    Indices (..., i) are where each window begins along `axes`; `batches` are axes of the array that
    go along with axes of the indices. Places broadcast to (..., *sizes), clipped into the array.
    """
    before, k = indices.shape[:-1], len(shape)
    starts = np.zeros((k, *before), int)
    starts[list(axes)] = np.moveaxis(indices, -1, 0)
    for axis, along in zip(*batches, strict=True):
        rows = [-1 if j == along else 1 for j in range(len(before))]
        starts[axis] = np.arange(shape[axis]).reshape(rows)
    last = (np.array(shape) - np.array(sizes)).reshape(-1, *(1 for _ in before))
    outside = bool(((starts < 0) | (starts > last)).any())
    places = []
    for axis, start in enumerate(np.clip(starts, 0, last)):
        along = np.arange(sizes[axis]).reshape([-1 if j == axis else 1 for j in range(k)])
        places.append(start.reshape(*before, *(1 for _ in shape)) + along)
    return places, outside


def _gather(params: Params, x: np.ndarray, indices: np.ndarray) -> np.ndarray | None:
    numbers, sizes = params["dimension_numbers"], params["slice_sizes"]
    batches = numbers.operand_batching_dims, numbers.start_indices_batching_dims
    places, outside = _window(x.shape, indices, sizes, numbers.start_index_map, batches)
    before = indices.ndim - 1
    gone = {*numbers.collapsed_slice_dims, *numbers.operand_batching_dims}
    if outside and "FILL_OR_DROP" in str(params["mode"]):
        return None
    read = x[tuple(places)].squeeze(tuple(before + axis for axis in gone))
    offsets = numbers.offset_dims
    return np.moveaxis(read, range(before, before + len(offsets)), offsets)


def _scatter(
    params: Params, x: np.ndarray, indices: np.ndarray, updates: np.ndarray
) -> np.ndarray | None:
    result = x.copy()
    if params["update_jaxpr"] is not None:
        return None
    places = _scattered(params, x, indices, updates)
    if places is None:
        return None
    result[places[0]] = places[1]
    return result


def scatter_add(
    params: Params, x: np.ndarray, indices: np.ndarray, updates: np.ndarray
) -> np.ndarray | None:
    """Return an array with entries of any kind added to windows of it; None if one is outside."""
    places, result = _scattered(params, x, indices, updates), x.copy()
    if places is not None:
        np.add.at(result, *places)
    return None if places is None else result


def _scattered(
    params: Params, x: np.ndarray, indices: np.ndarray, updates: np.ndarray
) -> tuple[tuple[np.ndarray, ...], np.ndarray] | None:
    """Return the places that windows cover and the updates, alike in shape; None if outside."""
    numbers, before = params["dimension_numbers"], indices.ndim - 1
    alone = sorted((*numbers.inserted_window_dims, *numbers.operand_batching_dims))
    windows = numbers.update_window_dims
    updates = np.moveaxis(updates, windows, range(before, before + len(windows)))
    updates = np.expand_dims(updates, [before + axis for axis in alone])
    batches = numbers.operand_batching_dims, numbers.scatter_indices_batching_dims
    places, outside = _window(
        x.shape, indices, updates.shape[before:], numbers.scatter_dims_to_operand_dims, batches
    )
    return None if outside else (tuple(np.broadcast_arrays(*places)), updates)


def _pad(params: Params, x: np.ndarray, value: np.ndarray) -> np.ndarray | None:
    config = params["padding_config"]
    if any(low < 0 or high < 0 or inner for low, high, inner in config):
        return None
    return np.pad(x, [(low, high) for low, high, _ in config], constant_values=value)


def _numeric(name: str) -> Rule:
    return lambda params, *arrays: getattr(np, name)(*arrays)


def _quotient(params: Params, x: np.ndarray, y: np.ndarray) -> np.ndarray | None:
    with np.errstate(all="ignore"):
        return None if x.dtype.kind != "f" else _unless_tiny(x / y, x, y)


def _integer_power(params: Params, x: np.ndarray) -> np.ndarray | None:
    """Return a power by the products of JAX, in its order."""
    if x.dtype.kind != "f" or params["y"] == 0:
        return None
    rest, square, power, parts = abs(params["y"]), x, None, [x]
    with np.errstate(all="ignore"):
        while rest:
            if rest & 1:
                power = square if power is None else power * square
                parts.append(power)
            rest >>= 1
            square = square * square if rest else square
            parts.append(square)
        assert power is not None
        result = power if params["y"] > 0 else np.ones((), x.dtype) / power
    return _unless_tiny(result, *parts)


def _unless_tiny(result: np.ndarray, *parts: np.ndarray) -> np.ndarray | None:
    """Return a result, but None where a number has so few digits that JAX takes it for 0."""
    least = np.finfo(result.dtype).tiny
    tiny = any(((a != 0.0) & (np.abs(a) < least)).any() for a in (result, *parts))
    return None if tiny else result


NUMERIC: dict[str, Callable[..., np.ndarray | None]] = {
    **MOVES,
    **{
        name: _numeric(full)
        for name, full in {
            **{"add": "add", "sub": "subtract", "mul": "multiply", "neg": "negative"},
            **{"add_any": "add", "not": "invert"},
            **{"lt": "less", "le": "less_equal", "gt": "greater", "ge": "greater_equal"},
            **{"eq": "equal", "ne": "not_equal", "max": "maximum", "min": "minimum"},
            **{"and": "bitwise_and", "or": "bitwise_or", "abs": "abs"},
        }.items()
    },
    "copy": lambda params, x: x,
    "div": _quotient,
    "integer_pow": _integer_power,
    "gather": _gather,
    "scatter": _scatter,
    "pad": _pad,
    "select_n": lambda params, which, *cases: np.choose(which.astype(int), cases),
    "convert_element_type": lambda params, x: x.astype(params["new_dtype"]),
    "reduce_or": lambda params, x: np.bitwise_or.reduce(x, params["axes"]),
    "reduce_and": lambda params, x: np.bitwise_and.reduce(x, params["axes"]),
    "iota": lambda params: np.broadcast_to(
        np.arange(params["shape"][params["dimension"]], dtype=params["dtype"]).reshape(
            [-1 if k == params["dimension"] else 1 for k in range(len(params["shape"]))]
        ),
        params["shape"],
    ),
}
"""Rules for plain numbers; where one returns None, JAX computes."""


Entry: TypeAlias = Any
"""An entry of an algebra: a number, a polynomial, a symbol; it adds and multiplies."""


class Algebra(NamedTuple):
    """The rules by which the equations of a trace act on entries.

    Attributes:
        rules: by the name of a primitive with one result. They go before the rules of `COMMON`, and
            are used where an operand is no array of plain numbers.
        constant: number -> the entry that it is.
        lift: array of numbers -> what it is in the walk: itself, or an array of entries. Constants,
            literals and results of numbers alone go through it.
        outside: () -> the entry that is read from outside of an array; it may raise instead.
        unknown: (equation, operands) -> results of a primitive without a rule; or it raises an
            error that names `equation.primitive.name` and what is allowed.
        within: (equation) -> a context that is entered while what it calls is walked.
        finish: (equation, results) -> the results under the types that the equation gives them.
    """

    rules: Mapping[str, Rule]
    constant: Callable[[float], Entry]
    lift: Callable[[np.ndarray], np.ndarray]
    outside: Callable[[], Entry]
    unknown: Callable[[JaxprEqn, list[np.ndarray]], list[np.ndarray]]
    within: Callable[[JaxprEqn], contextlib.AbstractContextManager[object]] = contextlib.nullcontext
    finish: Callable[[JaxprEqn, list[np.ndarray]], list[np.ndarray]] = lambda _, results: results


@contextlib.contextmanager
def float64() -> Iterator[None]:
    """Let JAX compute in float64 by its usual rules, whatever flags are set."""
    # A context and no `jax.config.update`, which would change a global setting.
    promotion = jax.numpy_dtype_promotion("standard")
    with jax.enable_x64(True), jax.debug_nans(False), jax.debug_infs(False), promotion:
        yield


def evaluate(
    function: Callable[..., Any], arguments: Sequence[np.ndarray], algebra: Algebra
) -> list[np.ndarray]:
    """Return the results of a function for JAX, traced in float64, for arrays of entries.

    Args:
        function: takes one float64 array of the shape of each argument.
        arguments: arrays of entries.
        algebra: what the function's equations mean for them.
    """
    # A trace holds its constants: in float32 they would be rounded before any rule sees them.
    with float64():
        # Shapes alone shape a trace, so zeros stand for entries that JAX cannot take.
        closed = jax.make_jaxpr(function)(*(jnp.zeros(a.shape) for a in arguments))
        return walk(closed.jaxpr, closed.consts, arguments, algebra)


def walk(
    jaxpr: Jaxpr, consts: Sequence[object], arguments: Sequence[np.ndarray], algebra: Algebra
) -> list[np.ndarray]:
    """Return the results of a jaxpr, each of its equations evaluated in an algebra.

    JAX computes on plain numbers in the precision that holds here, which should be the trace's.

    Args:
        jaxpr: of a trace, such as `jax.make_jaxpr(f)(x).jaxpr`.
        consts: values of its `constvars`.
        arguments: values of its `invars`, arrays of entries or of numbers.
        algebra: what its equations mean for entries.
    """
    values = dict(zip(jaxpr.constvars, (algebra.lift(np.asarray(c)) for c in consts), strict=True))
    values |= dict(zip(jaxpr.invars, arguments, strict=True))

    def read(variable: Var | Literal) -> np.ndarray:
        # A literal is stored in the equation itself, with its value.
        literal = isinstance(variable, Literal)
        return algebra.lift(np.asarray(variable.val)) if literal else values[variable]

    # Equations stand in order and assign once, so one pass binds every variable before its use.
    for equation in _used(jaxpr):
        results = apply(equation, [read(v) for v in equation.invars], algebra)
        results = algebra.finish(equation, results)
        values |= dict(zip(equation.outvars, results, strict=True))
    return [read(v) for v in jaxpr.outvars]


def _used(jaxpr: Jaxpr) -> list[JaxprEqn]:
    """Return the equations on which the results depend, as a trace keeps all that was written."""
    needed, result = {v for v in jaxpr.outvars if not isinstance(v, Literal)}, []
    for equation in reversed(jaxpr.eqns):
        if needed.intersection(equation.outvars):
            needed.update(v for v in equation.invars if not isinstance(v, Literal))
            result.append(equation)
    return result[::-1]


def used_leaves(function: Callable[..., Any], *arguments: Any) -> list[bool]:
    """Return which leaves of the arguments the results of a function for JAX may rest on."""
    jaxpr = jax.make_jaxpr(function)(*arguments).jaxpr
    read = {v for equation in _used(jaxpr) for v in equation.invars if not isinstance(v, Literal)}
    read.update(v for v in jaxpr.outvars if not isinstance(v, Literal))
    return [v in read for v in jaxpr.invars]


def apply(equation: JaxprEqn, operands: list[np.ndarray], algebra: Algebra) -> list[np.ndarray]:
    """Return the results of one equation for arrays of entries or of numbers."""
    name, params = equation.primitive.name, equation.params
    if name in INLINED:
        inner = next(params[k] for k in ("jaxpr", "call_jaxpr", "fun_jaxpr") if k in params)
        # `checkpoint` calls an open jaxpr, which has no constants of its own.
        closed = isinstance(inner, ClosedJaxpr)
        jaxpr, consts = (inner.jaxpr, inner.consts) if closed else (inner, ())
        with algebra.within(equation):
            return walk(jaxpr, consts, operands, algebra)
    # What numbers alone make is folded, so that rules see constants and not what made them.
    if all(a.dtype != object for a in operands):
        return [algebra.lift(a) for a in compute(equation, operands)]
    # It only keeps XLA from reordering, and nothing is reordered here.
    if name == "optimization_barrier":
        return operands
    if name in PLACED | ADDED and (_is_open(equation, operands) or has_function(equation)):
        return algebra.unknown(equation, operands)
    if name in PLACED:
        return _place(equation, operands, algebra)
    if name in ADDED:
        return [_add(equation, operands, algebra.constant)]
    # JAX lets it multiply whole numbers and others, where they are indices everywhere else.
    if name == "dot_general":
        operands = [algebra.lift(a.astype(float)) if a.dtype.kind in "biu" else a for a in operands]
    rule = algebra.rules.get(name, COMMON.get(name))
    if rule is None:
        return algebra.unknown(equation, operands)
    return [rule(params, *operands)]


INLINED = {
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
"""Primitives that only call; their derivatives by hand are of no use once JAX has traced."""

PLACED = {
    "split",
    "rev",
    "pad",
    "gather",
    "scatter",
    "dynamic_slice",
    "dynamic_update_slice",
    "expand_dims",
    "tile",
    "unstack",
}
"""Primitives that copy entries to other places."""

ADDED = {"scatter-add", "scatter_add", "cumsum"}
"""Primitives that are linear in their entries, with weights of any kind."""


_INDICES: dict[str, tuple[int, int | None]] = {
    **{name: (1, 2) for name in ("gather", "scatter", "scatter-add", "scatter_add")},
    "dynamic_slice": (1, None),
    "dynamic_update_slice": (2, None),
}
"""Which operands say where: from the first number to before the second."""


def has_function(equation: JaxprEqn) -> bool:
    """Tell whether an equation replaces entries by a function of them, as `at[..].apply` does."""
    return equation.primitive.name == "scatter" and equation.params["update_jaxpr"] is not None


def _is_open(equation: JaxprEqn, operands: list[np.ndarray]) -> bool:
    """Tell whether an index is an entry, so that where it points is not known."""
    first = _INDICES.get(equation.primitive.name)
    return first is not None and any(a.dtype == object for a in operands[first[0] : first[1]])


def map_entries(function: Callable[..., object], *arrays: np.ndarray) -> np.ndarray:
    """Return a function of one entry of each array, entry by entry."""
    # Of arrays without axes `frompyfunc` makes a bare entry, and the walk needs arrays throughout.
    return np.asarray(np.frompyfunc(function, len(arrays), 1)(*arrays), dtype=object)


def compute(equation: JaxprEqn, operands: Sequence[np.ndarray]) -> list[np.ndarray]:
    """Return the results of an equation for plain numbers."""
    name, arrays = equation.primitive.name, [np.asarray(a) for a in operands]
    rule = NUMERIC.get(name)
    result = None if rule is None else rule(equation.params, *arrays)
    if result is not None:
        return [np.asarray(result)]
    key = _key_of(equation, arrays)
    with _LOCK:
        results = _COMPUTED.pop(key, None)
    if results is None:
        results = by_jax(equation, arrays)
    if key is not None:
        with _LOCK:
            # At the end, so that the first one is the least recently used.
            _COMPUTED[key] = results
            while len(_COMPUTED) > 256 or _stored_bytes() > 10**7:
                _COMPUTED.pop(next(iter(_COMPUTED)))
    return results


def _key_of(equation: JaxprEqn, arrays: Sequence[np.ndarray]) -> Hashable | None:
    """Return a key, equal only for equal operations on equal bits; None where there is none."""
    # By text too, since 0.0 and -0.0 are equal.
    params = [
        (name, value, repr(value) if isinstance(value, float | tuple) else type(value))
        for name, value in equation.params.items()
    ]
    bits = [(str(a.dtype), a.shape, hashlib.sha256(a.tobytes()).digest()) for a in arrays]
    key = equation.primitive.name, jnp.result_type(float), *params, *bits
    try:
        hash(key)
    except TypeError:
        return None
    return key


def _stored_bytes() -> int:
    return sum(array.nbytes for results in _COMPUTED.values() for array in results)


def by_jax(equation: JaxprEqn, operands: Sequence[np.ndarray]) -> list[np.ndarray]:
    """Return the results of an equation for plain numbers as JAX computes them."""
    results = equation.primitive.bind(*map(jnp.asarray, operands), **equation.params)
    return [np.asarray(r) for r in (results if equation.primitive.multiple_results else [results])]


_COMPUTED: dict[Hashable, list[np.ndarray]] = {}
"""Results of JAX, which takes up to 60 ms for one; stages of an integrator compute them again."""
_LOCK = threading.Lock()


def _place(
    equation: JaxprEqn, operands: Sequence[np.ndarray], algebra: Algebra
) -> list[np.ndarray]:
    """Return the results of a primitive that copies entries: JAX moves their places about."""
    pool, places = _label_entries(operands)
    value = equation.params.get("fill_value")
    fill = math.nan if value is None else float(value)
    if value is not None:
        # What `gather` reads from outside: a number, which would be taken for a place.
        equation = equation.replace(params={**equation.params, "fill_value": -1.0})

    def entry(place: float) -> Entry:
        if 0.0 <= place < len(pool):
            return pool[int(place)]
        return algebra.outside() if math.isnan(fill) else algebra.constant(fill)

    return [map_entries(entry, r) for r in compute(equation, places)]


def _add(
    equation: JaxprEqn, operands: Sequence[np.ndarray], constant: Callable[[float], Entry]
) -> np.ndarray:
    """Return the result of a primitive that adds entries: each of a sum of entries with weights."""
    pool, places = _label_entries(operands)
    if equation.primitive.name != "cumsum":
        terms = [_alone(a) if a.dtype == float else a for a in places]
        sums = scatter_add(equation.params, *terms)
        if sums is not None:
            return map_entries(lambda term: _sum_of(pool, term, constant), sums)

    def result(unit: jax.Array) -> jax.Array:
        data = [unit[a.astype(int)] if a.dtype == float else jnp.asarray(a) for a in places]
        return equation.primitive.bind(*data, **equation.params)

    # Linear in its data, so that the images of unit vectors are the columns of its matrix.
    weights = np.asarray(jax.vmap(result)(jnp.eye(len(pool))))
    total = np.full(weights.shape[1:], constant(0.0), object)
    for entry, weight in zip(pool, weights, strict=True):
        total = total + map_entries(
            lambda w, p=entry: constant(w) * p if w else constant(0.0), weight
        )
    return total


def _alone(places: np.ndarray) -> np.ndarray:
    entries = np.empty(places.size, object)
    entries[:] = [(int(place),) for place in places.flat]
    return entries.reshape(places.shape)


def _sum_of(
    pool: Sequence[Entry], places: tuple[int, ...], constant: Callable[[float], Entry]
) -> Entry:
    return functools.reduce(operator.add, (constant(1.0) * pool[k] for k in places), constant(0.0))


def _label_entries(operands: Sequence[np.ndarray]) -> tuple[list[Entry], list[np.ndarray]]:
    """Return all data entries in a row, and the operands with each entry's place in that row."""
    pool: list[Entry] = []
    places = []
    for a in operands:
        # Integers are indices: they say where, not what.
        if a.dtype.kind in "iu":
            places.append(a)
            continue
        # Floats, since JAX moves them in the place of float data; exact up to 2^53.
        places.append(np.arange(len(pool), len(pool) + a.size, dtype=float).reshape(a.shape))
        pool += list(a.flat)
    return pool, places


def entrywise(function: Callable[..., object]) -> Rule:
    """Return the rule of a function of entries, which the primitive's parameters do not change."""
    return lambda params, *arrays: map_entries(function, *arrays)


def reduction(join: Callable[[Entry, Entry], Entry], of_none: Entry) -> Rule:
    """Return the rule that joins entries along axes two by two, the last axis first.

    `of_none`, what no entries make, takes no part where there are some: a solver would carry it
    along in every expression.
    """
    joined = np.frompyfunc(join, 2, 1)

    def reduce(params: Params, x: np.ndarray) -> np.ndarray:
        # From the last one on, so that the numbers of the axes to come still hold.
        for axis in sorted(params["axes"], reverse=True):
            begin = {} if x.shape[axis] else {"initial": of_none}
            x = np.asarray(joined.reduce(x, axis=axis, **begin), object)
        return x

    return reduce


def dot(zero: Entry) -> Rule:
    """Return the rule of `dot_general`, sums of products that begin at `zero`."""
    return functools.partial(_dot, zero)


def _dot(zero: Entry, params: Params, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the sum of products over contracted axes, batch axes first."""
    (contract_a, contract_b), (batch_a, batch_b) = params["dimension_numbers"]
    left, batch, rows = _matrix_form(a, batch_a, contract_a)
    right, _, columns = _matrix_form(b, batch_b, contract_b)
    result = np.empty((left.shape[0], left.shape[1], right.shape[1]), object)
    for i, j, k in np.ndindex(*result.shape):
        products = (p * q for p, q in zip(left[i, j], right[i, k], strict=True))
        # A plain `sum` would begin at the integer 0, which an entry need not know how to add.
        result[i, j, k] = sum(products, start=zero)
    return result.reshape(batch + rows + columns)


def _matrix_form(
    x: np.ndarray, batch: Sequence[int], contracted: Sequence[int]
) -> tuple[np.ndarray, tuple[int, ...], tuple[int, ...]]:
    """Return x as (batch, free, contracted), with the shapes of the first two."""
    free = [axis for axis in range(x.ndim) if axis not in (*batch, *contracted)]
    batch_shape = tuple(x.shape[axis] for axis in batch)
    free_shape = tuple(x.shape[axis] for axis in free)
    inner = math.prod(x.shape[axis] for axis in contracted)
    # Sizes are spelled out, as NumPy cannot infer a -1 next to an axis of length zero.
    permuted = x.transpose([*batch, *free, *contracted])
    return (
        permuted.reshape(math.prod(batch_shape), math.prod(free_shape), inner),
        batch_shape,
        free_shape,
    )


COMMON: dict[str, Rule] = {
    "add": entrywise(operator.add),
    "add_any": entrywise(operator.add),
    "sub": entrywise(operator.sub),
    "mul": entrywise(operator.mul),
    "neg": entrywise(operator.neg),
    "square": entrywise(lambda entry: entry * entry),
    **MOVES,
    # Exact entries have no memory, no precision and, once traced, no derivative.
    **{
        name: lambda params, x: x
        for name in ("copy", "copy_p", "reduce_precision", "stop_gradient")
    },
}
"""What Python's operators and NumPy's moves do to entries of any kind."""
