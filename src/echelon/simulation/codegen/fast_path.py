"""The code of the usual step, and what must hold of it.

Much of a step is written for what seldom happens: an angle beyond 45 degrees, a motor at its limit.
A truth that is marked as `rare` may be taken to hold always, since what it then chooses is right
for every number, or never, as long as it does not hold. So a step is written twice: as it usually
is, without all that, and whole. The first is tried, and left for the second where a lane is not as
usual. What both make is the same to the bit.
"""

from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

from echelon.simulation.scalars.scalar_graph import Node, rewritten


class FastPath(NamedTuple):
    """What usually is.

    Attributes:
        nodes: a node of the whole step -> what it then is.
        levels: truths of which none may hold; each level rests on what those before it assume.
    """

    nodes: Mapping[Node, Node]
    levels: Sequence[Sequence[Node]]


def whole(results: Sequence[Node]) -> Mapping[Node, Node]:
    """Return what nodes are where everything that is rare is taken to happen."""
    return rewritten(results, lambda node, args: True if node.op == "rare" else None)


def usual(results: Sequence[Node], choices: Iterable[tuple[Node, bool]]) -> FastPath:
    """Return what nodes are where nothing happens that is rare.

    Args:
        results: what is wanted.
        choices: truths, and whether each seldom holds or seldom does not.
    """
    sides, depths, found = dict(choices), dict[Node, int](), list[tuple[int, Node]]()

    def assume(node: Node, args: Sequence[Node]) -> Node | bool | None:
        # What is the same for all agents costs next to nothing, and is computed as a whole.
        depth = max((depths[a] for a in node.args), default=0)
        depths[node] = depth
        if node.op == "rare":
            if node.uniform:
                return True
            found.append((depth, args[0]))
            depths[node] = depth + 1
            return False
        if node not in sides:
            return None
        made = node.graph.make(node.op, *args)
        found.append((depth, made if sides[node] else node.graph.make("not", made)))
        depths[node] = depth + 1
        return not sides[node]

    made = rewritten(results, assume)
    levels = [[n for d, n in found if d == depth] for depth in sorted({d for d, _ in found})]
    return FastPath(made, [list(dict.fromkeys(level)) for level in levels])
