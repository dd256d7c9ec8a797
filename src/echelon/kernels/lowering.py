"""A function written for JAX as scalars of a graph.

JAX traces the function of one agent, and each equation of the trace is evaluated on nodes. What
cannot be is told with the primitive, and the file and line where the user wrote it.
"""

import contextlib
import functools
import operator
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NoReturn, final

import jax
import numpy as np

from echelon.core.errors import EchelonError
from echelon.core.jaxpr import Algebra, Rule, dot, each, entrywise, reduction, walk
from echelon.core.numerics import precision
from echelon.core.trace import in_short
from echelon.kernels import elementary
from echelon.kernels.scalar import Entry, Graph, Node

_LONGEST = 64
"""Rounds of a loop that are written out."""
_LARGEST = 6
"""Unknowns of a system of equations that is solved."""


class Unsupported(EchelonError):
    """A function uses what has no scalar operations: which primitive, and where it was written."""


@final
class _Missing:
    """Stands for a result that nothing may read; what is left over from a library's detour."""

    def __init__(self, primitive: str, where: str) -> None:
        self.primitive, self.where = primitive, where

    __array_ufunc__ = None

    def _read(self, *_: object) -> NoReturn:
        raise Unsupported(f"`{self.primitive}`{self.where}")

    __add__ = __radd__ = __sub__ = __rsub__ = __mul__ = __rmul__ = _read
    __truediv__ = __rtruediv__ = __neg__ = __float__ = __bool__ = _read


def lower(function: Callable[..., Any], graph: Graph, arguments: Sequence[Any]) -> list[np.ndarray]:
    """Return the results of a function for JAX, flattened, as arrays of nodes and numbers.

    Args:
        function: takes arrays and returns a tree of arrays.
        graph: that the nodes belong to.
        arguments: trees of arrays of nodes (of dtype object), or of plain numbers.

    Raises:
        Unsupported: a primitive has no scalar operations.
    """
    leaves, tree = jax.tree.flatten(list(arguments), is_leaf=lambda a: isinstance(a, np.ndarray))
    shaped = [_shape(leaf) for leaf in leaves]

    def flat(*given: Any) -> Any:
        return jax.tree.leaves(function(*jax.tree.unflatten(tree, given)))

    with precision("float64"):
        closed = jax.make_jaxpr(flat)(*shaped)
        try:
            return walk(closed.jaxpr, closed.consts, leaves, _algebra(graph))
        except (TypeError, ValueError, IndexError, KeyError, AttributeError) as error:
            # A trace is anyone's: what no rule was written for must end no run that JAX can make.
            raise Unsupported(f"a trace that no rule fits ({in_short(error)})") from error


def _shape(leaf: np.ndarray) -> jax.ShapeDtypeStruct:
    truths = leaf.dtype == object and leaf.size and all(_is_truth(e) for e in leaf.flat)
    kind = bool if truths else float if leaf.dtype == object else leaf.dtype
    return jax.ShapeDtypeStruct(leaf.shape, kind)


def _is_truth(entry: Any) -> bool:
    return entry.truth if isinstance(entry, Node) else isinstance(entry, bool | np.bool_)


def nodes(graph: Graph, entries: np.ndarray) -> list[Node]:
    """Return the entries of an array as nodes, row by row."""
    return [e if isinstance(e, Node) else graph.constant(_plain(e)) for e in entries.flat]


def _plain(entry: Any) -> float | bool:
    return bool(entry) if isinstance(entry, bool | np.bool_) else float(entry)


def _where(equation: Any) -> str:
    """Return where a user wrote what an equation does."""
    from jax._src import source_info_util as info

    frame = info.user_frame(equation.source_info.traceback)
    return "" if frame is None else f" in {frame.file_name}, line {frame.start_line}"


