"""Which nodes only one side of a choice needs: many of them are worth a branch."""

import graphlib
import heapq
from collections.abc import Sequence
from typing import final

from echelon.simulation.scalars.scalar_graph import Node, needed

_MANY = 40
"""Operations on one side of a choice from which on a branch is worth its cost."""


@final
class Branch:
    """What only one side of the choices by one truth needs.

    Attributes:
        which: the truth.
        side: whether the branch is taken where it holds, or where it does not.
        nodes: of the branch, in order.
        outputs: those of them that the choices read.
    """

    def __init__(self, which: Node, side: bool, nodes: list[Node], outputs: list[Node]) -> None:
        self.which, self.side, self.nodes, self.outputs = which, side, nodes, outputs


def large_choices(results: Sequence[Node]) -> list[tuple[Node, bool]]:
    """Return the truths with many nodes on one side of the choice, and that side."""
    nodes = [node for node in needed(results) if not node.uniform]
    return [(branch.which, branch.side) for branch in find_branches(nodes, results)]


def find_branches(nodes: list[Node], results: Sequence[Node]) -> list[Branch]:
    """Return the branches that are worth their cost; none within another."""
    users: dict[Node, list[Node]] = {node: [] for node in nodes}
    for node in nodes:
        for operand in set(node.args):
            if operand in users:
                users[operand].append(node)
    outside = set(results)
    choices: dict[tuple[Node, bool], list[Node]] = {}
    for node in nodes:
        if node.op == "select" and not node.args[0].uniform:
            for side in (True, False):
                choices.setdefault((node.args[0], side), []).append(node)
    branches, owned = list[Branch](), set[Node]()
    # Those of the later choices contain those of the earlier ones, and are worth more.
    for (which, side), selects in sorted(choices.items(), key=lambda c: -c[1][0].number):
        inner = _exclusive(users, outside, which, side, selects)
        inner = [node for node in inner if node.op != "leaf"]
        # A branch within another would save little more, and complicate the order.
        if len(inner) >= _MANY and not owned.intersection([*inner, *selects, which]):
            inside = set(inner)
            outputs = [n for n in inner if any(u not in inside for u in users[n])]
            branches.append(Branch(which, side, inner, outputs))
            owned.update(inner)
    return _without_cycles(nodes, branches)


def _without_cycles(nodes: list[Node], branches: list[Branch]) -> list[Branch]:
    """Return the branches that can be written in one piece each.

    One that needs the result of a choice which itself reads the branch cannot; its nodes are then
    written among the others.
    """
    while branches:
        owner: dict[Node, Node | Branch] = {node: b for b in branches for node in b.nodes}
        needs: dict[Node | Branch, set[Node | Branch]] = {
            branch: {owner.get(branch.which, branch.which)} for branch in branches
        }
        for node in nodes:
            piece = owner.get(node, node)
            needs.setdefault(piece, set()).update(owner.get(a, a) for a in node.args)
            needs[piece].discard(piece)
        try:
            graphlib.TopologicalSorter(needs).prepare()
        except graphlib.CycleError as error:
            branches = [branch for branch in branches if branch not in error.args[1]]
        else:
            break
    return branches


def _exclusive(
    users: dict[Node, list[Node]],
    outside: set[Node],
    which: Node,
    side: bool,
    selects: list[Node],
) -> list[Node]:
    """Return the nodes that nothing needs but one side of some choices."""
    chosen, inside = set(selects), set[Node]()

    def is_inside(node: Node, user: Node) -> bool:
        # The choice itself may read it at that side only, and not as its truth.
        if user not in chosen or user in inside:
            return user in inside
        return node is not user.args[2 if side else 1] and node is not user.args[0]

    # Backwards from the choices: all that read a number come before it.
    candidates = {a.number: a for select in selects for a in select.args if a in users}
    order = [-number for number in candidates]
    heapq.heapify(order)
    while order:
        node = candidates[-heapq.heappop(order)]
        if node in outside or node is which or not all(is_inside(node, u) for u in users[node]):
            continue
        inside.add(node)
        for a in node.args:
            if a in users and a.number not in candidates:
                candidates[a.number] = a
                heapq.heappush(order, -a.number)
    return sorted(inside, key=lambda node: node.number)
