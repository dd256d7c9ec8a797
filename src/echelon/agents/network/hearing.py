"""Who receives from whom: along which edges, and in words from which leaders and through whom."""

from collections.abc import Iterator, Sequence

import numpy as np
import scipy.sparse.csgraph as csgraph

from echelon.agents.network.exchange import Exchange
from echelon.agents.network.graph import Graph
from echelon.core.types import Array
from echelon.core.words import amount

_NAMED = 12
"""Up to so many followers, or leaders, are named one by one."""


def edges_of(graph: Graph, exchange: Exchange) -> tuple[Array, Array]:
    """Return the edge of each directed link (K,), and which end of it, 0 or 1, receives."""
    receivers, senders = np.asarray(exchange.receivers), np.asarray(exchange.senders)
    # Along a directed edge (i, j) j receives, and an undirected one has the lower number first.
    end = np.ones(len(receivers), int) if graph.directed else (receivers > senders).astype(int)
    keys = graph.edges @ (graph.agents, 1)
    order = np.argsort(keys)
    link_keys = np.where(end, senders, receivers) * graph.agents + np.where(end, receivers, senders)
    return order[np.searchsorted(keys, link_keys, sorter=order)], end


def heard_along(graph: Graph, leaderward: bool, leaders_hear: bool) -> Array:
    """Return (E, 2) whether each end of each edge uses the other's messages."""
    used = np.zeros((len(graph.edges), 2), bool)
    used[edges_of(graph, graph.exchange(leaderward))] = True
    return used & (leaders_hear | ~np.isin(graph.edges, graph.leaders))


def who_hears_whom(graph: Graph) -> str:
    """Return from which leaders followers receive, directly or through whom; for many, in numbers.

    Information spreads to all agents; the text gives the path from the nearest leader, relative to
    which the goals are defined.
    """
    near, before, hops = _nearest(graph)
    if len(graph.followers) <= _NAMED:
        parts = _by_follower(graph, near, before)
    elif len(graph.leaders) <= _NAMED:
        parts = _by_leader(graph, near, hops)
    else:
        parts = _in_total(graph, near, hops)
    outgoing = graph.outgoing()
    alone = [k for k in graph.leaders if {*outgoing[[k]].indices.tolist()} <= {*graph.leaders}]
    unheard = [f"nobody hears {_numbered('leader', alone)}"] if alone else []
    return "; ".join([*parts, *unheard])


def _nearest(graph: Graph) -> tuple[Array, Array, Array]:
    """Return for each agent its nearest leader, its neighbour towards it, and the distance."""
    options = {"indices": graph.leaders, "unweighted": True, "return_predecessors": True}
    links, before = map(np.atleast_2d, csgraph.dijkstra(graph.outgoing(), **options))
    # The first of equally near ones, as in `Graph.nearest_leader`.
    row = np.argmin(links, axis=0)
    agents = np.arange(graph.agents)
    return np.array(graph.leaders)[row], before[row, agents], links[row, agents].astype(int)


def _by_follower(graph: Graph, near: Array, before: Array) -> Iterator[str]:
    groups: dict[str, list[int]] = {}
    for agent in graph.followers:
        direct = [other for other in graph.neighbours(agent) if other in graph.leaders]
        way = _numbered("leader", direct or [int(near[agent])])
        way += "" if direct else f" through {before[agent]}"
        groups.setdefault(way, []).append(agent)
    for way, agents in groups.items():
        yield f"{_numbered('follower', agents)} {'hears' if len(agents) == 1 else 'hear'} {way}"


def _by_leader(graph: Graph, near: Array, hops: Array) -> Iterator[str]:
    followers = np.array(graph.followers)
    for leader in graph.leaders:
        nearest = followers[near[followers] == leader]
        direct = int((hops[nearest] == 1).sum())
        far = f", the farthest through {hops[nearest].max() - 1}" if direct < len(nearest) else ""
        verb = "hears" if direct == 1 else "hear"
        if count := len(nearest):
            some = amount(count, "follower")
            yield f"of {some} nearest to leader {leader} {direct} {verb} it{far}"


def _in_total(graph: Graph, near: Array, hops: Array) -> Iterator[str]:
    followers = np.array(graph.followers)
    direct, most = int((hops[followers] == 1).sum()), int(hops[followers].max()) - 1
    counts = np.bincount(near[followers], minlength=graph.agents)[list(graph.leaders)]
    yield (
        f"{direct} of {len(followers)} followers hear one of {len(graph.leaders)} leaders "
        f"directly, the farthest through {most}; {counts.min()} to {counts.max()} are nearest to "
        "the same"
    )


def _numbered(kind: str, agents: Sequence[int]) -> str:
    """Return agents of a kind, such as `leaders 0, 2 and 5`; of many the first ones."""
    if len(agents) == 1:
        return f"{kind} {agents[0]}"
    first, last = agents[: min(8, len(agents) - 1)], agents[-1]
    more = f" and {last}" if len(first) == len(agents) - 1 else f" and {len(agents) - 8} more"
    return f"{kind}s {', '.join(map(str, first))}{more}"
