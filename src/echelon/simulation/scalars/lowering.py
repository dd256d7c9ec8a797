"""A function written for JAX as scalars of a graph.

JAX traces the function of one agent, and each equation of the trace is evaluated on nodes. If one
has no scalar operations, the error names the primitive, and the file and line in the user's code.
"""

import contextlib
import functools
import operator
from collections.abc import Callable, Iterator, Sequence

import jax
import numpy as np
from jax.extend.core import JaxprEqn

from echelon.core.jaxpr import Algebra, Rule, dot, entrywise, map_entries, reduction, walk
from echelon.core.numerics import Precision, precision
from echelon.core.trace import error_summary
from echelon.core.types import PyTree
from echelon.simulation.scalars import elementary, powers
from echelon.simulation.scalars.indexing import INDEXING, cumulative, less, one_of
from echelon.simulation.scalars.scalar_graph import Entry, Node, ScalarGraph
from echelon.simulation.scalars.small_linear_systems import cholesky, lu, solve, triangle
from echelon.simulation.scalars.traced_entries import (
    LONGEST,
    Arrays,
    Params,
    PrimitiveRule,
    Unsupported,
    entry,
    is_truth,
    missing,
    node,
    where,
)
from echelon.simulation.scalars.whole_numbers import WHOLE_NUMBERS, TypeRules


def lower(
    function: Callable[..., PyTree], graph: ScalarGraph, arguments: Sequence[PyTree]
) -> Arrays:
    """Return the results of a function for JAX, flattened, as arrays of nodes and numbers.

    Args:
        function: takes arrays and returns a tree of arrays.
        graph: that the nodes belong to.
        arguments: trees of arrays of nodes (of dtype object), or of plain numbers.

    Raises:
        Unsupported: a primitive has no scalar operations.
    """
    leaves, tree = jax.tree.flatten(list(arguments), is_leaf=lambda a: isinstance(a, np.ndarray))
    # In the precision of the run: a user's function may ask for it (`x.dtype`).
    name: Precision = "float64" if graph.bits == 64 else "float32"
    shaped = [_shape(leaf, np.dtype(name)) for leaf in leaves]

    def flat(*entries: jax.Array) -> list[jax.Array]:
        return jax.tree.leaves(function(*jax.tree.unflatten(tree, entries)))

    with precision(name):
        closed = jax.make_jaxpr(flat)(*shaped)
        try:
            return walk(closed.jaxpr, closed.consts, leaves, _algebra(graph))
        except (TypeError, ValueError, IndexError, KeyError, AttributeError) as error:
            # Users write what is traced: an unforeseen trace must not end a run that JAX can do.
            raise Unsupported(f"a trace that no rule fits ({error_summary(error)})") from error


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
    entrywise_rules |= {name: function(getattr(powers, name)) for name in ("cbrt", "rsqrt")}
    entrywise_rules |= {
        "gt": lambda a, b: graph.make("lt", entry(b), entry(a)),
        "ge": lambda a, b: graph.make("le", entry(b), entry(a)),
        "pow": function(powers.power),
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
            lambda e: powers.integer_power(node(graph, e), params["y"]), x
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
    """Return the results of a loop of fixed length, unrolled."""
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
    """Return the results of a loop whose end does not depend on the agents."""
    params = equation.params
    tests, bodies = params["cond_nconsts"], params["body_nconsts"]
    test_consts, body_consts = operands[:tests], operands[tests : tests + bodies]
    carry, test, body = operands[tests + bodies :], params["cond_jaxpr"], params["body_jaxpr"]
    for _ in range(LONGEST + 1):
        [more] = walk(test.jaxpr, test.consts, [*test_consts, *carry], algebra)
        if more.dtype == object:
            break
        if not more:
            return carry
        carry = walk(body.jaxpr, body.consts, [*body_consts, *carry], algebra)
    reason = f"depends on the agent, or is more than {LONGEST} rounds away"
    raise Unsupported(f"a `while` loop whose end {reason}{where(equation)}")


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
