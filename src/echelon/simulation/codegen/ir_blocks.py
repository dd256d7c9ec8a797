"""Control flow and memory access that kernels are written with: loops, choices, addresses."""

import contextlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from types import MappingProxyType
from typing import NamedTuple

from echelon.simulation.codegen.kernel_plan import Plan
from echelon.simulation.codegen.vector_ir import Writer


class Context(NamedTuple):
    """The plan of a kernel, and names of addresses and numbers in its text.

    Attributes:
        plan: of the kernel.
        slots: name of a slot -> its value.
        mirror: what neighbours read at this step.
        next_mirror: what they read after it.
        step: the number of the step.
        table: this step's numbers in the table.
        uniform_values: this step's numbers that are the same for all agents.
        leader_mirror: what leaders ahead showed at this step.
        leader_messages: what they sent at this step.
        leader_count: the positions of leaders.
        tape: this step's part of the tape.
        at_hand: place of a number that is the same for all agents -> the number, loaded before.
    """

    plan: Plan
    slots: dict[str, str]
    mirror: str
    next_mirror: str
    step: str
    table: str
    uniform_values: str
    leader_mirror: str = ""
    leader_messages: str = ""
    leader_count: str = ""
    tape: str = ""
    at_hand: Mapping[int, str] = MappingProxyType({})


@contextlib.contextmanager
def loop(
    w: Writer, start: str, end: str, carried: Sequence[tuple[str, str]] = ()
) -> Iterator[tuple[str, list[str], list[str]]]:
    """Write a loop; yield its index, its carried values, and a list for their next values.

    After the loop the carried values are in the same list.
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
    following = list(names)
    yield index, names, following
    final, latch = w.put(f"add i64 {index}, 1"), w.fresh("latch")
    w.do(f"br label %{latch}")
    w.label(latch)
    w.do(f"br label %{head}")
    values = [("i64", start), *carried], [index, *names], [final, *following]
    for k, ((kind, first), name, new) in enumerate(zip(*values, strict=True)):
        w.lines[place + k] = f"  {name} = phi {kind} [ {first}, %{before} ], [ {new}, %{latch} ]"
    w.label(after)


@contextlib.contextmanager
def only_if(w: Writer, condition: str) -> Iterator[None]:
    """Write what is done only if a whole number is not 0."""
    some = w.put(f"icmp ne i64 {condition}, 0")
    then, after = w.fresh("then"), w.fresh("done")
    w.do(f"br i1 {some}, label %{then}, label %{after}")
    w.label(then)
    yield
    w.do(f"br label %{after}")
    w.label(after)


def flag(w: Writer, truths: str, place: str) -> str:
    """Write the load of a truth from a list of bytes."""
    return w.put(f"icmp ne i8 {w.load('i8', truths, place)}, 0")


def either(w: Writer, which: str, write: Callable[[bool], Sequence[str]]) -> list[str]:
    """Write vectors in one of two ways, by a truth."""
    labels, after = {True: w.fresh("so"), False: w.fresh("else")}, w.fresh("both")
    w.do(f"br i1 {which}, label %{labels[True]}, label %{labels[False]}")
    vectors, ends = dict[bool, Sequence[str]](), dict[bool, str]()
    for way, label in labels.items():
        w.label(label)
        vectors[way], ends[way] = write(way), w.fresh("end")
        w.do(f"br label %{ends[way]}")
        w.label(ends[way])
        w.do(f"br label %{after}")
    w.label(after)
    pairs = zip(vectors[True], vectors[False], strict=True)
    return [
        w.put(f"phi {w.vector} [ {a}, %{ends[True]} ], [ {b}, %{ends[False]} ]") for a, b in pairs
    ]


def listed_block(w: Writer, places: str, k: str, start: str) -> str:
    """Write the address of a block whose distance from a start is entry k of a list."""
    return w.at(w.scalar, start, w.load_place(places, k))


def load_places(w: Writer, start: str, first: str) -> str:
    """Write the load of whole numbers of 32 bits, one a lane, as 64 bits."""
    places = w.load(f"<{w.lanes} x i32>", start, first)
    return w.put(f"sext <{w.lanes} x i32> {places} to <{w.lanes} x i64>")


def gather(w: Writer, start: str, places: str, offset: int) -> str:
    """Write the load of one number a lane, at `places` after a start and an offset."""
    at = w.at(w.scalar, start, offset)
    lanes, name = w.lanes, f"llvm.masked.gather.v{w.lanes}f{w.bits}.v{w.lanes}p0"
    truths = f"<{lanes} x i1>"
    w.declare(w.vector, name, f"<{lanes} x ptr>", "i32", truths, w.vector)
    pointers = w.put(f"getelementptr {w.scalar}, ptr {at}, <{lanes} x i64> {places}")
    return w.put(
        f"call {w.vector} @{name}(<{lanes} x ptr> {pointers}, i32 {w.bits // 8}, "
        f"{truths} splat (i1 true), {w.vector} poison)"
    )
