"""The text of a kernel: loops over steps, blocks of agents, their neighbours and their edges.

Agents are stored in blocks of as many as a vector has lanes. A block holds its numbers row by row,
so that one address reaches all of them. What neighbours read of an agent is stored separately and
twice, as it is and as it will be after the step, one agent after the other: a neighbour is
anywhere, and its numbers are together. If a vector holds one agent of many formations, a neighbour
is another vector: what it shows is stored row by row, and each group of formations takes all its
steps before the next one, so that it stays in the nearest cache.
"""

import contextlib
import platform
from collections.abc import Iterator, Sequence

from echelon.simulation.codegen.emitter import Emitter, find_fast_path, general_case, large_choices
from echelon.simulation.codegen.kernel_plan import (
    ADDRESSES,
    ANNOUNCE,
    NO_MINIMUM,
    PRIOR,
    SLOTS,
    TASK,
    Body,
    Context,
    Plan,
)
from echelon.simulation.codegen.letters import at_step, part_of_group, send, take, uses_none
from echelon.simulation.codegen.neighbours import (
    exchange,
    leader_row,
    measure_edges,
    measure_pairs,
    mirror_row,
    write_mirror,
)
from echelon.simulation.codegen.scheduling import fuse, separate_uniform, shared
from echelon.simulation.codegen.vector_ir import (
    Writer,
    gather,
    listed_block,
    load_places,
    loop,
    only_if,
)
from echelon.simulation.scalars import Node, needed


def program(plan: Plan) -> str:
    """Return a kernel as text for LLVM."""
    w, numbers, plan = Writer(plan.bits, plan.lanes), shared(plan), separate_uniform(plan)
    plan = plan._replace(**{name: fuse(body) for name, body in plan.bodies.items()})
    w.label("entry")
    slots = dict[str, str]()
    for place, name in enumerate(SLOTS):
        kind = "ptr" if place < ADDRESSES else "i64"
        slots[name] = w.load(kind, w.at("i64", "%slots", place))
    last = w.put(f"add i64 {slots['first_step']}, {slots['steps']}")
    if numbers:
        _write_uniform(w, plan, slots, numbers, last)
    with loop(w, "0", slots["groups"]) as (group, _, _):
        _tasks(w, plan, _group(w, plan, slots, group), len(numbers))
    w.do("ret void")
    head = "define internal void @steps(ptr noalias %slots) #0 {"
    # 512 bits also where a processor prefers halves: the vector types are chosen on purpose.
    width = '"prefer-vector-width"="512"'
    attributes = f"attributes #0 = {{ nounwind noinline {width} {_ATTRIBUTES} }}"
    # The weights of a branch that is hardly ever taken.
    unlikely = '!0 = !{!"branch_weights", i32 1, i32 1000}'
    parts = [*sorted(w.declared), "", head, *w.lines, "}", "", _RUN]
    return "\n".join([*parts, "", attributes, unlikely, ""])


def _write_uniform(
    w: Writer, plan: Plan, slots: dict[str, str], numbers: Sequence[Node], last: str
) -> None:
    with loop(w, slots["first_step"], last) as (step, _, _):
        passed = w.put(f"sub i64 {step}, {slots['first_step']}")
        table = w.part(slots["table"], passed, plan.table)
        values = w.part(slots["uniform_values"], passed, len(numbers))
        context = Context(plan, slots, "", "", step, table, values)
        complete = general_case(numbers)
        numbers = [complete[node] for node in numbers]
        emitter = Emitter(w, lambda leaf: _load_uniform(w, context, *leaf.value))
        emitter.emit(numbers)
        for k, node in enumerate(numbers):
            value = emitter.value(node, uniform=True)
            if node.truth:
                value = w.put(f"uitofp i1 {value} to {w.scalar}")
            w.store(w.scalar, value, values, k)


