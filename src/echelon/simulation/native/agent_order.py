"""In which order the agents of a large swarm stand, so that those that hear each other are near."""

from typing import Any

import numpy as np
import scipy.sparse as sp
import scipy.sparse.csgraph as csgraph

from echelon.core.types import Array
from echelon.simulation.step.loop import Loop

_WINDOW = 256
"""Agents among which those of one degree are brought together: so few stay near each other."""
_LARGE = 10_000
"""Agents whose numbers no longer stay in a processor's own memory from one to the next."""


def is_large(agents: int) -> bool:
    """Tell whether it matters for so many agents where each stands."""
    return agents >= _LARGE


def ordered(loop: Loop, lanes: int, near: Array, degrees: Array | None) -> tuple[Array, Array]:
    """Return the agents in the order of their acting, and the first block of each level.

    In a level they stand as in an order of all agents, `near`, and within windows of it by their
    degrees where these are given. A level fills its last block with copies of its last agent, which
    do what that does and are read by nobody.
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
    """Return some agents in the order of all."""
    which = np.zeros(len(order), bool)
    which[some] = True
    return order[which[order]]


def windows(degrees: Array) -> Array:
    """Return numbers by which agents stand window after window, in each by their degrees."""
    return np.arange(len(degrees)) // _WINDOW * (degrees.max(initial=0) + 1) + degrees


def nearby(loop: Loop) -> Array:
    """Return the agents in an order in which those that hear each other are near.

    It is their own where that is as good, and of few agents. Numbers of a neighbour that was
    stepped long ago come from memory: a swarm numbered at random takes three times as long.
    """
    agents = len(loop.offsets)
    own = np.arange(agents)
    if not is_large(agents):
        return own
    i, j = np.asarray(loop.meter.edges, np.int32).T
    # Both ways, as the order wants a symmetric pattern, and directed edges have none.
    starts, order = grouped(np.concatenate([i, j]), agents)
    ends = np.concatenate([j, i])[order]
    links = sp.csr_array((np.ones(len(ends)), ends, starts), shape=(agents, agents))
    order = _from_an_end(links)
    rank = np.empty(agents, np.int32)
    rank[order] = own
    better = np.abs(rank[i] - rank[j]).sum(dtype=int) < np.abs(i - j).sum(dtype=int)
    return np.asarray(order, int) if better else own


def _from_an_end(links: Any) -> Array:
    """Return the agents that one reaches from another, by how far they are from one at an end.

    Neighbours are then at most about two layers apart, which are small where they begin at an end.
    """
    reached = csgraph.breadth_first_order(links, 0, return_predecessors=False)
    return csgraph.breadth_first_order(links, reached[-1], return_predecessors=False)


def grouped(keys: Array, count: int) -> tuple[Array, Array]:
    """Return where each of so many numbers begins among sorted keys, and the places of these.

    Equal keys stay in their order. It takes a fifth of the time of a sort.
    """
    # A matrix with an entry a column is turned about: it counts the rows, and fills them in order.
    entries = np.ones(len(keys), np.int8), keys.astype(np.int32), np.arange(len(keys) + 1)
    turned = sp.csc_array(entries, shape=(count, len(keys))).tocsr()
    return turned.indptr, turned.indices


def first_places(agents: Array) -> Array:
    """Return where each agent stands; of copies the first stands for the agent."""
    of = np.empty(agents.max() + 1, int)
    # Of places that are written twice the last holds.
    of[agents[::-1]] = np.arange(len(agents))[::-1]
    return of
