"""Where agents stand in blocks of vectors, and where each finds those that it hears."""

import abc
from collections.abc import Sequence
from typing import Any, NamedTuple, final

import numpy as np
import scipy.sparse as sp
import scipy.sparse.csgraph as csgraph

from echelon.core.types import Array
from echelon.engine.loop import Loop
from echelon.engine.turns import Near
from echelon.kernels import aligned, stride
from echelon.network.exchange import Exchange


class Found(NamedTuple):
    """What a kernel reads of others, as it is called with it.

    Attributes:
        neighbour_starts: (blocks + 1,) the first slot of each block.
        neighbours: (slots, lanes) what each hears, the k-th neighbour of each of a block.
        weights: (rows, slots, lanes) of these edges, a row for each stretch between switches of the
            graph; a kernel is called with one of them.
        sources: (positions,) where each finds what it is told.
        leaders: (positions,) where each finds its leader.
        edges: rows of the edges, for the sums of how far distances are off: the differences of the
            goals, the distances that they make, and room for the sums.
        edge_ends: (edges, 2, lanes) where the two ends of each show their numbers.
        smooth: (blocks,) whether the k-th neighbours of a block follow each other, for all k; where
            nothing lies in lines, whether no leader is among them.
        smooth_edges: (edges,) whether both ends of a block of edges do.
    """

    neighbour_starts: Array
    neighbours: Array
    weights: Array
    sources: Array
    leaders: Array
    edges: Array
    edge_ends: Array
    smooth: Array
    smooth_edges: Array