def _group(w: Writer, plan: Plan, slots: dict[str, str], group: str) -> dict[str, str]:
    blocks = w.put(f"mul i64 {group}, {slots['blocks']}")
    edges = w.put(f"mul i64 {group}, {slots['edge_blocks']}")
    parts = {
        "rows": (blocks, plan.rows * plan.lanes),
        "mirror": (blocks, plan.mirror),
        "next_mirror": (blocks, plan.mirror),
        "edges": (edges, (len(plan.edges) + 2) * plan.lanes),
        "tape": (blocks, plan.tape_rows * plan.lanes),
        "ahead": (blocks, plan.given * plan.lanes),
        "pairs": (w.put(f"mul i64 {group}, {slots['pair_count']}"), 2 * plan.lanes),
    }
    own = {name: w.part(slots[name], *part) for name, part in parts.items()}
    if plan.announce:
        own["sources"] = w.part(slots["sources"], blocks, plan.lanes, "i32")
    if plan.letters:
        own |= part_of_group(w, plan.letters, slots, group)
    return slots | own


def _tasks(w: Writer, plan: Plan, slots: dict[str, str], numbers: int) -> None:
    with loop(w, "0", slots["count"]) as (number, _, _):
        first = w.put(f"mul i64 {number}, {len(TASK)}")
        task = {name: w.load("i64", slots["schedule"], first, k) for k, name in enumerate(TASK)}
        wait(w, slots, task["before"], task["after"])
        context = _context(w, plan, slots, task["passed"], numbers)
        _before_all(w, context, task)
        leads = w.put(f"icmp eq i64 {task['level']}, 0")
        lead, follow, done = (w.fresh(stem) for stem in ("lead", "follow", "done"))
        w.do(f"br i1 {leads}, label %{lead}, label %{follow}")
        w.label(lead)
        _lead(w, context, task, done)
        w.label(follow)
        if plan.edges:
            measure_edges(w, context, task["first_edge"], task["last_edge"])
        context = _with_uniform(w, context, plan.others)
        with loop(w, task["start"], task["end"]) as (block, _, _):
            _act(w, context, plan.others, block)
        w.do(f"br label %{done}")
        w.label(done)
        announce(w, slots, number)


def _before_all(w: Writer, context: Context, task: dict[str, str]) -> None:
    """Write the tasks that come before any agent acts; of the others then nothing is left."""
    if context.plan.listens_first:
        _prior(w, context, task)
    if context.plan.announce:
        _announce(w, context, context.plan.announce, task)


def _prior(w: Writer, context: Context, task: dict[str, str]) -> None:
    """Write what all do before any of them acts, if that is the task; then no other is."""
    before = w.put(f"icmp eq i64 {task['level']}, {PRIOR}")
    bound = context.slots["leader_blocks"]
    context = context._replace(next_mirror=context.mirror)
    with only_if(w, w.put(f"zext i1 {before} to i64")):
        least = _least(w, task["end"], bound)
        bodies = context.plan.prior_first, context.plan.prior_others
        for body, start, end in zip(
            bodies, (task["start"], bound), (least, task["end"]), strict=True
        ):
            assert body is not None
            here = _with_uniform(w, context, body)
            with loop(w, start, end) as (block, _, _):
                if context.plan.letters:
                    base = w.part(here.slots["rows"], block, here.plan.rows * here.plan.lanes)
                    take(w, here, block, base)
                _act(w, here, body, block)
    _end_if(w, before, task)


def _announce(w: Writer, context: Context, body: Body, task: dict[str, str]) -> None:
    """Write what leaders announce, if that is the task; then no other is."""
    before = w.put(f"icmp eq i64 {task['level']}, {ANNOUNCE}")
    with only_if(w, w.put(f"zext i1 {before} to i64")):
        here = _with_uniform(w, context, body)
        with loop(w, task["start"], task["end"]) as (block, _, _):
            _act(w, here, body, block)
    _end_if(w, before, task)


