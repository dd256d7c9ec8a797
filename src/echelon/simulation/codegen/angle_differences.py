"""Differences of angles, which are the plain ones of small angles.

A difference of angles is the shorter way round. What agents show, agent by agent, then ends with a
number that is 0 where all their angles are small, and none where one is not, so that the sum of its
differences tells whether the sums of plain ones are right.
"""

import math
from collections.abc import Sequence

from echelon.simulation.codegen.ir_blocks import Plan
from echelon.simulation.codegen.vector_ir import Writer, number
from echelon.simulation.scalars.scalar_graph import Node, rewritten


def limits(plan: Plan) -> dict[int, float]:
    """Return up to which size of both numbers each entry's difference is theirs; 0 for never."""
    return {k: _limit(k, node) for k, node in enumerate(plan.others.difference)}


def _limit(k: int, node: Node) -> float:
    bounds = [math.inf]

    def unwound(node: Node, args: Sequence[Node]) -> float | None:
        if node.op != "rint" or args[0].op != "mul":
            return None
        one, other = args[0].args
        size, rest = (one, other) if one.op == "constant" else (other, one)
        if size.op != "constant" or not _is_plain(k, rest):
            return None
        # To the nearest whole number: below a half there is none to take off.
        bounds.append(0.249 / abs(size.value))
        return 0.0

    found = rewritten([node], unwound)[node]
    return min(bounds) if _is_plain(k, found) else 0.0


def _is_plain(k: int, node: Node) -> bool:
    """Tell whether an entry of the difference is that of two numbers."""
    leaves = [a.value for a in node.args if a.op == "leaf"]
    return node.op == "sub" and leaves == [("own", k), ("their", k)]


def winds(plan: Plan) -> bool:
    """Tell whether agents show whether all that winds is small."""
    found = [] if plan.together or plan.lines else [*limits(plan).values()]
    return any(map(math.isfinite, found)) and 0.0 not in found


def largeness(w: Writer, plan: Plan, values: Sequence[str]) -> str:
    """Write what is 0 where all that winds is small, and no number elsewhere."""
    truths, large = w.kind(True, False), ""
    for k, limit in limits(plan).items():
        if math.isfinite(limit):
            away = w.operation("abs", [values[k]], False, False)
            bound = f"splat ({w.scalar} {number(limit, w.bits)})"
            found = w.put(f"fcmp ugt {w.vector} {away}, {bound}")
            large = w.put(f"or {truths} {large}, {found}") if large else found
    none = f"splat ({w.scalar} {number(math.nan, w.bits)})"
    return w.put(f"select {truths} {large}, {w.vector} {none}, {w.vector} zeroinitializer")


def zeros(w: Writer, one: str) -> str:
    """Write whether a vector is 0 in all lanes."""
    truths, name = w.kind(True, False), f"llvm.vector.reduce.or.v{w.lanes}i1"
    w.declare("i1", name, truths)
    other = w.put(f"fcmp une {w.vector} {one}, zeroinitializer")
    return w.put(f"xor i1 {w.put(f'call i1 @{name}({truths} {other})')}, true")
