"""The loops about a body of code: steps, blocks of agents, their neighbours, their edges.

Agents stand in blocks of as many as a vector has lanes. A block holds its numbers row by row, so
that one address reaches all of them. What neighbours read of an agent stands apart and twice, as
it is and as it will be after the step, one agent after the other: a neighbour is anywhere, and its
numbers lie together. Where a vector holds one agent of many formations, its neighbour is another
vector: what it shows lies row by row, and each group of formations takes all its steps before the
next one, so that it stays in the nearest cache.
"""

import contextlib
from collections.abc import Iterator, Sequence

from echelon.simulation.codegen.barriers import tell_done, wait
from echelon.simulation.codegen.branches import choices
from echelon.simulation.codegen.fast_path import usual, whole
from echelon.simulation.codegen.fused import fused
from echelon.simulation.codegen.ir_blocks import (
    ADDRESSES,
    NO_NEWS,
    SLOTS,
    TURN,
    Body,
    Context,
    Plan,
    far_block,
    gather,
    load_places,
    load_row,
    loop,
    only_if,
    store_row,
)
from echelon.simulation.codegen.neighbours import exchange, led, line, measure_edges, write_mirror
from echelon.simulation.codegen.tape import record, taken, tape_at, tape_of
from echelon.simulation.codegen.uniform_values import apart, shared
from echelon.simulation.codegen.vector_ir import Emitter, Writer, number
from echelon.simulation.scalars.scalar_graph import Node, needed


def program(plan: Plan) -> str:
    """Return a kernel as text for LLVM."""
    w, numbers, plan = Writer(plan.bits, plan.lanes), shared(plan), apart(plan)
    plan = plan._replace(first=fused(plan.first), others=fused(plan.others))
    w.label("entry")
    slots = dict[str, str]()
    for place, name in enumerate(SLOTS):
        at = w.put(f"getelementptr i64, ptr %slots, i64 {place}")
        slots[name] = w.put(f"load {'ptr' if place < ADDRESSES else 'i64'}, ptr {at}")
    last = w.put(f"add i64 {slots['first_step']}, {slots['steps']}")
    if numbers:
        _share(w, plan, slots, numbers, last)
    with loop(w, "0", slots["groups"], []) as (group, _, _):
        _turns(w, plan, _group(w, plan, slots, group), len(numbers))
    w.do("ret void")
    head = "define void @run(ptr noalias %slots) #0 {"
    # 512 bits also where a processor would rather have halves: the types say what is meant.
    attributes = 'attributes #0 = { nounwind "prefer-vector-width"="512" }'
    # A branch that is hardly ever taken.
    seldom = '!0 = !{!"branch_weights", i32 1, i32 1000}'
    return "\n".join([*sorted(w.declared), "", head, *w.lines, "}", "", attributes, seldom, ""])


def _share(
    w: Writer, plan: Plan, slots: dict[str, str], numbers: Sequence[Node], last: str
) -> None:
    """Write the loop over the steps that computes what all agents have in common."""
    with loop(w, slots["first_step"], last, []) as (step, _, _):
        passed = w.put(f"sub i64 {step}, {slots['first_step']}")
        far = (w.put(f"mul i64 {passed}, {n}") for n in (plan.table, len(numbers)))
        table, common = (
            w.put(f"getelementptr {w.scalar}, ptr {slots[name]}, i64 {place}")
            for name, place in zip(("table", "common"), far, strict=True)
        )
        around = Context(plan, slots, "", "", step, table, common)
        complete = whole(numbers)
        numbers = [complete[node] for node in numbers]
        emitter = Emitter(w, lambda leaf: _same_for_all(w, around, *_named(leaf)))
        emitter.emit(numbers)
        for k, node in enumerate(numbers):
            value = emitter.value(node, uniform=True)
            if node.truth:
                value = w.put(f"uitofp i1 {value} to {w.scalar}")
            at = w.put(f"getelementptr {w.scalar}, ptr {common}, i64 {k}")
            w.do(f"store {w.scalar} {value}, ptr {at}")


