"""A function written for JAX as scalars of a graph.

JAX traces the function of one agent, and each equation of the trace is evaluated on nodes. If one
has no scalar operations, the error names the primitive, and the file and line in the user's code.
"""

import contextlib
import functools
import itertools
import operator
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import JaxprEqn

from echelon.core.numerics import Precision, precision
from echelon.core.trace import error_summary
from echelon.core.types import PyTree
from echelon.simulation.scalars import elementary
from echelon.simulation.scalars.host_part import HostPart
from echelon.simulation.scalars.scalar_graph import Entry, Node, ScalarGraph, needed, within
from echelon.simulation.scalars.traced_entries import (
    LARGEST,
    LONGEST,
    Arrays,
    Missing,
    Params,
    PrimitiveRule,
    Unsupported,
    array_type,
    entry,
    is_truth,
    missing,
    node,
    nodes,
    number,
    select,
    where,
)
from echelon.simulation.scalars.whole_numbers import WHOLE_NUMBERS, TypeRules, whole_range
from echelon_ranges.jaxpr import (
    Algebra,
    Rule,
    apply,
    dot,
    entrywise,
    has_function,
    map_entries,
    reduction,
    walk,
)


def lower(
    function: Callable[..., PyTree],
    graph: ScalarGraph,
    arguments: Sequence[PyTree],
    known: Sequence[PyTree] = (),
    ahead: HostPart | None = None,
) -> Arrays:
    """Return results of a JAX function, flattened, as nodes and numbers; or raise `Unsupported`.

    Args:
        function: of the arguments; of what the host knows first, if it knows any.
        graph: of the nodes.
        arguments: arrays of nodes or numbers.
        known: arrays that the host knows.
        ahead: takes what depends on these, and on the step at most.
    """
    leaves, tree = jax.tree.flatten(list(arguments), is_leaf=lambda a: isinstance(a, np.ndarray))
    first, before = jax.tree.flatten(list(known))
    # In the precision of the run: a user's function may ask for it (`x.dtype`).
    name: Precision = "float64" if graph.bits == 64 else "float32"
    shaped = [_shape(leaf, np.dtype(name)) for leaf in leaves]

    def flat(*entries: jax.Array) -> list[jax.Array]:
        own = jax.tree.unflatten(before, entries[: len(first)])
        return jax.tree.leaves(function(*own, *jax.tree.unflatten(tree, entries[len(first) :])))

    with precision(name):
        closed = jax.make_jaxpr(flat)(*first, *shaped)
        jaxpr = closed.jaxpr
        if ahead is not None:
            step = len(first) + next(k for k, leaf in enumerate(leaves) if _is_step(leaf))
            jaxpr, taken = ahead.split(closed, len(first), step, graph)
            leaves = [*taken, *leaves]
        try:
            return walk(jaxpr, closed.consts, leaves, _algebra(graph))
        except (TypeError, ValueError, IndexError, KeyError, AttributeError) as error:
            # Users write what is traced: an unforeseen trace must not end a run that JAX can do.
            raise Unsupported(f"a trace that no rule fits ({error_summary(error)})") from error


def _is_step(leaf: np.ndarray) -> bool:
    one: Any = leaf[()] if leaf.shape == () else None
    return isinstance(one, Node) and one.value == ("step",)


def _shape(leaf: np.ndarray, real: np.dtype) -> jax.ShapeDtypeStruct:
    truths = leaf.dtype == object and leaf.size and all(is_truth(e) for e in leaf.flat)
    kind = bool if truths else real if leaf.dtype.kind in "Of" else leaf.dtype
    return jax.ShapeDtypeStruct(leaf.shape, kind)


@contextlib.contextmanager
def _within(equation: JaxprEqn) -> Iterator[None]:
    """Add the line of a call to an error if what it calls has no line of its own."""
    try:
        yield
    except Unsupported as error:
        if ", line " in str(error):
            raise
        raise Unsupported(f"{error}{where(equation)}") from None


