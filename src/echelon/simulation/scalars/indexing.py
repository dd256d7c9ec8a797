"""Choices that differ between agents: indices of a table, cases, the largest entry, an order."""

import functools
import itertools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import JaxprEqn

from echelon.core.jaxpr import Algebra, apply, has_function, map_entries, walk
from echelon.simulation.scalars.scalar_graph import Entry, Node, ScalarGraph
from echelon.simulation.scalars.traced_entries import (
    LARGEST,
    LONGEST,
    Arrays,
    Params,
    PrimitiveRule,
    Unsupported,
    array_type,
    entry,
    number,
    select,
    where,
)

# ---- indices -------------------------------------------------------------------------------------


def at_index(graph: ScalarGraph, algebra: Algebra, equation: JaxprEqn, operands: Arrays) -> Arrays:
    """Return what is read or written at indices that differ between agents: each place is tried."""
    if has_function(equation):
        raise Unsupported(f"`scatter` of a function{where(equation)}")
    rows, ends = _rows(equation, operands), _ends(equation, operands)
    drops = _drops(equation)
    if not drops:
        rows = np.stack([_clipped(graph, rows[..., k], n) for k, n in enumerate(ends)], axis=-1)
    unknown = [k for k in range(len(ends)) if any(isinstance(e, Node) for e in rows[..., k].flat)]
    tried = list(itertools.product(*(range(ends[k] + 1) for k in unknown)))
    if len(tried) > LONGEST:
        raise Unsupported(f"a table of {len(tried)} places{where(equation)}")
    result = _elsewhere(equation, operands) if drops else None
    for place in tried:
        at = rows.copy()
        at[..., unknown] = place
        value = _at(algebra, equation, operands, at.astype(np.int64))
        if result is None:
            result = value
            continue
        there = map_entries(lambda *e, p=place: _is(graph, e, p), *(rows[..., k] for k in unknown))
        there = _spread(equation, there, value.ndim)
        result = map_entries(functools.partial(select, graph), there, value, result)
    assert result is not None
    return [result]


_FIRST = {"dynamic_slice": 1, "dynamic_update_slice": 2}
"""The first operand that is an index, of primitives with one operand per index."""


def _rows(equation: JaxprEqn, operands: Arrays) -> np.ndarray:
    """Return the numbers of each place along the last axis."""
    first = _FIRST.get(equation.primitive.name)
    return operands[1] if first is None else np.stack(operands[first:], axis=-1)


def _at(algebra: Algebra, equation: JaxprEqn, operands: Arrays, rows: np.ndarray) -> np.ndarray:
    """Return the result of an equation at constant indices."""
    first = _FIRST.get(equation.primitive.name)
    if first is None:
        constant = [operands[0], rows, *operands[2:]]
    else:
        constant = [*operands[:first], *(rows[..., k] for k in range(rows.shape[-1]))]
    return apply(equation, constant, algebra)[0]


def _is(graph: ScalarGraph, entries: tuple[Entry, ...], place: tuple[int, ...]) -> Entry:
    """Return whether numbers are those of a place."""
    same = [graph.make("eq", entry(e), float(p)) for e, p in zip(entries, place, strict=True)]
    return functools.reduce(functools.partial(graph.make, "and"), same, True)


def _drops(equation: JaxprEqn) -> bool:
    """Tell whether indices outside of a table are ignored; otherwise they are clipped."""
    from jax.lax import GatherScatterMode

    return equation.params.get("mode") == GatherScatterMode.FILL_OR_DROP


def _elsewhere(equation: JaxprEqn, operands: Arrays) -> np.ndarray:
    """Return the result for an index outside: what is not read is NaN."""
    if equation.primitive.name != "gather":
        return operands[0]
    value, out = equation.params["fill_value"], array_type(equation.outvars[0])
    if value is None and np.dtype(out.dtype).kind != "f":
        raise Unsupported(f"`gather` from outside of a table of {out.dtype}{where(equation)}")
    return np.full(out.shape, np.nan if value is None else value)


