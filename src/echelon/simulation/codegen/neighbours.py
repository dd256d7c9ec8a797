"""What neighbours read of an agent, and what each makes of it: sums over the edges."""

from collections.abc import Callable, Sequence

from echelon.simulation.codegen.angle_differences import largeness, limits, winds, zeros
from echelon.simulation.codegen.ir_blocks import (
    Body,
    Context,
    bytes_of,
    either,
    far_block,
    flag,
    gather,
    load_places,
    load_row,
    loop,
    store_row,
    stride,
)
from echelon.simulation.codegen.vector_ir import Emitter, Writer
from echelon.simulation.scalars.scalar_graph import Node, needed


def exchange(
    w: Writer,
    around: Context,
    body: Body,
    block: str,
    heard: Sequence[int],
    load: Callable[[Node], str],
) -> dict[int, str]:
    """Write the sums over the neighbours, slot by slot: the k-th neighbour of each agent."""
    plan, slots = around.plan, around.slots
    at = w.put(f"getelementptr i64, ptr {slots['neighbour_starts']}, i64 {block}")
    after = w.put(f"getelementptr i64, ptr {at}, i64 1")
    start, end = (w.put(f"load i64, ptr {place}") for place in (at, after))
    first = w.put(f"mul i64 {block}, {plan.lanes}")
    alone = 0.0 not in limits(plan).values()
    some = _AT_ONCE if alone else len(heard)

    def add_up(smooth: bool) -> list[str]:
        found = list[str]()
        for part in (heard[k : k + some] for k in range(0, len(heard), some)):
            wanted = [body.difference[k] for k in part]
            leaves = [n for n in needed(wanted) if n.op == "leaf" and n.value[0] == "own"]
            own = {leaf: body.now[leaf.value[1]] for leaf in leaves}
            mine = _own(w, around, own, block, load)
            found += _sums(w, around, (start, end), wanted, mine, smooth)
        return found

    if plan.lines:
        totals = either(w, flag(w, slots["smooth"], block), add_up)
    elif plan.together or not alone:
        totals = add_up(False)
    elif not (winds(plan) or plan.ahead):
        totals = _subtract(w, around, (start, end), first, heard)
    else:
        last = [plan.width - 1] * winds(plan)
        sums = _subtract(w, around, (start, end), first, [*heard, *last])
        plain = zeros(w, sums.pop()) if last else "true"
        if plan.ahead:
            plain = w.put(f"and i1 {plain}, {flag(w, slots['smooth'], block)}")
        totals = either(w, plain, lambda plain: sums if plain else add_up(False))
    return dict(zip(heard, totals, strict=True))


_AT_ONCE = 6
"""Entries that are added up at once, where none rests on another: so many stay in registers."""


def _sums(
    w: Writer,
    around: Context,
    slots: tuple[str, str],
    wanted: Sequence[Node],
    mine: dict[Node, str],
    smooth: bool,
) -> list[str]:
    """Write the sums of some entries of the difference over the neighbours."""
    plan = around.plan
    leaves = [n for n in needed(wanted) if n.op == "leaf"]
    entries = sorted({n.value[1] for n in leaves if n.value[0] == "their"})
    zero = [(w.vector, "zeroinitializer")] * len(wanted)
    with loop(w, *slots, zero) as (slot, totals, on):
        place = w.put(f"mul i64 {slot}, {plan.lanes}")
        theirs = _shown(w, around, "neighbours", slot, entries, smooth)

        def entry_of(leaf: Node) -> str:
            return mine[leaf] if leaf.value[0] == "own" else theirs[leaf.value[1]]

        emitter = Emitter(w, entry_of)
        emitter.emit(wanted)
        weight = None
        if plan.weighted:
            at = w.put(f"getelementptr {w.scalar}, ptr {around.slots['weights']}, i64 {place}")
            weight = w.put(f"load {w.vector}, ptr {at}, align {plan.lanes * bytes_of(w)}")
        for k, node in enumerate(wanted):
            value = emitter.value(node)
            if weight is not None:
                value = w.put(f"fmul {w.vector} {value}, {weight}")
            on[k] = w.put(f"fadd {w.vector} {totals[k]}, {value}")
    return totals