def _end_if(w: Writer, done: str, task: dict[str, str]) -> None:
    """Write that a task has no blocks left if it is done."""
    for name in ("start", "end", "first_edge", "last_edge"):
        task[name] = w.put(f"select i1 {done}, i64 0, i64 {task[name]}")


def _least(w: Writer, a: str, b: str) -> str:
    return w.put(f"select i1 {w.put(f'icmp slt i64 {a}, {b}')}, i64 {a}, i64 {b}")


def _context(w: Writer, plan: Plan, slots: dict[str, str], passed: str, numbers: int) -> Context:
    step = w.put(f"add i64 {slots['first_step']}, {passed}")
    odd = w.put(f"trunc i64 {passed} to i1")
    mirror, next_mirror = (
        w.put(f"select i1 {odd}, ptr {slots[a]}, ptr {slots[b]}")
        for a, b in (("next_mirror", "mirror"), ("mirror", "next_mirror"))
    )
    stored = w.put(f"icmp eq i64 {step}, {slots['input_step']}")
    stored = w.put(f"zext i1 {stored} to i64")
    values = w.part(slots["uniform_values"], passed, numbers)
    tape = w.part(slots["tape"], passed, slots["tape_step"]) if plan.tape_rows else ""
    given = w.part(slots["ahead"], passed, slots["ahead_step"]) if plan.given else ""
    slots = slots | {"input_step": stored}
    if plan.listens_first:
        mirror = next_mirror = slots["mirror"]
    context = Context(plan, slots, mirror, next_mirror, step, "", values, tape=tape, given=given)
    if plan.letters:
        return at_step(w, context, passed)
    return _ahead(w, context, passed) if plan.leaders_ahead else context


def _ahead(w: Writer, context: Context, passed: str) -> Context:
    """Write where a step is of what leaders ahead show and send."""
    plan, slots = context.plan, context.slots
    blocks, each = slots["leader_blocks"], plan.message_size * plan.lanes
    sizes = [w.put(f"mul i64 {blocks}, {n}") for n in (plan.mirror, each)]
    names = "leader_mirrors", "leader_messages"
    mirror, messages = (w.part(slots[k], passed, n) for k, n in zip(names, sizes, strict=True))
    count = w.put(f"mul i64 {blocks}, {plan.lanes}")
    return context._replace(leader_mirror=mirror, leader_messages=messages, leader_count=count)


_AT_HAND = 12
"""Numbers that are the same for all agents and stay in registers while a task is done."""


def _with_uniform(w: Writer, context: Context, body: Body) -> Context:
    """In the loop, LLVM would load it again after every store, which might change it."""
    leaves = [n for n in needed(body.results()) if n.op == "leaf" and n.value[0] == "uniform"]
    values = {n.value[1]: _load_uniform(w, context, *n.value) for n in leaves[:_AT_HAND]}
    return context._replace(at_hand=values)


def _lead(w: Writer, context: Context, task: dict[str, str], done: str) -> None:
    """Write what the leaders do in a step, up to a label; those ahead store it for the others."""
    plan, slots = context.plan, context.slots
    if plan.paired:
        measure_pairs(w, context)
    if plan.leaders_ahead:
        after = w.part(context.leader_mirror, slots["leader_blocks"], plan.mirror)
        slots = slots | {"row_stride": context.leader_count}
        context = context._replace(next_mirror=after, slots=slots)
    with loop(w, task["start"], task["end"]) as (block, _, _):
        _act(w, context, plan.first, block)
        if plan.leaders_ahead:
            base = w.part(slots["rows"], block, plan.rows * plan.lanes)
            messages = w.part(context.leader_messages, block, plan.message_size * plan.lanes)
            for k in range(plan.message_size):
                w.store_row(w.load_row(base, plan.message_start + k), messages, k)
    w.do(f"br label %{done}")


