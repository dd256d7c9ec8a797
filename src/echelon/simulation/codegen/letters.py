"""Letters that take time: they are stored, and come to their receivers by a table of the host."""

from collections.abc import Sequence

from echelon.simulation.codegen.kernel_plan import Context, Letters
from echelon.simulation.codegen.vector_ir import Writer, gather, load_places, loop, only_if


def part_of_group(w: Writer, letters: Letters, slots: dict[str, str], group: str) -> dict[str, str]:
    """Write where the letters of a group of formations are."""
    lanes, links = w.lanes, w.load("i64", slots["neighbour_starts"], slots["blocks"])
    ring = w.put(f"mul i64 {slots['blocks']}, {letters.slots * letters.size * lanes}")
    mail = w.put(f"mul i64 {links}, {len(letters.kept) * lanes}")
    both = w.put(f"add i64 {links}, {slots['blocks']}")
    both = w.put(f"mul i64 {both}, {lanes}")
    parts = {
        "ring": w.part(slots["ring"], group, ring),
        "mail": w.part(slots["mail"], group, mail),
        "arrivals": w.part(slots["arrivals"], group, both, "i32"),
        "links": links,
    }
    return parts | ({"weights": w.part(slots["weights"], group, both)} if letters.chosen else {})


def at_step(w: Writer, context: Context, passed: str) -> Context:
    """Write which letters arrive at a step, whether some are sent, and how much each counts."""
    slots, letters = context.slots, context.plan.letters
    assert letters is not None
    arrivals = w.part(slots["arrivals"], passed, slots["arrivals_step"], "i32")
    sends = w.load("i64", w.at("i64", slots["sends"], passed))
    if letters.chosen:
        slots = slots | {"weights": w.part(slots["weights"], passed, slots["weights_step"])}
    return context._replace(arrivals=arrivals, sends=sends, slots=slots)


def uses_none(w: Writer, context: Context, block: str) -> str:
    """Write the load of 1 for the agents of a block that use no letter, 0 for the others."""
    place = w.put(f"add i64 {context.slots['links']}, {block}")
    place = w.put(f"mul i64 {place}, {w.lanes}")
    return w.load(w.vector, context.slots["weights"], place)


def take(w: Writer, context: Context, block: str, base: str) -> None:
    """Write what the agents of a block keep of the letters that arrive."""
    letters, slots = context.plan.letters, context.slots
    assert letters is not None
    at = w.at("i64", slots["neighbour_starts"], block)
    ends = w.load("i64", at), w.load("i64", w.at("i64", at, 1))
    with loop(w, *ends) as (slot, _, _):
        mail = link_mail(w, context, slot)
        _keep(w, context, slot, mail, dict(enumerate(letters.kept)))
    place = w.put(f"add i64 {slots['links']}, {block}")
    packet = range(letters.value, letters.size - 1)
    _keep(w, context, place, base, dict(zip(letters.packet, packet, strict=True)))


def link_mail(w: Writer, context: Context, slot: str) -> str:
    """Write the address of what is kept of the last letters of a slot."""
    letters = context.plan.letters
    assert letters is not None
    return w.part(context.slots["mail"], slot, len(letters.kept) * w.lanes)


def _keep(w: Writer, context: Context, place: str, base: str, numbers: dict[int, int]) -> None:
    """Write that rows from an address on become the numbers of letters, where these arrive."""
    truths, kind = w.kind(True, False), f"<{w.lanes} x i64>"
    first = w.put(f"mul i64 {place}, {w.lanes}")
    places = load_places(w, context.arrivals, first)
    new = w.put(f"icmp sge {kind} {places}, zeroinitializer")
    with only_if(w, w.put(f"zext i1 {w.any_lane(new)} to i64")):
        there = w.put(f"select {truths} {new}, {kind} {places}, {kind} zeroinitializer")
        for row, number in numbers.items():
            value = gather(w, context.slots["ring"], there, number * w.lanes)
            sides = f"{w.vector} {value}, {w.vector} {w.load_row(base, row)}"
            w.store_row(w.put(f"select {truths} {new}, {sides}"), base, row)


def send(w: Writer, context: Context, block: str, values: Sequence[str]) -> None:
    """Write that the agents of a block send letters, if it is a step in which they do."""
    letters = context.plan.letters
    assert letters is not None
    with only_if(w, w.put(f"add i64 {context.sends}, 1")):
        row = w.put(f"mul i64 {context.sends}, {context.slots['blocks']}")
        place = w.put(f"add i64 {row}, {block}")
        start = w.part(context.slots["ring"], place, letters.size * w.lanes)
        for k, value in enumerate(values):
            w.store_row(value, start, k)