def _named(leaf: Node) -> tuple[str, Sequence[int]]:
    kind, *rest = leaf.value
    return kind, rest


def _group(w: Writer, plan: Plan, slots: dict[str, str], group: str) -> dict[str, str]:
    """Write where the numbers of a group are."""
    agents = w.put(f"mul i64 {group}, {slots['blocks']}")
    edges = w.put(f"mul i64 {group}, {slots['edge_blocks']}")
    sizes = {"rows": plan.rows * plan.lanes, "mirror": plan.mirror, "next_mirror": plan.mirror}
    found = {name: (agents, size) for name, size in sizes.items()}
    found["edges"] = edges, (len(plan.edges) + 2) * plan.lanes
    own = dict[str, str]()
    for name, (count, size) in found.items():
        far = w.put(f"mul i64 {count}, {size}")
        own[name] = w.put(f"getelementptr {w.scalar}, ptr {slots[name]}, i64 {far}")
    return slots | own


def _turns(w: Writer, plan: Plan, slots: dict[str, str], numbers: int) -> None:
    """Write all steps of a group, turn by turn."""
    with loop(w, "0", slots["count"], []) as (number, _, _):
        first = w.put(f"mul i64 {number}, {len(TURN)}")
        turn = dict[str, str]()
        for k, name in enumerate(TURN):
            at = w.put(f"getelementptr i64, ptr {slots['turns']}, i64 {first}")
            at = w.put(f"getelementptr i64, ptr {at}, i64 {k}")
            turn[name] = w.put(f"load i64, ptr {at}")
        wait(w, slots, turn["before"], turn["after"])
        around = _around(w, plan, slots, turn["passed"], numbers)
        leads, done = w.put(f"icmp eq i64 {turn['level']}, 0"), w.fresh("done")
        ways = {name: w.fresh(name) for name in ("lead", "follow")}
        w.do(f"br i1 {leads}, label %{ways['lead']}, label %{ways['follow']}")
        w.label(ways["lead"])
        _lead(w, around, turn)
        w.do(f"br label %{done}")
        w.label(ways["follow"])
        if plan.edges:
            measure_edges(w, around, turn["first_edge"], turn["last_edge"])
        with loop(w, turn["start"], turn["end"], []) as (block, _, _):
            _act(w, around, plan.others, block)
        w.do(f"br label %{done}")
        w.label(done)
        tell_done(w, slots, number)


def _around(w: Writer, plan: Plan, slots: dict[str, str], passed: str, numbers: int) -> Context:
    """Write where a step finds what changes from step to step."""
    step = w.put(f"add i64 {slots['first_step']}, {passed}")
    turned = passed
    if plan.backward:
        last = w.put(f"sub i64 {slots['steps']}, 1")
        turned = w.put(f"sub i64 {last}, {passed}")
    odd = w.put(f"trunc i64 {turned} to i1")
    now, later = (
        w.put(f"select i1 {odd}, ptr {slots[a]}, ptr {slots[b]}")
        for a, b in (("next_mirror", "mirror"), ("mirror", "next_mirror"))
    )
    shown = w.put(f"icmp eq i64 {step}, {slots['shown']}")
    shown = w.put(f"zext i1 {shown} to i64")
    common = _part(w, slots["common"], passed, str(numbers))
    tape = tape_at(w, slots, passed) if plan.taped else ""
    around = Context(plan, slots | {"shown": shown}, now, later, step, "", common, tape=tape)
    if not plan.ahead:
        return around
    blocks, each = slots["led_blocks"], plan.told * plan.lanes
    size, told = (w.put(f"mul i64 {blocks}, {n}") for n in (plan.mirror, each))
    ahead, told = (_part(w, slots[k], passed, n) for k, n in (("ahead", size), ("told", told)))
    return around._replace(ahead=ahead, told=told, led=w.put(f"mul i64 {blocks}, {plan.lanes}"))


