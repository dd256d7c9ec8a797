"""Where agents stand in blocks of vectors, and where each finds those that it hears."""

import abc
from collections.abc import Sequence
from typing import NamedTuple, final

import numpy as np

from echelon.agents.network.exchange import Exchange
from echelon.core.types import Array
from echelon.simulation.codegen import aligned, stride
from echelon.simulation.native.agent_order import (
    first_places,
    grouped,
    is_large,
    nearby,
    ordered,
    windows,
)
from echelon.simulation.native.schedule import BlockReach
from echelon.simulation.step.loop import Loop


class Neighbourhood(NamedTuple):
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
    near: BlockReach | None = None

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
    def find(self, width: int, rows: int, dtype: np.dtype) -> Neighbourhood:
        """Return where agents find each other: numbers are shown by `width`, blocks have `rows`."""

    @abc.abstractmethod
    def spacing(self, edges: Array) -> Array:
        """Return the sums that rows of edges hold, one an edge."""


_MOSTLY = 0.75
"""Of the blocks: how many find their neighbours one after the other where they lie in lines."""
_FEW = 1_000
"""Blocks that tell of all of them, whether their neighbours follow each other."""


def senders_of(loop: Loop) -> Array:
    """Return who tells each agent what it is told, (N,)."""
    if loop.parents is None:
        return np.asarray(loop.meter.nearest)
    # A leader is sent nothing, and its own place does as well as any.
    parents = np.asarray(loop.parents)
    return np.where(parents < 0, np.arange(len(parents)), parents)


