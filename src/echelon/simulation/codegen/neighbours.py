"""What neighbours read of an agent, and what each computes from it: sums over the edges.

A difference of angles is the shorter way round, and plain for small angles. Where neighbours read
whole vectors of an agent, the last entry is a flag: 0 if all angles of the agent are small, NaN if
one is not. The sum of its differences then tells whether the sums of plain differences are correct.
"""

import math
from collections.abc import Callable, Sequence

from echelon.simulation.codegen.emitter import Emitter
from echelon.simulation.codegen.kernel_plan import SHIFTED, Body, Context, Plan, stride
from echelon.simulation.codegen.letters import link_mail
from echelon.simulation.codegen.vector_ir import (
    Writer,
    either,
    flag,
    gather,
    listed_block,
    load_places,
    loop,
    only_if,
)
from echelon.simulation.scalars import Node, needed, rewritten


def exchange(
    w: Writer,
    context: Context,
    body: Body,
    block: str,
    entries: Sequence[int],
    load: Callable[[Node], str],
) -> dict[int, str]:
    """Write the sums over the neighbours, slot by slot: the k-th neighbour of each agent."""
    plan, slots = context.plan, context.slots
    at = w.at("i64", slots["neighbour_starts"], block)
    after = w.at("i64", at, 1)
    ends = w.load("i64", at), w.load("i64", after)
    first = w.put(f"mul i64 {block}, {plan.lanes}")
    plain = 0.0 not in plain_limits(plan).values()
    some = _AT_ONCE if plain else len(entries)

    def add_up(contiguous: bool, shifts: Sequence[int] = ()) -> list[str]:
        totals = list[str]()
        for part in (entries[k : k + some] for k in range(0, len(entries), some)):
            differences = [body.difference[k] for k in part]
            leaves = [n for n in needed(differences) if n.op == "leaf" and n.value[0] == "self"]
            shown = {leaf: body.mirror_before[leaf.value[1]] for leaf in leaves}
            mine: dict[Node | int, str] = {**_own_entries(w, context, shown, block, load)}
            if shifts:
                totals += _shifted_sums(w, context, block, ends[0], differences, mine)
            else:
                totals += _sums(w, context, ends, differences, mine, contiguous)
        return totals

    def add_up_listed() -> list[str]:
        return either(w, flag(w, slots["contiguous"], block), add_up)

    if plan.row_major and plan.shifts and not plan.letters:
        kind = w.load("i8", slots["contiguous"], block)
        usual = w.put(f"icmp eq i8 {kind}, {SHIFTED}")
        totals = either(w, usual, lambda so: add_up(so, plan.shifts) if so else add_up_listed())
    elif plan.row_major and not plan.letters:
        totals = add_up_listed()
    elif plan.batched or plan.letters or not plain:
        totals = add_up(False)
    elif not (has_flag(plan) or plan.leaders_ahead):
        totals = _subtract(w, context, ends, first, entries)
    else:
        last = [plan.width - 1] * has_flag(plan)
        sums = _subtract(w, context, ends, first, [*entries, *last])
        small = "true"
        if last:
            large = w.put(f"fcmp une {w.vector} {sums.pop()}, zeroinitializer")
            small = w.put(f"xor i1 {w.any_lane(large)}, true")
        if plan.leaders_ahead:
            small = w.put(f"and i1 {small}, {flag(w, slots['contiguous'], block)}")
        totals = either(w, small, lambda small: sums if small else add_up(False))
    return dict(zip(entries, totals, strict=True))


_AT_ONCE = 6
"""Entries that are added up at once, if none depends on another: so many stay in registers."""


def _sums(
    w: Writer,
    context: Context,
    ends: tuple[str, str],
    differences: Sequence[Node],
    mine: dict[Node | int, str],
    contiguous: bool,
) -> list[str]:
    entries = _read_entries(differences)
    zero = [(w.vector, "zeroinitializer")] * len(differences)
    with loop(w, *ends, zero) as (slot, totals, following):
        if context.plan.letters:
            mail = link_mail(w, context, slot)
            theirs = {k: w.load_row(mail, k) for k in entries}
        else:
            theirs = _listed_entries(w, context, "neighbours", slot, entries, contiguous)
        following[:] = _added(w, context, slot, differences, mine | theirs, totals)
    return totals