def _act(w: Writer, context: Context, body: Body, block: str) -> None:
    """Write what the agents of a block do: the fast path, and the general case it falls back to."""
    nodes = body.all()
    base = w.part(context.slots["rows"], block, context.plan.rows * context.plan.lanes)
    general = body.map_nodes(general_case(nodes))
    entries = sorted(
        n.value[1] for n in needed(general.results()) if n.op == "leaf" and n.value[0] == "z"
    )

    def load_row(leaf: Node) -> str:
        return w.load_row(base, leaf.value[1])

    z = exchange(w, context, general, block, entries, load_row) if entries else {}

    def load(leaf: Node) -> str:
        kind, *rest = leaf.value
        if kind == "z":
            return z[rest[0]]
        return _load(w, context, block, base, kind, rest)

    # Without the differences, whose sums are computed before.
    nodes = [*body.results(), *body.mirror_before]
    fast = find_fast_path(nodes, [*large_choices(body.results()), *_new_minima(body)])
    done, otherwise = w.fresh("done"), w.fresh("otherwise")
    if fast.levels:
        emitter = Emitter(w, load)
        simple = body.map_nodes(fast.nodes)
        emitter.emit_fast(simple.results(), fast.levels, otherwise)
        _write(w, context, simple, emitter, base, block)
        w.do(f"br label %{done}")
        w.label(otherwise)
    emitter = Emitter(w, load)
    emitter.emit(general.results())
    _write(w, context, general, emitter, base, block)
    if fast.levels:
        w.do(f"br label %{done}")
        w.label(done)


def _new_minima(body: Body) -> list[tuple[Node, bool]]:
    """Return the truths by which a minimum may become smaller, which is unlikely."""
    minima = (node for node in body.minima.values() if node.op == "select")
    return [(node.args[0], True) for node in minima if _has_no_effect("min", node.args[2])]


def _has_no_effect(op: str, node: Node) -> bool:
    neutral = {"add": 0.0, "min": NO_MINIMUM}.get(op)
    return neutral is not None and node is node.graph.constant(neutral)


def _load(
    w: Writer, context: Context, block: str, base: str, kind: str, rest: Sequence[int]
) -> str:
    plan = context.plan
    if kind == "row":
        return w.load_row(base, rest[0])
    if kind == "ahead":
        return w.load_row(w.part(context.given, block, plan.given * plan.lanes), rest[0])
    if kind == "alone":
        return uses_none(w, context, block)
    if kind == "message":
        start, row = context.slots["rows"], plan.message_start + rest[0]
        if plan.leaders_ahead:
            start, row = context.leader_messages, rest[0]
        return _look_up(w, context, "sources", start, row, block, plan.one_source)
    if kind == "leader":
        return _look_up(w, context, "leaders", context.mirror, rest[0], block, plan.one_leader)
    return _load_uniform(w, context, kind, *rest)


def _write(
    w: Writer, context: Context, body: Body, emitter: Emitter, base: str, block: str
) -> None:
    for row, node in body.stores.items():
        w.store_row(emitter.value(node), base, row)
    with only_if(w, context.slots["input_step"]):
        for row, node in body.on_request.items():
            w.store_row(emitter.value(node), base, row)
    for results, op in ((body.sums, "add"), (body.minima, "min")):
        for row, node in results.items():
            if _has_no_effect(op, node):
                continue
            with _if_effective(w, emitter, op, node) as value:
                w.store_row(w.operation(op, [w.load_row(base, row), value]), base, row)
    _note_exceptions(w, context.plan.exception_row, body, emitter, base)
    if body.mirror:
        write_mirror(w, context, [emitter.value(node) for node in body.mirror], block)
    if body.letter:
        send(w, context, block, [emitter.value(node) for node in body.letter])
    if body.tape:
        _record(w, context, body, emitter, block)


def _record(w: Writer, context: Context, body: Body, emitter: Emitter, block: str) -> None:
    with only_if(w, w.put(f"ptrtoint ptr {context.slots['tape']} to i64")):
        start = w.part(context.tape, block, context.plan.tape_rows * w.lanes)
        for row, node in body.tape.items():
            w.store_row(emitter.value(node), start, row)


