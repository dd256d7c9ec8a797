"""Where agents stand in blocks of vectors, and where each finds those that it hears."""

from typing import final

import numpy as np

from echelon.core.types import Array
from echelon.engine.loop import Loop
from echelon.kernels import aligned, stride


@final
class Places:
    """Positions in blocks of as many agents as a vector has lanes.

    Leaders come first, then the followers level by level: whoever is sent an input of this step
    comes after who sends it. A level fills its last block with copies, which do what the agent
    does and are read by nobody.

    Attributes:
        lanes: of a vector.
        agents: (positions,) who stands there.
        of: (N,) where each agent stands.
        segments: (levels + 1,) the first block of the leaders, of each level, and the end.
    """

    def __init__(self, loop: Loop, lanes: int) -> None:
        """Place the agents of a loop."""
        levels = [loop.followers]
        if loop.levels is not None:
            levels = [loop.followers[np.unique(row)] for row in loop.levels]
        filled = [np.resize(a, -(-len(a) // lanes) * lanes) for a in (loop.leaders, *levels)]
        self.lanes, self.agents = lanes, np.concatenate(filled)
        self.segments = np.cumsum([0, *(len(a) // lanes for a in filled)]).astype(np.int64)
        # Of copies the first stands for the agent.
        _, self.of = np.unique(self.agents, return_index=True)

    @property
    def blocks(self) -> int:
        """How many blocks there are."""
        return len(self.agents) // self.lanes


def heard(loop: Loop, places: Places) -> tuple[Array, Array, Array]:
    """Return whom each agent hears, slot by slot: the k-th neighbour of each of a block.

    Returns:
        The first slot of each block (blocks + 1,), and of all slots the positions and weights
        (slots, lanes).
    """
    exchange, agents = loop.exchange, places.agents.reshape(-1, places.lanes)
    order = np.argsort(np.asarray(exchange.receivers), kind="stable")
    senders, weights = (np.asarray(a)[order] for a in (exchange.senders, exchange.weights))
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
    return first, positions, np.where(there, weights[edge], 0.0)


def edge_blocks(loop: Loop, places: Places, dtype: np.dtype, width: int) -> tuple[Array, Array]:
    """Return the edges in blocks for the sums of how far distances are off.

    Neighbours read `width` numbers of each agent.

    Returns:
        Rows (blocks, q + 2, lanes): the differences of the goals, the distances that they make, and
        room for the sums; and where the two ends of each edge show their numbers, (blocks, 2,
        lanes).
    """
    meter, lanes = loop.meter, places.lanes
    edges, q = np.asarray(meter.edges), len(meter.measured)
    blocks, far = -(-len(edges) // lanes), stride(width, lanes)
    goals = np.asarray(meter.offsets)[:, list(meter.measured)]
    apart = np.resize(goals[edges[:, 0]] - goals[edges[:, 1]], (blocks * lanes, q))
    rows = aligned((blocks, q + 2, lanes), dtype)
    rows[:, :q] = apart.reshape(blocks, lanes, q).transpose(0, 2, 1)
    rows[:, q] = np.resize(meter.spacings, blocks * lanes).reshape(blocks, lanes)
    ends = np.resize(places.of[edges] * far, (blocks * lanes, 2))
    pairs = ends.reshape(blocks, lanes, 2).transpose(0, 2, 1)
    return rows, np.ascontiguousarray(pairs, np.int32)
