"""In which order nodes are computed: what is there late, and what is written after what."""

from collections.abc import Iterable, Mapping, Sequence

from echelon.simulation.scalars.scalar_graph import Node

_LONG = {"div": 3, "sqrt": 4, "select": 0, "neg": 0}
"""Operations that take longer than a product or less, in products."""


def lateness(nodes: Iterable[Node]) -> Mapping[Node, int]:
    """Return how many products in a row each of some nodes waits for; operands come first."""
    late = dict[Node, int]()
    for node in nodes:
        late[node] = max((late[a] for a in node.args), default=-1) + _LONG.get(node.op, 1)
    return late


def one_by_one(results: Sequence[Node], late: Mapping[Node, int]) -> list[Node]:
    """Return all that results rest on, result by result, the latest operand of each first.

    Fewer numbers then wait for others than in the order of a trace, where three sines are made at
    once, and fewer are put into memory meanwhile.
    """
    found, todo = dict[Node, None](), [(node, False) for node in reversed(results)]
    while todo:
        node, ready = todo.pop()
        if node in found:
            continue
        if ready:
            found[node] = None
            continue
        todo.append((node, True))
        todo += [(a, False) for a in sorted(set(node.args), key=lambda a: (late[a], a.number))]
    return list(found)
