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

from echelon.kernels.adjoint import record, taken, tape_at, tape_of
from echelon.kernels.arms import choices
from echelon.kernels.common import apart, shared
from echelon.kernels.frame import (
    ADDRESSES,
    SLOTS,
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
from echelon.kernels.neighbours import exchange, line, measure_edges, write_mirror
from echelon.kernels.scalar import Node, needed
from echelon.kernels.usual import usual, whole
from echelon.kernels.vector_ir import Emitter, Writer, number


def program(plan: Plan) -> str:
    """Return a kernel as text for LLVM."""
    w, numbers, plan = Writer(plan.bits, plan.lanes), shared(plan), apart(plan)
    w.label("entry")
    slots = dict[str, str]()
    for place, name in enumerate(SLOTS):
        at = w.put(f"getelementptr i64, ptr %slots, i64 {place}")
        slots[name] = w.put(f"load {'ptr' if place < ADDRESSES else 'i64'}, ptr {at}")
    last = w.put(f"add i64 {slots['first_step']}, {slots['steps']}")
    if numbers:
        _share(w, plan, slots, numbers, last)
    with loop(w, "0", slots["groups"], []) as (group, _, _):
        _steps(w, plan, _group(w, plan, slots, group), last, len(numbers))
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
    end = w.put(f"getelementptr i64, ptr {slots['segments']}, i64 {slots['levels']}")
    blocks = w.put(f"load i64, ptr {end}")
    agents = w.put(f"mul i64 {group}, {blocks}")
    edges = w.put(f"mul i64 {group}, {slots['edge_blocks']}")
    sizes = {"rows": plan.rows * plan.lanes, "mirror": plan.mirror, "next_mirror": plan.mirror}
    found = {name: (agents, size) for name, size in sizes.items()}
    found["edges"] = edges, (len(plan.edges) + 2) * plan.lanes
    own = dict[str, str]()
    for name, (count, size) in found.items():
        far = w.put(f"mul i64 {count}, {size}")
        own[name] = w.put(f"getelementptr {w.scalar}, ptr {slots[name]}, i64 {far}")
    return slots | own


def _steps(w: Writer, plan: Plan, slots: dict[str, str], last: str, numbers: int) -> None:
    """Write all steps of a group."""
    mirrors = [("ptr", slots["mirror"]), ("ptr", slots["next_mirror"])]
    with loop(w, slots["first_step"], last, mirrors) as (step, carried, following):
        passed = w.put(f"sub i64 {step}, {slots['first_step']}")
        if plan.backward:
            passed = w.put(f"sub i64 {w.put(f'sub i64 {last}, {step}')}, 1")
            step = w.put(f"add i64 {slots['first_step']}, {passed}")
        row = w.put(f"mul i64 {passed}, {numbers}")
        common = w.put(f"getelementptr {w.scalar}, ptr {slots['common']}, i64 {row}")
        tape = tape_at(w, slots, passed) if plan.taped else ""
        around = Context(plan, slots, carried[0], carried[1], step, "", common, tape)
        if plan.edges:
            measure_edges(w, around)
        _levels(w, around, passed)
        following[:] = [carried[1], carried[0]]


def _levels(w: Writer, around: Context, passed: str) -> None:
    """Write what all agents do in a step: leaders first, or on the way back last."""
    plan, levels = around.plan, around.slots["levels"]
    if not plan.backward:
        _level(w, around, plan.first, passed, "0")
    with loop(w, "1", levels, []) as (k, _, _):
        level = w.put(f"sub i64 {levels}, {k}") if plan.backward else k
        _level(w, around, plan.others, passed, level)
    if plan.backward:
        _level(w, around, plan.first, passed, "0")


def _level(w: Writer, around: Context, body: Body, passed: str, level: str) -> None:
    """Write what the agents of a level do, and that threads wait for each other after it."""
    with _blocks(w, around, level) as block:
        _act(w, around, body, block)
    _meet(w, around, passed, level)


@contextlib.contextmanager
def _blocks(w: Writer, around: Context, level: str) -> Iterator[str]:
    """Write the loop over the blocks of a level."""
    places = (
        w.put(f"getelementptr i64, ptr {around.slots[name]}, i64 {level}")
        for name in ("starts", "ends")
    )
    start, end = (w.put(f"load i64, ptr {place}") for place in places)
    with loop(w, start, end, []) as (block, _, _):
        yield block


_TURNS = 1_000
"""That a thread waits before it leaves the processor: another may need it to come here."""


def _meet(w: Writer, around: Context, passed: str, level: str) -> None:
    """Write that a thread waits until all have come here."""
    slots = around.slots
    alone = w.put(f"icmp eq i64 {slots['threads']}, 1")
    come, turn, here = (w.fresh(stem) for stem in ("come", "turn", "here"))
    w.do(f"br i1 {alone}, label %{here}, label %{come}")
    w.label(come)
    # They come once a level and step, and none goes on before all came: a count says which it is.
    before = w.put(f"mul i64 {passed}, {slots['levels']}")
    number = w.put(f"add i64 {w.put(f'add i64 {before}, {level}')}, 1")
    wanted = w.put(f"mul i64 {number}, {slots['threads']}")
    w.put(f"atomicrmw add ptr {slots['met']}, i64 1 acq_rel")
    turns, more = "%" + w.fresh("t"), "%" + w.fresh("t")
    w.do(f"br label %{turn}")
    w.label(turn)
    rested = w.fresh("rested")
    w.do(f"{turns} = phi i64 [ 0, %{come} ], [ {more}, %{rested} ]")
    w.do(f"{more} = add i64 {turns}, 1")
    seen = w.put(f"load atomic i64, ptr {slots['met']} acquire, align 8")
    all_ = w.put(f"icmp sge i64 {seen}, {wanted}")
    wait, rest = w.fresh("wait"), w.fresh("rest")
    w.do(f"br i1 {all_}, label %{here}, label %{wait}")
    w.label(wait)
    tired = w.put(f"icmp sgt i64 {turns}, {_TURNS}")
    w.do(f"br i1 {tired}, label %{rest}, label %{rested}")
    w.label(rest)
    w.put(f"call i32 {slots['rest']}()")
    w.do(f"br label %{rested}")
    w.label(rested)
    w.do(f"br label %{turn}")
    w.label(here)


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

    usually = usual(all_, choices(body.results()))
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


def _load(w: Writer, around: Context, block: str, base: str, kind: str, rest: Sequence[int]) -> str:
    """Write the load of what a body rests on, sums over neighbours apart."""
    plan = around.plan
    if kind == "row":
        return load_row(w, base, rest[0], plan.lanes)
    if kind == "told":
        start, row = around.slots["rows"], plan.tell + rest[0]
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
            if op == "add" and node.op == "constant" and node.value == 0.0:
                continue
            both = [load_row(w, base, row, lanes), emitter.value(node)]
            store_row(w, base, row, lanes, w.operation(op, both, False, False))


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
    if plan.lines and which == "leaders":
        start, offset = line(w, around, row), 0
    first = w.put(f"mul i64 {block}, {plan.lanes}")
    if not one:
        return gather(w, start, load_places(w, places, first), offset)
    place = w.put(f"load i32, ptr {places}, align 4")
    far = w.put(f"sext i32 {place} to i64")
    far = w.put(f"add i64 {far}, {offset}")
    at = w.put(f"getelementptr {w.scalar}, ptr {start}, i64 {far}")
    return w.splat(w.put(f"load {w.scalar}, ptr {at}"))
