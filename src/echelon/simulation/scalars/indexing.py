"""Choices whose number agents differ in: places of a table, cases, the largest, the order."""

import functools
import itertools
import operator
from collections.abc import Callable
from typing import Any

import numpy as np

from echelon.core.jaxpr import Algebra, apply, map_entries, walk
from echelon.simulation.scalars.scalar_graph import Node, ScalarGraph
from echelon.simulation.scalars.traced_entries import (
    LARGEST,
    LONGEST,
    Unsupported,
    Written,
    all_of,
    chosen,
    entry,
    number,
    where,
)

# ---- places --------------------------------------------------------------------------------------


def placed(
    graph: ScalarGraph, algebra: Algebra, equation: Any, operands: list[np.ndarray]
) -> list[np.ndarray]:
    """Return what is read or written at places that agents differ in: each place is tried."""
    rows, ends = _rows(equation, operands), _ends(equation, operands)
    drops = _drops(equation)
    if not drops:
        rows = np.stack([_clipped(graph, rows[..., k], n) for k, n in enumerate(ends)], axis=-1)
    unknown = [k for k in range(len(ends)) if any(isinstance(e, Node) for e in rows[..., k].flat)]
    tried = list(itertools.product(*(range(ends[k] + 1) for k in unknown)))
    if len(tried) > LONGEST:
        raise Unsupported(f"a table of {len(tried)} places{where(equation)}")
    found = _elsewhere(equation, operands) if drops else None
    for place in tried:
        made = _at(algebra, equation, operands, _filled_in(rows, unknown, place))
        if found is None:
            found = made
            continue
        there = map_entries(lambda *e, p=place: _is(graph, e, p), *(rows[..., k] for k in unknown))
        there = _spread(equation, there, made.ndim)
        found = map_entries(functools.partial(chosen, graph), there, made, found)
    assert found is not None
    return [found]


_FIRST = {"dynamic_slice": 1, "dynamic_update_slice": 2}
"""The first operand that is an index, of those whose indices come one by one."""


def _rows(equation: Any, operands: list[np.ndarray]) -> np.ndarray:
    """Return the numbers of each place along the last axis."""
    first = _FIRST.get(equation.primitive.name)
    return operands[1] if first is None else np.stack(operands[first:], axis=-1)


def _filled_in(rows: np.ndarray, unknown: list[int], place: tuple[int, ...]) -> np.ndarray:
    """Return whole numbers in which those that are not known are those of a place."""
    at = rows.copy()
    at[..., unknown] = place
    return at.astype(np.int64)


def _at(
    algebra: Algebra, equation: Any, operands: list[np.ndarray], rows: np.ndarray
) -> np.ndarray:
    """Return what an equation makes of known places."""
    first = _FIRST.get(equation.primitive.name)
    if first is None:
        known = [operands[0], rows, *operands[2:]]
    else:
        known = [*operands[:first], *(rows[..., k] for k in range(rows.shape[-1]))]
    return apply(equation, known, algebra)[0]


def _is(graph: ScalarGraph, entries: tuple[Any, ...], place: tuple[int, ...]) -> Any:
    """Tell whether numbers are those of a place."""
    same = [graph.make("eq", entry(e), float(p)) for e, p in zip(entries, place, strict=True)]
    return all_of(graph, same)


def _drops(equation: Any) -> bool:
    """Tell whether nothing is read or written outside of a table; else the nearest place is."""
    from jax.lax import GatherScatterMode

    return equation.params.get("mode") == GatherScatterMode.FILL_OR_DROP


def _elsewhere(equation: Any, operands: list[np.ndarray]) -> np.ndarray:
    """Return what is found where an index points outside: nothing read is no number."""
    if equation.primitive.name != "gather":
        return operands[0]
    value, given = equation.params["fill_value"], equation.outvars[0].aval
    if value is None and np.dtype(given.dtype).kind != "f":
        raise Unsupported(f"`gather` from outside of a table of {given.dtype}{where(equation)}")
    return np.full(given.shape, np.nan if value is None else value)


def _ends(equation: Any, operands: list[np.ndarray]) -> list[int]:
    """Return the last place along each axis that an index has a number for."""
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
    def one(e: Any) -> Any:
        return graph.make("min", graph.make("max", entry(e), 0.0), float(end))

    return map_entries(one, numbers) if numbers.dtype == object else np.clip(numbers, 0, end)


