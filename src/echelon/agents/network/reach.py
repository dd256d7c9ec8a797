"""The agents that leaders reach, along the edges of one stretch of time or of all stretches."""

from collections.abc import Sequence

import numpy as np
import scipy.sparse as sp
import scipy.sparse.csgraph as csgraph

from echelon.agents.network.edges import name_agents
from echelon.agents.network.matrices import GraphMatrices
from echelon.agents.network.switching import Schedule
from echelon.core.errors import GraphError
from echelon.core.types import Array


def check_reached(graph: GraphMatrices) -> None:
    """Check that leaders reach every agent along all edges, and along the last ones for ever.

    Raises:
        GraphError: they do not.
    """
    schedule = graph.schedule
    periodic = schedule is not None and schedule.period is not None
    lost = lost_along(
        graph, schedule.weights.max(axis=0) if schedule and periodic else graph.weights
    )
    if len(lost):
        raise GraphError(_cut_off(graph, lost))
    if schedule and not periodic:
        lost = unreached(graph, schedule, -1)
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


def lost_along(graph: GraphMatrices, weights: Array, leaders: Sequence[int] | None = None) -> Array:
    """Return the agents that no leader reaches along the edges that have a weight (E,).

    The leaders are those of the graph where none are named.
    """
    leaders = graph.leaders if leaders is None else leaders
    if not graph.directed:
        # One direction of each edge is enough, which halves the time for millions of edges.
        present = weights > 0.0
        edges = graph.edges if present.all() else graph.edges[present]
        links = sp.coo_array((np.ones(len(edges)), edges.T), (graph.agents, graph.agents))
        count, label = csgraph.connected_components(links.tocsr(), directed=False)
        led = np.zeros(count, bool)
        led[label[list(leaders)]] = True
        return np.flatnonzero(~led[label])
    among = {"indices": leaders, "unweighted": True, "min_only": True}
    return np.flatnonzero(np.isinf(csgraph.dijkstra(graph.outgoing(weights), **among)))


def nearest_leaders(graph: GraphMatrices) -> tuple[int, ...]:
    """Return `Graph.nearest_leader`."""
    if len(graph.leaders) == 1:
        return graph.leaders * graph.agents
    hops = csgraph.dijkstra(graph.outgoing(), indices=graph.leaders, unweighted=True)
    # `argmin` takes the first of equals, and leaders are sorted.
    return tuple(np.array(graph.leaders)[np.argmin(hops, axis=0)].tolist())


def unreached(graph: GraphMatrices, schedule: Schedule, row: int) -> Array:
    """Return the agents that are present in a row of a schedule, and that no leader reaches."""
    if schedule.present is None or schedule.nearest is None:
        return lost_along(graph, schedule.weights[row])
    here = np.flatnonzero(schedule.present[row])
    leaders = np.unique(schedule.nearest[row, here]).tolist()
    return np.intersect1d(lost_along(graph, schedule.weights[row], leaders), here)


def lost_at_times(graph: GraphMatrices) -> str:
    """Return which agents leaders do not reach at some time, and when; empty if there are none."""
    schedule = graph.schedule
    for row, span in enumerate(schedule.spans() if schedule is not None else ()):
        assert schedule is not None
        lost = unreached(graph, schedule, row)
        if len(lost):
            return f"{name_agents(lost)} no path to a leader {span}"
    return ""


def _name_leaders(graph: GraphMatrices) -> str:
    kind = "leader" if len(graph.leaders) == 1 else "leaders"
    return f"{kind} {', '.join(str(leader) for leader in graph.leaders[:8])}"