@contextlib.contextmanager
def _within(equation: Any) -> Iterator[None]:
    """Say where a call stands if what it calls was traced once for all, far from its caller."""
    try:
        yield
    except Unsupported as error:
        if ", line " in str(error):
            raise
        raise Unsupported(f"{error}{_where(equation)}") from None


def _algebra(graph: Graph) -> Algebra:
    def unknown(equation: Any, operands: list[np.ndarray]) -> list[np.ndarray]:
        name = equation.primitive.name
        if name in _STRUCTURED:
            return _STRUCTURED[name](graph, equation, operands)
        if name in _DETOURS:
            missing = _Missing(name, _where(equation))
            return [_filled(v.aval.shape, missing) for v in equation.outvars]
        raise Unsupported(f"`{name}`{_where(equation)}")

    return Algebra(_rules(graph), float, lambda n: n, lambda: float("nan"), unknown, _within)


def _filled(shape: tuple[int, ...], entry: object) -> np.ndarray:
    made = np.empty(shape, object)
    for place in np.ndindex(*shape):
        made[place] = entry
    return made


def _rules(graph: Graph) -> dict[str, Rule]:
    def op(name: str) -> Callable[..., Node]:
        return lambda *args: graph.make(name, *map(_entry, args))

    def function(of: Callable[..., Node]) -> Callable[..., Node]:
        return lambda *args: of(*(_node(graph, a) for a in args))

    own = {name: op(name) for name in _SAME}
    own |= {name: function(getattr(elementary, name)) for name in _ELEMENTARY}
    own |= {
        "gt": lambda a, b: graph.make("lt", _entry(b), _entry(a)),
        "ge": lambda a, b: graph.make("le", _entry(b), _entry(a)),
        "rem": function(elementary.remainder),
        "pow": function(elementary.power),
        "exp2": lambda a: elementary.exp(_node(graph, a) * float(np.log(2.0))),
        "clamp": lambda low, x, high: graph.make(
            "min", graph.make("max", _entry(low), _entry(x)), _entry(high)
        ),
        "is_finite": lambda a: graph.make("lt", graph.make("abs", a), float("inf")),
        "select_n": functools.partial(_choose, graph),
    }
    written: dict[str, Rule] = {
        "integer_pow": lambda params, x: each(
            lambda e: elementary.integer_power(_node(graph, e), params["y"]), x
        ),
        "round": functools.partial(_round, graph),
        "convert_element_type": functools.partial(_convert, graph),
        "dot_general": dot(0.0),
        "reduce_sum": reduction(operator.add, 0.0),
        "reduce_prod": reduction(operator.mul, 1.0),
        "reduce_max": reduction(op("max"), -np.inf),
        "reduce_min": reduction(op("min"), np.inf),
        "reduce_and": reduction(op("and"), True),
        "reduce_or": reduction(op("or"), False),
        "cholesky": functools.partial(_cholesky, graph),
    }
    return {name: entrywise(rule) for name, rule in own.items()} | written


_SAME = ("div", "abs", "sqrt", "floor", "ceil", "max", "min", "lt", "le", "eq", "ne")
_SAME += ("and", "or", "xor", "not")
_ELEMENTARY = ("sin", "cos", "tan", "asin", "acos", "atan", "atan2", "sinh", "cosh", "tanh")
_ELEMENTARY += ("asinh", "acosh", "atanh", "exp", "expm1", "log", "log1p", "logistic", "erf")
_ELEMENTARY += ("cbrt", "rsqrt", "sign")


def _entry(value: Any) -> Entry:
    return value if isinstance(value, Node) else _plain(value)


def _node(graph: Graph, value: Any) -> Node:
    return value if isinstance(value, Node) else graph.constant(_plain(value))


def _choose(graph: Graph, which: Any, first: Any, *others: Any) -> Any:
    """Return the case whose number is chosen; JAX numbers them from zero."""
    if not isinstance(which, Node):
        return (first, *others)[int(which)]
    if len(others) != 1:
        raise Unsupported("`select_n` of more than two cases")
    return graph.make("select", which, _entry(others[0]), _entry(first))


