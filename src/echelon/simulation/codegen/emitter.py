"""Writes a graph of scalars as instructions on vectors, whose lanes are agents.

What is the same for all agents is computed once, as a scalar. A large computation that only one
side of a choice needs is behind a branch, taken if any lane takes that side.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import final

from echelon.simulation.codegen.branches import Branch, find_branches
from echelon.simulation.codegen.scheduling import depth_first, lateness
from echelon.simulation.codegen.vector_ir import Writer
from echelon.simulation.scalars import Node, needed


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
        self._write_with_branches([n for n in nodes if not n.uniform], results)

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
        """Write some nodes, and those that now free more registers than they take; return others.

        A sum over the stages of an integrator is such: later, all stages would be live to the end.
        """
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
        """Write a branch that is taken if one of some truths holds in any lane."""
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

    # ---- branches ----

    def _write_with_branches(self, nodes: list[Node], results: Sequence[Node]) -> None:
        """Write nodes in order; those that only one side of a choice needs, behind a branch."""
        owner = {node: b for b in find_branches(nodes, results) for node in b.nodes}
        self._write_in_order(nodes, owner)

    def _write_in_order(self, nodes: Iterable[Node], owner: Mapping[Node, Branch]) -> None:
        """Write nodes outside of branches; each branch before the first node that reads it."""
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
        """Write nodes behind a branch, and those read outside as values that hold after it."""
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
