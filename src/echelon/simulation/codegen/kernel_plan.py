"""What a kernel computes and what it is called with, before any of it is code."""

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import NamedTuple, TypeAlias

from echelon.simulation.scalars import Node, needed

SHIFTED = 2
"""Of a block in `contiguous`: its neighbours, or ends, are as far away as `Plan.shifts` says."""
NO_MINIMUM = 2**31 - 1
"""The minimum in a row that has none yet: no step has that number."""
_Part: TypeAlias = Mapping[int, Node] | Sequence[Node]
_NONE: Mapping[int, Node] = MappingProxyType({})


class Body(NamedTuple):
    """What some of the agents compute in a step; the same code for all of them.

    A leaf is ("row", r), ("z", k), ("message", k), ("leader", k), ("self", k), ("neighbour", k) or,
    the same for all agents, ("time",), ("step",), ("steady",), ("table", c), ("uniform", k).

    Attributes:
        stores: row -> its new value.
        sums: row -> what is added to it.
        minima: row -> a value; the row keeps the smallest so far, beginning with `NO_MINIMUM`.
        on_request: row -> its new value at the step `input_step` only, since every store costs
            time.
        mirror: what neighbours read after the step, entry by entry.
        tape: row of the tape -> what is recorded there at each step, if a tape is given.
        exceptions: truths; where one holds, the agent's numbers are not what JAX computes.
        mirror_before: what neighbours read at the step, entry by entry.
        difference: of the leaves `self` and `neighbour`, entry by entry; z_k is the weighted sum of
            entry k over the neighbours.
    """

    stores: Mapping[int, Node] = _NONE
    sums: Mapping[int, Node] = _NONE
    minima: Mapping[int, Node] = _NONE
    on_request: Mapping[int, Node] = _NONE
    mirror: Sequence[Node] = ()
    tape: Mapping[int, Node] = _NONE
    exceptions: Sequence[Node] = ()
    # Not written; what is written reads them.
    mirror_before: Sequence[Node] = ()
    difference: Sequence[Node] = ()

    def results(self) -> list[Node]:
        """Return all nodes that are written."""
        return _nodes_in(self[:-2])

    def all(self) -> list[Node]:
        """Return all nodes: those that are written, and those of what neighbours read."""
        return _nodes_in(self)

    @property
    def reads_neighbours(self) -> bool:
        """Whether a result depends on a sum over the neighbours."""
        return any(n.op == "leaf" and n.value[0] == "z" for n in needed(self.results()))

    def map_nodes(self, after: Mapping[Node, Node]) -> "Body":
        """Return the body with some nodes replaced by others."""

        def mapped(part: _Part) -> _Part:
            if isinstance(part, Mapping):
                return {row: after.get(node, node) for row, node in part.items()}
            return [after.get(node, node) for node in part]

        return Body._make(map(mapped, self))


def _nodes_in(parts: Sequence[_Part]) -> list[Node]:
    lists = (part.values() if isinstance(part, Mapping) else part for part in parts)
    return [node for nodes in lists for node in nodes]


class Plan(NamedTuple):
    """A kernel before it is code.

    Attributes:
        bits: 64 or 32.
        lanes: of a vector.
        batched: whether a vector holds one agent of several formations, all alike, and not several
            agents of one formation.
        row_major: whether what neighbours read of a swarm is stored row by row, because most
            vectors of neighbours are agents that follow each other: rings, paths, grids.
        rows: of a block.
        width: numbers that neighbours read of an agent, stored in whole vectors; with the flag of
            `neighbours.has_flag`, if there is one.
        first: the body of the agents that act first.
        others: the body of all others, level by level.
        message_start: the first row of what an agent sends besides its state.
        message_size: how many rows that is.
        one_source: whether one agent sends to all others, so that no sender is looked up.
        one_leader: whether all have the same leader.
        weighted: whether some weight of an edge is not 1.
        shifts: how many positions the neighbours in the slots of most blocks are away, if that is
            known and `row_major`.
        edge_shifts: how many positions the two ends of the edges of most blocks are away.
        edges: entries that neighbours read of which distances are computed; none if no distances
            are.
        apart: whether the goals of some neighbours differ; else distances are their own errors.
        exception_row: becomes 1 where one of `Body.exceptions` holds.
        table: numbers per step in the table.
        dt: s.
        leaders_ahead: whether the leaders may take many steps before the others take the first,
            because they receive nothing: what they send is stored for each step.
        tape_rows: rows per block and step on the tape.
    """

    bits: int
    lanes: int
    batched: bool
    row_major: bool
    rows: int
    width: int
    first: Body
    others: Body
    message_start: int
    message_size: int
    one_source: bool
    one_leader: bool
    weighted: bool
    edges: tuple[int, ...]
    apart: bool
    exception_row: int
    table: int
    dt: float
    shifts: tuple[int, ...] = ()
    edge_shifts: tuple[int, ...] = ()
    leaders_ahead: bool = False
    tape_rows: int = 0

    @property
    def mirror(self) -> int:
        """How many numbers neighbours read of a block."""
        in_rows = self.batched or self.row_major
        return self.lanes * (self.width if in_rows else stride(self.width, self.lanes))


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


SLOTS = (
    "rows",
    "mirror",
    "next_mirror",
    "table",
    "schedule",
    "neighbour_starts",
    "neighbours",
    "weights",
    "sources",
    "leaders",
    "edges",
    "edge_ends",
    "uniform_values",
    "contiguous",
    "contiguous_edges",
    "leader_mirrors",
    "leader_messages",
    "progress",
    "yield_processor",
    "tape",
    "first_step",
    "steps",
    "count",
    "blocks",
    "edge_blocks",
    "first_steady",
    "input_step",
    "groups",
    "row_stride",
    "leader_blocks",
    "threads",
    "thread",
    "tape_step",
)
"""The arguments of a kernel: 20 addresses and 13 whole numbers of 64 bits.

Formations are stored in groups of as many as a vector has lanes; `rows`, the mirrors and `edges`
are those of the first of some groups, which have `blocks` and `edge_blocks` each. A swarm is one
group. `uniform_values` has space for the numbers of `scheduling.shared` at each step. `row_stride`
is how many numbers lie between two rows of a row-major mirror; `contiguous` says for each block,
and `contiguous_edges` for each block of edges, whether its neighbours follow each other there; if
the mirror is not row-major, whether no leader ahead is among them. `leader_mirrors` and
`leader_messages` store what the leaders in `leader_blocks` blocks send at each step. Inputs are
stored at the step `input_step`.

`schedule` has `count` rows of `TASK`: blocks of one level and blocks of edges that take a step.
Before a task a thread waits for the others: until each thread before it has finished as many tasks
as `before` says, and each thread behind it as many as `after`. `progress` counts the tasks that
each has finished, one cache line apart, and `yield_processor` is a function that yields the
processor.

`tape` is 0 if nothing is recorded, and `tape_step` is how many numbers lie between its steps.
"""
TASK = ("passed", "level", "start", "end", "first_edge", "last_edge", "before", "after")
"""Of a task: the steps before it in this call, the level, and where its blocks begin and end."""
ADDRESSES = 20


def stride(width: int, lanes: int) -> int:
    """Return how many numbers lie between two agents in a mirror: whole vectors."""
    return -(-width // lanes) * lanes
