"""What only one side of a choice needs: worth a branch where it is much."""

import graphlib
import heapq
from collections.abc import Sequence
from typing import final

from echelon.simulation.scalars.scalar_graph import Node, needed

_MANY = 40
"""Operations behind a choice from which on a branch is worth its cost."""


@final
class Branch:
    """What only one side of the choices by one truth needs.

    Attributes:
        which: the truth.
        side: whether the arm is taken where it holds, or where it does not.
        nodes: of the arm, in order.
        left: those of them that the choices read.
    """

    def __init__(self, which: Node, side: bool, nodes: list[Node], left: list[Node]) -> None:
        self.which, self.side, self.nodes, self.left = which, side, nodes, left


def choices(results: Sequence[Node]) -> list[tuple[Node, bool]]:
    """Return the truths by which much is chosen, and at which side of them that is."""
    nodes = [node for node in needed(results) if not node.uniform]
    return [(arm.which, arm.side) for arm in arms(nodes, results)]


def arms(nodes: list[Node], results: Sequence[Node]) -> list[Branch]:
    """Return the arms that are worth a branch; none within another."""
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
    found, taken = list[Branch](), set[Node]()
    # Those of the later choices hold those of the earlier ones, and are worth more.
    for (which, side), selects in sorted(choices.items(), key=lambda c: -c[1][0].number):
        arm = _exclusive(users, outside, which, side, selects)
        arm = [node for node in arm if node.op != "leaf"]
        if len(arm) >= _MANY and not taken.intersection([*arm, *selects, which]):
            inside = set(arm)
            left = [n for n in arm if any(u not in inside for u in users[n])]
            found.append(Branch(which, side, arm, left))
            taken.update(arm)
    return _without_circles(nodes, found)


def _without_circles(nodes: list[Node], found: list[Branch]) -> list[Branch]:
    """Return the arms that can be written in one piece each.

    One that needs the result of a choice which itself reads the arm cannot; its nodes then stand
    among the others.
    """
    while found:
        owner: dict[Node, Node | Branch] = {node: arm for arm in found for node in arm.nodes}
        needs: dict[Node | Branch, set[Node | Branch]] = {
            arm: {owner.get(arm.which, arm.which)} for arm in found
        }
        for node in nodes:
            whole = owner.get(node, node)
            needs.setdefault(whole, set()).update(owner.get(a, a) for a in node.args)
            needs[whole].discard(whole)
        try:
            graphlib.TopologicalSorter(needs).prepare()
        except graphlib.CycleError as circle:
            found = [arm for arm in found if arm not in circle.args[1]]
        else:
            break
    return found


def _exclusive(
    users: dict[Node, list[Node]],
    outside: set[Node],
    which: Node,
    side: bool,
    selects: list[Node],
) -> list[Node]:
    """Return the nodes that nothing needs but one side of some choices."""
    chosen, inside = set(selects), set[Node]()

    def wanted(node: Node, user: Node) -> bool:
        # The choice itself may read it at that side only, and not as its truth.
        if user not in chosen or user in inside:
            return user in inside
        return node is not user.args[2 if side else 1] and node is not user.args[0]

    # Backwards from the choices: all that read a number come before it.
    near = {a.number: a for select in selects for a in select.args if a in users}
    order = [-number for number in near]
    heapq.heapify(order)
    while order:
        node = near[-heapq.heappop(order)]
        if node in outside or node is which or not all(wanted(node, u) for u in users[node]):
            continue
        inside.add(node)
        for a in node.args:
            if a in users and a.number not in near:
                near[a.number] = a
                heapq.heappush(order, -a.number)
    return sorted(inside, key=lambda node: node.number)