def _note_exceptions(w: Writer, row: int, body: Body, emitter: Emitter, base: str) -> None:
    kind, either = w.kind(True, False), ""
    for node in body.exceptions:
        if node.op != "constant" or node.value:
            truth = emitter.value(node)
            either = w.put(f"or {kind} {either}, {truth}") if either else truth
    if either:
        with only_if(w, w.put(f"zext i1 {w.any_lane(either)} to i64")):
            sides = f"{w.vector} {w.number(1.0)}, {w.vector} {w.load_row(base, row)}"
            w.store_row(w.put(f"select {kind} {either}, {sides}"), base, row)


@contextlib.contextmanager
def _if_effective(w: Writer, emitter: Emitter, op: str, node: Node) -> Iterator[str]:
    if node.op == "select" and node.args[0].uniform:
        which, *sides = node.args
        for k, side in enumerate(sides):
            if _has_no_effect(op, side):
                condition = emitter.value(which, uniform=True)
                condition = w.put(f"xor i1 {condition}, true") if k == 0 else condition
                value = emitter.value(sides[1 - k])
                with only_if(w, w.put(f"zext i1 {condition} to i64")):
                    yield value
                return
    yield emitter.value(node)


def _load_uniform(w: Writer, context: Context, kind: str, *rest: int) -> str:
    if kind == "steady":
        late = w.put(f"icmp sge i64 {context.step}, {context.slots['first_steady']}")
        return w.put(f"uitofp i1 {late} to {w.scalar}")
    if kind == "uniform" and rest[0] in context.at_hand:
        return context.at_hand[rest[0]]
    if kind in ("table", "uniform"):
        start = context.table if kind == "table" else context.uniform_values
        return w.load(w.scalar, start, rest[0])
    assert kind == "step"
    return w.put(f"sitofp i64 {context.step} to {w.scalar}")


def _look_up(
    w: Writer, context: Context, which: str, start: str, row: int, block: str, one: bool
) -> str:
    """Write the load of a number of another agent, whose place is in a list of places."""
    places, plan = context.slots[which], context.plan
    by_lane = which == "sources" and plan.announce is not None
    if plan.batched and not by_lane:
        return w.load_row(listed_block(w, places, block, start), row)
    # Messages are stored in rows, and what neighbours read agent by agent or row-major.
    offset = row * plan.lanes if which == "sources" else row
    if which == "leaders" and plan.leaders_ahead:
        start = context.leader_mirror
    if which == "leaders" and plan.row_major:
        row_of = leader_row if plan.leaders_ahead else mirror_row
        start, offset = row_of(w, context, row), 0
    first = w.put(f"mul i64 {block}, {plan.lanes}")
    if not one:
        return gather(w, start, load_places(w, places, first), offset)
    far = w.put(f"add i64 {w.load_place(places)}, {offset}")
    return w.splat(w.load(w.scalar, start, far))


# ---- how threads that share the steps wait for each other ----------------------------------------

_SPINS = 1_000
"""Rounds that a thread waits before it yields the processor, which the other may need."""
_APART = 8
"""Numbers between two counts: each has its own cache line, because another thread writes it."""


def wait(w: Writer, slots: dict[str, str], before: str, after: str) -> None:
    """Write that a thread waits until the others have finished so many tasks."""
    several = w.put(f"icmp sgt i64 {slots['threads']}, 1")
    with only_if(w, w.put(f"zext i1 {several} to i64")):
        with loop(w, "0", slots["threads"]) as (other, _, _):
            lower = w.put(f"icmp slt i64 {other}, {slots['thread']}")
            count = w.put(f"select i1 {lower}, i64 {before}, i64 {after}")
            itself = w.put(f"icmp eq i64 {other}, {slots['thread']}")
            # It need not wait for itself.
            _wait_for(w, slots, other, w.put(f"select i1 {itself}, i64 0, i64 {count}"))


