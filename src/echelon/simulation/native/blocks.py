"""Positions of agents in blocks of vectors, and of the neighbours that each reads."""

import abc
from collections.abc import Sequence
from typing import NamedTuple, TypeAlias, final

import numpy as np
import scipy.sparse as sp
import scipy.sparse.csgraph as csgraph

from echelon.core.types import Array
from echelon.simulation.codegen import SHIFTED, Plan, aligned, stride
from echelon.simulation.step.loop import Loop
from echelon.simulation.step.turns import by_depth


class Neighbourhood(NamedTuple):
    """Where a kernel reads numbers of other agents; it is called with these arrays.

    Attributes:
        neighbour_starts: (blocks + 1,) the first slot of each block.
        neighbours: (slots, lanes) the k-th neighbour of each agent of a block.
        weights: (rows, slots, lanes) of these edges, a row for each stretch between switches of the
            graph; a kernel is called with one of them.
        sources: (positions,) the sender of each agent's message.
        leaders: (positions,) the leader of each agent.
        edges: rows of the edges, for the sums of distance errors: the differences of the goals,
            their distances, and the sums.
        edge_ends: (edges, 2, lanes) the two ends of each edge.
        contiguous: (blocks,) whether the k-th neighbours of a block follow each other, for all k;
            if the mirror is not row-major, whether no leader is among them.
        contiguous_edges: (edges,) whether both ends of a block of edges follow each other.
    """

    neighbour_starts: Array
    neighbours: Array
    weights: Array
    sources: Array
    leaders: Array
    edges: Array
    edge_ends: Array
    contiguous: Array
    contiguous_edges: Array


Shifts: TypeAlias = tuple[tuple[int, ...], tuple[int, ...]]
"""How many positions neighbours, and the ends of edges, are away in most blocks."""


class BlockReach(NamedTuple):
    """How far apart blocks are that depend on each other.

    Attributes:
        reach: the most blocks between neighbours, or between the ends of a block of edges.
        edges: (edge blocks,) the first block that each of them needs, ascending.
        bytes: of a block with all arrays that belong to it.
    """

    reach: int
    edges: Array
    bytes: int


