"""Sums of angle differences by sums of plain differences, which are equal for small angles.

A difference of angles is the shorter way round. Where neighbours read whole vectors of an agent,
the last entry is a flag: 0 if all angles of the agent are small, NaN if one is not. The sum of its
differences then tells whether the sums of plain differences are correct.
"""

import math
from collections.abc import Sequence

from echelon.simulation.codegen.kernel_plan import Plan
from echelon.simulation.codegen.vector_ir import Writer
from echelon.simulation.scalars.scalar_graph import Node, rewritten


def plain_limits(plan: Plan) -> dict[int, float]:
    """Return for each entry up to which size of both numbers its difference is plain."""
    return {k: _limit(k, node) for k, node in enumerate(plan.others.difference)}


def _limit(k: int, node: Node) -> float:
    bounds = [math.inf]

    def without_turns(node: Node, args: Sequence[Node]) -> float | None:
        if node.op != "rint" or args[0].op != "mul":
            return None
        one, other = args[0].args
        size, rest = (one, other) if one.op == "constant" else (other, one)
        if size.op != "constant" or not _is_plain(k, rest):
            return None
        # Rounded to the nearest whole number: below a half there are no turns to subtract.
        bounds.append(0.249 / abs(size.value))
        return 0.0

    result = rewritten([node], without_turns)[node]
    return min(bounds) if _is_plain(k, result) else 0.0


def _is_plain(k: int, node: Node) -> bool:
    """Tell whether an entry of the difference is that of two numbers."""
    leaves = [a.value for a in node.args if a.op == "leaf"]
    return node.op == "sub" and leaves == [("self", k), ("neighbour", k)]


def has_flag(plan: Plan) -> bool:
    """Tell whether agents show a flag for large angles."""
    limits = [] if plan.batched or plan.row_major else [*plain_limits(plan).values()]
    return any(map(math.isfinite, limits)) and 0.0 not in limits


def angle_flag(w: Writer, plan: Plan, values: Sequence[str]) -> str:
    """Write what is 0 if all angles are small, and NaN if one is not."""
    truths, large = w.kind(True, False), ""
    for k, limit in plain_limits(plan).items():
        if math.isfinite(limit):
            size = w.operation("abs", [values[k]])
            beyond = w.put(f"fcmp ugt {w.vector} {size}, {w.number(limit)}")
            large = w.put(f"or {truths} {large}, {beyond}") if large else beyond
    nan = w.number(math.nan)
    return w.put(f"select {truths} {large}, {w.vector} {nan}, {w.vector} zeroinitializer")


def is_zero(w: Writer, vector: str) -> str:
    """Write whether a vector is 0 in all lanes."""
    other = w.put(f"fcmp une {w.vector} {vector}, zeroinitializer")
    return w.put(f"xor i1 {w.any_lane(other)}, true")
