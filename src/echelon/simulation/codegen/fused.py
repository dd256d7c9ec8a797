"""Products that are added, in one operation and with one rounding, where a processor has it.

Which they are is decided here, before the step is written as it usually is and whole: LLVM would
decide by what stands in the same stretch of code, and the two would differ in the last bit.
"""

from collections import Counter
from collections.abc import Mapping, Sequence

from echelon.simulation.codegen.ir_blocks import Body
from echelon.simulation.codegen.scheduling import lateness
from echelon.simulation.scalars.scalar_graph import Node, needed, rewritten


def fused(body: Body) -> Body:
    """Return a body whose sums take in a product that nothing else reads."""
    return body.become(_fused([*body.results(), *body.now]))


def _fused(results: Sequence[Node]) -> Mapping[Node, Node]:
    nodes = needed(results)
    users, late = Counter(a for node in nodes for a in node.args), lateness(nodes)
    users.update(results)

    def join(node: Node, args: Sequence[Node]) -> Node | None:
        if node.op not in ("add", "sub") or node.uniform:
            return None
        alone = [k for k in (0, 1) if args[k].op == "mul" and users[node.args[k]] == 1]
        if not alone:
            return None
        # The one that is there last, since the other can be made meanwhile.
        k = max(alone, key=lambda k: late[node.args[k]])
        op = "fma" if node.op == "add" else ("fms", "fnma")[k]
        return node.graph.make(op, *args[k].args, args[1 - k])

    return rewritten(results, join)
