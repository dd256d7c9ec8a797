"""The loops about a body of code: steps, blocks of agents, their neighbours, their edges.

Agents stand in blocks of as many as a vector has lanes. A block holds its numbers row by row, so
that one address reaches all of them. What neighbours read of an agent stands apart and twice, as
it is and as it will be after the step, one agent after the other: a neighbour is anywhere, and its
numbers lie together.
"""

import contextlib
from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

from echelon.kernels.scalar import Node, needed
from echelon.kernels.vector_ir import Emitter, Writer, number


class Body(NamedTuple):
    """What some of the agents do in a step; the same code for all of them.

    A leaf is ("row", r), ("z", k), ("told", k), ("leader", k), ("own", k), ("their", k), or, the
    same for all, ("time",), ("step",), ("steady",), ("table", c).

    Attributes:
        stores: row -> what it becomes.
        sums: row -> what is added to it.
        latest: row -> a value; it becomes the step where the value is true.
        now: what neighbours read at the step, entry by entry.
        mirror: what they read after it.
        difference: of what stands in the leaves `own` and `their`, entry by entry; z_k is the
            weighted sum of entry k over the neighbours.
    """

    stores: dict[int, Node]
    sums: dict[int, Node]
    latest: dict[int, Node]
    now: Sequence[Node]
    mirror: Sequence[Node]
    difference: Sequence[Node]

    def results(self) -> list[Node]:
        """Return all that is written."""
        written = [*self.stores.values(), *self.sums.values(), *self.latest.values()]
        return [*written, *self.mirror]


class Plan(NamedTuple):
    """A kernel before it is code.

    Attributes:
        bits: 64 or 32.
        lanes: of a vector.
        rows: of a block.
        width: numbers that neighbours read of an agent.
        first: the body of those that act first.
        others: the body of all others, level by level.
        tell: the first row of what an agent tells others.
        told: how many rows that is.
        one_source: whether one agent tells all others, so that none needs to be looked up.
        one_leader: whether all have the same leader.
        weighted: whether edges differ in weight from 1.
        edges: which of the numbers that neighbours read make a distance; none are measured if empty.
        table: numbers that each step has in the table.
        dt: s.
    """

    bits: int
    lanes: int
    rows: int
    width: int
    first: Body
    others: Body
    tell: int
    told: int
    one_source: bool
    one_leader: bool
    weighted: bool
    edges: tuple[int, ...]
    table: int
    dt: float


SLOTS = (
    "rows",
    "mirror",
    "next_mirror",
    "table",
    "segments",
    "neighbour_starts",
    "neighbours",
    "weights",
    "sources",
    "leaders",
    "edges",
    "edge_ends",
    "first_step",
    "steps",
    "levels",
    "edge_blocks",
    "first_steady",
)
"""What a kernel is called with: 12 addresses and 5 whole numbers of 64 bits."""
_ADDRESSES = 12


class _Context(NamedTuple):
    """Names of what a body finds around it."""

    plan: Plan
    slots: dict[str, str]
    mirror: str
    following: str
    step: str
    table: str


def program(plan: Plan) -> str:
    """Return a kernel as text for LLVM."""
    w = Writer(plan.bits, plan.lanes)
    w.label("entry")
    slots = dict[str, str]()
    for place, name in enumerate(SLOTS):
        at = w.put(f"getelementptr i64, ptr %slots, i64 {place}")
        slots[name] = w.put(f"load {'ptr' if place < _ADDRESSES else 'i64'}, ptr {at}")
    last = w.put(f"add i64 {slots['first_step']}, {slots['steps']}")
    mirrors = [("ptr", slots["mirror"]), ("ptr", slots["next_mirror"])]
    with _loop(w, slots["first_step"], last, mirrors) as (step, carried, following):
        passed = w.put(f"sub i64 {step}, {slots['first_step']}")
        row = w.put(f"mul i64 {passed}, {plan.table}")
        table = w.put(f"getelementptr {w.scalar}, ptr {slots['table']}, i64 {row}")
        around = _Context(plan, slots, carried[0], carried[1], step, table)
        if plan.edges:
            _measure_edges(w, around)
        with _blocks(w, around, "0") as block:
            _act(w, around, plan.first, block)
        with _loop(w, "1", slots["levels"], []) as (level, _, _):
            with _blocks(w, around, level) as block:
                _act(w, around, plan.others, block)
        following[:] = [carried[1], carried[0]]
    w.do("ret void")
    head = "define void @run(ptr noalias %slots) #0 {"
    # 512 bits also where a processor would rather have halves: the types say what is meant.
    attributes = 'attributes #0 = { nounwind "prefer-vector-width"="512" }'
    return "\n".join([*sorted(w.declared), "", head, *w.lines, "}", "", attributes, ""])


