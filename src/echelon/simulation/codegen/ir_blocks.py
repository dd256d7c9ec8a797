"""What the loops of a kernel are made of: what is written of it, loops, loads and stores."""

import contextlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from types import MappingProxyType
from typing import NamedTuple

from echelon.simulation.codegen.vector_ir import Writer
from echelon.simulation.scalars.scalar_graph import Node, needed

NO_NEWS = 2**31 - 1
"""The least that a row keeps where it keeps none: no step has that number."""


class Body(NamedTuple):
    """What some of the agents do in a step; the same code for all of them.

    A leaf is ("row", r), ("z", k), ("told", k), ("leader", k), ("own", k), ("their", k), on the way
    back ("tape", r) and ("fed", k), or, the same for all, ("time",), ("step",), ("steady",),
    ("table", c).

    Attributes:
        stores: row -> what it becomes.
        sums: row -> what is added to it.
        greatest: row -> a value; the row keeps the largest that it ever was.
        least: row -> a value; the row keeps the smallest, from `NO_NEWS` on.
        shown: row -> what it becomes where `shown` is asked for, since every store costs time.
        now: what neighbours read at the step, entry by entry.
        mirror: what they read after it.
        difference: of what stands in the leaves `own` and `their`, entry by entry; z_k is the
            weighted sum of entry k over the neighbours.
        tape: row of the tape -> what is kept there of each step, where it is asked for.
        totals: place -> what is added up there over all agents and steps.
        to_sources: what is added to the `fed` of who told an agent what it was told, from 0 on.
        to_leaders: what is added to the `fed` of its leader, behind that.
    """

    stores: dict[int, Node]
    sums: dict[int, Node]
    greatest: dict[int, Node]
    least: dict[int, Node]
    shown: dict[int, Node]
    now: Sequence[Node]
    mirror: Sequence[Node]
    difference: Sequence[Node]
    tape: Mapping[int, Node] = MappingProxyType({})
    totals: Mapping[int, Node] = MappingProxyType({})
    to_sources: Sequence[Node] = ()
    to_leaders: Sequence[Node] = ()

    def results(self) -> list[Node]:
        """Return all that is written."""
        rows = (self.stores, self.sums, self.greatest, self.least, self.shown)
        listed = (*self.mirror, *self.to_sources, *self.to_leaders)
        kept = (*self.tape.values(), *self.totals.values())
        return [*(node for row in rows for node in row.values()), *listed, *kept]

    def all(self) -> list[Node]:
        """Return all that is written, and what of it is made of what neighbours read."""
        return [*self.results(), *self.now, *self.difference]

    @property
    def hears(self) -> bool:
        """Whether anything rests on what neighbours show."""
        return any(n.op == "leaf" and n.value[0] == "z" for n in needed(self.results()))

    def become(self, made: Mapping[Node, Node]) -> "Body":
        """Return the body whose nodes have become others, where they have."""

        def rows(of: Mapping[int, Node]) -> dict[int, Node]:
            return {row: made.get(node, node) for row, node in of.items()}

        def listed(of: Sequence[Node]) -> list[Node]:
            return [made.get(node, node) for node in of]

        return Body(
            stores=rows(self.stores),
            sums=rows(self.sums),
            greatest=rows(self.greatest),
            least=rows(self.least),
            shown=rows(self.shown),
            now=listed(self.now),
            mirror=listed(self.mirror),
            difference=listed(self.difference),
            tape=rows(self.tape),
            totals=rows(self.totals),
            to_sources=listed(self.to_sources),
            to_leaders=listed(self.to_leaders),
        )


class Plan(NamedTuple):
    """A kernel before it is code.

    Attributes:
        bits: 64 or 32.
        lanes: of a vector.
        together: whether a vector holds one agent of as many formations, which are all alike, and
            not as many agents of one.
        lines: whether what neighbours read of a swarm lies row by row, since most vectors of
            neighbours are agents that follow each other: rings, paths, grids.
        rows: of a block.
        width: numbers that neighbours read of an agent, which stand in whole vectors, with the one
            of `neighbours.winds` where it is true.
        first: the body of those that act first.
        others: the body of all others, level by level.
        tell: the first row of what an agent tells others.
        told: how many rows that is.
        one_source: whether one agent tells all others, so that none needs to be looked up.
        one_leader: whether all have the same leader.
        weighted: whether edges differ in weight from 1.
        edges: which of the numbers that neighbours read make a distance; none for none.
        table: numbers that each step has in the table.
        dt: s.
        ahead: whether the leaders may take many steps before the others take the first, since they
            hear nobody: what they show and tell is kept of each step.
        taped: rows that the tape has of a block at each step.
        backward: whether the steps are taken from the last to the first, the followers before the
            leaders, the deepest level first: for derivatives.
    """

    bits: int
    lanes: int
    together: bool
    lines: bool
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
    ahead: bool = False
    taped: int = 0
    backward: bool = False

    @property
    def mirror(self) -> int:
        """How many numbers neighbours read of a block."""
        in_rows = self.together or self.lines
        return self.lanes * (self.width if in_rows else stride(self.width, self.lanes))


