"""The matrices of a graph and its directed links, and what follows: order, parents and reach."""

import abc
from collections.abc import Sequence

import numpy as np
import scipy.sparse as sp
import scipy.sparse.csgraph as csgraph
from jaxtyping import Int

from echelon.agents.network.edges import name_agents
from echelon.agents.network.exchange import Exchange
from echelon.agents.network.switching import Schedule
from echelon.core.errors import GraphError
from echelon.core.types import Array, States


class GraphMatrices(abc.ABC):
    """Weighted edges, and the matrices that they make; abstract, its attributes are `Graph`'s."""

    edges: Array
    weights: Array
    agents: int
    leaders: tuple[int, ...]
    followers: tuple[int, ...]
    directed: bool
    schedule: Schedule | None

    def adjacency(self, weights: Array | None = None) -> sp.csr_array:
        """Return the adjacency matrix (N, N), sparse: A_ij weighs what i receives from j.

        It is symmetric for undirected graphs. `weights` (E,) replace those of the graph, which are
        the largest ones where it switches.
        """
        (receivers, senders), edge = self._links()
        entries = ((self.weights if weights is None else weights)[edge], (receivers, senders))
        return sp.csr_array(sp.coo_array(entries, shape=(self.agents, self.agents)))

    def outgoing(self, weights: Array | None = None) -> sp.csr_array:
        """Return (N, N), sparse: entry ij is the weight of what i sends to j, where it is not 0."""
        A = self.adjacency(weights)
        A.eliminate_zeros()
        return sp.csr_array(A.T) if self.directed else A

    def laplacian(self, weights: Array | None = None) -> sp.csr_array:
        """Return the Laplacian (N, N), sparse; its rows sum to zero."""
        A = self.adjacency(weights)
        return sp.csr_array(csgraph.laplacian(A, use_out_degree=self.directed))

    def grounded_laplacian(self) -> sp.csr_array:
        """Return the Laplacian's follower block, the paper's L of Lemma 1; sparse."""
        return self._grounded_laplacian(self.weights)

    def _grounded_laplacian(self, weights: Array, leaderward: bool = False) -> sp.csr_array:
        rows = np.asarray(self.followers)
        if not leaderward:
            return sp.csr_array(self.laplacian(weights)[rows][:, rows])
        depth, A = self.depths(), sp.coo_array(self.adjacency(weights))
        A.data = np.where(depth[A.col] < depth[A.row], A.data, 0.0)
        A = sp.csr_array(A)
        return sp.csr_array(sp.diags_array(A.sum(axis=1)) - A)[rows][:, rows]

    @property
    def presence(self) -> Array | None:
        """Who is there in each stretch of time, (S, N); None where all always are."""
        return None if self.schedule is None else self.schedule.present

    def stretches(self, leaderward: bool = False) -> tuple[sp.csr_array, ...]:
        """Return the grounded Laplacian of each stretch of time; one where nothing switches.

        With `leaderward` each agent uses only the neighbours that are nearer to a leader. Who is
        absent counts as one that hears the leader alone, with the largest weights of all, and so
        does a backup leader that leads: nobody hears the one, and the other follows the leader's
        path.
        """
        schedule, rows = self.schedule, self.weights[None]
        if schedule is None or schedule.present is None or schedule.nearest is None:
            rows = rows if schedule is None else schedule.weights
            return tuple(self._grounded_laplacian(row, leaderward) for row in rows)
        followers = np.asarray(self.followers)
        apart = ~schedule.present | (schedule.nearest == np.arange(self.agents))
        heaviest = float(self.grounded_laplacian().diagonal().max())
        return tuple(
            _apart(self._grounded_laplacian(row, leaderward), out, heaviest)
            for row, out in zip(schedule.weights, apart[:, followers], strict=True)
        )

    def inverse_grounded(self) -> Array:
        """Return the paper's M = L^-1 of Assumption 6 as a dense matrix (for small graphs)."""
        # Dense: the inverse has no zeros within a connected piece of followers.
        return np.linalg.inv(self.grounded_laplacian().toarray())

    def neighbours(self, agent: int) -> tuple[int, ...]:
        """Return the agents from which `agent` receives, sorted."""
        if not 0 <= agent < self.agents:
            raise GraphError(
                f"agent {agent} is not in this graph, whose agents are 0 to {self.agents - 1}."
            )
        (receivers, senders), _ = self._links()
        return tuple(sorted(senders[receivers == agent].tolist()))

    def depths(self) -> Int[Array, " N"]:
        """Return how many edges away the nearest leader of each agent is."""
        among = {"indices": self.leaders, "unweighted": True, "min_only": True}
        return csgraph.dijkstra(self.outgoing(), **among).astype(int)

    def _links(self) -> tuple[tuple[Array, Array], Array]:
        """Return receivers and senders of all directed links, and the edge of each, (K,)."""
        (i, j), edge = self.edges.T, np.arange(len(self.edges))
        if self.directed:
            return (j, i), edge
        return (np.concatenate([i, j]), np.concatenate([j, i])), np.concatenate([edge, edge])

    def exchange(self, leaderward: bool = False) -> Exchange:
        """Return the computation of the disagreement.

        With `leaderward` each agent uses only the neighbours that are nearer to a leader. Of a
        graph that switches the weights are (S, K), a row for each stretch.
        """
        (receivers, senders), edge = self._links()
        if leaderward:
            depth = self.depths()
            nearer = depth[senders] < depth[receivers]
            receivers, senders, edge = receivers[nearer], senders[nearer], edge[nearer]
        rows = self.weights if self.schedule is None else self.schedule.weights
        return Exchange(receivers, senders, rows[..., edge])

    def disagreement(self, y: States, t: float = 0.0) -> States:
        """Return z (N, n) with z_i = sum_j A_ij (y_i - y_j), for y (N, n), at a time (s)."""
        exchange = self.exchange()
        if self.schedule is not None:
            exchange = exchange.during(self.schedule.row(t))
        return exchange(y, exchange.along_edges(y))


def _apart(L: sp.csr_array, out: Array, weight: float) -> sp.csr_array:
    """Return a grounded Laplacian in which some followers (F,) hear the leader alone."""
    kept = sp.diags_array((~out).astype(float))
    return sp.csr_array(kept @ L + sp.diags_array(weight * out))


def ordered_outward(graph: GraphMatrices) -> tuple[tuple[int, tuple[int, ...]], ...]:
    """Return `Graph.outward`; raise `GraphError` if the graph switches."""
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
    links = sp.coo_array((np.ones(len(edges)), edges.T), (graph.agents, graph.agents))
    if csgraph.connected_components(links, directed=False)[0] > 1:
        raise GraphError(
            "the directed graph splits into one part for each leader: no agent receives from more "
            "than one of them; leave `directed` out, or give the edges."
        )
    return edges, np.asarray(exchange.weights)


def parents_of(graph: GraphMatrices) -> tuple[int, ...]:
    """Return `Graph.parents`, or raise as it does."""
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


def check_reached(graph: GraphMatrices) -> None:
    """Raise `GraphError` unless leaders reach all along all edges, and along the last for ever."""
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
    """Return the agents that no leader, by default of the graph, reaches along weights (E,)."""
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
