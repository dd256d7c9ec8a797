"""The communication graph (paper, Definition 2).

It is undirected or directed, weighted or not, with one or more leaders, and may switch in time.
"""

import copy
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any, final

import numpy as np
from numpy.typing import ArrayLike

from echelon.agents.network.edges import (
    advising,
    check_edges,
    check_leaders,
    check_size,
    count_agents,
    count_grid,
    edges_of_matrix,
    give_weights,
    links,
    pairs_within,
    split_weights,
)
from echelon.agents.network.events import check_backups, event_faults, schedule_of
from echelon.agents.network.graph_file import FileEdges, number_nodes, read_graph
from echelon.agents.network.matrices import (
    GraphMatrices,
    check_reached,
    nearest_leaders,
    ordered_outward,
    outward_edges,
    parents_of,
)
from echelon.agents.network.spectrum import (
    Grounded,
    Spectrum,
    directed_spectrum,
    switching_spectrum,
    symmetric_spectrum,
)
from echelon.agents.network.switching import Schedule, Stretch, unite
from echelon.agents.part import Event
from echelon.core.errors import GraphError, check_kind
from echelon.core.types import Array, PathLike
from echelon.core.words import amount

if TYPE_CHECKING:
    import networkx as nx


@final
class Graph(GraphMatrices):
    """An immutable graph on agents 0 .. N-1, some of which are leaders.

    Undirected edges carry information both ways. A directed edge (i, j) is an arrow: **j receives
    from i**, as in Moreau (2005) and in Ren and Beard (2008), so that arrows lead from the leaders
    to all others, and A_ji is its weight.

    Args:
        edges: (i, j) or (i, j, weight).
        leaders: numbers of the leaders.
        agents: the number N of agents, leaders included; by default the largest number in an edge
            plus one.
        directed: whether edges carry information one way.
        weights: of the edges, where these hold none.

    Attributes:
        edges: (E, 2) integers, each edge once in the order of the argument, undirected ones with
            the smaller agent first.
        weights: (E,) positive weights A_ij; of one that switches, the largest.
        agents: the number N of agents, leaders included.
        leaders: sorted agent numbers.
        followers: all other agents, sorted.
        directed: whether edges carry information one way.
        schedule: when which weights hold; None where they never change.
        events: what happens to it, by time.
        backups: who leads when the leader is lost, the first that is present.
        before: the graph without its events.

    Raises:
        GraphError: an edge is a self-loop, repeated or out of range; a weight is not positive and
            finite; there is no leader or nothing but leaders; no leader reaches an agent.
    """

    events: tuple[Event, ...]
    backups: tuple[int, ...]
    before: "Graph"

    def __init__(
        self,
        edges: Iterable[Sequence[float]],
        leaders: Iterable[int] = (0,),
        agents: int | None = None,
        directed: bool = False,
        weights: Sequence[float] | None = None,
    ) -> None:
        edges = edges if weights is None else give_weights(edges, weights)
        pairs, heavy = split_weights(edges)
        self.directed = bool(directed)
        count = count_agents(pairs, agents)
        self._set(*check_edges(pairs, heavy, count, self.directed), count, leaders, None)

    def _set(
        self,
        edges: Array,
        weights: Array,
        agents: int,
        leaders: Iterable[int],
        schedule: Schedule | None,
    ) -> None:
        self.edges, self.weights, self.agents, self.schedule = edges, weights, agents, schedule
        self.events, self.backups, self.before = (), (), self
        self.leaders = check_leaders(leaders, self.agents)
        self.followers = tuple(np.delete(np.arange(self.agents), self.leaders).tolist())
        if not self.followers:
            raise GraphError(f"all {self.agents} agents are leaders, and at least one must follow.")
        check_reached(self)
        self._spectrum: Spectrum | None = None
        # Runs share a graph and its spectrum, which no change of an array may make false.
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
        """Return the graph of the edges, as the constructor does."""
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
            leaders: numbers of the leaders.
            agents: the number of agents.
            directed: whether edges carry information one way.
            period: s, after which the stretches repeat; without it the last edges stay for ever.

        Raises:
            GraphError: a stretch has an invalid edge, the times do not ascend, or no leader reaches
                an agent along the edges of a whole period, or along the last ones.
        """
        graph = cls.__new__(cls)
        graph.directed = bool(directed)
        pairs, heavy, count, schedule = unite(stretches, agents, period, graph.directed)
        graph._set(pairs, heavy, count, leaders, schedule)
        return graph

    @classmethod
    def from_networkx(cls, graph: "nx.Graph[Any]", leaders: Iterable[int] = (0,)) -> "Graph":
        """Return the graph of a networkx graph, directed where it is.

        Its nodes are 0 .. N-1, or texts, which are numbered as in `read`. The edge attribute
        `weight` is read, and is 1 where it is missing.

        Raises:
            GraphError: it is no graph of networkx, or its nodes are neither 0 .. N-1 nor texts.
        """
        if not (hasattr(graph, "nodes") and hasattr(graph, "is_directed")):
            raise GraphError(
                f"`graph` is a `{type(graph).__name__}`, and must be a graph of networkx."
            )
        text = all(isinstance(node, str) for node in graph.nodes)
        number = number_nodes(list(graph.nodes)) if text else {node: node for node in graph.nodes}
        if set(number.values()) != set(range(len(graph))):
            raise GraphError(
                "the nodes of the networkx graph must be the whole numbers from 0 on, without "
                "a gap, or texts."
            )
        weighted = graph.edges(data="weight", default=1.0)
        edges = [(number[i], number[j], weight) for i, j, weight in weighted]
        return cls(edges, leaders, len(graph), graph.is_directed())

    @classmethod
    def read(
        cls, file: PathLike, leaders: Iterable[int] = (0,), directed: bool | None = None
    ) -> "Graph":
        """Return the graph in a file.

        The file is a table of edges (from, to and where given a weight), a table that is an
        adjacency matrix as of `from_adjacency`, GraphML (`.graphml`), or a sparse matrix that
        `scipy.sparse.save_npz` wrote (`.npz`). Whole numbers name agents; nodes such as `n0`, `n1`
        are agents in the order of their numbers, other texts in the order in which they occur.

        Args:
            file: path of the file.
            leaders: numbers of the leaders.
            directed: whether edges carry information one way; by default as GraphML says, if a
                matrix is not symmetric, and not for a list of edges.

        Raises:
            GraphError: the file cannot be read, or has no graph; the message names file and line.
        """
        found = read_graph(file)
        try:
            if not isinstance(found, FileEdges):
                return cls.from_adjacency(found, leaders, directed)
            one_way = bool(found.directed if directed is None else directed)
            return cls(found.edges, leaders, found.agents, one_way)
        except GraphError as error:
            raise GraphError(f"of the graph `{file}`: {error}") from None

    @classmethod
    def from_adjacency(
        cls, matrix: ArrayLike, leaders: Iterable[int] = (0,), directed: bool | None = None
    ) -> "Graph":
        """Return the graph of an adjacency matrix.

        Args:
            matrix: (N, N), A_ij >= 0 is the weight with which i receives from j; 0 for no edge. It
                may be a sparse matrix of SciPy.
            leaders: numbers of the leaders.
            directed: whether edges carry information one way; by default if A is not symmetric.

        Raises:
            GraphError: the matrix is not square, a weight is negative or not finite, an agent has
                an edge to itself, or an undirected graph is asked of a matrix without symmetry.
        """
        return cls(*edges_of_matrix(matrix, leaders, directed))

    def with_leaders(self, more: Iterable[int]) -> "Graph":
        """Return the same graph with more leaders."""
        return Graph(self._triples(), [*self.leaders, *more], self.agents, self.directed)

    def with_edges(self, more: Iterable[Sequence[float]]) -> "Graph":
        """Return the same graph with more edges."""
        return Graph([*self._triples(), *more], self.leaders, self.agents, self.directed)

    def with_events(self, events: Sequence[Event], backups: Sequence[int] = ()) -> "Graph":
        """Return the same graph, to which something happens; other events are replaced.

        Args:
            events: losses and arrivals of agents, and cuts of links.
            backups: who leads when the leader is lost, the first that is present.

        Raises:
            GraphError: an event is not possible, or leaves somebody without a path to the leader.
        """
        before, events, backups = self.before, tuple(events), tuple(backups)
        if (events, backups) == (self.events, self.backups):
            return self
        for k, event in enumerate(events):
            check_kind(f"events[{k}]", event, Event, GraphError)
        check_backups(before, backups)
        for fault in event_faults(before, events, backups):
            raise GraphError(f"{fault.text}.")
        graph, events = copy.copy(before), tuple(sorted(events, key=lambda event: event.at))
        graph.events, graph.backups, graph.before, graph._spectrum = events, backups, before, None
        graph.schedule = schedule_of(before, events, backups) if events else before.schedule
        return graph

    def until(self, at: float) -> "Graph":
        """Return the graph with the events before a time (s) alone: nobody joins afterwards."""
        graph, before, presence = copy.copy(self), self.before, self.presence
        events = tuple(event for event in self.events if event.at < at)
        absent = [] if presence is None else np.flatnonzero(~presence[0]).tolist()
        graph.events, graph.schedule, graph._spectrum = events, before.schedule, None
        if events or absent:
            graph.schedule = schedule_of(before, events, self.backups, absent)
        return graph

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
        """Return the directed graph in which agents receive only from those nearer to a leader.

        Raises:
            GraphError: the graph switches, or splits into parts with different leaders.
        """
        edges, weights = outward_edges(self)
        return Graph(edges, self.leaders, self.agents, True, weights.tolist())

    def in_steps(self, dt: float) -> "Graph | None":
        """Return the graph as it runs in steps of dt (s), to which switches are rounded up.

        None where the rounding repeats only after many periods.

        Raises:
            GraphError: stretches that are shorter than a step are left out, and without them no
                leader reaches an agent.
        """
        if self.schedule is None:
            return self
        schedule = self.schedule.in_steps(dt)
        if schedule is None:
            return None
        old, new = self.schedule.starts, schedule.starts
        if len(old) == len(new) and np.allclose(old, new, 0.0, 1e-9 * dt):
            return self
        graph = copy.copy(self)  # by whose weights agents are nearer to a leader than others
        graph.schedule, graph._spectrum = schedule, None
        check_reached(graph)
        return graph

    def spectrum(self) -> Spectrum:
        """Return the eigenvalues of the grounded Laplacian; computed once.

        All of them; beyond 400 followers of an undirected graph the smallest and the largest; of a
        graph that switches, those of all stretches.

        Raises:
            GraphError: the weights are too far apart for the smallest to be known, or a directed
                graph has too large a strongly connected component of followers.
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
        row = np.full(self.agents, -1)
        row[list(self.followers)] = np.arange(len(self.followers))
        ends = row[self.edges]
        free, grounded = (ends >= 0).all(axis=1), (ends >= 0).sum(axis=1) == 1
        to_leaders = np.stack([ends[grounded].max(axis=1), self.weights[grounded]], axis=1)
        return Grounded(ends[free], self.weights[free], to_leaders, len(self.followers))

    def parent_spectrum(self) -> Spectrum:
        """Return the eigenvalues where each agent of a tree receives its parent's input.

        They are the weights of all edges but those between leaders (theory page, T4).
        """
        between_leaders = np.isin(self.edges, self.leaders).all(axis=1)
        weights = np.unique(self.weights[~between_leaders])
        weights.setflags(write=False)
        return Spectrum(weights, len(weights), float(weights[0]))

    def nearest_leader(self) -> tuple[int, ...]:
        """Return the nearest leader of each agent, in edges (the lowest number on a tie)."""
        return nearest_leaders(self)

    def outward(self) -> tuple[tuple[int, tuple[int, ...]], ...]:
        """Return the agents by distance from the leaders, each with its earlier neighbours.

        It is the order in which agents can plan when each needs the plans of those before it. At
        equal distance the lower number comes first; a leader has no earlier neighbours.
        """
        return ordered_outward(self)

    def parents(self) -> tuple[int, ...]:
        """Return each agent's only neighbour that is nearer to a leader; leaders are their own.

        Raises:
            GraphError: the graph is no tree (edges between leaders aside), a directed one lets an
                agent receive from more than one other, or the graph switches.
        """
        return parents_of(self)

    def __eq__(self, other: object) -> bool:
        return (
            isinstance(other, Graph)
            and self._constants == other._constants
            and np.array_equal(self.edges, other.edges)
            and np.array_equal(self.weights, other.weights)
        )

    def __hash__(self) -> int:
        return hash((self._constants, self.edges.tobytes(), self.weights.tobytes()))

    @property
    def _constants(self) -> tuple[object, ...]:
        schedule = self.schedule
        times = schedule and (*(x.tobytes() for x in schedule[:2]), schedule.period)
        return self.agents, self.leaders, self.directed, times, self.events, self.backups

    def __repr__(self) -> str:
        edges = amount(len(self.edges), f"{'directed ' * self.directed}edge")
        return f"Graph({self.agents} agents, {edges}, leaders {list(self.leaders)})"
