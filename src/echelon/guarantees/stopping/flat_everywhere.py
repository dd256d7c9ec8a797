"""Borders of flat coordinates: as a model states them, or none for a linear map."""

from collections.abc import Sequence
from fractions import Fraction
from typing import NamedTuple, TypeAlias

import jax
import numpy as np

from echelon.agents.models.chains import Chains, derivatives_of
from echelon.agents.models.declarations import is_by_user
from echelon.agents.models.model import ControlAffine, FlatBound
from echelon.core.cache import memoize
from echelon.core.words import Kind
from echelon.guarantees.stopping.declared_borders import border_fault
from echelon.simulation.scalars import (
    Node,
    ScalarGraph,
    Unsupported,
    lower,
    needed,
    nodes,
)

_STATED = "flat_chains", "flat_bounds"
_PARTIAL = {"exponent", "mantissa", "root_guess"}
"""Operations that are not defined for all numbers; quotients and roots are not for some."""
_Form: TypeAlias = dict[int | None, Fraction]
"""A sum of multiples of nodes by their numbers, and of 1 under None."""


class KnownBounds(NamedTuple):
    """The borders of a model's flat coordinates, and how they are known.

    Attributes:
        bounds: None where they are not known.
        kind: of the argument: samples where somebody's class states them.
        fault: why they are not known.
    """

    bounds: Sequence[FlatBound] | None
    kind: Kind = Kind.PROOF
    fault: str = ""


def bounds_of(model: ControlAffine, chains: Chains) -> KnownBounds:
    """Return the borders of a model's flat coordinates.

    A model declares them with its chains; what a class that is not echelon's declares is compared
    with its equations at samples. There are none if the equations, traced, are defined everywhere
    and make flat coordinates an invertible linear map of all states and integrators, above which
    the inputs act by an invertible constant matrix.
    """
    by_user = {name for name in chains.declared if is_by_user(model, name)}
    mapped = Kind.SAMPLES if "flatten" in by_user else Kind.PROOF
    if not {*_STATED} <= {*chains.declared}:
        fault = f"`{type(model).__name__}` does not state where its flat coordinates end"
        everywhere = _is_everywhere(model, chains)
        return KnownBounds((), mapped) if everywhere else KnownBounds(None, fault=fault)
    if by_user.isdisjoint(_STATED) or _is_everywhere(model, chains):
        return KnownBounds(model.flat_bounds, mapped)
    fault = border_fault(model, chains)
    return KnownBounds(None if fault else model.flat_bounds, Kind.SAMPLES, fault)


@memoize
def _is_everywhere(model: ControlAffine, chains: Chains) -> bool:
    try:
        coordinates, moved = _traced(model, chains)
    except Unsupported:
        return False
    constant = all(set(form) <= {None} for rows in moved for row in rows for form in row)
    if not constant:
        return False
    numbers = [[[form.get(None, Fraction(0)) for form in row] for row in rows] for rows in moved]
    last = [[rows[degree - 1][k] for k, degree in enumerate(chains.degrees)] for rows in numbers]
    early = any(
        rows[order][k]
        for rows in numbers
        for k, degree in enumerate(chains.degrees)
        for order in range(degree - 1)
    )
    return not early and _is_invertible(last) and _is_invertible(coordinates)