def _algebra(graph: ScalarGraph) -> Algebra:
    def unknown(equation: JaxprEqn, operands: Arrays) -> Arrays:
        name = equation.primitive.name
        if name in _PRIMITIVES:
            return _PRIMITIVES[name](graph, algebra, equation, operands)
        if name in _UNREAD:
            return missing(equation)
        raise Unsupported(f"`{name}`{where(equation)}")

    algebra = Algebra(
        rules=_rules(graph),
        constant=float,
        lift=lambda n: n,
        outside=lambda: float("nan"),
        unknown=unknown,
        within=_within,
        finish=TypeRules(graph),
    )
    return algebra


def _rules(graph: ScalarGraph) -> dict[str, Rule]:
    def op(name: str) -> Callable[..., Node]:
        return lambda *args: graph.make(name, *map(entry, args))

    def function(of: Callable[..., Node]) -> Callable[..., Node]:
        def evaluate(*args: Entry) -> Node:
            with graph.verbatim():
                return of(*(node(graph, a) for a in args))

        return evaluate

    entrywise_rules = {name: op(name) for name in _SAME}
    entrywise_rules |= {name: function(getattr(elementary, name)) for name in _ELEMENTARY}
    entrywise_rules |= {name: function(getattr(elementary, name)) for name in ("cbrt", "rsqrt")}
    entrywise_rules |= {
        "gt": lambda a, b: graph.make("lt", entry(b), entry(a)),
        "ge": lambda a, b: graph.make("le", entry(b), entry(a)),
        "pow": function(elementary.power),
        "clamp": lambda low, x, high: graph.make(
            "min", graph.make("max", entry(low), entry(x)), entry(high)
        ),
        "is_finite": lambda a: graph.make("lt", graph.make("abs", a), float("inf")),
        "lt_to": functools.partial(less, graph),
        "le_to": lambda a, b: graph.make("not", less(graph, b, a)),
        "select_n": functools.partial(one_of, graph),
    }
    array_rules: dict[str, Rule] = {
        "integer_pow": lambda params, x: map_entries(
            lambda e: elementary.integer_power(node(graph, e), params["y"]), x
        ),
        "round": functools.partial(_round, graph),
        "dot_general": dot(0.0),
        "reduce_sum": reduction(operator.add, 0.0),
        "reduce_prod": reduction(operator.mul, 1.0),
        "reduce_max": reduction(op("max"), -np.inf),
        "reduce_min": reduction(op("min"), np.inf),
        "reduce_and": reduction(op("and"), True),
        "reduce_or": reduction(op("or"), False),
        "cholesky": functools.partial(cholesky, graph),
    }
    rules = {name: entrywise(rule) for name, rule in entrywise_rules.items()}
    joins = {"cumprod": operator.mul, "cummax": op("max"), "cummin": op("min")}
    return rules | array_rules | {name: cumulative(join) for name, join in joins.items()}


_SAME = ("abs", "sqrt", "floor", "ceil", "max", "min", "lt", "le", "eq", "ne")
_ELEMENTARY = ("sin", "cos", "tan", "asin", "acos", "atan", "atan2", "sinh", "cosh", "tanh")
_ELEMENTARY += ("asinh", "acosh", "atanh", "exp", "exp2", "expm1", "log", "log1p", "logistic")
_ELEMENTARY += ("erf", "erfc", "sign")


def _round(graph: ScalarGraph, params: Params, x: np.ndarray) -> np.ndarray:
    to_even = int(params["rounding_method"]) == 1
    if to_even:
        return map_entries(lambda e: graph.make("rint", e), x)
    return map_entries(lambda e: elementary.round_half_away(node(graph, e)), x)


# ---- loops ---------------------------------------------------------------------------------------


