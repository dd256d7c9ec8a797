"""The matrices of a graph and its directed links, from which all other properties follow."""

import abc

import numpy as np
import scipy.sparse as sp
import scipy.sparse.csgraph as csgraph
from jaxtyping import Int

from echelon.agents.network.exchange import Exchange
from echelon.agents.network.switching import Schedule
from echelon.core.errors import GraphError
from echelon.core.types import Array, States


class GraphMatrices(abc.ABC):
    """Weighted edges between agents 0 .. N-1, and the matrices that they make; abstract.

    Its attributes are those of `Graph`.
    """

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
        """Return the follower block of the Laplacian, sparse and positive definite.

        It is the paper's L of Lemma 1; of a directed graph it is not symmetric.
        """
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
        does an heir that leads: nobody hears the one, and the other follows the leader's path.
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