def _part(w: Writer, start: str, count: str, size: str) -> str:
    """Write the address behind some parts of a size."""
    far = w.put(f"mul i64 {count}, {size}")
    return w.put(f"getelementptr {w.scalar}, ptr {start}, i64 {far}")


def _lead(w: Writer, around: Context, turn: dict[str, str]) -> None:
    """Write what the leaders do in a step; those ahead leave it for the others."""
    plan, slots = around.plan, around.slots
    if plan.ahead:
        after = _part(w, around.ahead, slots["led_blocks"], str(plan.mirror))
        around = around._replace(following=after, slots=slots | {"line": around.led})
    with loop(w, turn["start"], turn["end"], []) as (block, _, _):
        _act(w, around, plan.first, block)
        if plan.ahead:
            base = _part(w, slots["rows"], block, str(plan.rows * plan.lanes))
            kept = _part(w, around.told, block, str(plan.told * plan.lanes))
            for k in range(plan.told):
                told = load_row(w, base, plan.tell + k, plan.lanes)
                store_row(w, kept, k, plan.lanes, told)


# ---- a body --------------------------------------------------------------------------------------


def _act(w: Writer, around: Context, body: Body, block: str) -> None:
    """Write what the agents of a block do: as it usually is, and whole where it is not."""
    plan, all_ = around.plan, body.all()
    size = plan.rows * plan.lanes
    begin = w.put(f"mul i64 {block}, {size}")
    base = w.put(f"getelementptr {w.scalar}, ptr {around.slots['rows']}, i64 {begin}")
    complete = body.become(whole(all_))
    heard = sorted(
        n.value[1] for n in needed(complete.results()) if n.op == "leaf" and n.value[0] == "z"
    )

    def row(leaf: Node) -> str:
        return load_row(w, base, leaf.value[1], plan.lanes)

    z = exchange(w, around, complete, block, heard, row) if heard else {}
    fed = taken(w, around, complete, block)

    def load(leaf: Node) -> str:
        kind, *rest = leaf.value
        if kind in ("z", "fed"):
            return (z if kind == "z" else fed)[rest[0]]
        return _load(w, around, block, base, kind, rest)

    usually = usual(all_, [*choices(body.results()), *_news(body)])
    done, otherwise = w.fresh("done"), w.fresh("otherwise")
    if usually.levels:
        emitter = Emitter(w, load)
        simple = body.become(usually.nodes)
        emitter.emit_usual(simple.results(), usually.levels, otherwise)
        _write(w, around, simple, emitter, base, block)
        w.do(f"br label %{done}")
        w.label(otherwise)
    emitter = Emitter(w, load)
    emitter.emit(complete.results())
    _write(w, around, complete, emitter, base, block)
    if usually.levels:
        w.do(f"br label %{done}")
        w.label(done)


def _news(body: Body) -> list[tuple[Node, bool]]:
    """Return the truths by which there is news of what is kept as the least, which is seldom."""
    least = (node for node in body.least.values() if node.op == "select")
    return [(node.args[0], True) for node in least if _is_none("min", node.args[2])]


def _is_none(op: str, node: Node) -> bool:
    """Tell whether nothing is added by a number, or no least one made by it."""
    none = {"add": 0.0, "min": NO_NEWS}.get(op)
    return node.op == "constant" and node.value == none


def _load(w: Writer, around: Context, block: str, base: str, kind: str, rest: Sequence[int]) -> str:
    """Write the load of what a body rests on, sums over neighbours apart."""
    plan = around.plan
    if kind == "row":
        return load_row(w, base, rest[0], plan.lanes)
    if kind == "told":
        start, row = around.slots["rows"], plan.tell + rest[0]
        if plan.ahead:
            start, row = around.told, rest[0]
        return _look_up(w, around, "sources", start, row, block, plan.one_source)
    if kind == "tape":
        return load_row(w, tape_of(w, around, block), rest[0], plan.lanes)
    if kind == "leader":
        return _look_up(w, around, "leaders", around.mirror, rest[0], block, plan.one_leader)
    return _same_for_all(w, around, kind, rest)


