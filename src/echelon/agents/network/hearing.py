"""Who hears whom: along which edges, and in words through whom each hears which leaders."""

from collections.abc import Iterator, Sequence

import numpy as np
import scipy.sparse.csgraph as csgraph

from echelon.agents.network.exchange import Exchange
from echelon.agents.network.graph import Graph
from echelon.core.types import Array

_NAMED = 12
"""Up to so many followers, or leaders of a flock, have words of their own."""


def edges_of(graph: Graph, heard: Exchange) -> tuple[Array, Array]:
    """Return along which edge each of the ways goes (K,), and which end of it, 0 or 1, hears."""
    hears, said = np.asarray(heard.receivers), np.asarray(heard.senders)
    # A directed edge (i, j) is heard by j, and an undirected one has the lower number first.
    end = np.ones(len(hears), int) if graph.directed else (hears > said).astype(int)
    keys = graph.edges @ (graph.agents, 1)
    order = np.argsort(keys)
    wanted = np.where(end, said, hears) * graph.agents + np.where(end, hears, said)
    return order[np.searchsorted(keys, wanted, sorter=order)], end


def heard_along(graph: Graph, leaderward: bool, leaders_hear: bool) -> Array:
    """Return whether each end of each edge hears the other, (E, 2).

    Args:
        graph: of all.
        leaderward: whether those alone are heard who are nearer to a leader.
        leaders_hear: whether leaders act on what they hear.
    """
    found = np.zeros((len(graph.edges), 2), bool)
    found[edges_of(graph, graph.exchange(leaderward))] = True
    return found & (leaders_hear | ~np.isin(graph.edges, graph.leaders))


def who_hears_whom(graph: Graph) -> str:
    """Return which leaders the followers hear, directly or through whom; of a flock, in numbers.

    Everybody hears everybody in the end; what is told is the way from the leader that goals are
    relative to, the nearest one.
    """
    near, before, hops = _ways(graph)
    if len(graph.followers) <= _NAMED:
        told = _each(graph, near, before)
    elif len(graph.leaders) <= _NAMED:
        told = _by_leader(graph, near, hops)
    else:
        told = _in_all(graph, near, hops)
    heard = graph.outgoing()
    alone = [k for k in graph.leaders if {*heard[[k]].indices.tolist()} <= {*graph.leaders}]
    unheard = [f"nobody hears {_numbered('leader', alone)}"] if alone else []
    return "; ".join([*told, *unheard])


def _ways(graph: Graph) -> tuple[Array, Array, Array]:
    """Return for each agent its nearest leader, its neighbour on the way there, and the links."""
    asked = {"indices": graph.leaders, "unweighted": True, "return_predecessors": True}
    links, before = map(np.atleast_2d, csgraph.dijkstra(graph.outgoing(), **asked))
    # The first of equals, as everywhere that the nearest leader counts.
    row = np.argmin(links, axis=0)
    agents = np.arange(graph.agents)
    return np.array(graph.leaders)[row], before[row, agents], links[row, agents].astype(int)


def _each(graph: Graph, near: Array, before: Array) -> Iterator[str]:
    """Yield who hears which leaders, all that hear the same in one part."""
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
        own = followers[near[followers] == leader]
        direct = int((hops[own] == 1).sum())
        far = f", the farthest through {hops[own].max() - 1}" if direct < len(own) else ""
        verb = "hears" if direct == 1 else "hear"
        if len(own):
            yield f"of {len(own)} followers nearest to leader {leader} {direct} {verb} it{far}"


def _in_all(graph: Graph, near: Array, hops: Array) -> Iterator[str]:
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
