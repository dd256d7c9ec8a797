"""The fast path of a step, and the conditions under which it is correct.

Much of a step is written for unlikely cases: an angle beyond 45 degrees, a motor at its limit. A
truth marked as `unlikely` may always be assumed to hold, because what it then selects is correct
for every number; while it does not hold, it may be assumed not to hold. So a step is written twice:
without the unlikely cases, and in full. The first is tried, and left for the second if a lane needs
it. Both compute the same bits.
"""

from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

from echelon.simulation.scalars.scalar_graph import Node, rewritten


class FastPath(NamedTuple):
    """A step without its unlikely cases.

    Attributes:
        nodes: a node of the full step -> its node in the fast path.
        levels: truths of which none may hold; each level depends on the assumptions of those
            before.
    """

    nodes: Mapping[Node, Node]
    levels: Sequence[Sequence[Node]]


def general_case(results: Sequence[Node]) -> Mapping[Node, Node]:
    """Return each node with every unlikely truth assumed to hold, which is always correct."""
    return rewritten(results, lambda node, args: True if node.op == "unlikely" else None)


def find_fast_path(results: Sequence[Node], choices: Iterable[tuple[Node, bool]]) -> FastPath:
    """Return each node with every unlikely truth assumed not to hold.

    Args:
        results: of the step.
        choices: further truths, and for each whether it is unlikely to hold, or not to hold.
    """
    sides, depths, excluded = dict(choices), dict[Node, int](), list[tuple[int, Node]]()

    def assume(node: Node, args: Sequence[Node]) -> Node | bool | None:
        # What is the same for all agents costs almost nothing, and is computed in full.
        depth = max((depths[a] for a in node.args), default=0)
        depths[node] = depth
        if node.op == "unlikely":
            if node.uniform:
                return True
            excluded.append((depth, args[0]))
            depths[node] = depth + 1
            return False
        if node not in sides:
            return None
        truth = node.graph.make(node.op, *args)
        excluded.append((depth, truth if sides[node] else node.graph.make("not", truth)))
        depths[node] = depth + 1
        return not sides[node]

    nodes = rewritten(results, assume)
    levels = [[n for d, n in excluded if d == depth] for depth in sorted({d for d, _ in excluded})]
    return FastPath(nodes, [list(dict.fromkeys(level)) for level in levels])