def _scan(graph: ScalarGraph, algebra: Algebra, equation: JaxprEqn, operands: Arrays) -> Arrays:
    params, body = equation.params, equation.params["jaxpr"]
    length, constant, carried = params["length"], params["num_consts"], params["num_carry"]
    if length > LONGEST:
        raise Unsupported(f"a loop of {length} rounds{where(equation)}")
    consts, carry = operands[:constant], operands[constant : constant + carried]
    rounds, columns = range(length), list[list[np.ndarray]]()
    for k in reversed(rounds) if params["reverse"] else rounds:
        rows = [x[k] for x in operands[constant + carried :]]
        rows = [np.asarray(x, x.dtype if isinstance(x, np.ndarray) else None) for x in rows]
        results = walk(body.jaxpr, body.consts, [*consts, *carry, *rows], algebra)
        carry = results[:carried]
        columns.append(results[carried:])
    columns = columns[::-1] if params["reverse"] else columns
    return [*carry, *(np.stack(column) for column in zip(*columns, strict=True))]


def _while(graph: ScalarGraph, algebra: Algebra, equation: JaxprEqn, operands: Arrays) -> Arrays:
    """Return the results of a loop: round by round, or a loop of the graph if its end differs."""
    params = equation.params
    tests, bodies = params["cond_nconsts"], params["body_nconsts"]
    test_consts, body_consts = operands[:tests], operands[tests : tests + bodies]
    carry, test, body = operands[tests + bodies :], params["cond_jaxpr"], params["body_jaxpr"]

    def going(carry: Arrays) -> np.ndarray:
        return walk(test.jaxpr, test.consts, [*test_consts, *carry], algebra)[0]

    def after(carry: Arrays) -> Arrays:
        return walk(body.jaxpr, body.consts, [*body_consts, *carry], algebra)

    for _ in range(LONGEST + 1):
        more = going(carry)
        if more.dtype == object:
            break
        if not more:
            return carry
        carry = after(carry)
    if graph.loops is None:
        reason = f"depends on the agent, or is more than {LONGEST} rounds away"
        raise Unsupported(f"a `while` loop whose end {reason}{where(equation)}")
    return _looped(graph, equation, carry, going, after)


def _looped(
    graph: ScalarGraph,
    equation: JaxprEqn,
    carry: Arrays,
    going: Callable[[Arrays], np.ndarray],
    after: Callable[[Arrays], Arrays],
) -> Arrays:
    """Return the results of a loop of the graph; truths are carried as numbers."""
    assert graph.loops is not None
    types, loop = [array_type(v) for v in equation.outvars], graph.loops
    graph.loops += 1

    def flat(arrays: Arrays) -> list[Node]:
        return [node(graph, number(graph, e)) for x in arrays for e in np.asarray(x).flat]

    def shaped(entries: Sequence[Node]) -> Arrays:
        left = iter(entries)
        rows = [[_carried(graph, next(left), t.dtype) for _ in range(t.size)] for t in types]
        return [np.array(r, object).reshape(t.shape) for r, t in zip(rows, types, strict=True)]

    begin = flat(carry)
    inner = [graph.carried(loop, k) for k in range(len(begin) + 1)]
    [test], last = nodes(graph, going(shaped(inner))), flat(after(shaped(inner)))
    found = [n for n in needed([test, *last]) if n in graph.exceptions]
    changes = within(loop, [test, *last, *(graph.exceptions[n] for n in found)])
    found = [n for n in found if changes[graph.exceptions[n]]]
    if set(found).intersection(needed([test])):
        raise Unsupported(f"a `while` loop whose end may be inaccurate{where(equation)}")
    results = graph.loop(loop, begin, test, last)
    if found:
        # Of a round that is not what JAX computes all later ones make something else.
        truths = [_truth(graph, inner[-1]), *(graph.exceptions.pop(n) for n in found)]
        wrong = functools.reduce(functools.partial(graph.make, "or"), truths)
        last = [*last, node(graph, number(graph, wrong))]
        *results, wrong = graph.loop(loop, [*begin, graph.constant(0.0)], test, last)
        for result in results:
            graph.except_where(result, _truth(graph, wrong))
    return shaped(results)