def _shifted_sums(
    w: Writer,
    context: Context,
    block: str,
    first_slot: str,
    differences: Sequence[Node],
    mine: dict[Node | int, str],
) -> list[str]:
    """Write the same without a loop where each neighbour is as far away as in most blocks."""
    totals = ["zeroinitializer"] * len(differences)
    here = w.put(f"mul i64 {block}, {w.lanes}")
    for number, shift in enumerate(context.plan.shifts):
        place = w.put(f"add i64 {here}, {shift}")
        theirs = {k: _row_part(w, context, k, place) for k in _read_entries(differences)}
        slot = w.put(f"add i64 {first_slot}, {number}")
        totals = _added(w, context, slot, differences, mine | theirs, totals)
    return totals


def _read_entries(differences: Sequence[Node]) -> list[int]:
    leaves = [n for n in needed(differences) if n.op == "leaf"]
    return sorted({n.value[1] for n in leaves if n.value[0] in ("neighbour", "link")})


def _added(
    w: Writer,
    context: Context,
    slot: str,
    differences: Sequence[Node],
    values: dict[Node | int, str],
    totals: Sequence[str],
) -> list[str]:

    emitter = Emitter(w, _reader(w, context, values))
    emitter.emit(differences)
    read = [emitter.value(node) for node in differences]
    if context.plan.weighted:
        place = w.put(f"mul i64 {slot}, {w.lanes}")
        weight = w.load(w.vector, context.slots["weights"], place)
        read = [w.operation("mul", [value, weight]) for value in read]
    return [w.operation("add", list(pair)) for pair in zip(totals, read, strict=True)]


def _reader(w: Writer, context: Context, values: dict[Node | int, str]) -> Callable[[Node], str]:
    """Return what loads the leaves of a difference."""

    def load(leaf: Node) -> str:
        kind, k = leaf.value
        if kind == "uniform":
            return w.load(w.scalar, context.uniform_values, k)
        return values[leaf if kind == "self" else k]

    return load


def _row_part(w: Writer, context: Context, row: int, place: str) -> str:
    # Aligned for a number only: the first one is in any lane.
    at = mirror_row(w, context, row, place)
    return w.put(f"load {w.vector}, ptr {at}, align {w.bits // 8}")


def _own_entries(
    w: Writer, context: Context, shown: dict[Node, Node], block: str, load: Callable[[Node], str]
) -> dict[Node, str]:
    letters = context.plan.letters is not None
    if context.plan.batched and not letters:
        start = w.part(context.mirror, block, context.plan.mirror)
        return {leaf: w.load_row(start, leaf.value[1]) for leaf in shown}
    if context.plan.row_major and not letters:
        first = w.put(f"mul i64 {block}, {w.lanes}")
        return {
            leaf: w.load(w.vector, mirror_row(w, context, leaf.value[1], first), 0)
            for leaf in shown
        }
    emitter = Emitter(w, load)
    emitter.emit(list(shown.values()))
    return {leaf: emitter.value(node) for leaf, node in shown.items()}