@final
class SwarmBlocks(Places):
    """The agents of one formation, neighbours in the lanes of a vector wherever they stand."""

    def __init__(self, loop: Loop, lanes: int) -> None:
        """Place the agents of a loop."""
        self.loop, self.lanes, self.groups, self.together = loop, lanes, 1, False
        near = nearby(loop)
        self._stand(near, None)
        degrees = np.bincount(np.asarray(loop.exchange.receivers), minlength=len(self.of))
        if is_large(len(loop.offsets)) and self._uneven(degrees[self.agents]):
            some = np.linspace(0, self.blocks - 1, _FEW, dtype=int)
            if not self._smooth(heard(loop, self, blocks=some))[1]:
                self._stand(near, degrees)
        self.heard = heard(loop, self)
        self.smooth, self.lines = self._smooth(self.heard)
        # Ends that are near in memory follow each other; leaders are near to all.
        ends = self.of[np.asarray(loop.meter.edges)].T
        i, j = np.minimum(*ends), np.maximum(*ends)
        leads, count = i < self.segments[1] * lanes, len(self.agents)
        order = grouped(np.where(leads, i, j), count)[1]
        self.edge_order = order[grouped(np.where(leads, j, i)[order], count)[1]]

    def _smooth(self, heard: tuple[Array, Array, Array]) -> tuple[Array, bool]:
        return smooth_blocks(*heard[:2], int(self.segments[1]) * self.lanes)

    def _uneven(self, degrees: Array) -> bool:
        """Tell whether blocks have fewer slots where those of one degree stand side by side."""
        # A block has as many slots as the most that one of its agents hears.
        sorted_ = np.sort(windows(degrees)) % (degrees.max() + 1)
        now, then = (part.reshape(-1, self.lanes).max(axis=1).sum() for part in (degrees, sorted_))
        return bool(then < 0.9 * now)

    def _stand(self, near: Array, degrees: Array | None) -> None:
        """Give all agents their places, those of one degree side by side where they are given."""
        self.agents, self.segments = ordered(self.loop, self.lanes, near, degrees)
        self.of = first_places(self.agents)

    def find(self, width: int, rows: int, dtype: np.dtype) -> Neighbourhood:
        """Return where agents find each other: what they show stands one after the other."""
        loop, lanes = self.loop, self.lanes
        far = 1 if self.lines else stride(width, lanes)
        starts, positions, weights = self.heard
        heavy = aligned(weights.shape, dtype)
        heavy[:] = weights
        held = self.of[senders_of(loop)[self.agents]]
        nearest = np.asarray(loop.meter.nearest)[self.agents]
        return Neighbourhood(
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

    def measure(self, found: Neighbourhood, far: int, bytes_: int) -> None:
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
        self.near = BlockReach(int(reach), first, bytes_)

    def spacing(self, edges: Array) -> Array:
        """Return the sums that rows of edges hold, (E,)."""
        sums = np.empty(len(self.edge_order), edges.dtype)
        sums[self.edge_order] = edges[:, -1].reshape(-1)[: len(sums)]
        return sums


@final
class FormationBlocks(Places):
    """One agent of as many formations in a vector: all find each other block by block.

    Agents are numbered formation by formation.
    """

    def __init__(self, loops: Sequence[Loop], lanes: int) -> None:
        """Place the agents of loops that are alike."""
        self.loops, self.loop, self.lanes = loops, loops[0], lanes
        self.groups = -(-len(loops) // lanes)
        self.alone, self.together, self.lines = SwarmBlocks(self.loop, 1), True, False
        # The last group is filled with copies.
        formation = np.minimum(np.arange(self.groups * lanes), len(loops) - 1)
        formation = formation.reshape(self.groups, 1, lanes)
        each = len(self.loop.offsets) * formation + self.alone.agents[:, None]
        self.agents, self.segments = each.reshape(-1), self.alone.segments
        self.of = first_places(self.agents)

    def find(self, width: int, rows: int, dtype: np.dtype) -> Neighbourhood:
        """Return where agents find each other in a group: what they show stands row by row."""
        loop, lanes, of, far = self.loop, self.lanes, self.alone.of, width * self.lanes
        starts, positions, weights = self.alone.heard
        heavy = aligned((*weights.shape[:2], lanes), dtype)
        heavy[:] = weights
        ends = of[np.asarray(loop.meter.edges)] * far
        return Neighbourhood(
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
    loop: Loop,
    places: Places,
    exchange: Exchange | None = None,
    blocks: Array | slice = slice(None),
) -> tuple[Array, Array, Array]:
    """Return whom each agent hears, slot by slot: the k-th neighbour of each of a block.

    It is by the loop's edges, or by others where they are given, of all blocks or of some.

    Returns:
        The first slot of each block (blocks + 1,), and of all slots the positions (slots, lanes)
        and weights (rows, slots, lanes).
    """
    exchange, of = exchange or loop.exchange, places.of.astype(np.int32)
    # By where they stand and not by their numbers, so that memory is read from end to end.
    first, order = grouped(of[np.asarray(exchange.receivers)], len(places.agents))
    said = of[np.asarray(exchange.senders)][order]
    agents = places.agents.reshape(-1, places.lanes)[blocks]
    begin, degrees = first[of[agents]], np.diff(first)[of[agents]]
    own = np.arange(len(places.agents), dtype=np.int32).reshape(-1, places.lanes)[blocks]
    slots = degrees.max(axis=1)
    starts = np.concatenate([[0], np.cumsum(slots)]).astype(np.int64)
    block = np.repeat(np.arange(len(agents)), slots)
    k = (np.arange(starts[-1]) - starts[block]).astype(np.int32)[:, None]
    there = k < degrees[block]
    edge = np.minimum(begin[block] + k, len(said) - 1)
    # Who has fewer neighbours hears itself, from which it differs by nothing.
    positions = np.where(there, said[edge], own[block])
    weights = np.atleast_2d(np.asarray(exchange.weights))
    if (weights == 1.0).all():
        return starts, positions, np.repeat(there[None], len(weights), axis=0).astype(float)
    return starts, positions, np.where(there, weights[:, order][:, edge], 0.0)


def edge_blocks(
    loop: Loop, places: "SwarmBlocks", dtype: np.dtype, far: int
) -> tuple[Array, Array]:
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