def _spread(equation: Any, there: np.ndarray, axes: int) -> np.ndarray:
    """Return the truths of some places with axes of length one for what stands at each."""
    if equation.primitive.name == "gather":
        return np.expand_dims(there, equation.params["dimension_numbers"].offset_dims)
    return there.reshape((1,) * axes)


# ---- cases ---------------------------------------------------------------------------------------


def one_of(graph: ScalarGraph, which: Any, *cases: Any) -> Any:
    """Return the case whose number is chosen; JAX numbers them from zero, and clips."""
    if not isinstance(which, Node):
        return cases[min(max(int(which), 0), len(cases) - 1)]
    if which.truth:
        return chosen(graph, which, cases[1], cases[0])
    found = cases[0]
    for k, case in enumerate(cases[1:], 1):
        found = chosen(graph, graph.make("le", float(k), which), case, found)
    return found


def cond(
    graph: ScalarGraph, algebra: Algebra, equation: Any, operands: list[np.ndarray]
) -> list[np.ndarray]:
    """Return what all branches make, entry by entry that of the one that is taken."""
    which, *rest = operands
    branches = equation.params["branches"]
    if which.dtype != object:
        branches = [one_of(graph, which, *branches)]
    made = [walk(b.jaxpr, b.consts, rest, algebra) for b in branches]
    if len(made) == 1:
        return made[0]
    [index] = which.flat
    return [
        map_entries(lambda *cases: one_of(graph, index, *cases), *results)
        for results in zip(*made, strict=True)
    ]


# ---- order ---------------------------------------------------------------------------------------


def less(graph: ScalarGraph, a: Any, b: Any) -> Any:
    """Return whether one number stands before another, where what is no number stands last."""
    return graph.make("or", graph.make("lt", entry(a), entry(b)), _is_lost(graph, b, a))


def _is_lost(graph: ScalarGraph, a: Any, b: Any) -> Any:
    """Tell whether the first is no number, and the second is one."""
    lost, there = (graph.make(op, entry(x), entry(x)) for op, x in (("ne", a), ("eq", b)))
    return graph.make("and", lost, there)


def extreme(before: Callable[[Any, Any], tuple[Any, Any]]) -> Written:
    """Return the rule of the place of the first largest or smallest; what is no number wins."""

    def find(
        graph: ScalarGraph, algebra: Algebra, equation: Any, operands: list[np.ndarray]
    ) -> list[np.ndarray]:
        [x] = operands
        [axis] = equation.params["axes"]
        if x.shape[axis] > LONGEST:
            raise Unsupported(f"the extreme of {x.shape[axis]} entries{where(equation)}")

        def farther(a: tuple[Any, Any], b: tuple[Any, Any]) -> tuple[Any, Any]:
            beyond = graph.make("lt", *map(entry, before(a[0], b[0])))
            both = (
                graph.make("ne", entry(b[0]), entry(b[0])),
                graph.make("eq", entry(a[0]), entry(a[0])),
            )
            it = graph.make("or", beyond, graph.make("and", *both))
            return chosen(graph, it, b[0], a[0]), chosen(graph, it, b[1], a[1])

        rows = np.moveaxis(map_entries(lambda e: number(graph, e), x), axis, -1)
        found = np.empty(rows.shape[:-1], object)
        for place in np.ndindex(*found.shape):
            pairs = ((e, float(k)) for k, e in enumerate(rows[place]))
            found[place] = functools.reduce(farther, pairs)[1]
        return [found]

    return find


def ordered(
    graph: ScalarGraph, algebra: Algebra, equation: Any, operands: list[np.ndarray]
) -> list[np.ndarray]:
    """Return arrays in the order of the first of them, by exchanges of neighbours."""
    axis, n = equation.params["dimension"], operands[0].shape[equation.params["dimension"]]
    if n > LARGEST or equation.params["num_keys"] != 1:
        raise Unsupported(f"`sort` of {n} entries{where(equation)}")
    columns = [np.moveaxis(np.array(x, object), axis, 0) for x in operands]
    for end in reversed(range(1, n)):
        for k in range(end):
            # Slices, since of a row that is a lone entry no array would be left.
            one, next_one = slice(k, k + 1), slice(k + 1, k + 2)
            later = map_entries(
                functools.partial(less, graph), columns[0][next_one], columns[0][one]
            )
            for x in columns:
                a, b = x[one].copy(), x[next_one].copy()
                x[one] = map_entries(functools.partial(chosen, graph), later, b, a)
                x[next_one] = map_entries(functools.partial(chosen, graph), later, a, b)
    return [np.moveaxis(x, 0, axis) for x in columns]


