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
_NONE: Mapping[int, Node] = {}


class Body(NamedTuple):
    """What some of the agents compute in a step; the same code for all of them.

    A leaf is ("row", r), ("z", k), ("message", k), ("leader", k), ("ahead", k), ("alone",), 1 where
    an agent uses no link, ("self", k), ("neighbour", k), what a neighbour shows, or ("link", k),
    the last number k that came by its link; or, the same for all agents, ("step",), ("steady",),
    ("table", c), ("uniform", k).

    Attributes:
        stores: row -> its new value.
        sums: row -> what is added to it.
        minima: row -> a value; the row keeps the smallest so far, beginning with `NO_MINIMUM`.
        on_request: row -> its new value at the step `input_step` only, since every store costs
            time.
        mirror: what neighbours read after the step, entry by entry.
        tape: row of the tape -> what is recorded there at each step, if a tape is given.
        letter: what the agent sends in the steps in which it sends, number by number.
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
    letter: Sequence[Node] = ()
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


class Letters(NamedTuple):
    """What agents send where that takes time: letters, of which the last ones are stored.

    Attributes:
        size: numbers of a letter.
        value: of them the first, which a receiver keeps for each link, with the last one.
        packet: rows of an agent with the others, which are passed on: of the newest it received.
        slots: letters of each agent that are stored.
        chosen: whether it depends on the step and the formation whose letters agents use, and so
            do the weights of their links.
    """

    size: int
    value: int
    packet: range
    slots: int
    chosen: bool = False

    @property
    def kept(self) -> list[int]:
        """The numbers of a letter that are kept for each link."""
        return [*range(self.value), self.size - 1]


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
        announce: what the agents that act first announce to all others in each step before any of
            them acts; None of nothing. Then whose message each receives differs between formations.
        prior_first, prior_others: what both do in each step before any agent acts; None of nothing.
            Then neighbours read what these show, and not what the step before has shown.
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
        goals: entries that are the goals of these, where they change with time; else none.
        apart: whether the goals of some neighbours differ; else distances are their own errors.
        exception_row: becomes 1 where one of `Body.exceptions` holds.
        table: numbers per step in the table.
        given: numbers of each agent and step that are given.
        letters: what is sent over links on which it takes time; None where all is heard at once.
        leaders_ahead: whether the leaders may take many steps before the others take the first,
            because they receive nothing: what they send is stored for each step.
        tape_rows: rows per block and step on the tape.
        paired: rows of a block by which two agents of a formation are apart, of which the smallest
            distance is kept; none where a tape has them.
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
    given: int = 0
    shifts: tuple[int, ...] = ()
    edge_shifts: tuple[int, ...] = ()
    leaders_ahead: bool = False
    tape_rows: int = 0
    paired: tuple[int, ...] = ()
    goals: tuple[int, ...] = ()
    letters: Letters | None = None
    prior_first: Body | None = None
    prior_others: Body | None = None
    announce: Body | None = None

    @property
    def bodies(self) -> dict[str, Body]:
        """The bodies by their names."""
        names = "first", "others", "prior_first", "prior_others", "announce"
        bodies = ((name, getattr(self, name)) for name in names)
        return {name: body for name, body in bodies if body is not None}

    @property
    def listens_first(self) -> bool:
        """Whether all agents do a part of a step before any of them acts."""
        return self.prior_others is not None

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
        given: the numbers that are given of this step.
        arrivals: where in memory are the letters that arrive at this step; -1 where none does.
        sends: the row of the letters that are sent at this step; -1 if none is.
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
    given: str = ""
    arrivals: str = ""
    sends: str = ""
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
    "ahead",
    "arrivals",
    "sends",
    "mail",
    "ring",
    "pairs",
    "pair_ends",
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
    "ahead_step",
    "arrivals_step",
    "weights_step",
    "pair_count",
)
"""The arguments of a kernel: 27 addresses and 17 whole numbers of 64 bits.

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

`tape` is 0 if nothing is recorded, and `tape_step` is how many numbers lie between its steps;
`ahead_step` is that of the numbers that are computed `ahead` of each agent and step.

`ring` has the last letters, row after row of all agents; `mail` has for each slot of a neighbour
what is kept of the last one. `arrivals` has for each slot, and behind them for each agent of which
a packet is newer, the place in `ring`, and `arrivals_step` lie between two steps; `sends` has for
each step the row that is written. Where agents choose whose letters they use, `weights` has for
each slot a weight, and behind them for each agent 1 if it uses none, `weights_step` numbers a step.

`pairs` has the least square of the distance of each two agents of a formation, `pair_count` of
them, and the step of it; `pair_ends` has the blocks of the two.
"""
TASK = ("passed", "level", "start", "end", "first_edge", "last_edge", "before", "after")
"""Of a task: the steps before it in this call, the level, and where its blocks begin and end.

Level 0 are the leaders, `PRIOR` is what all do before any of them acts, and `ANNOUNCE` what the
leaders do then."""
PRIOR, ANNOUNCE = -1, -2
ADDRESSES = 27


def stride(width: int, lanes: int) -> int:
    """Return how many numbers lie between two agents in a mirror: whole vectors."""
    return -(-width // lanes) * lanes
