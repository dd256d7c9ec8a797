"""Writes a graph of scalars as instructions on vectors, whose lanes are agents.

What is the same for all agents is computed once, as a scalar. A large computation that only one
side of a choice needs is behind a branch, taken if any lane takes that side.

Much of a step is written for unlikely cases: an angle beyond 45 degrees, a motor at its limit. A
truth marked as `unlikely` may always be assumed to hold, because what it then selects is correct
for every number; while it does not hold, it may be assumed not to hold. One that is `rare` selects
other last bits. So a step is written twice: without such cases, the fast path, and in full. The
first is tried, and left for the second if a lane needs it. Both compute the same bits.
"""

import graphlib
import heapq
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import NamedTuple, final

from echelon.simulation.codegen.scheduling import depth_first, lateness
from echelon.simulation.codegen.vector_ir import Writer
from echelon.simulation.scalars import Node, needed, rewritten

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
    """Leave out those that need the result of a choice which itself reads the branch."""
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


@final
class Emitter:
    """Writes nodes, each once; a function loads the leaves.

    Args:
        writer: to write to.
        load: leaf -> its value, written when it is first needed.
    """

    def __init__(self, writer: Writer, load: Callable[[Node], str]) -> None:
        self.writer, self.load = writer, load
        self.values: dict[Node, str] = {}
        self._wide: dict[Node, str] = {}

    def emit(self, results: Sequence[Node]) -> None:
        """Write all that results depend on."""
        nodes = needed(results)
        # Uniform values first: they come before every branch, and are outside of all.
        self._write([n for n in nodes if n.uniform])
        nodes = [n for n in nodes if not n.uniform]
        branches = find_branches(nodes, results)
        self._write_in_order(nodes, {node: b for b in branches for node in b.nodes})

    def emit_fast(
        self, results: Sequence[Node], levels: Sequence[Sequence[Node]], otherwise: str
    ) -> None:
        """Write all that results depend on; branch to a label if a truth of a level holds."""
        nodes = needed([*results, *(node for level in levels for node in level)])
        self._write([n for n in nodes if n.uniform])
        rest, late = [n for n in nodes if not n.uniform], lateness(nodes)
        for level in levels:
            first = [n for n in depth_first(level, late) if not n.uniform]
            rest = self._early(first, rest, results)
            self._leave(level, otherwise)
        self._write(n for n in depth_first(results, late) if not n.uniform)

    def _early(
        self, first: Sequence[Node], rest: Sequence[Node], results: Sequence[Node]
    ) -> list[Node]:
        """Write nodes and those that now free more registers than they take: sums over stages."""
        self._write(first)
        left = [n for n in rest if n not in self.values]
        users = dict[Node, int]()
        for node in left:
            for a in set(node.args):
                users[a] = users.get(a, 0) + 1
        live, others = set(results), list[Node]()
        for node in left:
            ready = node.args and all(
                a in self.values or a.op in ("constant", "leaf") for a in node.args
            )
            operands = {a for a in node.args if not a.uniform and a.op != "leaf" and a not in live}
            if ready and any(users[a] == 1 for a in operands):
                self._write([a for a in node.args if a.op == "leaf"])
                self._write([node])
                for a in set(node.args):
                    users[a] -= 1
            else:
                others.append(node)
        return [n for n in others if n not in self.values]

    def _leave(self, level: Sequence[Node], otherwise: str) -> None:
        w, kind = self.writer, self.writer.kind(True, False)
        truths, largest = list[str](), dict[float, str]()
        for node in level:
            if node.op == "lt" and node.args[0].op == "constant":
                bound, x = node.args[0].value, self.value(node.args[1])
                if bound in largest:
                    other = largest[bound]
                    larger = w.put(f"fcmp ogt {w.vector} {x}, {other}")
                    x = w.put(f"select {kind} {larger}, {w.vector} {x}, {w.vector} {other}")
                largest[bound] = x
            else:
                truths.append(self.value(node))
        for bound, x in largest.items():
            # Also for NaN: the general case looks at it lane by lane.
            truths.append(w.put(f"fcmp ugt {w.vector} {x}, {w.number(bound)}"))
        either = truths[0]
        for other in truths[1:]:
            either = w.put(f"or {kind} {either}, {other}")
        some, after = w.any_lane(either), w.fresh("usual")
        w.do(f"br i1 {some}, label %{otherwise}, label %{after}, !prof !0")
        w.label(after)

    def value(self, node: Node, uniform: bool = False) -> str:
        """Return a node as an operand, of scalars or of vectors."""
        if node.op == "constant":
            return self.writer.constant(node, uniform)
        if not node.uniform or uniform:
            return self.values[node]
        if node not in self._wide:
            kind = self.writer.kind(node.truth, True)
            self._wide[node] = self.writer.splat(self.values[node], kind)
        return self._wide[node]

    def _write(self, nodes: Iterable[Node]) -> None:
        for node in nodes:
            if node in self.values or node.op == "constant":
                continue
            self.values[node] = self.load(node) if node.op == "leaf" else self._operation(node)

    def _operation(self, node: Node) -> str:
        w, uniform = self.writer, node.uniform
        args = [self.value(a, uniform) for a in node.args]
        if node.op == "select":
            which, kind = w.kind(True, uniform), w.kind(node.truth, uniform)
            return w.put(f"select {which} {args[0]}, {kind} {args[1]}, {kind} {args[2]}")
        return w.operation(node.op, args, node.args[0].truth, uniform)

    def _write_in_order(self, nodes: Iterable[Node], owner: Mapping[Node, Branch]) -> None:
        for node in nodes:
            if node in owner or node in self.values:
                continue
            for branch in dict.fromkeys(owner[a] for a in node.args if a in owner):
                if branch.nodes[0] not in self.values:
                    # A branch does not depend on its own choice, so the recursion ends.
                    rest = needed([branch.which, *branch.nodes])
                    self._write_in_order([n for n in rest if owner.get(n) is not branch], owner)
                    self._branch(branch)
            self._write([node])

    def _branch(self, branch: Branch) -> None:
        w, which = self.writer, self.value(branch.which)
        if not branch.side:
            which = w.put(f"xor {w.kind(True, False)} {which}, splat (i1 true)")
        some = w.any_lane(which)
        before, inside, after = (w.fresh(stem) for stem in ("from", "take", "join"))
        w.do(f"br label %{before}")
        w.label(before)
        w.do(f"br i1 {some}, label %{inside}, label %{after}")
        w.label(inside)
        # A vector made of a scalar in the branch is not defined after it.
        wide = dict(self._wide)
        self._write(branch.nodes)
        self._wide = wide
        end = w.fresh("end")
        w.do(f"br label %{end}")
        w.label(end)
        w.do(f"br label %{after}")
        w.label(after)
        for node in branch.outputs:
            values = f"[ {self.values[node]}, %{end} ], [ zeroinitializer, %{before} ]"
            self.values[node] = w.put(f"phi {w.kind(node.truth, False)} {values}")


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
    """Return each node with every unlikely truth assumed to hold, and rare ones computed."""

    def plain(node: Node, args: Sequence[Node]) -> Node | bool | None:
        if node.op == "rare":
            return args[0]
        return True if node.op == "unlikely" else None

    return rewritten(results, plain)


def find_fast_path(results: Sequence[Node], choices: Iterable[tuple[Node, bool]]) -> FastPath:
    """Return each node with unlikely and rare truths assumed not to hold, nor `choices`."""
    sides, depths, excluded = dict(choices), dict[Node, int](), list[tuple[int, Node]]()

    def assume(node: Node, args: Sequence[Node]) -> Node | bool | None:
        # What is the same for all agents costs almost nothing, and is computed in full.
        depth = max((depths[a] for a in node.args), default=0)
        depths[node] = depth
        if node.op in ("unlikely", "rare"):
            if node.uniform:
                return True if node.op == "unlikely" else args[0]
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