def _ends(equation: JaxprEqn, operands: Arrays) -> list[int]:
    """Return the last place along each axis that is indexed."""
    name, params, shape = equation.primitive.name, equation.params, operands[0].shape
    if name == "dynamic_slice":
        return [n - k for n, k in zip(shape, params["slice_sizes"], strict=True)]
    if name == "dynamic_update_slice":
        return [n - k for n, k in zip(shape, operands[1].shape, strict=True)]
    numbers = params["dimension_numbers"]
    if name == "gather":
        return [shape[k] - params["slice_sizes"][k] for k in numbers.start_index_map]
    if operands[1].size > operands[1].shape[-1] or numbers.update_window_dims:
        raise Unsupported(f"`{name}` of more than one entry{where(equation)}")
    return [shape[k] - 1 for k in numbers.scatter_dims_to_operand_dims]


def _clipped(graph: ScalarGraph, numbers: np.ndarray, end: int) -> np.ndarray:
    def clipped(e: Entry) -> Node:
        return graph.make("min", graph.make("max", entry(e), 0.0), float(end))

    return map_entries(clipped, numbers) if numbers.dtype == object else np.clip(numbers, 0, end)


def _spread(equation: JaxprEqn, there: np.ndarray, axes: int) -> np.ndarray:
    """Return the truths of some places with axes of length one for the entries at each."""
    if equation.primitive.name == "gather":
        return np.expand_dims(there, equation.params["dimension_numbers"].offset_dims)
    return there.reshape((1,) * axes)


# ---- cases ---------------------------------------------------------------------------------------


def one_of(graph: ScalarGraph, which: "Entry | np.ndarray", *cases: Any) -> Any:
    """Return the case of a number; JAX counts from zero, and clips."""
    if not isinstance(which, Node):
        return cases[min(max(int(which), 0), len(cases) - 1)]
    if which.truth:
        return select(graph, which, cases[1], cases[0])
    result = cases[0]
    for k, case in enumerate(cases[1:], 1):
        result = select(graph, graph.make("le", float(k), which), case, result)
    return result


def cond(graph: ScalarGraph, algebra: Algebra, equation: JaxprEqn, operands: Arrays) -> Arrays:
    """Return the results of the branch that is taken, entry by entry; all are computed."""
    which, *rest = operands
    branches = equation.params["branches"]
    if which.dtype != object:
        branches = [one_of(graph, which, *branches)]
    results = [walk(b.jaxpr, b.consts, rest, algebra) for b in branches]
    if len(results) == 1:
        return results[0]
    [index] = which.flat
    return [
        map_entries(lambda *cases: one_of(graph, index, *cases), *alternatives)
        for alternatives in zip(*results, strict=True)
    ]


# ---- order ---------------------------------------------------------------------------------------


def less(graph: ScalarGraph, a: Entry, b: Entry) -> Node:
    """Return whether one number is before another in a sorted array, in which NaN is last."""
    return graph.make("or", graph.make("lt", entry(a), entry(b)), _only_first_is_nan(graph, b, a))


def _only_first_is_nan(graph: ScalarGraph, a: Entry, b: Entry) -> Node:
    nan, not_nan = (graph.make(op, entry(x), entry(x)) for op, x in (("ne", a), ("eq", b)))
    return graph.make("and", nan, not_nan)