def _truth(graph: ScalarGraph, carried: Node) -> Node:
    return graph.make("ne", carried, 0.0)


def _carried(graph: ScalarGraph, entry: Node, kind: np.dtype) -> Node:
    """Return a number that a loop carries as an entry of a type."""
    if np.dtype(kind).kind == "b":
        return _truth(graph, entry)
    if np.dtype(kind).kind in "iu":
        graph.ranges[entry] = whole_range(graph, kind)
    return entry


# ---- small systems of linear equations -----------------------------------------------------------


def solve(graph: ScalarGraph, algebra: Algebra, equation: JaxprEqn, operands: Arrays) -> Arrays:
    """Return the solution of linear equations; images of unit vectors are the matrix's columns."""
    jaxprs, lengths = equation.params["jaxprs"], equation.params["const_lengths"]
    matvec, count = jaxprs.matvec, lengths.matvec
    total = sum(lengths)
    consts, b = operands[:count], operands[total:]
    if len(b) != 1:
        raise Unsupported(f"`custom_linear_solve` of several vectors{where(equation)}")
    [right] = b
    # Of a group without agents.
    if not right.size:
        return [right]
    columns = []
    for k in range(right.size):
        unit = np.zeros(right.size)
        unit[k] = 1.0
        [image] = walk(matvec.jaxpr, matvec.consts, [*consts, unit.reshape(right.shape)], algebra)
        columns.append(nodes(graph, image))
    rows = np.array(columns, object).T
    solved = np.empty(right.size, object)
    for part in _parts(rows):
        if len(part) > LARGEST:
            raise Unsupported(f"a system of {len(part)} equations{where(equation)}")
        rhs = np.array(nodes(graph, right), object)[part]
        solved[part] = _eliminate(graph, rows[np.ix_(part, part)], rhs)
    return [solved.reshape(right.shape)]


def _parts(rows: np.ndarray) -> list[list[int]]:
    """Return the sets of unknowns that share no equation with others."""
    from scipy.sparse.csgraph import connected_components

    nonzero = np.vectorize(lambda e: not (e.op == "constant" and e.value == 0.0))(rows)
    count, label = connected_components(nonzero, directed=False)
    return [np.flatnonzero(label == k).tolist() for k in range(count)]


def _eliminate(graph: ScalarGraph, matrix: np.ndarray, right: np.ndarray) -> np.ndarray:
    both, n = np.column_stack([matrix, right]), len(matrix)
    for k in range(n):
        _pivot(graph, both, k, n)
        for i in range(k + 1, n):
            factor = both[i, k] / both[k, k]
            both[i, k:] = [p - factor * q for p, q in zip(both[i, k:], both[k, k:], strict=True)]
    return _by_triangle(both[:, :n], both[:, n], lower=False, unit=False)


def _pivot(graph: ScalarGraph, rows: np.ndarray, k: int, n: int) -> Node:
    """Exchange row k for that of the largest entry below, and return the index of that row."""
    largest, place = graph.make("abs", rows[k, k]), graph.constant(float(k))
    for i in range(k + 1, n):
        size = graph.make("abs", rows[i, k])
        larger = graph.make("lt", largest, size)
        largest, place = select(graph, larger, size, largest), select(graph, larger, i, place)
    here = rows[k].copy()
    for i in range(k + 1, n):
        it = graph.make("eq", place, float(i))
        rows[k] = [select(graph, it, p, q) for p, q in zip(rows[i], rows[k], strict=True)]
        rows[i] = [select(graph, it, q, p) for p, q in zip(rows[i], here, strict=True)]
    return place


def _by_triangle(A: np.ndarray, right: np.ndarray, lower: bool, unit: bool) -> np.ndarray:
    b, n = right.copy(), len(A)
    for k in range(n) if lower else reversed(range(n)):
        for j in range(k) if lower else range(k + 1, n):
            b[k] = b[k] - A[k, j] * b[j]
        b[k] = b[k] if unit else b[k] / A[k, k]
    return b