class Places(abc.ABC):
    """Positions in blocks of as many agents as a vector has lanes.

    Leaders come first, then the followers level by level: whoever is sent an input of this step
    comes after who sends it.

    Attributes:
        loop: that of the agents, or of the first formation.
        lanes: of a vector.
        agents: (positions,) who stands there.
        of: where each agent stands.
        segments: (levels + 1,) the first block of the leaders, of each level, and the end.
        groups: of formations, which are stepped one after the other.
        together: whether vectors hold agents of as many formations.
        lines: whether what neighbours read lies row by row over all positions.
        near: how far blocks reach, where leaders may be ahead of all others and that is known.
    """

    loop: Loop
    lanes: int
    agents: Array
    of: Array
    segments: Array
    groups: int
    together: bool
    lines: bool
    near: Near | None = None

    @property
    def edge_blocks(self) -> int:
        """How many blocks the edges of a group fill."""
        edges = len(np.asarray(self.loop.meter.edges))
        return edges if self.together else -(-edges // self.lanes)

    @property
    def line(self) -> int:
        """How many numbers lie between two rows of what neighbours read, where it lies in lines."""
        # A row begins on a line of memory of its own, of 64 that a cache tells apart.
        lines = self.blocks + (5 - self.blocks) % 64
        return lines * self.lanes

    @property
    def blocks(self) -> int:
        """How many blocks there are."""
        return len(self.agents) // self.lanes

    @abc.abstractmethod
    def find(self, width: int, rows: int, dtype: np.dtype) -> Found:
        """Return where agents find each other: numbers are shown by `width`, blocks have `rows`."""

    @abc.abstractmethod
    def spacing(self, edges: Array) -> Array:
        """Return the sums that rows of edges hold, one an edge."""


_MOSTLY = 0.75
"""Of the blocks: how many find their neighbours one after the other where they lie in lines."""
_WINDOW = 256
"""Agents among which those of one degree are brought together: so few stay near each other."""
_LARGE = 10_000
"""Agents whose numbers no longer stay in a processor's own memory from one to the next."""


def _ordered(loop: Loop, lanes: int, degrees: Array | None) -> tuple[Array, Array]:
    """Return the agents in the order of their acting, and the first block of each level.

    A level fills its last block with copies of its last agent, which do what that does and are read
    by nobody.
    """
    levels = [loop.followers]
    if loop.levels is not None:
        levels = [loop.followers[np.unique(row)] for row in loop.levels]
    rank = _nearby(loop)
    levels = [level[np.argsort(rank[level], kind="stable")] for level in levels]
    if degrees is not None:
        window = [np.arange(len(level)) // _WINDOW for level in levels]
        levels = [
            level[np.lexsort((degrees[level], near))]
            for level, near in zip(levels, window, strict=True)
        ]
    filled = [np.append(a, np.repeat(a[-1:], -len(a) % lanes)) for a in (loop.leaders, *levels)]
    segments = np.cumsum([0, *(len(a) // lanes for a in filled)]).astype(np.int64)
    return np.concatenate(filled), segments


def _nearby(loop: Loop) -> Array:
    """Return the place of each agent in an order in which those that hear each other are near.

    It is their own where that is as good, and of few agents. Numbers of a neighbour that was
    stepped long ago come from memory: a swarm numbered at random takes three times as long.
    """
    agents, exchange = len(loop.offsets), loop.exchange
    own = np.arange(agents)
    if agents < _LARGE:
        return own
    i, j = np.asarray(exchange.receivers), np.asarray(exchange.senders)
    # Both ways, as the order wants a symmetric pattern, and directed edges have none.
    both = np.concatenate([i, j]), np.concatenate([j, i])
    links = sp.csr_array((np.ones(2 * len(i), np.int8), both), shape=(agents, agents))
    order = _from_an_end(links)
    if len(order) < agents:
        order = csgraph.reverse_cuthill_mckee(sp.csr_matrix(links), symmetric_mode=True)
    rank = np.empty(agents, int)
    rank[order] = own
    return rank if np.abs(rank[i] - rank[j]).sum() < np.abs(i - j).sum() else own


def _from_an_end(links: Any) -> Array:
    """Return the agents that one reaches from another, by how far they are from one at an end.

    Neighbours are then at most about two layers apart, which are small where they begin at an end.
    """
    reached = csgraph.breadth_first_order(links, 0, return_predecessors=False)
    return csgraph.breadth_first_order(links, reached[-1], return_predecessors=False)


def _first(agents: Array) -> Array:
    """Return where each agent stands; of copies the first stands for the agent."""
    return np.unique(agents, return_index=True)[1]


def senders_of(loop: Loop) -> Array:
    """Return who tells each agent what it is told, (N,)."""
    if loop.parents is None:
        return np.asarray(loop.meter.nearest)
    # A leader is sent nothing, and its own place does as well as any.
    parents = np.asarray(loop.parents)
    return np.where(parents < 0, np.arange(len(parents)), parents)


@final
class Swarm(Places):
    """The agents of one formation, neighbours in the lanes of a vector wherever they stand."""

    def __init__(self, loop: Loop, lanes: int) -> None:
        """Place the agents of a loop."""
        self.loop, self.lanes, self.groups, self.together = loop, lanes, 1, False
        self._stand(None)
        degrees = np.bincount(np.asarray(loop.exchange.receivers), minlength=len(self.of))
        if len(loop.offsets) >= _LARGE and not self.lines and self._uneven(degrees[self.agents]):
            self._stand(degrees)
        # Ends that are near in memory follow each other; leaders are near to all.
        i, j = np.sort(self.of[np.asarray(loop.meter.edges)], axis=1).T
        self.edge_order = np.lexsort((j, i, np.where(i < self.segments[1] * lanes, j, i)))

    def _uneven(self, degrees: Array) -> bool:
        """Tell whether blocks have fewer slots where those of one degree stand side by side."""
        # A block has as many slots as the most that one of its agents hears.
        sorted_ = degrees[np.lexsort((degrees, np.arange(len(degrees)) // _WINDOW))]
        now, then = (part.reshape(-1, self.lanes).max(axis=1).sum() for part in (degrees, sorted_))
        return bool(then < 0.9 * now)

    def _stand(self, degrees: Array | None) -> None:
        """Give all agents their places, those of one degree side by side where they are given."""
        loop, lanes = self.loop, self.lanes
        self.agents, self.segments = _ordered(loop, lanes, degrees)
        self.of = _first(self.agents)
        self.heard = heard(loop, self)
        starts, positions, _ = self.heard
        led = int(self.segments[1]) * lanes
        self.smooth, self.lines = smooth_blocks(starts, positions, led)

    def find(self, width: int, rows: int, dtype: np.dtype) -> Found:
        """Return where agents find each other: what they show stands one after the other."""
        loop, lanes = self.loop, self.lanes
        far = 1 if self.lines else stride(width, lanes)
        starts, positions, weights = self.heard
        heavy = aligned(weights.shape, dtype)
        heavy[:] = weights
        held = self.of[senders_of(loop)[self.agents]]
        nearest = np.asarray(loop.meter.nearest)[self.agents]
        return Found(
            starts,
            np.ascontiguousarray(positions * far, np.int32),
            heavy,
            ((held // lanes) * rows * lanes + held % lanes).astype(np.int32),
            (self.of[nearest] * far).astype(np.int32),
            *(edges := edge_blocks(loop, self, dtype, far)),
            self.smooth.astype(np.int8),
            self._smooth_edges(edges[1]),
        )

    def _smooth_edges(self, ends: Array) -> Array:
        leads = (ends < self.segments[1] * self.lanes).any(axis=(1, 2))
        return np.asarray(_follow(ends).all(axis=1) & ~leads, np.int8)

    def measure(self, found: Found, far: int, bytes_: int) -> None:
        """Find how far blocks of so many bytes reach, whose agents show numbers `far` apart."""
        size, led = self.lanes * far, int(self.segments[1])
        slots = slice(found.neighbour_starts[led], None)
        block = np.repeat(np.arange(self.blocks, dtype=np.int32), np.diff(found.neighbour_starts))
        there = found.neighbours[slots] // size
        apart = np.where(there < led, 0, np.abs(there - block[slots, None]))
        ends = found.edge_ends // size
        # The last block is filled with edges from elsewhere, which nobody reads.
        filled = np.arange(ends[:, 0].size).reshape(-1, 1, self.lanes) >= len(self.edge_order)
        ends = np.where((ends < led) | filled, self.blocks, ends)
        first = np.minimum.accumulate(ends.min(axis=(1, 2))[::-1])[::-1]
        last = np.where(ends == self.blocks, 0, ends).max(axis=(1, 2))
        reach = max(1, apart.max(initial=0), (last - first).max(initial=0))
        self.near = Near(int(reach), first, bytes_)

    def spacing(self, edges: Array) -> Array:
        """Return the sums that rows of edges hold, (E,)."""
        sums = np.empty(len(self.edge_order), edges.dtype)
        sums[self.edge_order] = edges[:, -1].reshape(-1)[: len(sums)]
        return sums


@final
class Formations(Places):
    """One agent of as many formations in a vector: all find each other block by block.

    Agents are numbered formation by formation.
    """

    def __init__(self, loops: Sequence[Loop], lanes: int) -> None:
        """Place the agents of loops that are alike."""
        self.loops, self.loop, self.lanes = loops, loops[0], lanes
        self.groups = -(-len(loops) // lanes)
        self.alone, self.together, self.lines = Swarm(self.loop, 1), True, False
        # The last group is filled with copies.
        formation = np.minimum(np.arange(self.groups * lanes), len(loops) - 1)
        formation = formation.reshape(self.groups, 1, lanes)
        each = len(self.loop.offsets) * formation + self.alone.agents[:, None]
        self.agents, self.segments = each.reshape(-1), self.alone.segments
        self.of = _first(self.agents)

    def find(self, width: int, rows: int, dtype: np.dtype) -> Found:
        """Return where agents find each other in a group: what they show stands row by row."""
        loop, lanes, of, far = self.loop, self.lanes, self.alone.of, width * self.lanes
        starts, positions, weights = self.alone.heard
        heavy = aligned((*weights.shape[:2], lanes), dtype)
        heavy[:] = weights
        ends = of[np.asarray(loop.meter.edges)] * far
        return Found(
            starts,
            (positions * far).astype(np.int32),
            heavy,
            (of[senders_of(loop)[self.alone.agents]] * rows * lanes).astype(np.int32),
            (of[np.asarray(loop.meter.nearest)[self.alone.agents]] * far).astype(np.int32),
            self._edges(dtype),
            np.ascontiguousarray(ends, np.int32),
            np.zeros(1, np.int8),
            np.zeros(1, np.int8),
        )

    def _edges(self, dtype: np.dtype) -> Array:
        """Return the rows of the edges, (groups, E, q + 2, lanes)."""
        meter, lanes, last = self.loop.meter, self.lanes, len(self.loops) - 1
        pairs, q = np.asarray(meter.edges), len(meter.measured)
        rows = aligned((self.groups, len(pairs), q + 2, lanes), dtype)
        # Runs that differ in their seeds alone share one.
        made = dict[int, Array]()
        for f in range(self.groups * lanes):
            meter = self.loops[min(f, last)].meter
            if id(meter) not in made:
                goals = np.asarray(meter.offsets)[:, list(meter.measured)]
                apart = goals[pairs[:, 0]] - goals[pairs[:, 1]]
                made[id(meter)] = np.column_stack([apart, meter.spacings])
            rows[f // lanes, :, : q + 1, f % lanes] = made[id(meter)]
        return rows

    def spacing(self, edges: Array) -> Array:
        """Return the sums that rows of edges hold, (formations E,)."""
        each = edges[:, :, -1].transpose(0, 2, 1).reshape(self.groups * self.lanes, -1)
        return each[: len(self.loops)].reshape(-1)


def smooth_blocks(starts: Array, positions: Array, led: int = 0) -> tuple[Array, bool]:
    """Return whose neighbours follow each other, slot by slot, and whether lines pay for it.

    Where they do not, it is whose neighbours are none of the leaders, of so many positions.
    """
    block = np.repeat(np.arange(len(starts) - 1), np.diff(starts))

    def all_(slots: Array) -> Array:
        return np.bincount(block, ~slots, len(starts) - 1) == 0

    smooth = all_(np.logical_and(_follow(positions), positions[:, 0] >= led))
    # A number that is gathered lane by lane costs some times what one of a line does.
    lines = bool(smooth.mean() > _MOSTLY)
    return (smooth if lines else all_(np.asarray((positions >= led).all(axis=1)))), lines


def _follow(positions: Array) -> Array:
    """Return which of some lists of positions (..., lanes) are each one more than the last."""
    return (np.diff(positions, axis=-1) == 1).all(axis=-1)


def heard(
    loop: Loop, places: Places, exchange: Exchange | None = None
) -> tuple[Array, Array, Array]:
    """Return whom each agent hears, slot by slot: the k-th neighbour of each of a block.

    It is by the loop's edges, or by others where they are given.

    Returns:
        The first slot of each block (blocks + 1,), and of all slots the positions (slots, lanes)
        and weights (rows, slots, lanes).
    """
    exchange, agents = exchange or loop.exchange, places.agents.reshape(-1, places.lanes)
    order = np.argsort(np.asarray(exchange.receivers), kind="stable")
    senders = np.asarray(exchange.senders)[order]
    weights = np.atleast_2d(np.asarray(exchange.weights))[:, order]
    ends = np.searchsorted(np.asarray(exchange.receivers)[order], np.arange(len(loop.offsets) + 1))
    degrees = np.diff(ends)
    slots = degrees[agents].max(axis=1)
    first = np.concatenate([[0], np.cumsum(slots)]).astype(np.int64)
    block = np.repeat(np.arange(places.blocks), slots)
    k = (np.arange(first[-1]) - first[block])[:, None]
    there = k < degrees[agents[block]]
    edge = np.minimum(ends[agents[block]] + k, len(senders) - 1)
    own = np.arange(agents.size).reshape(agents.shape)[block]
    # Who has fewer neighbours hears itself, from which it differs by nothing.
    positions = np.where(there, places.of[senders[edge]], own)
    return first, positions, np.where(there, weights[:, edge], 0.0)


def edge_blocks(loop: Loop, places: "Swarm", dtype: np.dtype, far: int) -> tuple[Array, Array]:
    """Return the edges in blocks for the sums of how far distances are off.

    What two agents show that follow each other lies `far` apart.

    Returns:
        Rows (blocks, q + 2, lanes): the differences of the goals, the distances that they make, and
        room for the sums; and where the two ends of each edge show their numbers, (blocks, 2,
        lanes).
    """
    meter, lanes = loop.meter, places.lanes
    edges, q = np.asarray(meter.edges)[places.edge_order], len(meter.measured)
    blocks = -(-len(edges) // lanes)
    goals = np.asarray(meter.offsets)[:, list(meter.measured)]
    apart = np.resize(goals[edges[:, 0]] - goals[edges[:, 1]], (blocks * lanes, q))
    rows = aligned((blocks, q + 2, lanes), dtype)
    rows[:, :q] = apart.reshape(blocks, lanes, q).transpose(0, 2, 1)
    spacings = np.asarray(meter.spacings)[places.edge_order]
    rows[:, q] = np.resize(spacings, blocks * lanes).reshape(blocks, lanes)
    ends = np.resize(places.of[edges] * far, (blocks * lanes, 2))
    pairs = ends.reshape(blocks, lanes, 2).transpose(0, 2, 1)
    return rows, np.ascontiguousarray(pairs, np.int32)