def _write(w: Writer, around: Context, body: Body, emitter: Emitter, base: str, block: str) -> None:
    """Write what a body leaves: in the rows of its block, and for its neighbours."""
    _write_rows(w, around, body, emitter, base)
    write_mirror(w, around, [emitter.value(node) for node in body.mirror], block)
    record(w, around, body, emitter, block)


def _write_rows(w: Writer, around: Context, body: Body, emitter: Emitter, base: str) -> None:
    """Write what a body leaves in the rows of its block."""
    lanes = around.plan.lanes
    for row, node in body.stores.items():
        store_row(w, base, row, lanes, emitter.value(node))
    with only_if(w, around.slots["shown"]):
        for row, node in body.shown.items():
            store_row(w, base, row, lanes, emitter.value(node))
    for kept, op in ((body.sums, "add"), (body.greatest, "max"), (body.least, "min")):
        for row, node in kept.items():
            if _is_none(op, node):
                continue
            with _sometimes(w, emitter, op, node) as value:
                both = [load_row(w, base, row, lanes), value]
                store_row(w, base, row, lanes, w.operation(op, both, False, False))


@contextlib.contextmanager
def _sometimes(w: Writer, emitter: Emitter, op: str, node: Node) -> Iterator[str]:
    """Write what is done where a number is not none, by what is the same for all agents."""
    if node.op == "select" and node.args[0].uniform:
        which, *sides = node.args
        for k, side in enumerate(sides):
            if _is_none(op, side):
                wanted = emitter.value(which, uniform=True)
                wanted = w.put(f"xor i1 {wanted}, true") if k == 0 else wanted
                value = emitter.value(sides[1 - k])
                with only_if(w, w.put(f"zext i1 {wanted} to i64")):
                    yield value
                return
    yield emitter.value(node)


def _same_for_all(w: Writer, around: Context, kind: str, rest: Sequence[int]) -> str:
    """Write a number that all agents have in common."""
    if kind == "steady":
        late = w.put(f"icmp sge i64 {around.step}, {around.slots['first_steady']}")
        return w.put(f"uitofp i1 {late} to {w.scalar}")
    if kind in ("table", "common"):
        start = around.table if kind == "table" else around.common
        at = w.put(f"getelementptr {w.scalar}, ptr {start}, i64 {rest[0]}")
        return w.put(f"load {w.scalar}, ptr {at}")
    step = w.put(f"sitofp i64 {around.step} to {w.scalar}")
    if kind == "step":
        return step
    # From the step number, since a sum of many dt would gather rounding.
    return w.operation("mul", [step, number(around.plan.dt, w.bits)], False, True)


def _look_up(
    w: Writer, around: Context, which: str, start: str, row: int, block: str, one: bool
) -> str:
    """Write the load of what another agent has, whose place is in a list of places."""
    places, plan = around.slots[which], around.plan
    if plan.together:
        return load_row(w, far_block(w, places, block, start), row, plan.lanes)
    # What is told stands in rows, and what is shown agent by agent or in lines.
    offset = row * plan.lanes if which == "sources" else row
    if plan.ahead and which == "leaders":
        start = around.ahead
    if plan.lines and which == "leaders":
        start, offset = led(w, around, row) if plan.ahead else line(w, around, row), 0
    first = w.put(f"mul i64 {block}, {plan.lanes}")
    if not one:
        return gather(w, start, load_places(w, places, first), offset)
    place = w.put(f"load i32, ptr {places}, align 4")
    far = w.put(f"sext i32 {place} to i64")
    far = w.put(f"add i64 {far}, {offset}")
    at = w.put(f"getelementptr {w.scalar}, ptr {start}, i64 {far}")
    return w.splat(w.put(f"load {w.scalar}, ptr {at}"))