@contextlib.contextmanager
def _loop(
    w: Writer, start: str, end: str, carried: Sequence[tuple[str, str]]
) -> Iterator[tuple[str, list[str], list[str]]]:
    """Write a loop; give its index, what it carries, and a list for what it carries on.

    What it carries is, after the loop, in the same list.
    """
    before, head, body, after = (w.fresh(s) for s in ("before", "head", "body", "after"))
    index = "%" + w.fresh("i")
    names = ["%" + w.fresh("c") for _ in carried]
    w.do(f"br label %{before}")
    w.label(before)
    w.do(f"br label %{head}")
    w.label(head)
    place = len(w.lines)
    w.lines += [""] * (1 + len(carried))
    more = w.put(f"icmp slt i64 {index}, {end}")
    w.do(f"br i1 {more}, label %{body}, label %{after}")
    w.label(body)
    on = list(names)
    yield index, names, on
    final, latch = w.put(f"add i64 {index}, 1"), w.fresh("latch")
    w.do(f"br label %{latch}")
    w.label(latch)
    w.do(f"br label %{head}")
    w.lines[place] = f"  {index} = phi i64 [ {start}, %{before} ], [ {final}, %{latch} ]"
    for k, ((kind, first), name, new) in enumerate(zip(carried, names, on, strict=True), 1):
        w.lines[place + k] = f"  {name} = phi {kind} [ {first}, %{before} ], [ {new}, %{latch} ]"
    w.label(after)


@contextlib.contextmanager
def _blocks(w: Writer, around: _Context, level: str) -> Iterator[str]:
    """Write the loop over the blocks of a level."""
    at = w.put(f"getelementptr i64, ptr {around.slots['segments']}, i64 {level}")
    following = w.put(f"getelementptr i64, ptr {at}, i64 1")
    start, end = (w.put(f"load i64, ptr {place}") for place in (at, following))
    with _loop(w, start, end, []) as (block, _, _):
        yield block


# ---- a body --------------------------------------------------------------------------------------


def _act(w: Writer, around: _Context, body: Body, block: str) -> None:
    """Write what the agents of a block do."""
    plan = around.plan
    size = plan.rows * plan.lanes
    begin = w.put(f"mul i64 {block}, {size}")
    base = w.put(f"getelementptr {w.scalar}, ptr {around.slots['rows']}, i64 {begin}")
    first = w.put(f"mul i64 {block}, {plan.lanes}")
    results = body.results()
    heard = sorted(n.value[1] for n in needed(results) if n.op == "leaf" and n.value[0] == "z")

    def row(leaf: Node) -> str:
        return _load_row(w, base, leaf.value[1], plan.lanes)

    z = _exchange(w, around, body, block, first, heard, row) if heard else {}

    def load(leaf: Node) -> str:
        kind, *rest = leaf.value
        if kind == "z":
            return z[rest[0]]
        if kind == "row":
            return row(leaf)
        if kind == "told":
            start, offset = around.slots["rows"], (plan.tell + rest[0]) * plan.lanes
            return _look_up(w, around, "sources", start, offset, first, plan.one_source)
        if kind == "leader":
            start = around.mirror
            return _look_up(w, around, "leaders", start, rest[0], first, plan.one_leader)
        return _same_for_all(w, around, kind, rest)

    emitter = Emitter(w, load)
    emitter.emit(results)
    _write_rows(w, around, body, emitter, base)
    _write_mirror(w, around, [emitter.value(node) for node in body.mirror], first)


def _write_rows(
    w: Writer, around: _Context, body: Body, emitter: Emitter, base: str
) -> None:
    """Write what a body leaves in the rows of its block."""
    lanes = around.plan.lanes
    for row, node in body.stores.items():
        _store_row(w, base, row, lanes, emitter.value(node))
    for row, node in body.sums.items():
        old = _load_row(w, base, row, lanes)
        total = w.put(f"fadd {w.vector} {old}, {emitter.value(node)}")
        _store_row(w, base, row, lanes, total)
    for row, node in body.latest.items():
        step = w.splat(_same_for_all(w, around, "step", []))
        old, truths = _load_row(w, base, row, lanes), w.kind(True, False)
        which = emitter.value(node)
        new = w.put(f"select {truths} {which}, {w.vector} {step}, {w.vector} {old}")
        _store_row(w, base, row, lanes, new)