class Places(abc.ABC):
    """Positions in blocks of as many agents as a vector has lanes.

    Leaders come first, then the followers level by level: an agent that receives an input of this
    step comes after its sender.

    Attributes:
        loop: of the agents, or of the first formation.
        lanes: of a vector.
        agents: (positions,) the agent at each position.
        position: of each agent.
        segments: (levels + 1,) the first block of the leaders, of each level, and the end.
        groups: the number of groups of formations, which are stepped one after the other.
        batched: whether vectors hold agents of several formations.
        row_major: whether what neighbours read is stored row by row over all positions.
        reach: of blocks, if leaders may be ahead of all others and it was measured.
        shifts: `shifts` and `edge_shifts` of `Plan`.
        listens_first: as in `Plan`.
        announces: whether leaders announce what they do before any agent acts.
    """

    loop: Loop
    lanes: int
    agents: Array
    position: Array
    segments: Array
    groups: int
    batched: bool
    row_major: bool
    reach: BlockReach | None = None
    shifts: Shifts = ((), ())
    listens_first: bool = False
    announces: bool = False

    @property
    def edge_blocks(self) -> int:
        """The number of blocks of edges in a group."""
        edges = len(np.asarray(self.loop.meter.edges))
        return edges if self.batched else -(-edges // self.lanes)

    @property
    def row_stride(self) -> int:
        """How many numbers lie between two rows of a row-major mirror."""
        # So that rows begin in different ones of the 64 sets of a cache.
        return (self.blocks + (5 - self.blocks) % 64) * self.lanes

    @property
    def blocks(self) -> int:
        """The number of blocks."""
        return len(self.agents) // self.lanes

    def mirrors(self, plan: Plan, dtype: np.dtype | type) -> list[Array]:
        """Return memory for what neighbours read at a step and after it."""
        in_rows = plan.row_major
        shape = (plan.width, self.row_stride) if in_rows else (self.blocks, plan.mirror)
        return [aligned(shape, dtype) for _ in range(2)]

    @abc.abstractmethod
    def neighbourhood(self, width: int, rows: int, dtype: np.dtype) -> Neighbourhood:
        """Return where agents read each other: `width` numbers each, and messages in `rows`."""

    @abc.abstractmethod
    def leaders_of(self, nearest: Array, width: int) -> Array:
        """Return where the leader of each agent is, by its number (N,), in a mirror of a width."""

    @abc.abstractmethod
    def of_edges(self, values: Array) -> Array:
        """Return values (E,) of edges where their sums are, unless NumPy repeats them."""

    @abc.abstractmethod
    def spacing(self, edges: Array) -> Array:
        """Return the sums in rows of edges, one for each edge."""


_SAMPLE = 1_000
"""Blocks from which the share of contiguous ones is estimated."""


def _senders_of(loop: Loop) -> Array:
    """Return the sender of each agent's message, (N,)."""
    depths = by_depth(loop)
    if depths is None:
        return np.asarray(loop.meter.nearest)
    # A leader receives nothing; any place is valid.
    parents = np.asarray(depths.parents)
    return np.where(parents < 0, np.arange(len(parents)), parents)


@final
class SwarmBlocks(Places):
    """The agents of one formation; the neighbours of a vector are anywhere."""

    def __init__(self, loop: Loop, lanes: int) -> None:
        """Place the agents of a loop."""
        self.loop, self.lanes, self.groups, self.batched = loop, lanes, 1, False
        near = nearby(loop)
        self._place(near, None)
        degrees = np.bincount(
            np.asarray(loop.graph.exchange.receivers), minlength=len(self.position)
        )
        if is_large(len(loop.places.offsets)) and self._is_uneven(degrees[self.agents]):
            some = np.linspace(0, self.blocks - 1, _SAMPLE, dtype=int)
            if not self._contiguous(neighbour_slots(loop, self, blocks=some))[1]:
                self._place(near, degrees)
        self.slots = neighbour_slots(loop, self)
        contiguous, self.row_major = self._contiguous(self.slots)
        self.contiguous = contiguous.astype(np.int8)
        self._order_edges()
        ends = self.edge_ends().reshape(-1, 2, self.lanes)
        leads = (ends < self.segments[1] * self.lanes).any(axis=(1, 2))
        self.contiguous_edges = np.asarray(follow(ends).all(axis=1) & ~leads, np.int8)
        if self.row_major:
            starts = 2 * np.arange(self.edge_blocks + 1)
            self.shifts = (
                mark_shifted(*self.slots[:2], self.contiguous),
                mark_shifted(starts, self.edge_ends(), self.contiguous_edges),
            )

    def _order_edges(self) -> None:
        ends = self.position[np.asarray(self.loop.meter.edges)].T
        i, j = np.minimum(*ends), np.maximum(*ends)
        # Leaders are near to all.
        leads, count = i < self.segments[1] * self.lanes, len(self.agents)
        order = grouped(np.where(leads, i, j), count)[1]
        self.edge_order = order[grouped(np.where(leads, j, i)[order], count)[1]]

    def _contiguous(self, slots: tuple[Array, Array, Array]) -> tuple[Array, bool]:
        return contiguous_blocks(*slots[:2], int(self.segments[1]) * self.lanes)

    def _is_uneven(self, degrees: Array) -> bool:
        """Tell whether blocks have fewer slots if agents of one degree are side by side."""
        # A block has as many slots as the highest degree of its agents.
        sorted_ = np.sort(windows(degrees)) % (degrees.max() + 1)
        now, then = (part.reshape(-1, self.lanes).max(axis=1).sum() for part in (degrees, sorted_))
        return bool(then < 0.9 * now)

    def _place(self, near: Array, degrees: Array | None) -> None:
        self.agents, self.segments = ordered(self.loop, self.lanes, near, degrees)
        self.position = first_places(self.agents)

    def neighbourhood(self, width: int, rows: int, dtype: np.dtype) -> Neighbourhood:
        """Return where agents read each other: one agent's numbers after the other's."""
        loop, lanes = self.loop, self.lanes
        far = 1 if self.row_major else stride(width, lanes)
        starts, positions, weights = self.slots
        sources = self.position[_senders_of(loop)[self.agents]]
        return Neighbourhood(
            starts,
            np.ascontiguousarray(positions * far, np.int32),
            _aligned_copy(weights, dtype),
            ((sources // lanes) * rows * lanes + sources % lanes).astype(np.int32),
            self.leaders_of(np.asarray(loop.meter.nearest), width),
            *edge_blocks(loop, self, dtype, far),
            self.contiguous,
            self.contiguous_edges,
        )

    def leaders_of(self, nearest: Array, width: int) -> Array:
        """Return where the leader of each agent is."""
        far = 1 if self.row_major else stride(width, self.lanes)
        return (self.position[nearest[self.agents]] * far).astype(np.int32)

    def of_edges(self, values: Array) -> Array:
        """Return values (E,) of edges where their sums are, (edge blocks, lanes)."""
        ordered = np.resize(values[self.edge_order], self.edge_blocks * self.lanes)
        return ordered.reshape(-1, self.lanes)

    def edge_ends(self) -> Array:
        """Return the positions of the ends of edges, (2 edge blocks, lanes)."""
        edges = np.asarray(self.loop.meter.edges)[self.edge_order]
        ends = np.resize(self.position[edges], (self.edge_blocks * self.lanes, 2))
        return ends.reshape(-1, self.lanes, 2).swapaxes(1, 2).reshape(-1, self.lanes)

    def measure_reach(self, neighbourhood: Neighbourhood, far: int, bytes_: int) -> None:
        """Measure the reach of blocks of so many bytes, with agents `far` numbers apart."""
        size, leaders = self.lanes * far, int(self.segments[1])
        starts = neighbourhood.neighbour_starts
        slots = slice(starts[leaders], None)
        block = np.repeat(np.arange(self.blocks, dtype=np.int32), np.diff(starts))
        there = neighbourhood.neighbours[slots] // size
        distance = np.where(there < leaders, 0, np.abs(there - block[slots, None]))
        ends = neighbourhood.edge_ends // size
        # The last block is filled with repeated edges, which are not read.
        filled = np.arange(ends[:, 0].size).reshape(-1, 1, self.lanes) >= len(self.edge_order)
        ends = np.where((ends < leaders) | filled, self.blocks, ends)
        first = np.minimum.accumulate(ends.min(axis=(1, 2))[::-1])[::-1]
        last = np.where(ends == self.blocks, 0, ends).max(axis=(1, 2))
        reach = max(1, distance.max(initial=0), (last - first).max(initial=0))
        self.reach = BlockReach(int(reach), first, bytes_)

    def spacing(self, edges: Array) -> Array:
        """Return the sums in rows of edges, (E,)."""
        sums = np.empty(len(self.edge_order), edges.dtype)
        sums[self.edge_order] = edges[:, -1].reshape(-1)[: len(sums)]
        return sums


@final
class FormationBlocks(Places):
    """Vectors hold one agent of several formations; agents are numbered formation by formation."""

    def __init__(self, loops: Sequence[Loop], lanes: int) -> None:
        """Place the agents of loops that differ only in numbers."""
        self.loops, self.loop, self.lanes = loops, loops[0], lanes
        self.groups = -(-len(loops) // lanes)
        self.swarm, self.batched, self.row_major = SwarmBlocks(self.loop, 1), True, False
        # The last group is filled with copies.
        formation = np.minimum(np.arange(self.groups * lanes), len(loops) - 1)
        formation = formation.reshape(self.groups, 1, lanes)
        agents = len(self.loop.places.offsets) * formation + self.swarm.agents[:, None]
        self.agents, self.segments = agents.reshape(-1), self.swarm.segments
        self.position = first_places(self.agents)

    def neighbourhood(self, width: int, rows: int, dtype: np.dtype) -> Neighbourhood:
        """Return where agents of a group read each other: their numbers are row by row."""
        loop, lanes, far = self.loop, self.lanes, width * self.lanes
        place, (starts, positions, weights) = self.swarm.position, self.swarm.slots
        ends = place[np.asarray(loop.meter.edges)] * far
        return Neighbourhood(
            starts,
            (positions * far).astype(np.int32),
            _aligned_copy(np.broadcast_to(weights, (*weights.shape[:2], lanes)), dtype),
            (place[_senders_of(loop)[self.swarm.agents]] * rows * lanes).astype(np.int32),
            self.leaders_of(np.asarray(loop.meter.nearest), width),
            self._edges(dtype),
            np.ascontiguousarray(ends, np.int32),
            np.zeros(1, np.int8),
            np.zeros(1, np.int8),
        )

    def leaders_of(self, nearest: Array, width: int) -> Array:
        """Return where the leader of each agent is."""
        places = self.swarm.position[nearest[self.swarm.agents]]
        return (places * width * self.lanes).astype(np.int32)

    def of_edges(self, values: Array) -> Array:
        """Return values (E,) of edges where their sums are, (E, 1)."""
        return values[:, None]

    def _edges(self, dtype: np.dtype) -> Array:
        """Return the rows of the edges, (groups, E, q + 2, lanes)."""
        meter, lanes, last = self.loop.meter, self.lanes, len(self.loops) - 1
        pairs, q = np.asarray(meter.edges), len(meter.measured)
        rows = aligned((self.groups, len(pairs), q + 2, lanes), dtype)
        # Runs that differ only in their seeds share one.
        by_meter = dict[int, Array]()
        for f in range(self.groups * lanes):
            meter = self.loops[min(f, last)].meter
            if id(meter) not in by_meter:
                goals = np.asarray(meter.offsets)[:, list(meter.measured)]
                differences = goals[pairs[:, 0]] - goals[pairs[:, 1]]
                by_meter[id(meter)] = np.column_stack([differences, meter.spacings])
            rows[f // lanes, :, : q + 1, f % lanes] = by_meter[id(meter)]
        return rows

    def spacing(self, edges: Array) -> Array:
        """Return the sums in rows of edges, (formations E,)."""
        by_formation = edges[:, :, -1].transpose(0, 2, 1).reshape(self.groups * self.lanes, -1)
        return by_formation[: len(self.loops)].reshape(-1)


def _aligned_copy(values: Array, dtype: np.dtype | type) -> Array:
    copy = aligned(values.shape, dtype)
    copy[:] = values
    return copy


def neighbour_slots(
    loop: Loop, places: Places, blocks: Array | slice = slice(None)
) -> tuple[Array, Array, Array]:
    """Return the neighbours of each agent, slot by slot: the k-th neighbour of each of a block.

    Args:
        loop: of the agents.
        places: of the agents.
        blocks: for which neighbours are returned.

    Returns:
        The first slot of each block (blocks + 1,), and of all slots the positions (slots, lanes)
        and weights (rows, slots, lanes).
    """
    exchange, place = loop.graph.exchange, places.position.astype(np.int32)
    starts, there, edge = _slots(loop, places, blocks)
    itself = np.arange(len(places.agents), dtype=np.int32).reshape(-1, places.lanes)[blocks]
    block = np.repeat(np.arange(len(starts) - 1), np.diff(starts))
    # An agent with fewer neighbours reads itself; the difference is 0.
    positions = np.where(there, place[np.asarray(exchange.senders)][edge], itself[block])
    weights = np.atleast_2d(np.asarray(exchange.weights))
    if (weights == 1.0).all():
        return starts, positions, np.repeat(there[None], len(weights), axis=0).astype(float)
    return starts, positions, np.where(there, weights[:, edge], 0.0)


def link_slots(loop: Loop, places: Places) -> Array:
    """Return the link of each slot of all agents, (slots, lanes); -1 where there is none."""
    _, there, edge = _slots(loop, places, slice(None))
    return np.where(there, edge, -1)


def _slots(loop: Loop, places: Places, blocks: Array | slice) -> tuple[Array, Array, Array]:
    """Return the first slot of each block, and of all slots whether there is a link, and which."""
    exchange, place = loop.graph.exchange, places.position.astype(np.int32)
    # By position and not by number, so that memory is read from end to end.
    first, order = grouped(place[np.asarray(exchange.receivers)], len(places.agents))
    agents = places.agents.reshape(-1, places.lanes)[blocks]
    begin, degrees = first[place[agents]], np.diff(first)[place[agents]]
    slots = degrees.max(axis=1)
    starts = np.concatenate([[0], np.cumsum(slots)]).astype(np.int64)
    block = np.repeat(np.arange(len(agents)), slots)
    k = (np.arange(starts[-1]) - starts[block]).astype(np.int32)[:, None]
    there = k < degrees[block]
    return starts, there, order[np.minimum(begin[block] + k, len(order) - 1)]


def edge_blocks(loop: Loop, places: SwarmBlocks, dtype: np.dtype, far: int) -> tuple[Array, Array]:
    """Return the edges in blocks, for the sums of distance errors.

    The numbers that neighbours read of consecutive agents are `far` apart.

    Returns:
        Rows (blocks, q + 2, lanes): the differences of the goals, their distances, and the sums;
        and the two ends of each edge, (blocks, 2, lanes).
    """
    meter, lanes = loop.meter, places.lanes
    edges, q = np.asarray(meter.edges)[places.edge_order], len(meter.measured)
    blocks = -(-len(edges) // lanes)
    goals = np.asarray(meter.offsets)[:, list(meter.measured)]
    differences = np.resize(goals[edges[:, 0]] - goals[edges[:, 1]], (blocks * lanes, q))
    rows = aligned((blocks, q + 2, lanes), dtype)
    rows[:, :q] = differences.reshape(blocks, lanes, q).transpose(0, 2, 1)
    spacings = np.asarray(meter.spacings)[places.edge_order]
    rows[:, q] = np.resize(spacings, blocks * lanes).reshape(blocks, lanes)
    ends = places.edge_ends().reshape(blocks, 2, lanes) * far
    return rows, np.ascontiguousarray(ends, np.int32)


# ---- the order of agents in memory ---------------------------------------------------------------


_WINDOW = 256
"""Agents among which those of one degree are grouped: so few stay near each other."""
_LARGE = 10_000
"""Agents from which on their numbers do not stay in a processor's cache."""


def is_large(agents: int) -> bool:
    """Tell whether the order of so many agents matters."""
    return agents >= _LARGE


def ordered(loop: Loop, lanes: int, near: Array, degrees: Array | None) -> tuple[Array, Array]:
    """Return the agents in the order in which they act, and the first block of each level.

    In a level they are in the order `near` of all agents, and within windows of it by their degrees
    if these are given. A level fills its last block with copies of its last agent, which compute
    the same and are not read.
    """
    levels, depths = [loop.laws.followers], by_depth(loop)
    if depths is not None:
        levels = [loop.laws.followers[np.unique(row)] for row in depths.levels]
    levels = [_among(near, level) for level in levels]
    if degrees is not None:
        levels = [level[np.argsort(windows(degrees[level]), kind="stable")] for level in levels]
    filled = [
        np.append(a, np.repeat(a[-1:], -len(a) % lanes)) for a in (loop.laws.leaders, *levels)
    ]
    segments = np.cumsum([0, *(len(a) // lanes for a in filled)]).astype(np.int64)
    return np.concatenate(filled), segments


def _among(order: Array, some: Array) -> Array:
    which = np.zeros(len(order), bool)
    which[some] = True
    return order[which[order]]


def windows(degrees: Array) -> Array:
    """Return sort keys of agents: window after window, in each by their degrees."""
    return np.arange(len(degrees)) // _WINDOW * (degrees.max(initial=0) + 1) + degrees


def nearby(loop: Loop) -> Array:
    """Return the agents in an order in which neighbours are near each other.

    It is their own order if that is as good, and for few agents. The numbers of a neighbour that
    was stepped long ago come from main memory: a swarm in random order takes three times as long.
    """
    agents = len(loop.places.offsets)
    original = np.arange(agents)
    if not is_large(agents):
        return original
    i, j = np.asarray(loop.meter.edges, np.int32).T
    # Both directions: the order needs a symmetric pattern.
    starts, order = grouped(np.concatenate([i, j]), agents)
    ends = np.concatenate([j, i])[order]
    links = sp.csr_array((np.ones(len(ends)), ends, starts), shape=(agents, agents))
    # By the distance from an agent at an end of the graph: neighbours are then at most about two
    # layers apart, and layers are small if they begin at an end.
    end = csgraph.breadth_first_order(links, 0, return_predecessors=False)[-1]
    order = csgraph.breadth_first_order(links, end, return_predecessors=False)
    rank = np.empty(agents, np.int32)
    rank[order] = original
    better = np.abs(rank[i] - rank[j]).sum(dtype=int) < np.abs(i - j).sum(dtype=int)
    return np.asarray(order, int) if better else original


def grouped(keys: Array, count: int) -> tuple[Array, Array]:
    """Return where numbers below `count` begin among sorted keys, and the stable order, in O(N)."""
    # Conversion of a matrix with one entry a column counts its rows, and fills them in order.
    entries = np.ones(len(keys), np.int8), keys.astype(np.int32), np.arange(len(keys) + 1)
    rows = sp.csc_array(entries, shape=(count, len(keys))).tocsr()
    return rows.indptr, rows.indices


def first_places(agents: Array) -> Array:
    """Return the position of each agent; of copies, that of the first."""
    position = np.empty(agents.max() + 1, int)
    # If a place is written twice, the last value stays.
    position[agents[::-1]] = np.arange(len(agents))[::-1]
    return position


# ---- blocks whose neighbours follow each other in memory -----------------------------------------


_MOSTLY = 0.75
"""The share of blocks with contiguous neighbours from which on a row-major mirror is faster, and of
blocks with the same shifts for which code is written."""
_MOST_SHIFTS = 6
"""Slots that are written one by one: an agent of a grid has four."""


def contiguous_blocks(starts: Array, positions: Array, leaders: int = 0) -> tuple[Array, bool]:
    """Return which blocks have contiguous neighbours in all slots, and whether row-major is faster.

    If it is not, return which blocks have no leader among their neighbours, of so many positions.
    """
    block = np.repeat(np.arange(len(starts) - 1), np.diff(starts))

    def all_(slots: Array) -> Array:
        return np.bincount(block, ~slots, len(starts) - 1) == 0

    contiguous = all_(np.logical_and(follow(positions), positions[:, 0] >= leaders))
    # To gather a number lane by lane costs several times as much as to load contiguous ones.
    if contiguous.mean() > _MOSTLY:
        return contiguous, True
    return all_(np.asarray((positions >= leaders).all(axis=1))), False


def mark_shifted(starts: Array, positions: Array, contiguous: Array) -> tuple[int, ...]:
    """Return how many positions the neighbours of most blocks are away; mark those `SHIFTED`.

    There are none if blocks differ, or have many slots. The arguments are those of
    `contiguous_blocks`, and its result as whole numbers.
    """
    sizes, lanes = np.diff(starts), positions.shape[1]
    size = int(np.bincount(sizes[contiguous > 0]).argmax()) if contiguous.any() else 0
    if not 0 < size <= _MOST_SHIFTS:
        return ()
    some = np.flatnonzero((contiguous > 0) & (sizes == size))
    first = positions[starts[some][:, None] + np.arange(size), 0]
    kinds, kind, counts = np.unique(
        first - some[:, None] * lanes, axis=0, return_inverse=True, return_counts=True
    )
    most = counts.argmax()
    if counts[most] < _MOSTLY * len(contiguous):
        return ()
    contiguous[some[kind.reshape(-1) == most]] = SHIFTED
    return tuple(kinds[most].tolist())


def follow(positions: Array) -> Array:
    """Return which of some lists of positions (..., lanes) are consecutive numbers."""
    return (np.diff(positions, axis=-1) == 1).all(axis=-1)