def _own(
    w: Writer, around: Context, own: dict[Node, Node], block: str, load: Callable[[Node], str]
) -> dict[Node, str]:
    """Write what the agents of a block show themselves: leaf -> a vector."""
    if around.plan.together:
        begin = w.put(f"mul i64 {block}, {around.plan.mirror}")
        start = w.put(f"getelementptr {w.scalar}, ptr {around.mirror}, i64 {begin}")
        return {leaf: load_row(w, start, leaf.value[1], w.lanes) for leaf in own}
    if around.plan.lines:
        first = w.put(f"mul i64 {block}, {w.lanes}")
        return {leaf: _load_at(w, line(w, around, leaf.value[1], first), 0) for leaf in own}
    emitter = Emitter(w, load)
    emitter.emit(list(own.values()))
    return {leaf: emitter.value(node) for leaf, node in own.items()}


def _shown(
    w: Writer, around: Context, which: str, slot: str, entries: Sequence[int], smooth: bool
) -> dict[int, str]:
    """Write the load of what some agents show, whose places stand in a list: entry -> a vector.

    In lines they follow each other if they are smooth.
    """
    if around.plan.together:
        there = far_block(w, around.slots[which], slot, around.mirror)
        return {k: load_row(w, there, k, w.lanes) for k in entries}
    first = w.put(f"mul i64 {slot}, {w.lanes}")
    at = w.put(f"getelementptr i32, ptr {around.slots[which]}, i64 {first}")
    if around.plan.lines and smooth:
        place = w.put(f"sext i32 {w.put(f'load i32, ptr {at}, align 4')} to i64")
        return {
            k: w.put(f"load {w.vector}, ptr {line(w, around, k, place)}, align {bytes_of(w)}")
            for k in entries
        }
    if around.plan.lines:
        places = load_places(w, around.slots[which], first)
        return {k: gather(w, line(w, around, k), _kept(w, around, k, places), 0) for k in entries}
    others = [_their(w, around, at, lane, around.plan.ahead) for lane in range(w.lanes)]
    found = dict[int, str]()
    for piece in sorted({k // 4 for k in entries}):
        # A gather of one number a lane would cost more than turning rows about, four by four.
        rows = [_joined(w, [_four(w, a, piece) for a in others[j::4]]) for j in range(4)]
        found |= enumerate(transposed(w, rows), 4 * piece)
    return found


def led(w: Writer, around: Context, row: int) -> str:
    """Write the address of a row of what leaders ahead show."""
    far = w.put(f"mul i64 {around.led}, {row}")
    return w.put(f"getelementptr {w.scalar}, ptr {around.ahead}, i64 {far}")


def _kept(w: Writer, around: Context, row: int, places: str) -> str:
    """Write the places in a row of a mirror, of leaders ahead where they are kept."""
    if not around.plan.ahead:
        return places
    there, here = (
        w.put(f"ptrtoint ptr {at} to i64") for at in (led(w, around, row), line(w, around, row))
    )
    shift = 3 if w.bits == 64 else 2
    far = w.put(f"ashr exact i64 {w.put(f'sub i64 {there}, {here}')}, {shift}")
    kind = f"<{w.lanes} x i64>"

    def spread(value: str) -> str:
        first = w.put(f"insertelement {kind} poison, i64 {value}, i32 0")
        zeros = f"<{w.lanes} x i32> zeroinitializer"
        return w.put(f"shufflevector {kind} {first}, {kind} poison, {zeros}")

    leads = w.put(f"icmp slt {kind} {places}, {spread(around.led)}")
    moved = w.put(f"add {kind} {places}, {spread(far)}")
    return w.put(f"select {w.kind(True, False)} {leads}, {kind} {moved}, {kind} {places}")


def _four(w: Writer, start: str, piece: int) -> str:
    at = w.put(f"getelementptr {w.scalar}, ptr {start}, i64 {4 * piece}")
    return w.put(f"load <4 x {w.scalar}>, ptr {at}, align {4 * bytes_of(w)}")


def _joined(w: Writer, parts: Sequence[str]) -> str:
    """Write short vectors as one."""
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


def line(w: Writer, around: Context, row: int, place: str = "0", start: str = "") -> str:
    """Write the address of a place in a row of a mirror in lines."""
    far = w.put(f"mul i64 {around.slots['line']}, {row}")
    begin = w.put(f"getelementptr {w.scalar}, ptr {start or around.mirror}, i64 {far}")
    return w.put(f"getelementptr {w.scalar}, ptr {begin}, i64 {place}")


def _subtract(
    w: Writer, around: Context, slots: tuple[str, str], first: str, heard: Sequence[int]
) -> list[str]:
    """Write the sums of plain differences, agent by agent: their numbers lie in whole vectors."""
    plan, lanes = around.plan, w.lanes
    pieces = sorted({k // lanes for k in heard})
    far, found = stride(plan.width, lanes), dict[int, str]()
    begin = w.put(f"mul i64 {first}, {far}")
    start = w.put(f"getelementptr {w.scalar}, ptr {around.mirror}, i64 {begin}")
    # So many agents at once that their numbers and sums stay in registers.
    some = max(1, 8 // 2 ** (len(pieces) - 1).bit_length())
    totals = dict[tuple[int, int], str]()
    for agent in range(0, lanes, some):
        places = [(lane, piece) for lane in range(agent, agent + some) for piece in pieces]
        totals |= zip(places, _subtract_some(w, around, slots, start, places), strict=True)
    for piece in pieces:
        rows = [totals[lane, piece] for lane in range(lanes)]
        found |= enumerate(transposed(w, rows), piece * lanes)
    return [found[k] for k in heard]


def _subtract_some(
    w: Writer,
    around: Context,
    slots: tuple[str, str],
    start: str,
    places: Sequence[tuple[int, int]],
) -> list[str]:
    """Write the sums of some agents' whole vectors: (lane, piece) each."""
    far = stride(around.plan.width, w.lanes)
    own = [_load_at(w, start, lane * far + piece * w.lanes) for lane, piece in places]
    zero = [(w.vector, "zeroinitializer")] * len(places)
    with loop(w, *slots, zero) as (slot, totals, on):
        place = w.put(f"mul i64 {slot}, {w.lanes}")
        at = w.put(f"getelementptr i32, ptr {around.slots['neighbours']}, i64 {place}")
        heavy = w.put(f"getelementptr {w.scalar}, ptr {around.slots['weights']}, i64 {place}")
        lanes = dict.fromkeys(lane for lane, _ in places)
        others = {lane: _their(w, around, at, lane) for lane in lanes}
        weighted = around.plan.weighted
        weights = {lane: _weight(w, heavy, lane) for lane in lanes if weighted}
        for k, (lane, piece) in enumerate(places):
            their = _load_at(w, others[lane], piece * w.lanes)
            away = w.operation("sub", [own[k], their], False, False)
            if weighted:
                away = w.operation("mul", [away, weights[lane]], False, False)
            on[k] = w.operation("add", [totals[k], away], False, False)
    return totals


def _their(w: Writer, around: Context, places: str, lane: int, ahead: bool = False) -> str:
    """Write the address of what a lane's neighbour shows, who may be a leader ahead."""
    start = around.mirror
    if ahead:
        at = w.put(f"getelementptr i32, ptr {places}, i64 {lane}")
        place = w.put(f"sext i32 {w.put(f'load i32, ptr {at}, align 4')} to i64")
        end = w.put(f"mul i64 {around.led}, {stride(around.plan.width, w.lanes)}")
        leads = w.put(f"icmp slt i64 {place}, {end}")
        start = w.put(f"select i1 {leads}, ptr {around.ahead}, ptr {start}")
    return far_block(w, places, str(lane), start)


def _weight(w: Writer, weights: str, lane: int) -> str:
    at = w.put(f"getelementptr {w.scalar}, ptr {weights}, i64 {lane}")
    return w.splat(w.put(f"load {w.scalar}, ptr {at}"))


def _load_at(w: Writer, start: str, place: int) -> str:
    at = w.put(f"getelementptr {w.scalar}, ptr {start}, i64 {place}")
    return w.put(f"load {w.vector}, ptr {at}, align {w.lanes * bytes_of(w)}")


def write_mirror(w: Writer, around: Context, values: Sequence[str], block: str) -> None:
    """Write what neighbours will read: of formations row by row, else agent after agent."""
    lanes, far = w.lanes, stride(around.plan.width, w.lanes)
    if around.plan.lines:
        first = w.put(f"mul i64 {block}, {lanes}")
        for k, value in enumerate(values):
            at = line(w, around, k, first, around.following)
            w.do(f"store {w.vector} {value}, ptr {at}, align {lanes * bytes_of(w)}")
        return
    begin = w.put(f"mul i64 {block}, {around.plan.mirror}")
    start = w.put(f"getelementptr {w.scalar}, ptr {around.following}, i64 {begin}")
    if around.plan.together:
        for k, value in enumerate(values):
            store_row(w, start, k, lanes, value)
        return
    shown = [*values, *([largeness(w, around.plan, values)] if winds(around.plan) else [])]
    padded = [*shown, *["zeroinitializer"] * (far - len(shown))]
    for piece in range(0, far, lanes):
        for lane, column in enumerate(transposed(w, padded[piece : piece + lanes])):
            at = w.put(f"getelementptr {w.scalar}, ptr {start}, i64 {lane * far + piece}")
            w.do(f"store {w.vector} {column}, ptr {at}, align {lanes * bytes_of(w)}")


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


def measure_edges(w: Writer, around: Context, start: str, end: str) -> None:
    """Write the loop that adds up how far distances along edges are from those of the formation.

    A block of edges has the differences of their goals, row by row, the distances that these make,
    and the sums.
    """
    plan, slots = around.plan, around.slots
    axes = plan.edges
    size = (len(axes) + 2) * plan.lanes
    with loop(w, start, end, []) as (block, _, _):
        begin = w.put(f"mul i64 {block}, {size}")
        base = w.put(f"getelementptr {w.scalar}, ptr {slots['edges']}, i64 {begin}")
        first = w.put(f"mul i64 {block}, 2")
        second = w.put(f"add i64 {first}, 1")

        def ends(smooth: bool, pair: tuple[str, str] = (first, second)) -> list[str]:
            found = [_shown(w, around, "edge_ends", end, axes, smooth) for end in pair]
            return [end[axis] for axis in axes for end in found]

        smooth = slots["smooth_edges"]
        found = either(w, flag(w, smooth, block), ends) if plan.lines else ends(False)
        squares = "zeroinitializer"
        for k in range(len(axes)):
            apart = w.operation("sub", found[2 * k : 2 * k + 2], False, False)
            apart = w.operation("add", [apart, load_row(w, base, k, plan.lanes)], False, False)
            square = w.operation("mul", [apart, apart], False, False)
            squares = w.operation("add", [squares, square], False, False)
        distance = w.operation("sqrt", [squares], False, False)
        wanted = load_row(w, base, len(axes), plan.lanes)
        off = w.operation("sub", [distance, wanted], False, False)
        square = w.operation("mul", [off, off], False, False)
        total = load_row(w, base, len(axes) + 1, plan.lanes)
        total = w.put(f"fadd {w.vector} {total}, {square}")
        store_row(w, base, len(axes) + 1, plan.lanes, total)