def extreme(before: Callable[[Entry, Entry], tuple[Entry, Entry]]) -> PrimitiveRule:
    """Return the rule of the index of the first largest or smallest entry; NaN wins."""

    def find(graph: ScalarGraph, algebra: Algebra, equation: JaxprEqn, operands: Arrays) -> Arrays:
        [x] = operands
        [axis] = equation.params["axes"]
        if x.shape[axis] > LONGEST:
            raise Unsupported(f"the extreme of {x.shape[axis]} entries{where(equation)}")

        def better(a: tuple[Entry, Entry], b: tuple[Entry, Entry]) -> tuple[Entry, Entry]:
            beyond = graph.make("lt", *map(entry, before(a[0], b[0])))
            it = graph.make("or", beyond, _only_first_is_nan(graph, b[0], a[0]))
            return select(graph, it, b[0], a[0]), select(graph, it, b[1], a[1])

        rows = np.moveaxis(map_entries(lambda e: number(graph, e), x), axis, -1)
        indices = np.empty(rows.shape[:-1], object)
        for place in np.ndindex(*indices.shape):
            pairs = ((e, float(k)) for k, e in enumerate(rows[place]))
            indices[place] = functools.reduce(better, pairs)[1]
        return [indices]

    return find


def sorted_by(graph: ScalarGraph, algebra: Algebra, equation: JaxprEqn, operands: Arrays) -> Arrays:
    """Return arrays in the order of the first of them, by bubble sort."""
    axis, n = equation.params["dimension"], operands[0].shape[equation.params["dimension"]]
    if n > LARGEST or equation.params["num_keys"] != 1:
        raise Unsupported(f"`sort` of {n} entries{where(equation)}")
    columns = [np.moveaxis(np.array(x, object), axis, 0) for x in operands]
    for end in reversed(range(1, n)):
        for k in range(end):
            # Slices, because a single entry would not stay an array.
            one, next_one = slice(k, k + 1), slice(k + 1, k + 2)
            later = map_entries(
                functools.partial(less, graph), columns[0][next_one], columns[0][one]
            )
            for x in columns:
                a, b = x[one].copy(), x[next_one].copy()
                x[one] = map_entries(functools.partial(select, graph), later, b, a)
                x[next_one] = map_entries(functools.partial(select, graph), later, a, b)
    return [np.moveaxis(x, 0, axis) for x in columns]


# ---- along an axis -------------------------------------------------------------------------------


def cumulative(join: Callable[..., object]) -> Callable[..., np.ndarray]:
    """Return the rule of cumulative results along an axis."""
    joined = np.frompyfunc(join, 2, 1)

    def accumulate(params: Params, x: np.ndarray) -> np.ndarray:
        axis, reverse = params["axis"], params["reverse"]
        x = np.flip(x, axis) if reverse else x
        result = np.asarray(joined.accumulate(x, axis=axis, dtype=object), object)
        return np.flip(result, axis) if reverse else result

    return accumulate


def scattered(
    op: str, graph: ScalarGraph, algebra: Algebra, equation: JaxprEqn, operands: Arrays
) -> Arrays:
    """Return a table each of whose entries is joined with the updates that fall on it."""
    if operands[1].dtype == object:
        return at_index(graph, algebra, equation, operands)
    table, rows, updates = operands
    params = {name: equation.params[name] for name in _SCATTERED}

    def landed(unit: jax.Array) -> jax.Array:
        return jax.lax.scatter_add(jnp.zeros(table.shape), jnp.asarray(rows), unit, **params)

    units = jnp.eye(updates.size).reshape(updates.size, *updates.shape)
    result = table
    for update, places in zip(updates.flat, np.asarray(jax.vmap(landed)(units)), strict=True):
        result = map_entries(
            lambda e, there, u=update: graph.make(op, entry(e), entry(u)) if there else e,
            result,
            places,
        )
    return [result]


_SCATTERED = ("dimension_numbers", "indices_are_sorted", "unique_indices", "mode")

INDEXING: dict[str, PrimitiveRule] = {
    **{name: at_index for name in ("gather", "dynamic_slice", "dynamic_update_slice")},
    **{name: at_index for name in ("scatter", "scatter-add", "scatter_add")},
    **{
        f"scatter{dash}{name}": functools.partial(scattered, name)
        for dash, name in itertools.product("-_", ("mul", "min", "max"))
    },
    "cond": cond,
    "argmax": extreme(lambda a, b: (a, b)),
    "argmin": extreme(lambda a, b: (b, a)),
    "sort": sorted_by,
}
"""Primitives that choose by numbers."""
