"""Numbers of other types than the run's: whole numbers, numbers of single precision, their bits.

A whole number is a number without a fraction, exact up to 2^53 (2^24 in single precision). JAX's
wrap around at the ends of their type. Where it is known that a result is exact, it is wrapped too;
where it is not, the graph notes an exception.
"""

import math
from collections.abc import Callable

import numpy as np
from jax.extend.core import JaxprEqn

from echelon.simulation.scalars.elementary import choose, less, remainder, signed
from echelon.simulation.scalars.scalar_graph import LOGICAL, Entry, Node, ScalarGraph, needed
from echelon.simulation.scalars.traced_entries import (
    Arrays,
    Missing,
    PrimitiveRule,
    Unsupported,
    array_type,
    entry,
    node,
    number,
    select,
    where,
)
from echelon_ranges.jaxpr import INLINED, Algebra, map_entries

_EXACT = {64: 2.0**53, 32: 2.0**24}
_CALLS = INLINED | {"scan", "while", "cond"}
"""Primitives whose equations are walked one by one."""


# ---- what may be how large -----------------------------------------------------------------------


def range_of(x: Node) -> tuple[float, float]:
    """Return the least and the largest number that a node may be, as far as it is known."""
    known = x.graph.ranges
    if x not in known:
        known[x] = _range(x)
    return known[x]


def _range(x: Node) -> tuple[float, float]:
    if x.op == "constant":
        return float(x.value), float(x.value)
    args = x.args[1:] if x.op == "select" else x.args
    if x.op not in _RANGES:
        return -math.inf, math.inf
    low, high = _RANGES[x.op](*(range_of(a) for a in args))
    # Of infinite ends, such as inf - inf, nothing is known.
    return (-math.inf if math.isnan(low) else low), (math.inf if math.isnan(high) else high)


_Range = tuple[float, float]


def _product(a: _Range, b: _Range) -> _Range:
    ends = [p * q for p in a for q in b]
    return (math.nan, math.nan) if any(map(math.isnan, ends)) else (min(ends), max(ends))


_RANGES: dict[str, Callable[..., _Range]] = {
    "add": lambda a, b: (a[0] + b[0], a[1] + b[1]),
    "sub": lambda a, b: (a[0] - b[1], a[1] - b[0]),
    "unfused_sub": lambda a, b: (a[0] - b[1], a[1] - b[0]),
    "mul": _product,
    "neg": lambda a: (-a[1], -a[0]),
    "abs": lambda a: (0.0, max(-a[0], a[1])),
    "min": lambda a, b: (min(a[0], b[0]), min(a[1], b[1])),
    "max": lambda a, b: (max(a[0], b[0]), max(a[1], b[1])),
    "select": lambda a, b: (min(a[0], b[0]), max(a[1], b[1])),
    "floor": lambda a: (a[0] - 1.0, a[1]),
    "ceil": lambda a: (a[0], a[1] + 1.0),
}
"""The range of a result by those of the operands."""


def whole_range(graph: ScalarGraph, kind: np.dtype) -> tuple[float, float]:
    """Return the range of whole numbers of a type that are exact."""
    limits, exact = np.iinfo(kind), _EXACT[graph.bits]
    return max(float(limits.min), -exact), min(float(limits.max), exact)


def may_be_exception(graph: ScalarGraph, node: Node, size: float) -> bool:
    """Tell whether a node may not be what JAX computes, if no leaf is larger than a size."""
    truth, ranges = graph.exceptions[node], dict(graph.ranges)
    # "Far, and larger than so much", as of an angle.
    bound, number = truth.args[-1].args if truth.op == "and" else (truth, truth)
    if truth.op != "and" or bound.op != "constant":
        return True
    for leaf in needed([number]):
        if leaf.op == "leaf":
            graph.ranges[leaf] = -size, size
    most = range_of(number)[1]
    graph.ranges = ranges
    return most > bound.value


# ---- results of every equation -------------------------------------------------------------------


