"""The agents that leaders reach, along the edges of one stretch of time or of all stretches."""

import numpy as np
import scipy.sparse as sp
import scipy.sparse.csgraph as csgraph

from echelon.agents.network.edges import name_agents
from echelon.agents.network.matrices import GraphMatrices
from echelon.core.errors import GraphError
from echelon.core.types import Array


def check_reached(graph: GraphMatrices) -> None:
    """Check that leaders reach every agent along all edges, and along the last ones for ever.

    Raises:
        GraphError: they do not.
    """
    lost = lost_along(graph, graph.weights)
    if len(lost):
        raise GraphError(_cut_off(graph, lost))
    schedule = graph.schedule
    if schedule is not None and schedule.period is None:
        lost = lost_along(graph, schedule.weights[-1])
        if len(lost):
            raise GraphError(
                f"the graph leaves agents behind: {name_agents(lost)} no path to a leader "
                f"({_name_leaders(graph)}) from {schedule.starts[-1]:g} s on, after the last "
                "switch; add edges there, or give a `period` after which the schedule repeats."
            )
    if len(graph.leaders) == 1:
        return
    count, label = csgraph.connected_components(graph.adjacency(), directed=False)
    if count > 1:
        # Each component has its own leader and would be a separate formation.
        apart = np.flatnonzero(label != label[0])
        raise GraphError(f"the graph is disconnected: {name_agents(apart)} no path to agent 0.")


def _cut_off(graph: GraphMatrices, lost: Array) -> str:
    """Return the error message about agents that no leader ever reaches."""
    who = f"{name_agents(lost)} no path to a leader ({_name_leaders(graph)})"
    if graph.schedule is not None and graph.schedule.period is not None:
        return (
            f"the graph leaves agents behind: {who} in a window of {graph.schedule.period:g} s, "
            "along all edges of the schedule together; add an edge to it."
        )
    if graph.directed:
        return (
            f"the graph leaves agents behind: {who} along its arrows; an edge "
            "[i, j] lets j receive from i, so add one, or reverse one."
        )
    return f"the graph is disconnected: {who}."


def lost_along(graph: GraphMatrices, weights: Array) -> Array:
    """Return the agents that no leader reaches along the edges that have a weight (E,)."""
    if not graph.directed:
        # One direction of each edge is enough, which halves the time for millions of edges.
        present = weights > 0.0
        edges = graph.edges if present.all() else graph.edges[present]
        links = sp.coo_array((np.ones(len(edges)), edges.T), (graph.agents, graph.agents))
        count, label = csgraph.connected_components(links.tocsr(), directed=False)
        led = np.zeros(count, bool)
        led[label[list(graph.leaders)]] = True
        return np.flatnonzero(~led[label])
    among = {"indices": graph.leaders, "unweighted": True, "min_only": True}
    return np.flatnonzero(np.isinf(csgraph.dijkstra(graph.outgoing(weights), **among)))


def nearest_leaders(graph: GraphMatrices) -> tuple[int, ...]:
    """Return `Graph.nearest_leader`."""
    if len(graph.leaders) == 1:
        return graph.leaders * graph.agents
    hops = csgraph.dijkstra(graph.outgoing(), indices=graph.leaders, unweighted=True)
    # `argmin` takes the first of equals, and leaders are sorted.
    return tuple(np.array(graph.leaders)[np.argmin(hops, axis=0)].tolist())


def lost_at_times(graph: GraphMatrices) -> str:
    """Return which agents leaders do not reach at some time, and when; empty if there are none."""
    if graph.schedule is None:
        return ""
    for span, weights in zip(graph.schedule.spans(), graph.schedule.weights, strict=True):
        lost = lost_along(graph, weights)
        if len(lost):
            return f"{name_agents(lost)} no path to a leader {span}"
    return ""


def _name_leaders(graph: GraphMatrices) -> str:
    kind = "leader" if len(graph.leaders) == 1 else "leaders"
    return f"{kind} {', '.join(str(leader) for leader in graph.leaders[:8])}"