def _wait_for(w: Writer, slots: dict[str, str], other: str, count: str) -> None:
    at = w.part(slots["progress"], other, _APART, "i64")
    start, turn, here = (w.fresh(stem) for stem in ("start", "turn", "here"))
    w.do(f"br label %{start}")
    w.label(start)
    w.do(f"br label %{turn}")
    spins, more = "%" + w.fresh("t"), "%" + w.fresh("t")
    w.label(turn)
    rested = w.fresh("rested")
    w.do(f"{spins} = phi i64 [ 0, %{start} ], [ {more}, %{rested} ]")
    w.do(f"{more} = add i64 {spins}, 1")
    finished = w.put(f"load atomic i64, ptr {at} acquire, align 8")
    enough = w.put(f"icmp sge i64 {finished}, {count}")
    again, rest = w.fresh("wait"), w.fresh("rest")
    w.do(f"br i1 {enough}, label %{here}, label %{again}")
    w.label(again)
    long = w.put(f"icmp sgt i64 {spins}, {_SPINS}")
    w.do(f"br i1 {long}, label %{rest}, label %{rested}")
    w.label(rest)
    w.put(f"call i32 {slots['yield_processor']}()")
    w.do(f"br label %{rested}")
    w.label(rested)
    w.do(f"br label %{turn}")
    w.label(here)


def announce(w: Writer, slots: dict[str, str], task: str) -> None:
    """Write that a thread lets the others know that it has finished a task."""
    several = w.put(f"icmp sgt i64 {slots['threads']}, 1")
    with only_if(w, w.put(f"zext i1 {several} to i64")):
        at = w.part(slots["progress"], slots["thread"], _APART, "i64")
        count = w.put(f"add i64 {task}, 1")
        w.do(f"store atomic i64 {count}, ptr {at} release, align 8")


_X86 = """\
declare void @llvm.x86.sse.stmxcsr(ptr)
declare void @llvm.x86.sse.ldmxcsr(ptr)
define void @run(ptr noalias %slots) nounwind {
  %old = alloca i32
  %new = alloca i32
  call void @llvm.x86.sse.stmxcsr(ptr %old)
  %before = load i32, ptr %old
  %within = or i32 %before, 32832 ; flush to zero, denormals are zero
  store i32 %within, ptr %new
  call void @llvm.x86.sse.ldmxcsr(ptr %new)
  call void @steps(ptr %slots)
  call void @llvm.x86.sse.ldmxcsr(ptr %old)
  ret void
}"""
_ARM = """\
declare i64 @llvm.aarch64.get.fpcr()
declare void @llvm.aarch64.set.fpcr(i64)
define void @run(ptr noalias %slots) nounwind {
  %before = call i64 @llvm.aarch64.get.fpcr()
  %within = or i64 %before, 16777216 ; flush to zero
  call void @llvm.aarch64.set.fpcr(i64 %within)
  call void @steps(ptr %slots)
  call void @llvm.aarch64.set.fpcr(i64 %before)
  ret void
}"""
_OTHER = """\
define void @run(ptr noalias %slots) nounwind {
  call void @steps(ptr %slots)
  ret void
}"""
_RUNS = {"x86_64": _X86, "AMD64": _X86, "aarch64": _ARM, "arm64": _ARM}
_RUN = _RUNS.get(platform.machine(), _OTHER)
"""The function `run`, which calls `steps`, as LLVM moves arithmetic over neither end of a call.

Denormal numbers are 0 in it, in operands and in results, as in JAX: an operation with one takes a
hundred times as long. Each thread sets its processor's register so, and puts it back at the end."""

_ATTRIBUTES = " ".join(
    f'"denormal-fp-math{suffix}"="preserve-sign,preserve-sign"' for suffix in ("", "-f32")
)
"""What LLVM must know to fold constants as the processor would."""