def _listed_entries(
    w: Writer,
    context: Context,
    which: str,
    slot: str,
    entries: Sequence[int],
    contiguous: bool,
) -> dict[int, str]:
    """In a row-major mirror the places follow each other if they are contiguous."""
    plan, slots = context.plan, context.slots
    if plan.batched:
        there = listed_block(w, slots[which], slot, context.mirror)
        return {k: w.load_row(there, k) for k in entries}
    first = w.put(f"mul i64 {slot}, {w.lanes}")
    at = w.at("i32", slots[which], first)
    if plan.row_major and contiguous:
        place = w.load_place(at)
        return {k: _row_part(w, context, k, place) for k in entries}
    if plan.row_major:
        places = load_places(w, slots[which], first)
        addresses = ((k, mirror_row(w, context, k)) for k in entries)
        return {k: gather(w, a, _with_leaders(w, context, k, places), 0) for k, a in addresses}
    others = [_neighbour_at(w, context, at, lane, plan.leaders_ahead) for lane in range(w.lanes)]
    vectors, four = dict[int, str](), f"<4 x {w.scalar}>"
    for piece in sorted({k // 4 for k in entries}):
        # A gather of one number a lane would cost more than transposing rows, four by four.
        rows = [
            _joined(w, [w.load(four, other, 4 * piece) for other in others[j::4]]) for j in range(4)
        ]
        vectors |= enumerate(transposed(w, rows), 4 * piece)
    return vectors


def mirror_row(w: Writer, context: Context, row: int, place: str = "0", start: str = "") -> str:
    """Write the address of a place in a row of a row-major mirror."""
    begin = w.part(start or context.mirror, context.slots["row_stride"], row)
    return w.at(w.scalar, begin, place)


def leader_row(w: Writer, context: Context, row: int) -> str:
    """Write the address of a row of what leaders ahead showed."""
    return w.part(context.leader_mirror, context.leader_count, row)


def _with_leaders(w: Writer, context: Context, row: int, places: str) -> str:
    """Write the places in a row of a mirror; those of leaders ahead are where these are stored."""
    if not context.plan.leaders_ahead:
        return places
    rows = leader_row(w, context, row), mirror_row(w, context, row)
    there, here = (w.put(f"ptrtoint ptr {at} to i64") for at in rows)
    shift = 3 if w.bits == 64 else 2
    far = w.put(f"ashr exact i64 {w.put(f'sub i64 {there}, {here}')}, {shift}")
    kind = f"<{w.lanes} x i64>"
    leads = w.put(f"icmp slt {kind} {places}, {w.splat(context.leader_count, 'i64')}")
    moved = w.put(f"add {kind} {places}, {w.splat(far, 'i64')}")
    return w.put(f"select {w.kind(True, False)} {leads}, {kind} {moved}, {kind} {places}")


def _joined(w: Writer, parts: Sequence[str]) -> str:
    size = w.lanes // len(parts)
    while len(parts) > 1:
        order = ", ".join(f"i32 {k}" for k in range(2 * size))
        kind = f"<{size} x {w.scalar}>"
        parts = [
            w.put(f"shufflevector {kind} {a}, {kind} {b}, <{2 * size} x i32> <{order}>")
            for a, b in zip(parts[::2], parts[1::2], strict=True)
        ]
        size *= 2
    return parts[0]


# ---- plain differences ---------------------------------------------------------------------------


def _subtract(
    w: Writer, context: Context, ends: tuple[str, str], first: str, entries: Sequence[int]
) -> list[str]:
    """Write the sums of plain differences, agent by agent: their numbers are in whole vectors."""
    plan, lanes = context.plan, w.lanes
    pieces = sorted({k // lanes for k in entries})
    start = w.part(context.mirror, first, stride(plan.width, lanes))
    # So many agents at once that their numbers and sums stay in registers.
    some = max(1, 8 // 2 ** (len(pieces) - 1).bit_length())
    totals, vectors = dict[tuple[int, int], str](), dict[int, str]()
    for agent in range(0, lanes, some):
        places = [(lane, piece) for lane in range(agent, agent + some) for piece in pieces]
        totals |= zip(places, _subtract_some(w, context, ends, start, places), strict=True)
    for piece in pieces:
        rows = [totals[lane, piece] for lane in range(lanes)]
        vectors |= enumerate(transposed(w, rows), piece * lanes)
    return [vectors[k] for k in entries]


def _subtract_some(
    w: Writer,
    context: Context,
    ends: tuple[str, str],
    start: str,
    places: Sequence[tuple[int, int]],
) -> list[str]:
    """Write the sums of some agents' whole vectors: (lane, piece) each."""
    far, weighted = stride(context.plan.width, w.lanes), context.plan.weighted
    mine = [w.load(w.vector, start, lane * far + piece * w.lanes) for lane, piece in places]
    zero = [(w.vector, "zeroinitializer")] * len(places)
    with loop(w, *ends, zero) as (slot, totals, following):
        place = w.put(f"mul i64 {slot}, {w.lanes}")
        at = w.at("i32", context.slots["neighbours"], place)
        at_weights = w.at(w.scalar, context.slots["weights"], place)
        lanes = dict.fromkeys(lane for lane, _ in places)
        others = {lane: _neighbour_at(w, context, at, lane) for lane in lanes}
        weights = {lane: w.splat(w.load(w.scalar, at_weights, lane)) for lane in lanes if weighted}
        for k, (lane, piece) in enumerate(places):
            their = w.load(w.vector, others[lane], piece * w.lanes)
            difference = w.operation("sub", [mine[k], their])
            if weighted:
                difference = w.operation("mul", [difference, weights[lane]])
            following[k] = w.operation("add", [totals[k], difference])
    return totals


def _neighbour_at(
    w: Writer, context: Context, places: str, lane: int, leaders_ahead: bool = False
) -> str:
    start = context.mirror
    if leaders_ahead:
        place = w.load_place(places, lane)
        end = w.put(f"mul i64 {context.leader_count}, {stride(context.plan.width, w.lanes)}")
        leads = w.put(f"icmp slt i64 {place}, {end}")
        start = w.put(f"select i1 {leads}, ptr {context.leader_mirror}, ptr {start}")
    return listed_block(w, places, str(lane), start)


def write_mirror(w: Writer, context: Context, values: Sequence[str], block: str) -> None:
    """Write what neighbours will read: of formations row by row, else agent after agent."""
    plan, lanes, far = context.plan, w.lanes, stride(context.plan.width, w.lanes)
    if plan.row_major:
        first = w.put(f"mul i64 {block}, {lanes}")
        for k, value in enumerate(values):
            w.store(w.vector, value, mirror_row(w, context, k, first, context.next_mirror))
        return
    start = w.part(context.next_mirror, block, plan.mirror)
    if plan.batched:
        for k, value in enumerate(values):
            w.store_row(value, start, k)
        return
    shown = [*values, *([angle_flag(w, plan, values)] if has_flag(plan) else [])]
    padded = [*shown, *["zeroinitializer"] * (far - len(shown))]
    for piece in range(0, far, lanes):
        for lane, column in enumerate(transposed(w, padded[piece : piece + lanes])):
            w.store(w.vector, column, start, lane * far + piece)


def transposed(w: Writer, rows: Sequence[str]) -> list[str]:
    """Write the transposes of squares side by side in some vectors, in log2 of them stages."""
    lanes, rows = w.lanes, list(rows)
    distance = 1
    while distance < len(rows):
        mixed = list(rows)
        for k in range(len(rows)):
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
    return w.put(f"shufflevector {w.vector} {a}, {w.vector} {b}, <{w.lanes} x i32> <{places}>")


def measure_edges(w: Writer, context: Context, start: str, end: str) -> None:
    """Write the loop that adds up by how much distances along edges differ from their goals'."""
    plan, slots, axes = context.plan, context.slots, context.plan.edges
    read = [*axes, *plan.goals]
    with loop(w, start, end) as (block, _, _):
        base = w.part(slots["edges"], block, (len(axes) + 2) * plan.lanes)
        ends = _ends(w, context, block, read)
        squares = desired = "zeroinitializer"
        for k in range(len(axes)):
            difference = w.operation("sub", ends[2 * k : 2 * k + 2])
            if plan.goals:
                far = 2 * (k + len(axes))
                goal = w.operation("sub", ends[far : far + 2])
                difference = w.operation("add", [difference, goal])
                desired = w.operation("add", [desired, w.operation("mul", [goal, goal])])
            elif plan.apart:
                difference = w.operation("add", [difference, w.load_row(base, k)])
            square = w.operation("mul", [difference, difference])
            squares = w.operation("add", [squares, square])
        if plan.goals or plan.apart:
            goal = w.load_row(base, len(axes))
            desired = w.operation("sqrt", [desired]) if plan.goals else goal
            error = w.operation("sub", [w.operation("sqrt", [squares]), desired])
            squares = w.operation("mul", [error, error])
        total = w.load_row(base, len(axes) + 1)
        w.store_row(w.operation("add", [total, squares]), base, len(axes) + 1)


def _ends(w: Writer, context: Context, block: str, entries: Sequence[int]) -> list[str]:
    """Write the loads of what both ends of a block of edges show, entry by entry."""
    plan, slots = context.plan, context.slots
    first = w.put(f"mul i64 {block}, 2")
    second = w.put(f"add i64 {first}, 1")

    def read(contiguous: bool, pair: tuple[str, str] = (first, second)) -> list[str]:
        ends = [_listed_entries(w, context, "edge_ends", k, entries, contiguous) for k in pair]
        return [end[entry] for entry in entries for end in ends]

    def read_listed() -> list[str]:
        return either(w, flag(w, slots["contiguous_edges"], block), read)

    def read_shifted() -> list[str]:
        here = w.put(f"mul i64 {block}, {w.lanes}")
        places = [w.put(f"add i64 {here}, {shift}") for shift in plan.edge_shifts]
        return [_row_part(w, context, entry, place) for entry in entries for place in places]

    if plan.row_major and plan.edge_shifts:
        kind = w.load("i8", slots["contiguous_edges"], block)
        usual = w.put(f"icmp eq i8 {kind}, {SHIFTED}")
        return either(w, usual, lambda so: read_shifted() if so else read_listed())
    return read_listed() if plan.row_major else read(False)


def measure_pairs(w: Writer, context: Context) -> None:
    """Write the loop that keeps the smallest distances of each two agents of a formation."""
    slots = context.slots
    now = w.splat(w.put(f"sitofp i64 {context.step} to {w.scalar}"))
    with loop(w, "0", slots["pair_count"]) as (pair, _, _):
        first = w.put(f"mul i64 {pair}, 2")
        second = w.put(f"add i64 {first}, 1")
        ends = [listed_block(w, slots["pair_ends"], k, slots["rows"]) for k in (first, second)]
        square = "zeroinitializer"
        for row in context.plan.paired:
            apart = w.operation("sub", [w.load_row(end, row) for end in ends])
            square = w.operation("add", [square, w.operation("mul", [apart, apart])])
        base = w.part(slots["pairs"], pair, 2 * w.lanes)
        least = w.load_row(base, 0)
        # Not of NaN.
        closer = w.put(f"fcmp olt {w.vector} {square}, {least}")
        with only_if(w, w.put(f"zext i1 {w.any_lane(closer)} to i64")):
            truths = w.kind(True, False)
            for row, value in enumerate((square, now)):
                sides = f"{w.vector} {value}, {w.vector} {w.load_row(base, row)}"
                w.store_row(w.put(f"select {truths} {closer}, {sides}"), base, row)


# ---- differences of angles -----------------------------------------------------------------------


def plain_limits(plan: Plan) -> dict[int, float]:
    """Return for each entry up to which size of both numbers its difference is plain."""
    return {k: _limit(k, node) for k, node in enumerate(plan.others.difference)}


def _limit(k: int, node: Node) -> float:
    bounds = [math.inf]

    def without_turns(node: Node, args: Sequence[Node]) -> float | None:
        if node.op != "rint" or args[0].op != "mul":
            return None
        one, other = args[0].args
        size, rest = (one, other) if one.op == "constant" else (other, one)
        if size.op != "constant" or not _is_plain(k, rest):
            return None
        # Rounded to the nearest whole number: below a half there are no turns to subtract.
        bounds.append(0.249 / abs(size.value))
        return 0.0

    result = rewritten([node], without_turns)[node]
    return min(bounds) if _is_plain(k, result) else 0.0


def _is_plain(k: int, node: Node) -> bool:
    leaves = [a.value for a in node.args if a.op == "leaf"]
    return node.op == "sub" and leaves == [("self", k), ("neighbour", k)]


def has_flag(plan: Plan) -> bool:
    """Tell whether agents show a flag for large angles."""
    limits = [] if plan.batched or plan.row_major else [*plain_limits(plan).values()]
    return any(map(math.isfinite, limits)) and 0.0 not in limits


def angle_flag(w: Writer, plan: Plan, values: Sequence[str]) -> str:
    """Write what is 0 if all angles are small, and NaN if one is not."""
    truths, large = w.kind(True, False), ""
    for k, limit in plain_limits(plan).items():
        if math.isfinite(limit):
            size = w.operation("abs", [values[k]])
            beyond = w.put(f"fcmp ugt {w.vector} {size}, {w.number(limit)}")
            large = w.put(f"or {truths} {large}, {beyond}") if large else beyond
    nan = w.number(math.nan)
    return w.put(f"select {truths} {large}, {w.vector} {nan}, {w.vector} zeroinitializer")