class TypeRules:
    """Checks the results of each equation of a trace, and gives them the range of their type."""

    def __init__(self, graph: ScalarGraph) -> None:
        self.graph, self._checked = graph, len(graph.nodes)

    def __call__(self, equation: JaxprEqn, results: Arrays) -> Arrays:
        """Return results with the rounding, or wrapping, of their type; or raise `Unsupported`."""
        new, name = self.graph.nodes[self._checked :], equation.primitive.name
        if not all(map(_is_well_typed, new)):
            raise Unsupported(f"`{name}` of truths{where(equation)}")
        if name == "reduce_precision":
            raise Unsupported(f"`{name}`{where(equation)}")
        if name not in _CALLS:
            with self.graph.verbatim():
                pairs = zip(equation.outvars, results, strict=True)
                results = [self._of_type(equation, array_type(v).dtype, r, new) for v, r in pairs]
        self._checked = len(self.graph.nodes)
        return results

    def _of_type(
        self, equation: JaxprEqn, dtype: np.dtype, result: np.ndarray, new: list[Node]
    ) -> np.ndarray:
        if result.dtype != object or any(isinstance(e, Missing) for e in result.flat):
            return result
        kind, name = np.dtype(dtype), equation.primitive.name
        if kind.kind == "f" and 8 * kind.itemsize == self.graph.bits or kind.kind == "b":
            return result
        if kind == np.float32:
            return map_entries(lambda e: self.graph.make("single", entry(e)), result)
        if kind.kind not in "iu":
            raise Unsupported(f"`{name}` of the type {kind}{where(equation)}")
        # A sum of many has partial sums, which are whole numbers as well.
        for part in new:
            if part.op in ("add", "sub", "mul") and name in _PARTIAL:
                self._bounded(part, kind)
        return map_entries(lambda e: self._bounded(e, kind) if isinstance(e, Node) else e, result)

    def _bounded(self, x: Node, kind: np.dtype) -> Node:
        g, limits, exact = self.graph, np.iinfo(kind), _EXACT[self.graph.bits]
        least, most, (low, high) = float(limits.min), float(limits.max), range_of(x)
        if max(least, -exact) <= low and high <= min(most, exact):
            return x
        if max(-low, high, -least, most) <= exact:
            count = 2.0 ** (8 * kind.itemsize)
            x = x - count * g.make("floor", (x - least) * (1.0 / count))
        else:
            least, most = max(least, -exact), min(most, exact)
            inside = g.make("and", g.make("le", least, x), g.make("le", x, most))
            g.except_where(x, g.make("not", inside))
        g.ranges[x] = least, most
        return x


_PARTIAL = {"reduce_sum", "cumsum", "reduce_prod", "cumprod", "dot_general", "integer_pow"}


def _is_well_typed(node: Node) -> bool:
    truths = [a.truth for a in node.args]
    if node.op == "loop":
        return True
    if node.op == "select":
        return truths[0] and truths[1] == truths[2]
    return all(truths) if node.op in LOGICAL else not any(truths)


# ---- rules ---------------------------------------------------------------------------------------


def convert(graph: ScalarGraph, algebra: Algebra, equation: JaxprEqn, operands: Arrays) -> Arrays:
    """Return entries under another type; a whole number is a number without a fraction."""
    [x], [source] = operands, equation.invars
    to, of = np.dtype(equation.params["new_dtype"]), np.dtype(array_type(source).dtype)
    if to.kind not in "bfiu":
        raise Unsupported(f"`convert_element_type` to {to}{where(equation)}")

    def converted(e: Entry) -> Entry:
        if to.kind == "b":
            return e if of.kind == "b" else graph.make("ne", entry(e), 0.0)
        if to.kind == "f" or of.kind == "b":
            return number(graph, e)
        return _truncated(graph, e, to) if of.kind == "f" else e

    return [map_entries(converted, x)]


def _truncated(graph: ScalarGraph, e: Entry, to: np.dtype) -> Node:
    """Return a number as a whole one, as XLA does: truncated and clipped, NaN as 0."""
    down, up = (graph.make(op, entry(e)) for op in ("floor", "ceil"))
    towards = select(graph, graph.make("lt", entry(e), 0.0), up, down)
    towards = select(graph, graph.make("eq", entry(e), entry(e)), towards, 0.0)
    least, most = (float(end) for end in (np.iinfo(to).min, np.iinfo(to).max))
    whole = graph.make("min", graph.make("max", towards, least), most)
    # Not by its operands alone, which are any numbers, but often within less.
    low, high = range_of(node(graph, e))
    graph.ranges[whole] = max(least, min(low, 0.0)), min(most, max(high, 0.0))
    return whole


