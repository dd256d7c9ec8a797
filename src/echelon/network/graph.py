"""The communication graph (paper, Definition 2).

It is undirected, weighted or not, with one or more leaders.
"""

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any, final

import numpy as np
import scipy.sparse as sp
import scipy.sparse.csgraph as csgraph
import scipy.sparse.linalg as spla

from echelon.core.errors import GraphError
from echelon.core.types import Array, States
from echelon.network.bound import Grounded, least_eigenvalue_bound
from echelon.network.edges import (
    check_edges,
    check_leaders,
    check_size,
    count_agents,
    name_agents,
    split_weights,
)
from echelon.network.exchange import Exchange
from echelon.network.reach import advising
from echelon.network.spectrum import Spectrum

if TYPE_CHECKING:
    import networkx as nx

# Below this many followers the dense eigenvalue routine is both faster and exact to rounding.
_DENSE = 400
_RESOLVED = 1e-6
_LEFT_OUT = 1e-6
_ITERATIONS = 30
_ROUNDED = 1.0 - 1e-9
"""A bound this near to an eigenvalue takes nothing from it."""


@final
class Graph:
    """An immutable undirected graph on agents 0 .. N-1, some of which are leaders.

    Attributes:
        edges: (E, 2) integers, each edge once with the smaller agent first, in the order given.
        weights: (E,) positive weights A_ij.
        agents: the number N of agents, leaders included.
        leaders: sorted agent numbers.
        followers: all other agents, sorted.

    Raises:
        GraphError: an edge is a self-loop, repeated or out of range; a weight is not positive and
            finite; there is no leader or nothing but leaders; the graph is disconnected.
    """

    def __init__(
        self,
        edges: Iterable[Sequence[float]],
        leaders: Iterable[int] = (0,),
        agents: int | None = None,
    ) -> None:
        """Check and keep the graph; an edge is (i, j) or (i, j, weight)."""
        pairs, weights = split_weights(edges)
        self.agents = count_agents(pairs, agents)
        self.edges, self.weights = check_edges(pairs, weights, self.agents)
        self.leaders = check_leaders(leaders, self.agents)
        self.followers = tuple(np.setdiff1d(np.arange(self.agents), self.leaders).tolist())
        if not self.followers:
            raise GraphError(f"all {self.agents} agents are leaders, and at least one must follow.")
        self._check_connected()
        self._spectrum: Spectrum | None = None
        # Runs share a graph, and its spectrum is kept: what cannot change cannot go stale.
        for array in (self.edges, self.weights):
            array.setflags(write=False)

    @classmethod
    def from_edges(
        cls,
        edges: Iterable[Sequence[float]],
        leaders: Iterable[int] = (0,),
        agents: int | None = None,
    ) -> "Graph":
        """Return the graph of the given edges.

        `agents` is the largest number named, plus one, when left out.
        """
        return cls(edges, leaders, agents)

    @classmethod
    def from_networkx(cls, graph: "nx.Graph[Any]", leaders: Iterable[int] = (0,)) -> "Graph":
        """Return the graph of an undirected networkx graph whose nodes are 0 .. N-1.

        The edge attribute `weight` is read, and is 1 where it is missing.

        Raises:
            GraphError: the graph is directed or its nodes are not 0 .. N-1.
        """
        if graph.is_directed():
            raise GraphError("the networkx graph is directed, and must be undirected.")
        if set(graph.nodes) != set(range(len(graph))):
            raise GraphError(
                "the nodes of the networkx graph must be the whole numbers from 0 on, "
                "without a gap."
            )
        edges = [(i, j, data.get("weight", 1.0)) for i, j, data in graph.edges(data=True)]
        return cls(edges, leaders, len(graph))

    def with_leaders(self, more: Iterable[int]) -> "Graph":
        """Return the same graph with more leaders."""
        return Graph(self._triples(), [*self.leaders, *more], self.agents)

    def with_edges(self, more: Iterable[Sequence[float]]) -> "Graph":
        """Return the same graph with more edges."""
        return Graph([*self._triples(), *more], self.leaders, self.agents)

    def _triples(self) -> list[list[float]]:
        return np.column_stack([self.edges, self.weights]).tolist()

    @classmethod
    def path(cls, agents: int, leaders: Iterable[int] = (0,)) -> "Graph":
        """Return the line 0 - 1 - ... - (agents - 1)."""
        check_size(agents, 2, "path")
        return cls([(i, i + 1) for i in range(agents - 1)], leaders, agents)

    @classmethod
    def ring(cls, agents: int, leaders: Iterable[int] = (0,)) -> "Graph":
        """Return the closed line."""
        check_size(agents, 3, "ring")
        return cls([(i, (i + 1) % agents) for i in range(agents)], leaders, agents)

    @classmethod
    def star(cls, agents: int, leaders: Iterable[int] = (0,)) -> "Graph":
        """Return the star with agent 0 in the middle."""
        check_size(agents, 2, "star")
        return cls([(0, i) for i in range(1, agents)], leaders, agents)

    @classmethod
    def complete(cls, agents: int, leaders: Iterable[int] = (0,)) -> "Graph":
        """Return the graph with every edge."""
        check_size(agents, 2, "complete", agents * (agents - 1) // 2)
        return cls(np.stack(np.triu_indices(agents, 1), axis=1), leaders, agents)

    @classmethod
    def grid(cls, rows: int, columns: int, leaders: Iterable[int] = (0,)) -> "Graph":
        """Return rows x columns agents, numbered row by row, linked to the nearest four."""
        check_size(rows * columns, 2, "grid")
        number = np.arange(rows * columns).reshape(rows, columns)
        across = np.stack([number[:, :-1].ravel(), number[:, 1:].ravel()], axis=1)
        down = np.stack([number[:-1].ravel(), number[1:].ravel()], axis=1)
        return cls(np.concatenate([across, down]), leaders, rows * columns)

    @classmethod
    def geometric(
        cls, agents: int, radius: float, seed: int = 0, leaders: Iterable[int] = (0,)
    ) -> "Graph":
        """Return random points of the unit square, linked where closer than `radius`.

        Raises:
            GraphError: the radius is too small for the points to be connected.
        """
        # Imported here: random graphs alone need it.
        from scipy.spatial import KDTree

        # An agent's neighbours are those in its disc, as far as that lies in the square.
        share = min(1.0, np.pi * float(radius) * float(radius))
        check_size(agents, 2, "geometric", share * agents * (agents - 1) / 2)
        points = np.random.default_rng(seed).uniform(size=(agents, 2))
        pairs = KDTree(points).query_pairs(radius, output_type="ndarray")
        # The tree returns pairs in no promised order; sorted, a seed is one graph everywhere. One
        # number a pair sorts ten times faster than two.
        number = np.sort(pairs[:, 0] * agents + pairs[:, 1])
        with advising(points, radius):
            return cls(np.stack(np.divmod(number, agents), axis=1), leaders, agents)

    def adjacency(self) -> sp.csr_array:
        """Return the symmetric adjacency matrix (N, N), sparse."""
        both = self.exchange()
        entries = (both.weights, (both.receivers, both.senders))
        return sp.csr_array(sp.coo_array(entries, shape=(self.agents, self.agents)))

    def laplacian(self) -> sp.csr_array:
        """Return the Laplacian (N, N), sparse; its rows sum to zero."""
        return sp.csr_array(csgraph.laplacian(self.adjacency()))

    def grounded_laplacian(self) -> sp.csr_array:
        """Return the follower block of the Laplacian, sparse and positive definite.

        It is the paper's L of Lemma 1.
        """
        rows = np.asarray(self.followers)
        return sp.csr_array(self.laplacian()[rows][:, rows])

    def inverse_grounded(self) -> Array:
        """Return the paper's M = L^-1 of Assumption 6 as a dense matrix (for small graphs)."""
        # Dense: the inverse has no zeros within a connected piece of followers.
        return np.linalg.inv(self.grounded_laplacian().toarray())

    def spectrum(self) -> Spectrum:
        """Return the eigenvalues of the grounded Laplacian; computed once.

        All of them up to 400 followers, beyond that the smallest and the largest.

        Raises:
            GraphError: the weights are too far apart for the smallest to be known.
        """
        if self._spectrum is None:
            L, count = self.grounded_laplacian(), len(self.followers)
            if count <= _DENSE:
                dense = L.toarray()
                eigenvalues, vector = np.linalg.eigvalsh(dense), np.linalg.eigh(dense)[1][:, 0]
            else:
                eigenvalues, vector = _extremes(L)
            low, high = float(eigenvalues[0]), float(eigenvalues[-1])
            # Floats know it to the rounding of the largest.
            known = low if low > _RESOLVED * high else np.inf
            proved = least_eigenvalue_bound(self._grounded(), _spread(L, vector), known)
            if not proved > 0.0:
                raise GraphError(
                    f"the weights of the graph lie between {self.weights.min():.3g} and "
                    f"{self.weights.max():.3g}, too far apart to tell its smallest eigenvalue "
                    "from 0; bring them nearer to each other."
                )
            # Where rounding may have raised it, the eigenvalue is no better known than its bound.
            eigenvalues[0] = min(eigenvalues[0], proved / _ROUNDED)
            eigenvalues.setflags(write=False)
            self._spectrum = Spectrum(eigenvalues, count, proved)
        return self._spectrum

    def _grounded(self) -> Grounded:
        """Return the grounded Laplacian by its weights."""
        place = np.full(self.agents, -1)
        place[list(self.followers)] = np.arange(len(self.followers))
        ends = place[self.edges]
        free, held = (ends >= 0).all(axis=1), (ends >= 0).sum(axis=1) == 1
        holds = np.stack([ends[held].max(axis=1), self.weights[held]], axis=1)
        return Grounded(ends[free], self.weights[free], holds, len(self.followers))

    def parent_spectrum(self) -> Spectrum:
        """Return the eigenvalues where each agent of a tree is sent its parent's input.

        They are the edges' weights, those between leaders aside (theory page, T4).
        """
        led = np.isin(self.edges, self.leaders).all(axis=1)
        weights = np.unique(self.weights[~led])
        weights.setflags(write=False)
        return Spectrum(weights, len(weights), float(weights[0]))

    def neighbours(self, agent: int) -> tuple[int, ...]:
        """Return the agents linked to `agent`, sorted."""
        if not 0 <= agent < self.agents:
            raise GraphError(
                f"agent {agent} is not in this graph, whose agents are 0 to {self.agents - 1}."
            )
        i, j = self.edges.T
        return tuple(sorted(np.concatenate([j[i == agent], i[j == agent]]).tolist()))

    def nearest_leader(self) -> tuple[int, ...]:
        """Return for each agent the leader fewest edges away (the lowest number on a tie)."""
        hops = csgraph.dijkstra(self.adjacency(), indices=self.leaders, unweighted=True)
        # `argmin` takes the first of equals, and leaders are sorted.
        return tuple(self.leaders[k] for k in np.argmin(np.atleast_2d(hops), axis=0))

    def outward(self) -> tuple[tuple[int, tuple[int, ...]], ...]:
        """Return the agents by how far they are from the leaders, each with its earlier neighbours.

        It is the order in which agents can plan when each needs the plans of those before it. Among
        the equally far the lower number comes first; a leader has no earlier neighbours.
        """
        # Stable, which leaves the equally far in the order of their numbers.
        order = np.argsort(self.depths(), kind="stable").tolist()
        known = {agent: order[:place] for place, agent in enumerate(order)}
        return tuple(
            (i, () if i in self.leaders else tuple(j for j in self.neighbours(i) if j in known[i]))
            for i in order
        )

    def depths(self) -> Array:
        """Return (N,) how many edges away each agent's nearest leader is."""
        among = {"indices": self.leaders, "unweighted": True, "min_only": True}
        return csgraph.dijkstra(self.adjacency(), **among).astype(int)

    def parents(self) -> tuple[int, ...]:
        """Return each agent's only neighbour that is nearer to a leader; leaders are their own.

        Raises:
            GraphError: the graph is no tree (edges between leaders aside).
        """
        depth, parents = self.depths(), np.arange(self.agents)
        i, j = self.edges[depth[self.edges].max(axis=1) > 0].T
        child, parent = np.where(depth[i] > depth[j], (i, j), (j, i))
        # An edge between two that are equally far gives both of them one more way.
        counted = np.concatenate([child, parent[depth[i] == depth[j]]])
        several = np.flatnonzero(np.bincount(counted, minlength=self.agents) > 1)
        if len(several):
            raise GraphError(
                f"the graph is no tree: {name_agents(several)} more than one way to a leader, "
                "and so no one parent; the feed-forward `relay` needs none."
            )
        parents[child] = parent
        return tuple(parents.tolist())

    def exchange(self, leaderward: bool = False) -> "Exchange":
        """Return the computation of the disagreement; leaderward, of those nearer a leader."""
        (i, j), w = self.edges.T, self.weights
        heard = np.concatenate([i, j]), np.concatenate([j, i]), np.concatenate([w, w])
        if leaderward:
            nearer = self.depths()[heard[1]] < self.depths()[heard[0]]
            heard = tuple(part[nearer] for part in heard)
        return Exchange(*heard)

    def disagreement(self, y: States) -> States:
        """Return z (N, n) with z_i = sum_j A_ij (y_i - y_j), for y (N, n)."""
        return self.exchange()(y, y)

    def __eq__(self, other: object) -> bool:
        """Tell whether two graphs have the same agents, leaders and edges in the same order."""
        return (
            isinstance(other, Graph)
            and (self.agents, self.leaders) == (other.agents, other.leaders)
            and np.array_equal(self.edges, other.edges)
            and np.array_equal(self.weights, other.weights)
        )

    def __hash__(self) -> int:
        """Hash what `__eq__` compares."""
        return hash((self.agents, self.leaders, self.edges.tobytes(), self.weights.tobytes()))

    def __repr__(self) -> str:
        """Say the size."""
        return f"Graph({self.agents} agents, {len(self.edges)} edges, leaders {list(self.leaders)})"

    def _check_connected(self) -> None:
        count, label = csgraph.connected_components(self.adjacency(), directed=False)
        if count == 1:
            return
        reached = np.isin(label, label[list(self.leaders)])
        lost = np.flatnonzero(~reached)
        if len(lost):
            raise GraphError(
                f"the graph is disconnected: {name_agents(lost)} no path to a leader "
                f"({_name_leaders(self)})."
            )
        # Each piece has a leader of its own, and would be a formation of its own.
        apart = np.flatnonzero(label != label[0])
        raise GraphError(f"the graph is disconnected: {name_agents(apart)} no path to agent 0.")


def factor_inverse(L: sp.csr_array) -> spla.LinearOperator:
    """Return x -> L^-1 x for a sparse positive definite matrix, which is factored here, once."""
    # An ordering and a pivoting that keep L's symmetry leave a factor many times sparser.
    symmetric = {"SymmetricMode": True}
    factor = spla.splu(sp.csc_array(L), "MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=symmetric)
    return spla.LinearOperator(L.shape, factor.solve, dtype=np.float64)  # pyright: ignore


def _extremes(L: sp.csr_array) -> tuple[Array, Array]:
    """Return the ends of the spectrum of a sparse positive definite matrix, and the low vector."""
    # About 0 the smallest is far from the others, relative to itself; Lanczos on L finds it last.
    inverse = factor_inverse(L)
    smallest, vectors = spla.eigsh(L, k=1, sigma=0.0, OPinv=inverse)
    # The same about a bound of the largest, the sum of two neighbours' degrees (Anderson, Morley):
    # of a line the largest lie so close together that Lanczos on L hardly parts them.
    entries, degrees = sp.coo_array(L), L.diagonal()
    bound = 1.000001 * float((degrees[entries.row] + degrees[entries.col]).max())
    above = factor_inverse(sp.csr_array(bound * sp.eye_array(len(degrees)) - L))
    away = spla.LinearOperator(L.shape, lambda x: -above.matvec(x), dtype=np.float64)  # pyright: ignore
    largest = spla.eigsh(L, k=1, sigma=bound, OPinv=away, return_eigenvectors=False)
    return np.concatenate([smallest, largest]), vectors[:, 0]


def _spread(L: sp.csr_array, vector: Array) -> Array:
    """Return an eigenvector with entries on all pieces of a network that its leaders cut apart.

    On a piece that it leaves out, inverse iteration finds the piece's own.
    """
    _, piece = csgraph.connected_components(L, directed=False)
    size = np.zeros(piece.max() + 1)
    np.maximum.at(size, piece, np.abs(vector))
    if (size > _LEFT_OUT).all():
        return vector
    inverse, other = factor_inverse(L), np.ones(len(vector))
    for _ in range(_ITERATIONS):
        other = inverse.matvec(other)
        largest = np.zeros_like(size)
        np.maximum.at(largest, piece, other)
        other = other / largest[piece]
    return np.where(size[piece] > _LEFT_OUT, vector, other)


def _name_leaders(graph: Graph) -> str:
    kind = "leader" if len(graph.leaders) == 1 else "leaders"
    return f"{kind} {', '.join(str(leader) for leader in graph.leaders[:8])}"


def shares(graph: Graph, agent: int, earlier: tuple[int, ...]) -> Array:
    """Return what part each neighbour has in an agent's targets, by the edges' weights."""
    weights = np.asarray(graph.adjacency()[[agent]].toarray()).ravel()[list(earlier)]
    return weights / weights.sum()