# ---- whole numbers -------------------------------------------------------------------------------


def converted(
    graph: ScalarGraph, algebra: Algebra, equation: Any, operands: list[np.ndarray]
) -> list[np.ndarray]:
    """Return entries under another type; a whole number is a number without a fraction."""
    [x], [given] = operands, equation.invars
    to, of = np.dtype(equation.params["new_dtype"]), np.dtype(given.aval.dtype)
    if to.kind not in "bfiu":
        raise Unsupported(f"`convert_element_type` to {to}{where(equation)}")

    def one(e: Any) -> Any:
        if to.kind == "b":
            return e if of.kind == "b" else graph.make("ne", entry(e), 0.0)
        if to.kind == "f" or of.kind == "b":
            return number(graph, e)
        return _whole(graph, e, to, of, where(equation))

    return [map_entries(one, x)]


def _whole(graph: ScalarGraph, e: Any, to: np.dtype, of: np.dtype, at: str) -> Any:
    """Return a number as a whole one, as XLA makes it: towards 0, nothing beyond, 0 of none."""
    if of.kind == "f":
        down, up = (graph.make(op, entry(e)) for op in ("floor", "ceil"))
        towards = chosen(graph, graph.make("lt", entry(e), 0.0), up, down)
        towards = chosen(graph, graph.make("eq", entry(e), entry(e)), towards, 0.0)
        held = np.iinfo(to)
        return graph.make("min", graph.make("max", towards, float(held.min)), float(held.max))
    if to.itemsize < of.itemsize and to.itemsize < 4:
        raise Unsupported(f"`convert_element_type` to {to}{at}")
    if to.kind == "u" and of.kind == "i":
        return chosen(graph, graph.make("lt", entry(e), 0.0), e + 2.0 ** (8 * to.itemsize), e)
    return e


def divided(
    graph: ScalarGraph, algebra: Algebra, equation: Any, operands: list[np.ndarray]
) -> list[np.ndarray]:
    """Return quotients; those of whole numbers are whole, towards 0."""
    whole = np.dtype(equation.outvars[0].aval.dtype).kind in "iu"

    def one(a: Any, b: Any) -> Any:
        made = graph.make("over" if whole else "div", entry(a), entry(b))
        if not whole:
            return made
        down, up = graph.make("floor", made), graph.make("ceil", made)
        return chosen(graph, graph.make("lt", made, 0.0), up, down)

    return [map_entries(one, *operands)]


def logical(name: str) -> Written:
    """Return the rule of an operation on truths; on the bits of whole numbers there is none."""

    def make(
        graph: ScalarGraph, algebra: Algebra, equation: Any, operands: list[np.ndarray]
    ) -> list[np.ndarray]:
        if np.dtype(equation.outvars[0].aval.dtype).kind != "b":
            raise Unsupported(f"`{name}` of whole numbers{where(equation)}")
        return [map_entries(lambda *e: graph.make(name, *map(entry, e)), *operands)]

    return make


def running(join: Callable[[Any, Any], Any]) -> Callable[..., np.ndarray]:
    """Return the rule of what entries come to one after the other along an axis."""
    joined = np.frompyfunc(join, 2, 1)

    def accumulate(params: Any, x: np.ndarray) -> np.ndarray:
        turned = np.flip(x, params["axis"]) if params["reverse"] else x
        made = np.asarray(joined.accumulate(turned, axis=params["axis"], dtype=object), object)
        return np.flip(made, params["axis"]) if params["reverse"] else made

    return accumulate


PICKED: dict[str, Written] = {
    **{name: placed for name in ("gather", "dynamic_slice", "dynamic_update_slice")},
    **{name: placed for name in ("scatter", "scatter-add", "scatter_add")},
    **{name: logical(name) for name in ("and", "or", "xor", "not")},
    "cond": cond,
    "argmax": extreme(lambda a, b: (a, b)),
    "argmin": extreme(lambda a, b: (b, a)),
    "sort": ordered,
    "convert_element_type": converted,
    "div": divided,
}
"""Primitives that choose by numbers, or mean another thing for whole ones."""
RUNNING = {"cumprod": running(operator.mul)}