SLOTS = (
    "rows",
    "mirror",
    "next_mirror",
    "table",
    "turns",
    "neighbour_starts",
    "neighbours",
    "weights",
    "sources",
    "leaders",
    "edges",
    "edge_ends",
    "common",
    "smooth",
    "smooth_edges",
    "ahead",
    "told",
    "done",
    "rest",
    "tape",
    "totals",
    "fed",
    "first_step",
    "steps",
    "count",
    "blocks",
    "edge_blocks",
    "first_steady",
    "shown",
    "groups",
    "line",
    "led_blocks",
    "threads",
    "thread",
    "tape_step",
)
"""What a kernel is called with: 22 addresses and 13 whole numbers of 64 bits.

Formations stand in groups of as many as a vector has lanes; `rows`, the mirrors and `edges` are
those of the first of some groups, which have so many `blocks` and `edge_blocks` each. A swarm is
one group. `common` has room for the numbers of `common.shared` at each step. `line` is how many
numbers lie between two rows of a mirror in lines; `smooth` tells of each block, and `smooth_edges`
of each block of edges, whether its others follow each other there, or elsewhere whether no leader
ahead is among them. `ahead` and `told` keep what the leaders in so many blocks show and tell of
each step. Inputs are stored of the step `shown`.

`turns` are `count` rows of `TURN`: blocks of one level and blocks of edges that take a step. Before
it a thread waits for the others: until each before it has done as many turns as `before` says, and
each behind it as many as `after`. `done` counts the turns of each, a line of memory apart, and
`rest` is a function that leaves the processor to others.

`tape` is 0 where none is kept, and `tape_step` how many numbers lie between its steps; `totals` has
a vector for each, and `fed` what was added for each agent.
"""
TURN = ("passed", "level", "start", "end", "first_edge", "last_edge", "before", "after")
"""Of a turn: the steps before it in this call, the level, and where its blocks begin and end."""
ADDRESSES = 22


def stride(width: int, lanes: int) -> int:
    """Return how many numbers lie between two agents for their neighbours."""
    return -(-width // lanes) * lanes


class Context(NamedTuple):
    """Names of what a body finds around it."""

    plan: Plan
    slots: dict[str, str]
    mirror: str
    following: str
    step: str
    table: str
    common: str
    ahead: str = ""
    told: str = ""
    led: str = ""
    tape: str = ""


@contextlib.contextmanager
def loop(
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
def only_if(w: Writer, wanted: str) -> Iterator[None]:
    """Write what is done only where a whole number is not 0."""
    some = w.put(f"icmp ne i64 {wanted}, 0")
    then, after = w.fresh("then"), w.fresh("done")
    w.do(f"br i1 {some}, label %{then}, label %{after}")
    w.label(then)
    yield
    w.do(f"br label %{after}")
    w.label(after)


def flag(w: Writer, truths: str, place: str) -> str:
    """Write the load of a truth from a list of bytes."""
    at = w.put(f"getelementptr i8, ptr {truths}, i64 {place}")
    return w.put(f"icmp ne i8 {w.put(f'load i8, ptr {at}')}, 0")


def either(w: Writer, which: str, makes: Callable[[bool], Sequence[str]]) -> list[str]:
    """Write vectors in one of two ways, by a truth."""
    ways, after = {True: w.fresh("so"), False: w.fresh("else")}, w.fresh("both")
    w.do(f"br i1 {which}, label %{ways[True]}, label %{ways[False]}")
    made, ends = dict[bool, Sequence[str]](), dict[bool, str]()
    for way, label in ways.items():
        w.label(label)
        made[way], ends[way] = makes(way), w.fresh("end")
        w.do(f"br label %{ends[way]}")
        w.label(ends[way])
        w.do(f"br label %{after}")
    w.label(after)
    pairs = zip(made[True], made[False], strict=True)
    return [
        w.put(f"phi {w.vector} [ {a}, %{ends[True]} ], [ {b}, %{ends[False]} ]") for a, b in pairs
    ]


def bytes_of(w: Writer) -> int:
    """Return the bytes of a number."""
    return w.bits // 8


def load_row(w: Writer, base: str, row: int, lanes: int) -> str:
    """Write the load of a row of a block."""
    at = w.put(f"getelementptr {w.scalar}, ptr {base}, i64 {row * lanes}")
    return w.put(f"load {w.vector}, ptr {at}, align {lanes * bytes_of(w)}")


def store_row(w: Writer, base: str, row: int, lanes: int, value: str) -> None:
    """Write the store of a row of a block."""
    at = w.put(f"getelementptr {w.scalar}, ptr {base}, i64 {row * lanes}")
    w.do(f"store {w.vector} {value}, ptr {at}, align {lanes * bytes_of(w)}")


def far_block(w: Writer, places: str, k: str, start: str) -> str:
    """Write the address of a block, of which entry k of a list tells how far it is."""
    at = w.put(f"getelementptr i32, ptr {places}, i64 {k}")
    place = w.put(f"load i32, ptr {at}, align 4")
    far = w.put(f"sext i32 {place} to i64")
    return w.put(f"getelementptr {w.scalar}, ptr {start}, i64 {far}")


def load_places(w: Writer, start: str, first: str) -> str:
    """Write the load of whole numbers of 32 bits, one a lane, as 64 bits."""
    at = w.put(f"getelementptr i32, ptr {start}, i64 {first}")
    found = w.put(f"load <{w.lanes} x i32>, ptr {at}, align 4")
    return w.put(f"sext <{w.lanes} x i32> {found} to <{w.lanes} x i64>")


def gather(w: Writer, start: str, places: str, offset: int) -> str:
    """Write the load of one number a lane, at `places` after a start and an offset."""
    at = w.put(f"getelementptr {w.scalar}, ptr {start}, i64 {offset}")
    lanes, name = w.lanes, f"llvm.masked.gather.v{w.lanes}f{w.bits}.v{w.lanes}p0"
    truths = f"<{lanes} x i1>"
    w.declare(w.vector, name, f"<{lanes} x ptr>", "i32", truths, w.vector)
    all_at = w.put(f"getelementptr {w.scalar}, ptr {at}, <{lanes} x i64> {places}")
    return w.put(
        f"call {w.vector} @{name}(<{lanes} x ptr> {all_at}, i32 {bytes_of(w)}, "
        f"{truths} splat (i1 true), {w.vector} poison)"
    )
