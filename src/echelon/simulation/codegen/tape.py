"""What derivatives need of a kernel: a tape of each step, sums over agents, and who feeds whom.

Backwards in time an agent is fed what those felt whom it told something: the transpose of a look-up
is an addition. All agents of a vector are added one after the other, so that no two meet at one
place, and the order, and with it every bit, is the same each time.
"""

from collections.abc import Mapping, Sequence

from echelon.simulation.codegen.ir_blocks import (
    Body,
    Context,
    Plan,
    bytes_of,
    far_block,
    load_row,
    only_if,
    store_row,
    stride,
)
from echelon.simulation.codegen.neighbours import transposed
from echelon.simulation.codegen.vector_ir import Emitter, Writer
from echelon.simulation.scalars.scalar_graph import Node, needed

_KEPT = ("row", "z", "told", "leader")
"""Leaves that differ from step to step and are not the same for all agents."""


def fed_widths(plan: Plan) -> tuple[int, int]:
    """Return where in an agent's `fed` what leaders are fed begins, and where it ends."""
    source, leader = (
        stride(len(part), plan.lanes) for part in (plan.others.to_sources, plan.others.to_leaders)
    )
    return source, source + leader


# ---- bodies --------------------------------------------------------------------------------------


def from_tape(body: Body, named: Mapping[str, str]) -> tuple[Body, list[tuple[str, int]]]:
    """Return a body that finds on a tape what was at hand forwards, and the leaves kept there.

    Args:
        body: whose leaves are named as in the step forward.
        named: kind of a leaf that is at hand on the way back -> what it is called there.
    """
    leaves = [n for n in needed(body.all()) if n.op == "leaf"]
    kept = [n.value for n in leaves if n.value[0] in _KEPT]
    made = dict[Node, Node]()
    for node in needed(body.all()):
        if node.op == "leaf" and node.value[0] in _KEPT:
            made[node] = node.graph.leaf("tape", kept.index(node.value))
        elif node.op == "leaf" and node.value[0] in named:
            made[node] = node.graph.leaf(named[node.value[0]], *node.value[1:])
        elif node.args:
            made[node] = node.graph.make(node.op, *(made[a] for a in node.args))
        else:
            made[node] = node
    return body.become(made), kept


# ---- the tape ------------------------------------------------------------------------------------


def tape_at(w: Writer, slots: Mapping[str, str], passed: str) -> str:
    """Write the address of what the tape has of a step."""
    far = w.put(f"mul i64 {passed}, {slots['tape_step']}")
    return w.put(f"getelementptr {w.scalar}, ptr {slots['tape']}, i64 {far}")


def tape_of(w: Writer, around: Context, block: str) -> str:
    """Write the address of what the tape has of a block."""
    far = w.put(f"mul i64 {block}, {around.plan.taped * w.lanes}")
    return w.put(f"getelementptr {w.scalar}, ptr {around.tape}, i64 {far}")


def record(w: Writer, around: Context, body: Body, emitter: Emitter, block: str) -> None:
    """Write what a body leaves beside its block: on the tape, in totals, for others."""
    if body.tape:
        with only_if(w, w.put(f"ptrtoint ptr {around.slots['tape']} to i64")):
            start = tape_of(w, around, block)
            for row, node in body.tape.items():
                store_row(w, start, row, w.lanes, emitter.value(node))
    for place, node in body.totals.items():
        both = [load_row(w, around.slots["totals"], place, w.lanes), emitter.value(node)]
        store_row(w, around.slots["totals"], place, w.lanes, w.operation("add", both, False, False))
    first, _ = fed_widths(around.plan)
    for which, nodes, far in (
        ("sources", body.to_sources, 0),
        ("leaders", body.to_leaders, first),
    ):
        _feed(w, around, which, [emitter.value(node) for node in nodes], block, far)


# ---- who feeds whom ------------------------------------------------------------------------------


def _feed(
    w: Writer, around: Context, which: str, values: Sequence[str], block: str, far: int
) -> None:
    """Write that values are added for the agents of a list, lane by lane."""
    first = w.put(f"mul i64 {block}, {w.lanes}")
    places = w.put(f"getelementptr i32, ptr {around.slots[which]}, i64 {first}")
    for piece in range(0, len(values), w.lanes):
        some = [*values[piece : piece + w.lanes]]
        some += ["zeroinitializer"] * (w.lanes - len(some))
        for lane, column in enumerate(transposed(w, some)):
            start = far_block(w, places, str(lane), around.slots["fed"])
            at = w.put(f"getelementptr {w.scalar}, ptr {start}, i64 {far + piece}")
            before = w.put(f"load {w.vector}, ptr {at}, align {w.lanes * bytes_of(w)}")
            after = w.operation("add", [before, column], False, False)
            w.do(f"store {w.vector} {after}, ptr {at}, align {w.lanes * bytes_of(w)}")


def taken(w: Writer, around: Context, body: Body, block: str) -> dict[int, str]:
    """Write the load of what a body was fed, entry -> a vector, and clear it for the next step."""
    entries = [n.value[1] for n in needed(body.results()) if n.op == "leaf" and n.value[0] == "fed"]
    if not entries:
        return {}
    found, (_, size) = dict[int, str](), fed_widths(around.plan)
    begin = w.put(f"mul i64 {block}, {size * w.lanes}")
    start = w.put(f"getelementptr {w.scalar}, ptr {around.slots['fed']}, i64 {begin}")
    for piece in range(0, size, w.lanes):
        rows = list[str]()
        for lane in range(w.lanes):
            at = w.put(f"getelementptr {w.scalar}, ptr {start}, i64 {lane * size + piece}")
            rows.append(w.put(f"load {w.vector}, ptr {at}, align {w.lanes * bytes_of(w)}"))
            w.do(f"store {w.vector} zeroinitializer, ptr {at}, align {w.lanes * bytes_of(w)}")
        found |= enumerate(transposed(w, rows), piece)
    return found
