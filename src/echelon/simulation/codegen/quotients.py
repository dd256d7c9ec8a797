"""Quotients by the same number share its inverse: of all operations they take the longest."""

from collections import Counter
from collections.abc import Mapping, Sequence

from echelon.simulation.scalars.scalar_graph import Node, needed, rewritten

_SMOOTH = {"add", "sub", "mul", "neg"}
"""What may read a quotient that is rounded otherwise; where it is cut to whole numbers or compared,
49/49 must be 1."""


def inverses_shared(results: Sequence[Node]) -> Mapping[Node, Node]:
    """Return what nodes become where quotients by one number are products with its inverse.

    They may differ by a unit of the last place from what they were.
    """
    nodes = needed(results)
    exact = {a for node in nodes if node.op not in _SMOOTH for a in node.args}
    found = [n for n in nodes if n.op == "div" and not n.uniform and n not in exact]
    by = Counter(node.args[1] for node in found)
    shared = {node for node in found if by[node.args[1]] > 1 or node.args[1].uniform}

    def product(node: Node, args: Sequence[Node]) -> Node | None:
        return args[0] * node.graph.make("div", 1.0, args[1]) if node in shared else None

    return rewritten(results, product)