def _same_for_all(w: Writer, around: _Context, kind: str, rest: Sequence[int]) -> str:
    """Write a number that all agents have in common."""
    if kind == "steady":
        late = w.put(f"icmp sge i64 {around.step}, {around.slots['first_steady']}")
        return w.put(f"uitofp i1 {late} to {w.scalar}")
    if kind == "table":
        at = w.put(f"getelementptr {w.scalar}, ptr {around.table}, i64 {rest[0]}")
        return w.put(f"load {w.scalar}, ptr {at}")
    step = w.put(f"sitofp i64 {around.step} to {w.scalar}")
    if kind == "step":
        return step
    # From the step number, since a sum of many dt would gather rounding.
    return w.operation("mul", [step, number(around.plan.dt, w.bits)], False, True)


def _bytes(w: Writer) -> int:
    return w.bits // 8


def _load_row(w: Writer, base: str, row: int, lanes: int) -> str:
    at = w.put(f"getelementptr {w.scalar}, ptr {base}, i64 {row * lanes}")
    return w.put(f"load {w.vector}, ptr {at}, align {lanes * _bytes(w)}")


def _store_row(w: Writer, base: str, row: int, lanes: int, value: str) -> None:
    at = w.put(f"getelementptr {w.scalar}, ptr {base}, i64 {row * lanes}")
    w.do(f"store {w.vector} {value}, ptr {at}, align {lanes * _bytes(w)}")


def _load_places(w: Writer, start: str, first: str) -> str:
    """Write the load of whole numbers of 32 bits, one a lane, as 64 bits."""
    at = w.put(f"getelementptr i32, ptr {start}, i64 {first}")
    found = w.put(f"load <{w.lanes} x i32>, ptr {at}, align 4")
    return w.put(f"sext <{w.lanes} x i32> {found} to <{w.lanes} x i64>")


def _gather(w: Writer, start: str, places: str, offset: int) -> str:
    """Write the load of one number a lane, at `places` after a start and an offset."""
    at = w.put(f"getelementptr {w.scalar}, ptr {start}, i64 {offset}")
    lanes, name = w.lanes, f"llvm.masked.gather.v{w.lanes}f{w.bits}.v{w.lanes}p0"
    truths = f"<{lanes} x i1>"
    w.declare(w.vector, name, f"<{lanes} x ptr>", "i32", truths, w.vector)
    all_at = w.put(f"getelementptr {w.scalar}, ptr {at}, <{lanes} x i64> {places}")
    return w.put(
        f"call {w.vector} @{name}(<{lanes} x ptr> {all_at}, i32 {_bytes(w)}, "
        f"{truths} splat (i1 true), {w.vector} poison)"
    )


def _look_up(
    w: Writer, around: _Context, which: str, start: str, offset: int, first: str, one: bool
) -> str:
    """Write the load of what another agent has, whose place is in a list of places."""
    places = around.slots[which]
    if not one:
        return _gather(w, start, _load_places(w, places, first), offset)
    place = w.put(f"load i32, ptr {places}, align 4")
    far = w.put(f"sext i32 {place} to i64")
    far = w.put(f"add i64 {far}, {offset}")
    at = w.put(f"getelementptr {w.scalar}, ptr {start}, i64 {far}")
    return w.splat(w.put(f"load {w.scalar}, ptr {at}"))


# ---- the network ---------------------------------------------------------------------------------


def _exchange(
    w: Writer,
    around: _Context,
    body: Body,
    block: str,
    first: str,
    heard: Sequence[int],
    load_row: Callable[[Node], str],
) -> dict[int, str]:
    """Write the sums over the neighbours, slot by slot: the k-th neighbour of each agent."""
    plan, slots = around.plan, around.slots
    at = w.put(f"getelementptr i64, ptr {slots['neighbour_starts']}, i64 {block}")
    after = w.put(f"getelementptr i64, ptr {at}, i64 1")
    start, end = (w.put(f"load i64, ptr {place}") for place in (at, after))
    wanted = [body.difference[k] for k in heard]
    leaves = [n for n in needed(wanted) if n.op == "leaf"]
    own = {leaf: body.now[leaf.value[1]] for leaf in leaves if leaf.value[0] == "own"}
    mine = Emitter(w, load_row)
    mine.emit(list(own.values()))
    zero = [(w.vector, "zeroinitializer")] * len(heard)
    with _loop(w, start, end, zero) as (slot, totals, on):
        place = w.put(f"mul i64 {slot}, {plan.lanes}")
        places = _load_places(w, slots["neighbours"], place)

        def load(leaf: Node) -> str:
            if leaf in own:
                return mine.value(own[leaf])
            return _gather(w, around.mirror, places, leaf.value[1])

        emitter = Emitter(w, load)
        emitter.emit(wanted)
        weight = None
        if plan.weighted:
            at = w.put(f"getelementptr {w.scalar}, ptr {slots['weights']}, i64 {place}")
            weight = w.put(f"load {w.vector}, ptr {at}, align {plan.lanes * _bytes(w)}")
        for k, node in enumerate(wanted):
            value = emitter.value(node)
            if weight is not None:
                value = w.put(f"fmul contract {w.vector} {value}, {weight}")
            on[k] = w.put(f"fadd contract {w.vector} {totals[k]}, {value}")
    return dict(zip(heard, totals, strict=True))


