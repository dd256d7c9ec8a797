"""Which operations are shared or fused, and in which order nodes are computed."""

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence

from echelon.simulation.codegen.kernel_plan import Body, Plan
from echelon.simulation.scalars import Node, needed, rewritten


def shared(plan: Plan) -> list[Node]:
    """Return the numbers of a plan's bodies that are the same for all agents at a step, in order.

    They depend on the time and on the table alone, such as what a leader follows. They are computed
    once, and all groups of formations read them from memory, step by step.
    """
    return [node for body in plan.bodies.values() for node in _border(body)]


def separate_uniform(plan: Plan) -> Plan:
    """Return a plan whose bodies read from memory what is the same for all agents."""
    places = {node: k for k, node in enumerate(shared(plan))}

    def read(node: Node, _: Sequence[Node]) -> Node | None:
        if node not in places:
            return None
        leaf = node.graph.leaf("uniform", places[node], uniform=True)
        return node.graph.make("ne", leaf, 0.0) if node.truth else leaf

    changed = {k: b.map_nodes(rewritten(b.all(), read)) for k, b in plan.bodies.items()}
    return plan._replace(**changed)


def _border(body: Body) -> list[Node]:
    """Return the uniform nodes that are results or operands of nodes that are not uniform."""
    nodes, border = needed(body.all()), set(body.all())
    border |= {a for node in nodes if not node.uniform for a in node.args}
    # Constants are in the code itself, and need no memory.
    return [n for n in nodes if n.uniform and n.op != "constant" and n in border]


def fuse(body: Body) -> Body:
    """Return a body with sums fused with a product that nothing else reads.

    This is decided before the fast path and the general case are written: LLVM would decide by what
    is in the same basic block, and the two would differ in the last bit.
    """
    results = [*body.results(), *body.mirror_before]
    nodes = needed(results)
    users, late = Counter(a for node in nodes for a in node.args), lateness(nodes)
    users.update(results)

    def join(node: Node, args: Sequence[Node]) -> Node | None:
        if node.op not in ("add", "sub") or node.uniform:
            return None
        alone = [k for k in (0, 1) if args[k].op == "mul" and users[node.args[k]] == 1]
        if not alone:
            return None
        # The later one, because the other can be computed meanwhile.
        k = max(alone, key=lambda k: late[node.args[k]])
        op = "fma" if node.op == "add" else ("fms", "fnma")[k]
        return node.graph.make(op, *args[k].args, args[1 - k])

    return body.map_nodes(rewritten(results, join))


_LATENCY = {"div": 3, "sqrt": 4, "select": 0, "neg": 0}
"""Of operations that take longer than a product or less, in products."""


def lateness(nodes: Iterable[Node]) -> Mapping[Node, int]:
    """Return how many products in a row each of some nodes waits for; operands come first."""
    late = dict[Node, int]()
    for node in nodes:
        late[node] = max((late[a] for a in node.args), default=-1) + _LATENCY.get(node.op, 1)
    return late


def depth_first(results: Sequence[Node], late: Mapping[Node, int]) -> list[Node]:
    """Return all that results depend on, result by result, the latest operand of each first.

    Fewer numbers are live at once than in the order of a trace, which computes three sines side by
    side, and fewer are spilled to memory.
    """
    order, todo = dict[Node, None](), [(node, False) for node in reversed(results)]
    while todo:
        node, ready = todo.pop()
        if node in order:
            continue
        if ready:
            order[node] = None
            continue
        todo.append((node, True))
        todo += [(a, False) for a in sorted(set(node.args), key=lambda a: (late[a], a.number))]
    return list(order)