def _traced(
    model: ControlAffine, chains: Chains
) -> tuple[list[list[Fraction]], list[list[list[_Form]]]]:
    """Return the slopes of the flat coordinates, and what inputs add to them [input][order][k].

    Slopes are 0 throughout where a coordinate is no linear form of the states and integrators.

    Raises:
        Unsupported: the trace has what is no scalar operation, or not defined everywhere.
    """
    graph, n = ScalarGraph(), len(model.state_names)
    leaves = [graph.leaf("row", place) for place in range(n + chains.size)]
    x, e = (np.array(part, object) for part in (leaves[:n], leaves[n:]))
    order, m = max(chains.degrees), len(chains.degrees)

    def both(x: jax.Array, e: jax.Array) -> tuple[jax.Array, ...]:
        return derivatives_of(model, chains, x, e, order)

    parts = [nodes(graph, part) for part in lower(both, graph, [x, e])]
    if any(_is_partial(node) for node in needed(sum(parts, start=[]))):
        raise Unsupported("a function that is not defined everywhere")
    values, _, moved = ([_form_of(node) for node in part] for part in parts)
    inside = [values[m * i + k] for k, degree in enumerate(chains.degrees) for i in range(degree)]
    places = [leaf.number for leaf in leaves]
    known = [set(form) <= {*places, None} for form in inside]
    rows = [
        [form.get(place, Fraction(0)) if linear else Fraction(0) for place in places]
        for form, linear in zip(inside, known, strict=True)
    ]
    shaped = np.array(moved, object).reshape(m, order, m).tolist()
    return rows, shaped


def _is_partial(node: Node) -> bool:
    if node.op == "sqrt":
        return not _sign(node.args[0])
    if node.op == "div":
        by = node.args[1]
        return _sign(by) != 1.0 and not (by.op == "constant" and by.value != 0.0)
    return node.op in _PARTIAL


def _sign(node: Node) -> float:
    """Return 1 of what is positive for all numbers, 0.5 of what is not negative, 0 of others."""
    if node.op == "constant":
        return float(node.value > 0.0) or 0.5 * (node.value == 0.0)
    if node.op == "mul" and node.args[0] is node.args[1]:
        return 0.5
    signs = [_sign(a) for a in node.args] if node.op in ("add", "mul", "sqrt") else [0.0]
    if not all(signs):
        return 0.0
    return max(signs) if node.op == "add" else min(signs)


def _form_of(node: Node) -> _Form:
    """Return a node as a sum of multiples of others, as far down as it is one."""
    done = dict[int, _Form]()
    todo = [node]
    while todo:
        top = todo[-1]
        waiting = [a for a in top.args if a.number not in done]
        if waiting:
            todo += waiting
            continue
        done[todo.pop().number] = _one(top, [done[a.number] for a in top.args])
    return done[node.number]


def _one(node: Node, args: list[_Form]) -> _Form:
    if node.op == "constant" and np.isfinite(node.value):
        return _tidy({None: Fraction(node.value)})
    if node.op in ("add", "sub", "unfused_sub"):
        return _sum(args[0], args[1], Fraction(1 if node.op == "add" else -1))
    if node.op == "neg":
        return _sum({}, args[0], Fraction(-1))
    for k, other in ((0, 1), (1, 0)):
        if node.op == "mul" and set(args[k]) <= {None}:
            return _sum({}, args[other], args[k].get(None, Fraction(0)))
    if node.op == "div" and set(args[1]) == {None}:
        return _sum({}, args[0], 1 / args[1][None])
    return {node.number: Fraction(1)}


def _sum(a: _Form, b: _Form, factor: Fraction) -> _Form:
    return _tidy({k: a.get(k, Fraction(0)) + factor * b.get(k, Fraction(0)) for k in {*a, *b}})


def _tidy(form: _Form) -> _Form:
    return {k: c for k, c in form.items() if c}


def _is_invertible(rows: list[list[Fraction]]) -> bool:
    """Tell whether a square matrix has no zero determinant, by elimination; others are not."""
    rows, n = [list(row) for row in rows], len(rows)
    if any(len(row) != n for row in rows):
        return False
    for k in range(n):
        pivot = next((i for i in range(k, n) if rows[i][k]), None)
        if pivot is None:
            return False
        rows[k], rows[pivot] = rows[pivot], rows[k]
        for i in range(k + 1, n):
            share = rows[i][k] / rows[k][k]
            rows[i] = [a - share * b for a, b in zip(rows[i], rows[k], strict=True)]
    return True