def _round(graph: Graph, params: Mapping[str, Any], x: np.ndarray) -> np.ndarray:
    to_even = int(params["rounding_method"]) == 1
    if to_even:
        return each(lambda e: graph.make("rint", e), x)
    return each(lambda e: elementary.round_half_away(_node(graph, e)), x)


def _convert(graph: Graph, params: Mapping[str, Any], x: np.ndarray) -> np.ndarray:
    """Return entries under another type."""
    kind = np.dtype(params["new_dtype"]).kind

    def one(entry: Any) -> Any:
        truth = _is_truth(entry)
        if kind == "b":
            return entry if truth else graph.make("ne", entry, 0.0)
        if kind in "iu" and not truth:
            # A whole number that agents differ in would mostly be an index.
            raise Unsupported("`convert_element_type` to a whole number")
        return graph.make("select", entry, 1.0, 0.0) if truth else entry

    return each(one, x)


# ---- primitives with functions of their own ------------------------------------------------------


def _cond(graph: Graph, equation: Any, operands: list[np.ndarray]) -> list[np.ndarray]:
    """Return what both branches make, entry by entry that of the one that is taken."""
    which, *rest = operands
    branches = equation.params["branches"]
    if which.dtype != object:
        taken = branches[min(max(int(which), 0), len(branches) - 1)]
        return walk(taken.jaxpr, taken.consts, rest, _algebra(graph))
    if len(branches) != 2:
        raise Unsupported(f"`switch` of {len(branches)} cases{_where(equation)}")
    first, second = (walk(b.jaxpr, b.consts, rest, _algebra(graph)) for b in branches)
    [index] = which.flat
    truth = index if index.truth else graph.make("ne", index, 0.0)

    def pick(b: Any, a: Any) -> Any:
        return graph.make("select", truth, _entry(b), _entry(a))

    return [each(pick, b, a) for a, b in zip(first, second, strict=True)]


def _scan(graph: Graph, equation: Any, operands: list[np.ndarray]) -> list[np.ndarray]:
    """Return what a loop of known length makes, written out."""
    params, body = equation.params, equation.params["jaxpr"]
    length, fixed, moving = params["length"], params["num_consts"], params["num_carry"]
    if length > _LONGEST:
        raise Unsupported(f"a loop of {length} rounds{_where(equation)}")
    consts, carry = operands[:fixed], operands[fixed : fixed + moving]
    rounds, made = range(length), list[list[np.ndarray]]()
    for k in reversed(rounds) if params["reverse"] else rounds:
        given = [x[k] for x in operands[fixed + moving :]]
        given = [np.asarray(x, x.dtype if isinstance(x, np.ndarray) else None) for x in given]
        results = walk(body.jaxpr, body.consts, [*consts, *carry, *given], _algebra(graph))
        carry = results[:moving]
        made.append(results[moving:])
    made = made[::-1] if params["reverse"] else made
    return [*carry, *(np.stack(column) for column in zip(*made, strict=True))]


def _while(graph: Graph, equation: Any, operands: list[np.ndarray]) -> list[np.ndarray]:
    """Return what a loop makes whose end does not depend on the agents."""
    params = equation.params
    tests, bodies = params["cond_nconsts"], params["body_nconsts"]
    seen, used = operands[:tests], operands[tests : tests + bodies]
    carry, test, body = operands[tests + bodies :], params["cond_jaxpr"], params["body_jaxpr"]
    for _ in range(_LONGEST + 1):
        [more] = walk(test.jaxpr, test.consts, [*seen, *carry], _algebra(graph))
        if more.dtype == object:
            break
        if not more:
            return carry
        carry = walk(body.jaxpr, body.consts, [*used, *carry], _algebra(graph))
    raise Unsupported(f"a `while` loop whose end depends on the agent, or is far{_where(equation)}")


