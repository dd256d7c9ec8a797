"""The transposed graph: the receivers of each agent, for derivatives along its edges."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from echelon.agents.network.exchange import Exchange
from echelon.core.types import Array
from echelon.simulation.codegen import contribution_widths, stride
from echelon.simulation.native.blocks import (
    SwarmBlocks,
    aligned_copy,
    neighbour_slots,
    senders_of,
)
from echelon.simulation.native.contiguity import contiguous_blocks
from echelon.simulation.native.kernel_cache import Kernel
from echelon.simulation.scalars import Unsupported
from echelon.simulation.step.loop import Loop, stretch_at


class TransposedGraph(NamedTuple):
    """The receivers of each agent, as `blocks.neighbour_slots` has its senders.

    Attributes:
        starts: (blocks + 1,) the first slot of each block.
        positions: (slots, lanes) of the receivers.
        weights: (rows, slots, lanes) of the edges.
        contiguous: (blocks,) whether the receivers of a block follow each other.
        row_major: whether the mirror is row-major.
    """

    starts: Array
    positions: Array
    weights: Array
    contiguous: Array
    row_major: bool


class TransposedArrays(NamedTuple):
    """The same as a kernel reads it, and to whom each agent contributes: a `Neighbourhood`."""

    neighbour_starts: Array
    neighbours: Array
    weights: Array
    contiguous: Array
    sources: Array
    leaders: Array


def check_pairs(loop: Loop) -> None:
    """Check that each edge is in both directions, with a weight of 1.

    Raises:
        Unsupported: an edge is not.
    """
    exchange = loop.exchange
    both = len(exchange.receivers) == 2 * len(loop.meter.edges)
    if not both or loop.switches is not None or (np.asarray(exchange.weights) != 1.0).any():
        raise Unsupported(
            "slopes along distances of edges that are not all bidirectional with weight 1"
        )


def transpose_graph(loop: Loop, places: SwarmBlocks) -> TransposedGraph:
    """Return the transposed graph of a loop."""
    exchange = loop.exchange
    reverse = Exchange(exchange.senders, exchange.receivers, exchange.weights)
    starts, positions, weights = neighbour_slots(loop, places, reverse)
    agents = places.agents.reshape(-1, places.lanes)
    itself = np.arange(agents.size).reshape(agents.shape)
    block = np.repeat(np.arange(places.blocks), np.diff(starts))
    # A copy has no cotangents, so that sums over all lanes count each agent once.
    once = (places.position[agents] == itself)[block]
    positions, weights = np.where(once, positions, itself[block]), np.where(once, weights, 0.0)
    return TransposedGraph(starts, positions, weights, *contiguous_blocks(starts, positions))


def transposed_arrays(
    loop: Loop, places: SwarmBlocks, graph: TransposedGraph, kernel: Kernel
) -> TransposedArrays:
    """Return what the kernel of the backward pass reads of a transposed graph."""
    plan, position = kernel.plan, places.position
    far = 1 if plan.row_major else stride(plan.width, plan.lanes)
    _, width = contribution_widths(plan)
    return TransposedArrays(
        graph.starts,
        np.ascontiguousarray(graph.positions * far, np.int32),
        aligned_copy(graph.weights, np.float64),
        graph.contiguous.astype(np.int8),
        (position[senders_of(loop)[places.agents]] * width).astype(np.int32),
        (position[np.asarray(loop.meter.nearest)[places.agents]] * width).astype(np.int32),
    )


def transposed_disagreement(loop: Loop, cotangents: Float[Array, "N k"]) -> Float[Array, "N k"]:
    """Return the cotangents of what agents send at the first step from those of disagreements."""
    exchange, sent = loop.exchange, np.zeros_like(cotangents)
    weights = np.atleast_2d(np.asarray(exchange.weights))[stretch_at(loop, 0)[0]]
    along = weights[:, None] * cotangents[exchange.receivers]
    np.add.at(sent, np.asarray(exchange.receivers), along)
    np.subtract.at(sent, np.asarray(exchange.senders), along)
    return sent