def divide(graph: ScalarGraph, algebra: Algebra, equation: JaxprEqn, operands: Arrays) -> Arrays:
    """Return quotients; those of whole numbers are truncated, and by 0 the last number."""
    kind = np.dtype(array_type(equation.outvars[0]).dtype)
    if kind.kind not in "iu":
        return [map_entries(lambda a, b: graph.make("div", entry(a), entry(b)), *operands)]
    by_zero = -1.0 if kind.kind == "i" else float(np.iinfo(kind).max)

    def quotient(a: Entry, b: Entry) -> Node:
        result = graph.make("exact_div", entry(a), entry(b))
        whole = signed(graph.make("floor", graph.make("abs", result)), result)
        return _at_most(graph, choose(graph.make("eq", entry(b), 0.0), by_zero, whole), a, 1.0)

    return [map_entries(quotient, *operands)]


def divided_rest(
    graph: ScalarGraph, algebra: Algebra, equation: JaxprEqn, operands: Arrays
) -> Arrays:
    """Return remainders; of a whole number by 0, that number."""
    whole = np.dtype(array_type(equation.outvars[0]).dtype).kind in "iu"

    def rest(a: Entry, b: Entry) -> Node:
        with graph.verbatim():
            result = remainder(node(graph, a), node(graph, b))
        if not whole:
            return result
        return _at_most(graph, choose(graph.make("eq", entry(b), 0.0), a, result), a, 0.0)

    return [map_entries(rest, *operands)]


def _at_most(graph: ScalarGraph, result: Node, a: Entry, least: float) -> Node:
    """Return a result, of which it is known that it is no larger than an operand."""
    most = max(*map(abs, range_of(node(graph, a))), least)
    if result.op != "constant":
        graph.ranges[result] = -most, most
    return result


def logical(name: str) -> PrimitiveRule:
    """Return the rule of an operation on truths; there is none for the bits of whole numbers."""

    def rule(graph: ScalarGraph, algebra: Algebra, equation: JaxprEqn, operands: Arrays) -> Arrays:
        if np.dtype(array_type(equation.outvars[0]).dtype).kind != "b":
            raise Unsupported(f"`{name}` of whole numbers{where(equation)}")
        return [map_entries(lambda *e: graph.make(name, *map(entry, e)), *operands)]

    return rule


# ---- bits ----------------------------------------------------------------------------------------


def bits_of(graph: ScalarGraph, algebra: Algebra, equation: JaxprEqn, operands: Arrays) -> Arrays:
    """Return stand-ins for the bits of numbers, of which only the sign may be read."""
    name, at = equation.primitive.name, where(equation)
    return [map_entries(lambda e: Missing(name, at, node(graph, e)), *operands)]


def shift(graph: ScalarGraph, algebra: Algebra, equation: JaxprEqn, operands: Arrays) -> Arrays:
    """Return whole numbers shifted to the right, or the sign from the bits of a number."""
    name, kind = equation.primitive.name, np.dtype(array_type(equation.outvars[0]).dtype)

    def shifted(e: "Entry | Missing", by: Entry) -> Node:
        if isinstance(by, Node) or not isinstance(e, Node | Missing):
            raise Unsupported(f"`{name}` by a number of places that is not known{where(equation)}")
        if isinstance(e, Missing):
            last = int(by) == 8 * kind.itemsize - 1 and name == "shift_right_arithmetic"
            if e.source is None or not last:
                raise Unsupported(f"`{e.primitive}`{e.where}")
            below = less(signed(graph.constant(1.0), e.source), graph.constant(0.0))
            return choose(below, -1.0, 0.0)
        if name == "shift_right_logical" and range_of(e)[0] < 0.0:
            raise Unsupported(f"`{name}` of a number that may be below 0{where(equation)}")
        # Its range is known by those of the two operations.
        return graph.make("floor", e * 2.0 ** -int(by))

    return [map_entries(shifted, *operands)]


WHOLE_NUMBERS: dict[str, PrimitiveRule] = {
    **{name: logical(name) for name in ("and", "or", "xor", "not")},
    **dict.fromkeys(("shift_right_arithmetic", "shift_right_logical"), shift),
    "bitcast_convert_type": bits_of,
    "convert_element_type": convert,
    "div": divide,
    "rem": divided_rest,
}
"""Primitives that differ for whole numbers."""
