"""The communication graph (paper, Definition 2).

It is undirected or directed, weighted or not, with one or more leaders, and may switch in time.
"""

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any, final

import numpy as np
import scipy.sparse as sp
import scipy.sparse.csgraph as csgraph

from echelon.agents.network.bound import Grounded
from echelon.agents.network.edges import (
    check_edges,
    check_leaders,
    check_size,
    count_agents,
    count_grid,
    give_weights,
    links,
    split_weights,
)
from echelon.agents.network.eigenvalues import (
    directed_spectrum,
    switching_spectrum,
    symmetric_spectrum,
)
from echelon.agents.network.exchange import Exchange
from echelon.agents.network.radius import advising, pairs_within
from echelon.agents.network.reach import check_reached, nearest_leaders
from echelon.agents.network.spectrum import Spectrum
from echelon.agents.network.switching import Schedule, Stretch, unite
from echelon.agents.network.tree import ordered_outward, outward_edges, parents_of
from echelon.core.errors import GraphError
from echelon.core.types import Array, States

if TYPE_CHECKING:
    import networkx as nx


@final
class Graph:
    """An immutable graph on agents 0 .. N-1, some of which are leaders.

    An edge of an undirected graph is heard both ways. A directed one (i, j) is an arrow along which
    i tells j: **j hears i**, as in Moreau (2005) and in Ren and Beard (2008), so that arrows lead
    from the leaders to all others, and A_ji is its weight.

    Args:
        edges: (i, j) or (i, j, weight).
        leaders: those who lead.
        agents: how many there are; the largest number named, plus one, when left out.
        directed: whether edges are heard one way.
        weights: of the edges, where these hold none.

    Attributes:
        edges: (E, 2) integers, each edge once in the order given, undirected ones with the smaller
            agent first.
        weights: (E,) positive weights A_ij; of one that switches, the largest.
        agents: the number N of agents, leaders included.
        leaders: sorted agent numbers.
        followers: all other agents, sorted.
        directed: whether edges are heard one way.
        schedule: when which weights hold; None where they never change.

    Raises:
        GraphError: an edge is a self-loop, repeated or out of range; a weight is not positive and
            finite; there is no leader or nothing but leaders; no leader reaches an agent.
    """

    def __init__(
        self,
        edges: Iterable[Sequence[float]],
        leaders: Iterable[int] = (0,),
        agents: int | None = None,
        directed: bool = False,
        weights: Sequence[float] | None = None,
    ) -> None:
        """Check and keep the graph."""
        edges = edges if weights is None else give_weights(edges, weights)
        pairs, heavy = split_weights(edges)
        self.directed = bool(directed)
        count = count_agents(pairs, agents)
        self._keep(*check_edges(pairs, heavy, count, self.directed), count, leaders, None)

    def _keep(
        self,
        edges: Array,
        weights: Array,
        agents: int,
        leaders: Iterable[int],
        schedule: Schedule | None,
    ) -> None:
        self.edges, self.weights, self.agents, self.schedule = edges, weights, agents, schedule
        self.leaders = check_leaders(leaders, self.agents)
        self.followers = tuple(np.delete(np.arange(self.agents), self.leaders).tolist())
        if not self.followers:
            raise GraphError(f"all {self.agents} agents are leaders, and at least one must follow.")
        check_reached(self)
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
        directed: bool = False,
        weights: Sequence[float] | None = None,
    ) -> "Graph":
        """Return the graph of the given edges, as the class itself."""
        return cls(edges, leaders, agents, directed, weights)

    @classmethod
    def switching(
        cls,
        stretches: Sequence[Stretch],
        leaders: Iterable[int] = (0,),
        agents: int | None = None,
        directed: bool = False,
        period: float | None = None,
    ) -> "Graph":
        """Return a graph that switches.

        Args:
            stretches: (time in s, the edges from then on), the first at 0.
            leaders: those who lead.
            agents: how many there are.
            directed: whether edges are heard one way.
            period: s, after which all begins again; the last edges stay for ever when left out.

        Raises:
            GraphError: a stretch has a false edge, the times do not ascend, or no leader reaches an
                agent along the edges of a whole period, or along the last ones.
        """
        graph = cls.__new__(cls)
        graph.directed = bool(directed)
        pairs, heavy, count, schedule = unite(stretches, agents, period, graph.directed)
        graph._keep(pairs, heavy, count, leaders, schedule)
        return graph

    @classmethod
    def from_networkx(cls, graph: "nx.Graph[Any]", leaders: Iterable[int] = (0,)) -> "Graph":
        """Return the graph of a networkx graph whose nodes are 0 .. N-1, directed where it is.

        The edge attribute `weight` is read, and is 1 where it is missing.

        Raises:
            GraphError: its nodes are not 0 .. N-1.
        """
        if set(graph.nodes) != set(range(len(graph))):
            text = "the nodes of the networkx graph must be the whole numbers from 0 on"
            raise GraphError(f"{text}, without a gap.")
        edges = [(i, j, data.get("weight", 1.0)) for i, j, data in graph.edges(data=True)]
        return cls(edges, leaders, len(graph), graph.is_directed())

    def with_leaders(self, more: Iterable[int]) -> "Graph":
        """Return the same graph with more leaders."""
        return Graph(self._triples(), [*self.leaders, *more], self.agents, self.directed)

    def with_edges(self, more: Iterable[Sequence[float]]) -> "Graph":
        """Return the same graph with more edges."""
        return Graph([*self._triples(), *more], self.leaders, self.agents, self.directed)

    def _triples(self) -> list[list[float]]:
        return np.column_stack([self.edges, self.weights]).tolist()

    @classmethod
    def path(cls, agents: int, leaders: Iterable[int] = (0,), directed: bool = False) -> "Graph":
        """Return the line 0 - 1 - ... - (agents - 1); a directed one leads away from 0."""
        check_size(agents, 2, "path")
        return cls(links(np.arange(agents - 1), np.arange(1, agents)), leaders, agents, directed)

    @classmethod
    def ring(cls, agents: int, leaders: Iterable[int] = (0,), directed: bool = False) -> "Graph":
        """Return the closed line."""
        check_size(agents, 3, "ring")
        all_ = np.arange(agents)
        return cls(links(all_, (all_ + 1) % agents), leaders, agents, directed)

    @classmethod
    def star(cls, agents: int, leaders: Iterable[int] = (0,), directed: bool = False) -> "Graph":
        """Return the star with agent 0 in the middle."""
        check_size(agents, 2, "star")
        return cls(links(0, np.arange(1, agents)), leaders, agents, directed)

    @classmethod
    def complete(cls, agents: int, leaders: Iterable[int] = (0,)) -> "Graph":
        """Return the graph with every edge."""
        check_size(agents, 2, "complete", share=1)
        return cls(np.stack(np.triu_indices(agents, 1), axis=1), leaders, agents)

    @classmethod
    def grid(cls, rows: int, columns: int, leaders: Iterable[int] = (0,)) -> "Graph":
        """Return rows x columns agents, numbered row by row, linked to the nearest four."""
        agents = count_grid(rows, columns)
        number = np.arange(agents).reshape(rows, columns)
        across = links(number[:, :-1].ravel(), number[:, 1:].ravel())
        down = links(number[:-1].ravel(), number[1:].ravel())
        return cls(np.concatenate([across, down]), leaders, agents)

    @classmethod
    def geometric(
        cls, agents: int, radius: float, seed: int = 0, leaders: Iterable[int] = (0,)
    ) -> "Graph":
        """Return random points of the unit square, linked where closer than `radius`.

        Raises:
            GraphError: the radius is too small for the points to be connected.
        """
        # An agent's neighbours are those in its disc, as far as that lies in the square.
        share = min(1.0, np.pi * float(radius) * float(radius))
        check_size(agents, 2, "geometric", share=share)
        points = np.random.default_rng(seed).uniform(size=(agents, 2))
        with advising(points, radius):
            return cls(pairs_within(points, radius), leaders, agents)

    def one_way(self) -> "Graph":
        """Return the directed graph in which agents hear those alone that are nearer to a leader.

        Raises:
            GraphError: the graph switches, or falls apart between leaders.
        """
        edges, weights = outward_edges(self)
        return Graph(edges, self.leaders, self.agents, True, weights.tolist())

    def adjacency(self) -> sp.csr_array:
        """Return the adjacency matrix (N, N), sparse: A_ij weighs what i hears of j.

        It is symmetric for undirected graphs; of one that switches it has the largest weights.
        """
        return self._weighing(self.weights)

    def _weighing(self, weights: Array) -> sp.csr_array:
        (receivers, senders), place = self._ways()
        entries = (weights[place], (receivers, senders))
        return sp.csr_array(sp.coo_array(entries, shape=(self.agents, self.agents)))

    def told(self, weights: Array | None = None) -> sp.csr_array:
        """Return (N, N), sparse: entry ij where i tells j, its weight; of some weights (E,)."""
        A = self._weighing(self.weights if weights is None else weights)
        A.eliminate_zeros()
        return sp.csr_array(A.T) if self.directed else A

    def laplacian(self) -> sp.csr_array:
        """Return the Laplacian (N, N), sparse; its rows sum to zero."""
        return self._laplacian(self.adjacency())

    def _laplacian(self, A: sp.csr_array) -> sp.csr_array:
        return sp.csr_array(csgraph.laplacian(A, use_out_degree=self.directed))

    def grounded_laplacian(self) -> sp.csr_array:
        """Return the follower block of the Laplacian, sparse and positive definite.

        It is the paper's L of Lemma 1; of a directed graph it is not symmetric.
        """
        return self._grounding(self.weights)

    def _grounding(self, weights: Array, leaderward: bool = False) -> sp.csr_array:
        A, rows = self._weighing(weights), np.asarray(self.followers)
        if leaderward:
            depth, A = self.depths(), sp.coo_array(A)
            A.data = np.where(depth[A.col] < depth[A.row], A.data, 0.0)
            A = sp.csr_array(A)
            return sp.csr_array(sp.diags_array(A.sum(axis=1)) - A)[rows][:, rows]
        return sp.csr_array(self._laplacian(A)[rows][:, rows])

    def stretches(self, leaderward: bool = False) -> tuple[sp.csr_array, ...]:
        """Return the grounded Laplacian of each stretch of time, one where nothing switches.

        Leaderward, of hearing those alone that are nearer to a leader.
        """
        rows = self.weights[None] if self.schedule is None else self.schedule.weights
        return tuple(self._grounding(row, leaderward) for row in rows)

    def inverse_grounded(self) -> Array:
        """Return the paper's M = L^-1 of Assumption 6 as a dense matrix (for small graphs)."""
        # Dense: the inverse has no zeros within a connected piece of followers.
        return np.linalg.inv(self.grounded_laplacian().toarray())

    def spectrum(self) -> Spectrum:
        """Return the eigenvalues of the grounded Laplacian; computed once.

        All of them, or beyond 400 followers of an undirected graph the smallest and the largest; of
        one that switches, those of all stretches.

        Raises:
            GraphError: the weights are too far apart for the smallest to be known, or too many
                followers of a directed graph hear each other in circles.
        """
        if self._spectrum is None:
            if self.schedule is not None:
                self._spectrum = switching_spectrum(self.stretches())
            elif self.directed:
                self._spectrum = directed_spectrum(self.grounded_laplacian(), self.weights)
            else:
                self._spectrum = symmetric_spectrum(self.grounded_laplacian(), self._grounded())
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
        """Return the agents that `agent` hears, sorted."""
        if not 0 <= agent < self.agents:
            raise GraphError(
                f"agent {agent} is not in this graph, whose agents are 0 to {self.agents - 1}."
            )
        (receivers, senders), _ = self._ways()
        return tuple(sorted(senders[receivers == agent].tolist()))

    def nearest_leader(self) -> tuple[int, ...]:
        """Return for each agent the leader fewest edges away (the lowest number on a tie)."""
        return nearest_leaders(self)

    def outward(self) -> tuple[tuple[int, tuple[int, ...]], ...]:
        """Return the agents by how far they are from the leaders, each with its earlier neighbours.

        It is the order in which agents can plan when each needs the plans of those before it. Among
        the equally far the lower number comes first; a leader has no earlier neighbours.
        """
        return ordered_outward(self)

    def depths(self) -> Array:
        """Return (N,) how many edges away each agent's nearest leader is."""
        among = {"indices": self.leaders, "unweighted": True, "min_only": True}
        return csgraph.dijkstra(self.told(), **among).astype(int)

    def parents(self) -> tuple[int, ...]:
        """Return each agent's only neighbour that is nearer to a leader; leaders are their own.

        Raises:
            GraphError: the graph is no tree (edges between leaders aside), lets an agent hear more
                than one where it is directed, or switches.
        """
        return parents_of(self)

    def _ways(self) -> tuple[tuple[Array, Array], Array]:
        """Return who hears whom, receivers and senders, and along which edge, (K,) each."""
        (i, j), edge = self.edges.T, np.arange(len(self.edges))
        if self.directed:
            return (j, i), edge
        return (np.concatenate([i, j]), np.concatenate([j, i])), np.concatenate([edge, edge])

    def exchange(self, leaderward: bool = False) -> "Exchange":
        """Return the computation of the disagreement; leaderward, of those nearer a leader.

        Of a graph that switches its weights are (S, K), a row for each stretch.
        """
        (receivers, senders), place = self._ways()
        if leaderward:
            depth = self.depths()
            nearer = depth[senders] < depth[receivers]
            receivers, senders, place = receivers[nearer], senders[nearer], place[nearer]
        rows = self.weights if self.schedule is None else self.schedule.weights
        return Exchange(receivers, senders, rows[..., place])

    def disagreement(self, y: States, t: float = 0.0) -> States:
        """Return z (N, n) with z_i = sum_j A_ij (y_i - y_j), for y (N, n), at a time (s)."""
        heard = self.exchange()
        return (heard if self.schedule is None else heard.during(self.schedule.row(t)))(y, y)

    def __eq__(self, other: object) -> bool:
        """Tell whether two graphs have the same agents, leaders and edges in the same order."""
        return (
            isinstance(other, Graph)
            and self._known == other._known
            and np.array_equal(self.edges, other.edges)
            and np.array_equal(self.weights, other.weights)
        )

    def __hash__(self) -> int:
        """Hash what `__eq__` compares."""
        return hash((self._known, self.edges.tobytes(), self.weights.tobytes()))

    @property
    def _known(self) -> tuple[object, ...]:
        when = self.schedule and (*(x.tobytes() for x in self.schedule[:2]), self.schedule.period)
        return self.agents, self.leaders, self.directed, when

    def __repr__(self) -> str:
        """Say the size."""
        edges = f"{len(self.edges)} {'directed ' * self.directed}edges"
        return f"Graph({self.agents} agents, {edges}, leaders {list(self.leaders)})"
