"""What is the same for all agents at a step, computed once for all of them.

It is a part of the graph that rests on the time and on the table alone, such as what a leader
follows. All groups of formations have it in common, and read it from memory, step by step.
"""

from collections.abc import Sequence

from echelon.simulation.codegen.ir_blocks import Body, Plan
from echelon.simulation.scalars.scalar_graph import Node, needed, rewritten


def shared(plan: Plan) -> list[Node]:
    """Return the numbers that the bodies of a plan have in common for all agents, in order."""
    return [node for body in (plan.first, plan.others) for node in _border(body)]


def apart(plan: Plan) -> Plan:
    """Return a plan whose bodies read what is the same for all agents."""
    places = {node: k for k, node in enumerate(shared(plan))}

    def read(node: Node, _: Sequence[Node]) -> Node | None:
        if node not in places:
            return None
        leaf = node.graph.leaf("common", places[node], uniform=True)
        return node.graph.make("ne", leaf, 0.0) if node.truth else leaf

    first, others = (b.become(rewritten(b.all(), read)) for b in (plan.first, plan.others))
    return plan._replace(first=first, others=others)


def _border(body: Body) -> list[Node]:
    """Return the nodes, the same for all agents, that others rest on, or that are wanted."""
    nodes, wanted = needed(body.all()), set(body.all())
    wanted |= {a for node in nodes if not node.uniform for a in node.args}
    return [n for n in nodes if n.uniform and n.op != "constant" and n in wanted]
