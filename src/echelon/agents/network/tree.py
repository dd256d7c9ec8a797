"""The order of agents by distance from the leaders, and their parents in a tree."""

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from echelon.agents.network.edges import name_agents
from echelon.agents.network.matrices import GraphMatrices
from echelon.core.errors import GraphError
from echelon.core.types import Array


def ordered_outward(graph: GraphMatrices) -> tuple[tuple[int, tuple[int, ...]], ...]:
    """Return `Graph.outward`.

    Raises:
        GraphError: the graph switches.
    """
    if graph.schedule is not None:
        raise GraphError("the graph switches, and plans are made in one order for all times.")
    # Stable, so that agents at equal distance stay in the order of their numbers.
    order = np.argsort(graph.depths(), kind="stable").tolist()
    earlier = {agent: order[:place] for place, agent in enumerate(order)}
    return tuple(
        (i, () if i in graph.leaders else tuple(j for j in graph.neighbours(i) if j in earlier[i]))
        for i in order
    )


def outward_edges(graph: GraphMatrices) -> tuple[Array, Array]:
    """Return the edges (E, 2) as arrows from nearer to a leader to farther, and their weights (E,).

    Edges between agents at equal distance are left out.

    Raises:
        GraphError: the graph switches, or the parts of different leaders are not connected.
    """
    if graph.schedule is not None:
        raise GraphError("the graph switches, and no agent is nearer to a leader at all times.")
    exchange = graph.exchange(leaderward=True)
    edges = np.stack([exchange.senders, exchange.receivers], axis=1)
    links = coo_array((np.ones(len(edges)), edges.T), (graph.agents, graph.agents))
    if connected_components(links, directed=False)[0] > 1:
        raise GraphError(
            "the directed graph splits into one part for each leader: no agent receives from more "
            "than one of them; leave `directed` out, or give the edges."
        )
    return edges, np.asarray(exchange.weights)


def parents_of(graph: GraphMatrices) -> tuple[int, ...]:
    """Return `Graph.parents`.

    Raises:
        GraphError: as there.
    """
    if graph.schedule is not None:
        raise GraphError(
            "the graph switches, and an agent has no one parent for all times; the feed-forward "
            "`relay` needs none."
        )
    depth, parents = graph.depths(), np.arange(graph.agents)
    i, j = graph.edges[depth[graph.edges].max(axis=1) > 0].T
    if graph.directed:
        # In a tree an agent receives from its parent only.
        follower = depth[j] > 0
        child, parent = j[follower], i[follower]
        counted, way = child, "more than one agent to hear"
    else:
        child, parent = np.where(depth[i] > depth[j], (i, j), (j, i))
        # An edge between agents at equal distance gives each of them a second path to a leader.
        counted = np.concatenate([child, parent[depth[i] == depth[j]]])
        way = "more than one way to a leader"
    several = np.flatnonzero(np.bincount(counted, minlength=graph.agents) > 1)
    if len(several):
        raise GraphError(
            f"the graph is no tree: {name_agents(several)} {way}, and so no one parent; the "
            "feed-forward `relay` needs none."
        )
    parents[child] = parent
    return tuple(parents.tolist())


def shares(graph: GraphMatrices, agent: int, earlier: tuple[int, ...]) -> Array:
    """Return the share of each neighbour in an agent's targets, by the weights of edges."""
    weights = np.asarray(graph.adjacency()[[agent]].toarray()).ravel()[list(earlier)]
    return weights / weights.sum()
