"""The entries of a lowered function's arrays: nodes, plain numbers, and what nothing may read."""

import functools
from collections.abc import Callable
from typing import Any, NoReturn, TypeAlias, final

import numpy as np

from echelon.core.errors import EchelonError
from echelon.core.jaxpr import Algebra
from echelon.simulation.scalars.scalar_graph import Entry, Node, ScalarGraph

LONGEST = 64
"""Rounds of a loop that are written out, and places of a table that are looked through."""
LARGEST = 6
"""Unknowns of a system of equations that is solved, and entries that are sorted."""

Written: TypeAlias = "Callable[[ScalarGraph, Algebra, Any, list[np.ndarray]], list[np.ndarray]]"
"""(graph, algebra, equation, operands) -> results: a primitive that needs more than parameters."""


class Unsupported(EchelonError):
    """A function uses what has no scalar operations: which primitive, and where it was written."""


@final
class Missing:
    """Stands for a result that nothing may read; what is left over from a library's detour."""

    def __init__(self, primitive: str, where: str) -> None:
        self.primitive, self.where = primitive, where

    __array_ufunc__ = None

    def _read(self, *_: object) -> NoReturn:
        raise Unsupported(f"`{self.primitive}`{self.where}")

    __add__ = __radd__ = __sub__ = __rsub__ = __mul__ = __rmul__ = _read
    __truediv__ = __rtruediv__ = __neg__ = __float__ = __bool__ = _read


def missing(equation: Any) -> list[np.ndarray]:
    """Return results of an equation that nothing may read."""
    stand_in = Missing(equation.primitive.name, where(equation))
    return [filled(v.aval.shape, stand_in) for v in equation.outvars]


def filled(shape: tuple[int, ...], value: object) -> np.ndarray:
    """Return an array that holds one entry everywhere."""
    made = np.empty(shape, object)
    for place in np.ndindex(*shape):
        made[place] = value
    return made


def where(equation: Any) -> str:
    """Return where a user wrote what an equation does."""
    from jax._src import source_info_util as info

    frame = info.user_frame(equation.source_info.traceback)
    return "" if frame is None else f" in {frame.file_name}, line {frame.start_line}"


def is_truth(value: Any) -> bool:
    """Tell whether an entry is true or false, and no number."""
    return value.truth if isinstance(value, Node) else isinstance(value, bool | np.bool_)


def entry(value: Any) -> Entry:
    """Return an entry as an operand."""
    return value if isinstance(value, Node) else _plain(value)


def node(graph: ScalarGraph, value: Any) -> Node:
    """Return an entry as a node."""
    return value if isinstance(value, Node) else graph.constant(_plain(value))


def nodes(graph: ScalarGraph, entries: np.ndarray) -> list[Node]:
    """Return the entries of an array as nodes, row by row."""
    return [node(graph, e) for e in entries.flat]


def number(graph: ScalarGraph, value: Any) -> Any:
    """Return an entry as a number: 1 for true."""
    return graph.make("select", entry(value), 1.0, 0.0) if is_truth(value) else value


def chosen(graph: ScalarGraph, which: Any, a: Any, b: Any) -> Any:
    """Return one entry where a truth holds, else another."""
    return graph.make("select", entry(which), entry(a), entry(b))


def all_of(graph: ScalarGraph, truths: list[Any]) -> Any:
    """Return whether all truths hold."""
    first: Any = True
    return functools.reduce(lambda a, b: graph.make("and", entry(a), entry(b)), truths, first)


def _plain(value: Any) -> float | bool:
    return bool(value) if isinstance(value, bool | np.bool_) else float(value)
