"""What a kernel for derivatives needs: a tape of each step, sums over agents, contributions.

In the backward pass, the agents that received a message add a contribution for its sender: the
transpose of a look-up is an addition. The agents of a vector add one after the other, so that no
two write to one place at once, and the order, and with it every bit, is the same each time.
"""

from collections.abc import Mapping, Sequence

from echelon.simulation.codegen.emitter import Emitter
from echelon.simulation.codegen.ir_blocks import Context, listed_block, only_if
from echelon.simulation.codegen.kernel_plan import Body, Plan, stride
from echelon.simulation.codegen.neighbours import transposed
from echelon.simulation.codegen.vector_ir import Writer
from echelon.simulation.scalars.scalar_graph import Node, needed

_RECORDED = ("row", "z", "message", "leader")
"""Leaves that change from step to step and are not the same for all agents."""


def contribution_widths(plan: Plan) -> tuple[int, int]:
    """Return where in the contributions of an agent those to a leader begin, and where they end."""
    source, leader = (
        stride(len(part), plan.lanes) for part in (plan.others.to_sources, plan.others.to_leaders)
    )
    return source, source + leader


# ---- bodies --------------------------------------------------------------------------------------


def from_tape(body: Body, names: Mapping[str, str]) -> tuple[Body, list[tuple[str, int]]]:
    """Return a body that reads from a tape, and the leaves that the forward step records there.

    Args:
        body: whose leaves are named as in the forward step.
        names: kind of a leaf that the backward pass has -> its name there.
    """
    leaves = [n for n in needed(body.all()) if n.op == "leaf"]
    # All other leaves can be read again in the backward pass.
    recorded = [n.value for n in leaves if n.value[0] in _RECORDED]
    after = dict[Node, Node]()
    for node in needed(body.all()):
        if node.op == "leaf" and node.value[0] in _RECORDED:
            after[node] = node.graph.leaf("tape", recorded.index(node.value))
        elif node.op == "leaf" and node.value[0] in names:
            after[node] = node.graph.leaf(names[node.value[0]], *node.value[1:])
        elif node.args:
            after[node] = node.graph.make(node.op, *(after[a] for a in node.args))
        else:
            after[node] = node
    return body.map_nodes(after), recorded


# ---- the tape ------------------------------------------------------------------------------------


def tape_block(w: Writer, context: Context, block: str) -> str:
    """Write the address of a block's part of the tape."""
    return w.part(context.tape, block, context.plan.tape_rows * w.lanes)


def record(w: Writer, context: Context, body: Body, emitter: Emitter, block: str) -> None:
    """Write the results of a body outside of its block: on the tape, in totals, for others."""
    if body.tape:
        with only_if(w, w.put(f"ptrtoint ptr {context.slots['tape']} to i64")):
            start = tape_block(w, context, block)
            for row, node in body.tape.items():
                w.store_row(emitter.value(node), start, row)
    totals = context.slots["totals"]
    for place, node in body.totals.items():
        both = [w.load_row(totals, place), emitter.value(node)]
        w.store_row(w.operation("add", both), totals, place)
    first, _ = contribution_widths(context.plan)
    for which, nodes, offset in (
        ("sources", body.to_sources, 0),
        ("leaders", body.to_leaders, first),
    ):
        _contribute(w, context, which, [emitter.value(node) for node in nodes], block, offset)


# ---- contributions -------------------------------------------------------------------------------


def _contribute(
    w: Writer, context: Context, which: str, values: Sequence[str], block: str, offset: int
) -> None:
    """Write that values are added for the agents of a list, lane by lane."""
    first = w.put(f"mul i64 {block}, {w.lanes}")
    places = w.at("i32", context.slots[which], first)
    for piece in range(0, len(values), w.lanes):
        some = [*values[piece : piece + w.lanes]]
        some += ["zeroinitializer"] * (w.lanes - len(some))
        for lane, column in enumerate(transposed(w, some)):
            start = listed_block(w, places, str(lane), context.slots["contributions"])
            at = w.at(w.scalar, start, offset + piece)
            after = w.operation("add", [w.load(w.vector, at), column])
            w.store(w.vector, after, at)


def take_contributions(w: Writer, context: Context, body: Body, block: str) -> dict[int, str]:
    """Write the load of a body's contributions, entry -> a vector, and clear them."""
    leaves = [n for n in needed(body.results()) if n.op == "leaf"]
    if not any(n.value[0] == "contribution" for n in leaves):
        return {}
    entries, (_, size) = dict[int, str](), contribution_widths(context.plan)
    start = w.part(context.slots["contributions"], block, size * w.lanes)
    for piece in range(0, size, w.lanes):
        rows = list[str]()
        for lane in range(w.lanes):
            at = w.at(w.scalar, start, lane * size + piece)
            rows.append(w.load(w.vector, at))
            w.store(w.vector, "zeroinitializer", at)
        entries |= enumerate(transposed(w, rows), piece)
    return entries
