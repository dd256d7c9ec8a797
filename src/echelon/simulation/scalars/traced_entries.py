"""Entries of a lowered function's arrays: nodes, plain numbers, stand-ins for unread results."""

from collections.abc import Callable, Mapping
from typing import Any, NoReturn, TypeAlias, cast, final

import numpy as np
from jax.core import ShapedArray
from jax.extend.core import JaxprEqn, Literal, Var

from echelon.core.errors import EchelonError
from echelon.simulation.scalars.scalar_graph import Entry, Node, ScalarGraph
from echelon_ranges.jaxpr import Algebra

LONGEST = 64
"""The most rounds of a loop that are unrolled, and places of a table that are searched."""
LARGEST = 6
"""The most unknowns of a system of equations, and entries to sort."""

Arrays: TypeAlias = list[np.ndarray]
"""The operands or results of an equation: arrays of entries, or of plain numbers."""
Params: TypeAlias = Mapping[str, Any]
"""The parameters of a primitive; their types depend on it."""
PrimitiveRule: TypeAlias = Callable[[ScalarGraph, Algebra, JaxprEqn, Arrays], Arrays]
"""(graph, algebra, equation, operands) -> results, if these need more than parameters."""


class Unsupported(EchelonError):
    """A function has no scalar operations; the text names the primitive and the line."""


@final
class Missing:
    """Stands for a result that nothing may read, such as intermediate results of a library.

    Attributes:
        primitive: that makes it.
        where: it is in the user's code.
        source: the number of which it is a part; None if it is of no number.
    """

    def __init__(self, primitive: str, where: str, source: Node | None = None) -> None:
        self.primitive, self.where, self.source = primitive, where, source

    __array_ufunc__ = None

    def _read(self, *_: object) -> NoReturn:
        raise Unsupported(f"`{self.primitive}`{self.where}")

    __add__ = __radd__ = __sub__ = __rsub__ = __mul__ = __rmul__ = _read
    __truediv__ = __rtruediv__ = __neg__ = __float__ = __bool__ = _read


def missing(equation: JaxprEqn) -> Arrays:
    """Return results of an equation that nothing may read."""
    stand_in = Missing(equation.primitive.name, where(equation))
    return [np.full(array_type(v).shape, stand_in, object) for v in equation.outvars]


def array_type(variable: Var | Literal) -> ShapedArray:
    """Return the shape and type of a variable, which is an array."""
    return cast(ShapedArray, variable.aval)


def where(equation: JaxprEqn) -> str:
    """Return where the user's code has an equation."""
    from jax._src import source_info_util as info

    frame = info.user_frame(equation.source_info.traceback)
    return "" if frame is None else f" in {frame.file_name}, line {frame.start_line}"


def is_truth(value: Entry) -> bool:
    """Tell whether an entry is true or false, and not a number."""
    return value.truth if isinstance(value, Node) else isinstance(value, bool | np.bool_)


def entry(value: Entry) -> Entry:
    """Return an entry as an operand."""
    return value if isinstance(value, Node) else _plain(value)


def node(graph: ScalarGraph, value: Entry) -> Node:
    """Return an entry as a node."""
    return value if isinstance(value, Node) else graph.constant(_plain(value))


def nodes(graph: ScalarGraph, entries: np.ndarray) -> list[Node]:
    """Return the entries of an array as nodes, row by row."""
    return [node(graph, e) for e in entries.flat]


def number(graph: ScalarGraph, value: Entry) -> Entry:
    """Return an entry as a number: 1 for true."""
    return graph.make("select", entry(value), 1.0, 0.0) if is_truth(value) else value


def select(graph: ScalarGraph, which: Entry, a: Entry, b: Entry) -> Node:
    """Return one entry where a truth holds, else another."""
    return graph.make("select", entry(which), entry(a), entry(b))


def _plain(value: float | bool) -> float | bool:
    return bool(value) if isinstance(value, bool | np.bool_) else float(value)
