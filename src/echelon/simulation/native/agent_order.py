"""The order of the agents of a large swarm in memory, in which neighbours are near each other."""

import numpy as np
import scipy.sparse as sp
import scipy.sparse.csgraph as csgraph

from echelon.core.types import Array
from echelon.simulation.step.loop import Loop

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
    levels = [loop.followers]
    if loop.levels is not None:
        levels = [loop.followers[np.unique(row)] for row in loop.levels]
    levels = [_among(near, level) for level in levels]
    if degrees is not None:
        levels = [level[np.argsort(windows(degrees[level]), kind="stable")] for level in levels]
    filled = [np.append(a, np.repeat(a[-1:], -len(a) % lanes)) for a in (loop.leaders, *levels)]
    segments = np.cumsum([0, *(len(a) // lanes for a in filled)]).astype(np.int64)
    return np.concatenate(filled), segments


def _among(order: Array, some: Array) -> Array:
    """Return some agents in an order of all."""
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
    agents = len(loop.offsets)
    original = np.arange(agents)
    if not is_large(agents):
        return original
    i, j = np.asarray(loop.meter.edges, np.int32).T
    # Both directions: the order needs a symmetric pattern.
    starts, order = grouped(np.concatenate([i, j]), agents)
    ends = np.concatenate([j, i])[order]
    links = sp.csr_array((np.ones(len(ends)), ends, starts), shape=(agents, agents))
    order = _from_an_end(links)
    rank = np.empty(agents, np.int32)
    rank[order] = original
    better = np.abs(rank[i] - rank[j]).sum(dtype=int) < np.abs(i - j).sum(dtype=int)
    return np.asarray(order, int) if better else original


def _from_an_end(links: sp.csr_array) -> Array:
    """Return connected agents by their distance from one at an end of the graph.

    Neighbours are then at most about two layers apart, and layers are small if they begin at an
    end.
    """
    reached = csgraph.breadth_first_order(links, 0, return_predecessors=False)
    return csgraph.breadth_first_order(links, reached[-1], return_predecessors=False)


def grouped(keys: Array, count: int) -> tuple[Array, Array]:
    """Return where each number below `count` begins among the sorted keys, and the order of these.

    The order is stable. It takes a fifth of the time of a sort.
    """
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
