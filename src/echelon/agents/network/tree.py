"""A graph as seen from its leaders: who comes before whom, and who is whose parent."""

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from echelon.agents.network.edges import name_agents
from echelon.agents.network.matrices import GraphMatrices
from echelon.core.errors import GraphError
from echelon.core.types import Array


def ordered_outward(graph: GraphMatrices) -> tuple[tuple[int, tuple[int, ...]], ...]:
    """Return what `Graph.outward` says.

    Raises:
        GraphError: the graph switches.
    """
    if graph.schedule is not None:
        raise GraphError("the graph switches, and plans are made in one order for all times.")
    # Stable, which leaves the equally far in the order of their numbers.
    order = np.argsort(graph.depths(), kind="stable").tolist()
    known = {agent: order[:place] for place, agent in enumerate(order)}
    return tuple(
        (i, () if i in graph.leaders else tuple(j for j in graph.neighbours(i) if j in known[i]))
        for i in order
    )


def outward_edges(graph: GraphMatrices) -> tuple[Array, Array]:
    """Return the edges (E, 2) as arrows from nearer to a leader to farther, and their weights (E,).

    Edges between agents equally far are none of them.

    Raises:
        GraphError: the graph switches, or what each leader leads falls apart from the rest.
    """
    if graph.schedule is not None:
        raise GraphError("the graph switches, and no agent is nearer to a leader at all times.")
    heard = graph.exchange(leaderward=True)
    edges = np.stack([heard.senders, heard.receivers], axis=1)
    links = coo_array((np.ones(len(edges)), edges.T), (graph.agents, graph.agents))
    if connected_components(links, directed=False)[0] > 1:
        raise GraphError(
            "of the graph heard one way, what the leaders lead falls apart: no agent hears more "
            "than one of them; leave `directed` out, or give the edges."
        )
    return edges, np.asarray(heard.weights)


def parents_of(graph: GraphMatrices) -> tuple[int, ...]:
    """Return what `Graph.parents` says.

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
        # Whoever hears another one beside its parent is no link of a chain of its own.
        heard = depth[j] > 0
        child, parent = j[heard], i[heard]
        counted, way = child, "more than one agent to hear"
    else:
        child, parent = np.where(depth[i] > depth[j], (i, j), (j, i))
        # An edge between two that are equally far gives both of them one more way.
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
    """Return what part each neighbour has in an agent's targets, by the edges' weights."""
    weights = np.asarray(graph.adjacency()[[agent]].toarray()).ravel()[list(earlier)]
    return weights / weights.sum()
