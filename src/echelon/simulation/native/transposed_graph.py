"""A graph turned about: who heard each agent, for what is taken back along its edges."""

from typing import NamedTuple

import numpy as np

from echelon.agents.network.exchange import Exchange
from echelon.core.types import Array
from echelon.simulation.codegen import aligned, fed_widths, stride
from echelon.simulation.native.blocks import SwarmBlocks, heard, senders_of, smooth_blocks
from echelon.simulation.native.kernel_cache import Kernel
from echelon.simulation.scalars import Unsupported
from echelon.simulation.step.loop import Loop, stretch_at


class TransposedGraph(NamedTuple):
    """Who heard each agent, as `places.heard` has whom it hears; whose positions are in lines."""

    starts: Array
    positions: Array
    weights: Array
    smooth: Array
    lines: bool


class TransposedArrays(NamedTuple):
    """The same as a kernel reads it, and whom each agent feeds: `places.Found` turned about."""

    neighbour_starts: Array
    neighbours: Array
    weights: Array
    smooth: Array
    sources: Array
    leaders: Array


def check_pairs(loop: Loop) -> None:
    """Refuse edges that are not each heard by both their ends, with a weight of 1.

    Raises:
        Unsupported: some are.
    """
    exchange = loop.exchange
    both = len(exchange.receivers) == 2 * len(loop.meter.edges)
    if not both or loop.switches is not None or (np.asarray(exchange.weights) != 1.0).any():
        raise Unsupported("slopes along distances of edges that are not all heard both ways alike")


def turned_about(loop: Loop, places: SwarmBlocks) -> TransposedGraph:
    """Return the graph of a loop turned about."""
    exchange = loop.exchange
    turned = Exchange(exchange.senders, exchange.receivers, exchange.weights)
    starts, positions, weights = heard(loop, places, turned)
    agents = places.agents.reshape(-1, places.lanes)
    own = np.arange(agents.size).reshape(agents.shape)
    block = np.repeat(np.arange(places.blocks), np.diff(starts))
    # A copy feels nothing, so that what is added up over all lanes counts each agent once.
    once = (places.of[agents] == own)[block]
    positions, weights = np.where(once, positions, own[block]), np.where(once, weights, 0.0)
    return TransposedGraph(starts, positions, weights, *smooth_blocks(starts, positions))


def reach_of(
    loop: Loop, places: SwarmBlocks, turned: TransposedGraph, kernel: Kernel
) -> TransposedArrays:
    """Return what a kernel that takes back reads of a graph turned about."""
    plan, nearest = kernel.plan, np.asarray(loop.meter.nearest)
    heavy = aligned(turned.weights.shape, np.float64)
    heavy[:] = turned.weights
    far, (_, fed) = 1 if plan.lines else stride(plan.width, plan.lanes), fed_widths(plan)
    return TransposedArrays(
        turned.starts,
        np.ascontiguousarray(turned.positions * far, np.int32),
        heavy,
        turned.smooth.astype(np.int8),
        (places.of[senders_of(loop)[places.agents]] * fed).astype(np.int32),
        (places.of[nearest[places.agents]] * fed).astype(np.int32),
    )


def heard_back(loop: Loop, felt: Array) -> Array:
    """Return the slopes along what agents show (N, s), of those along what they hear at a start."""
    exchange, made = loop.exchange, np.zeros_like(felt)
    weights = np.atleast_2d(np.asarray(exchange.weights))[stretch_at(loop, 0)[0]]
    along = weights[:, None] * felt[exchange.receivers]
    np.add.at(made, np.asarray(exchange.receivers), along)
    np.subtract.at(made, np.asarray(exchange.senders), along)
    return made