def _write_mirror(w: Writer, around: _Context, values: Sequence[str], first: str) -> None:
    """Write what neighbours will read, one agent after the other."""
    lanes, width = w.lanes, around.plan.width
    begin = w.put(f"mul i64 {first}, {width}")
    start = w.put(f"getelementptr {w.scalar}, ptr {around.following}, i64 {begin}")
    for block in range(0, width, lanes):
        rows = [values[k] if k < len(values) else "zeroinitializer" for k in range(block, block + lanes)]
        columns = _transposed(w, rows)
        piece = min(lanes, width - block)
        for lane, column in enumerate(columns):
            at = w.put(f"getelementptr {w.scalar}, ptr {start}, i64 {lane * width + block}")
            kept, kind = column, w.vector
            if piece < lanes:
                kind = f"<{piece} x {w.scalar}>"
                order = ", ".join(f"i32 {k}" for k in range(piece))
                kept = w.put(
                    f"shufflevector {w.vector} {column}, {w.vector} poison, <{piece} x i32> <{order}>"
                )
            w.do(f"store {kind} {kept}, ptr {at}, align {_bytes(w)}")


def _transposed(w: Writer, rows: Sequence[str]) -> list[str]:
    """Write the transpose of as many vectors as a vector has lanes, in log2 of them stages."""
    lanes, rows = w.lanes, list(rows)
    distance = 1
    while distance < lanes:
        mixed = list(rows)
        for k in range(lanes):
            if k & distance:
                continue
            a, b = rows[k], rows[k + distance]
            low = [i if not i & distance else lanes + i - distance for i in range(lanes)]
            high = [i + distance if not i & distance else lanes + i for i in range(lanes)]
            mixed[k], mixed[k + distance] = (_shuffle(w, a, b, order) for order in (low, high))
        rows, distance = mixed, 2 * distance
    return rows


def _shuffle(w: Writer, a: str, b: str, order: Sequence[int]) -> str:
    places = ", ".join(f"i32 {k}" for k in order)
    if a == b == "zeroinitializer":
        return a
    return w.put(
        f"shufflevector {w.vector} {a}, {w.vector} {b}, <{w.lanes} x i32> <{places}>"
    )


def _measure_edges(w: Writer, around: _Context) -> None:
    """Write the loop that adds up how far distances along edges are from those of the formation.

    A block of edges has the differences of their goals, row by row, the distances that these make,
    and the sums.
    """
    plan, slots = around.plan, around.slots
    axes = plan.edges
    size = (len(axes) + 2) * plan.lanes
    with _loop(w, "0", slots["edge_blocks"], []) as (block, _, _):
        begin = w.put(f"mul i64 {block}, {size}")
        base = w.put(f"getelementptr {w.scalar}, ptr {slots['edges']}, i64 {begin}")
        first = w.put(f"mul i64 {block}, {2 * plan.lanes}")
        second = w.put(f"add i64 {first}, {plan.lanes}")
        ends = [_load_places(w, slots["edge_ends"], place) for place in (first, second)]
        squares = "zeroinitializer"
        for k, axis in enumerate(axes):
            one, other = (_gather(w, around.mirror, places, axis) for places in ends)
            apart = w.operation("sub", [one, other], False, False)
            apart = w.operation("add", [apart, _load_row(w, base, k, plan.lanes)], False, False)
            square = w.operation("mul", [apart, apart], False, False)
            squares = w.operation("add", [squares, square], False, False)
        distance = w.operation("sqrt", [squares], False, False)
        wanted = _load_row(w, base, len(axes), plan.lanes)
        off = w.operation("sub", [distance, wanted], False, False)
        square = w.operation("mul", [off, off], False, False)
        total = _load_row(w, base, len(axes) + 1, plan.lanes)
        total = w.put(f"fadd {w.vector} {total}, {square}")
        _store_row(w, base, len(axes) + 1, plan.lanes, total)