def cholesky(graph: ScalarGraph, params: Params, matrix: np.ndarray) -> np.ndarray:
    """Return the L with L L' = matrix."""
    n = matrix.shape[-1]
    if matrix.ndim != 2 or n > LARGEST:
        raise Unsupported(f"`cholesky` of shape {matrix.shape}")
    L = np.full((n, n), 0.0, object)
    for j in range(n):
        rest = matrix[j, j] - sum((L[j, k] * L[j, k] for k in range(j)), 0.0)
        L[j, j] = graph.make("sqrt", rest)
        for i in range(j + 1, n):
            rest = matrix[i, j] - sum((L[i, k] * L[j, k] for k in range(j)), 0.0)
            L[i, j] = rest / L[j, j]
    return L


def triangle(graph: ScalarGraph, algebra: Algebra, equation: JaxprEqn, operands: Arrays) -> Arrays:
    """Return the solution X of A X = B, or of X A = B, for a triangular A."""
    A, B = (np.asarray(x, object) for x in operands)
    if any(isinstance(e, Missing) for x in (A, B) for e in x.flat):
        return missing(equation)
    if A.ndim != 2 or len(A) > LARGEST:
        raise Unsupported(f"`triangular_solve` of shape {A.shape}{where(equation)}")
    params = equation.params
    left, lower = params["left_side"], params["lower"]
    if params["transpose_a"] == left:
        A, lower = A.T, not lower
    rows = np.array(nodes(graph, A), object).reshape(A.shape)
    columns = B.T if left else B
    solved = [_by_triangle(rows, column, lower, params["unit_diagonal"]) for column in columns]
    return [np.array(solved, object).reshape(columns.shape).T if left else np.stack(solved)]


def lu(graph: ScalarGraph, algebra: Algebra, equation: JaxprEqn, operands: Arrays) -> Arrays:
    """Return L and U in one matrix, the pivot row of each step, and the order of the rows.

    If they are computed for a system of equations, nothing reads them: `solve` eliminates itself.
    """
    [matrix] = operands
    n = matrix.shape[-1]
    if matrix.shape != (n, n) or n > LARGEST:
        return missing(equation)
    order = np.array([graph.constant(float(k)) for k in range(n)])
    rows = np.column_stack([np.array(nodes(graph, matrix), object).reshape(n, n), order])
    pivots = []
    for k in range(n):
        pivots.append(_pivot(graph, rows, k, n))
        for i in range(k + 1, n):
            rows[i, k] = factor = rows[i, k] / rows[k, k]
            later = zip(rows[i, k + 1 : n], rows[k, k + 1 : n], strict=True)
            rows[i, k + 1 : n] = [p - factor * q for p, q in later]
    return [rows[:, :n], np.array(pivots, object), rows[:, n]]


# ---- choices that differ between agents ----------------------------------------------------------

# ---- indices -------------------------------------------------------------------------------------


def at_index(graph: ScalarGraph, algebra: Algebra, equation: JaxprEqn, operands: Arrays) -> Arrays:
    """Return what is read or written at indices that differ between agents: each place is tried."""
    if has_function(equation):
        raise Unsupported(f"`scatter` of a function{where(equation)}")
    rows, ends = _rows(equation, operands), _ends(equation, operands)
    drops = equation.params.get("mode") == jax.lax.GatherScatterMode.FILL_OR_DROP
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


# ---- all primitives ------------------------------------------------------------------------------

_PRIMITIVES: dict[str, PrimitiveRule] = (
    INDEXING
    | WHOLE_NUMBERS
    | {
        "scan": _scan,
        "while": _while,
        "custom_linear_solve": solve,
        "lu": lu,
        "triangular_solve": triangle,
    }
)
_UNREAD = {"lu_pivots_to_permutation", "lu_solve"}
"""What JAX computes before it solves equations; `solve` does not read it."""