def _solve(graph: Graph, equation: Any, operands: list[np.ndarray]) -> list[np.ndarray]:
    """Return the solution of linear equations, whose matrix is what they do to unit vectors."""
    jaxprs, lengths = equation.params["jaxprs"], equation.params["const_lengths"]
    matvec, count = jaxprs.matvec, lengths.matvec
    total = sum(lengths)
    consts, b = operands[:count], operands[total:]
    if len(b) != 1:
        raise Unsupported(f"`custom_linear_solve` of several vectors{_where(equation)}")
    [right] = b
    columns = []
    for k in range(right.size):
        unit = np.zeros(right.size)
        unit[k] = 1.0
        [image] = walk(
            matvec.jaxpr, matvec.consts, [*consts, unit.reshape(right.shape)], _algebra(graph)
        )
        columns.append(nodes(graph, image))
    rows = np.array(columns, object).T
    solved = np.empty(right.size, object)
    for part in _parts(rows):
        if len(part) > _LARGEST:
            raise Unsupported(f"a system of {len(part)} equations{_where(equation)}")
        wanted = np.array(nodes(graph, right), object)[part]
        solved[part] = _eliminate(graph, rows[np.ix_(part, part)], wanted)
    return [solved.reshape(right.shape)]


def _parts(rows: np.ndarray) -> list[list[int]]:
    """Return the sets of unknowns that no equation has together with others."""
    from scipy.sparse.csgraph import connected_components

    there = np.vectorize(lambda e: not (e.op == "constant" and e.value == 0.0))(rows)
    count, label = connected_components(there, directed=False)
    return [np.flatnonzero(label == k).tolist() for k in range(count)]


def _eliminate(graph: Graph, matrix: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Return the solution by Gauss's method; each pivot is the largest of its column."""
    A, b, n = matrix.copy(), right.copy(), len(matrix)
    for k in range(n):
        for i in range(k + 1, n):
            larger = graph.make("lt", graph.make("abs", A[k, k]), graph.make("abs", A[i, k]))
            for one in (A, b[:, None]):
                up = [
                    graph.make("select", larger, q, p) for p, q in zip(one[k], one[i], strict=True)
                ]
                one[i] = [
                    graph.make("select", larger, p, q) for p, q in zip(one[k], one[i], strict=True)
                ]
                one[k] = up
        for i in range(k + 1, n):
            factor = A[i, k] / A[k, k]
            A[i, k:] = [p - factor * q for p, q in zip(A[i, k:], A[k, k:], strict=True)]
            b[i] = b[i] - factor * b[k]
    for k in reversed(range(n)):
        rest = b[k]
        for j in range(k + 1, n):
            rest = rest - A[k, j] * b[j]
        b[k] = rest / A[k, k]
    return b


def _cholesky(graph: Graph, params: Mapping[str, Any], matrix: np.ndarray) -> np.ndarray:
    """Return L with L L' a matrix."""
    n = matrix.shape[-1]
    if matrix.ndim != 2 or n > _LARGEST:
        raise Unsupported(f"`cholesky` of shape {matrix.shape}")
    L = np.full((n, n), 0.0, object)
    for j in range(n):
        rest = matrix[j, j] - sum((L[j, k] * L[j, k] for k in range(j)), 0.0)
        L[j, j] = graph.make("sqrt", rest)
        for i in range(j + 1, n):
            rest = matrix[i, j] - sum((L[i, k] * L[j, k] for k in range(j)), 0.0)
            L[i, j] = rest / L[j, j]
    return L


_STRUCTURED = {
    "cond": _cond,
    "scan": _scan,
    "while": _while,
    "custom_linear_solve": _solve,
}
_DETOURS = {"lu", "lu_pivots_to_permutation", "triangular_solve", "lu_solve"}
"""What JAX factors before it solves; the equations are solved here by themselves."""
