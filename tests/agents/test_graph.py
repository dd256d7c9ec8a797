"""The graph: spectra in closed form, networkx, and the laws of Laplacians."""

from fractions import Fraction

import jax.numpy as jnp
import networkx as nx
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles import adjacency, connected, laplacian, relabelled

from echelon.agents.network.graph import Graph
from echelon.agents.network.spectrum import rounded_bound
from echelon.core import errors, numerics
from echelon.guarantees.verifier.algebra import is_positive_definite


def graphs(most=9, weighted=True):
    """A random connected graph with one to three leaders."""
    return connected(most, weighted).map(lambda parts: Graph.from_edges(*parts))


def dense(graph):
    return laplacian(graph.agents, graph.edges, graph.weights)


def disagreement(graph, y):
    with numerics.precision("float64"):
        return np.asarray(graph.disagreement(jnp.asarray(y)))


@given(graphs())
def test_laplacian_is_degrees_minus_adjacency_symmetric_with_rows_that_sum_to_zero(graph):
    A, L = graph.adjacency().toarray(), graph.laplacian().toarray()
    assert A == pytest.approx(adjacency(graph.agents, graph.edges, graph.weights), abs=0.0)
    assert L == pytest.approx(dense(graph), abs=1e-13)
    assert np.array_equal(L, L.T)
    assert L.sum(axis=1) == pytest.approx(np.zeros(graph.agents), abs=1e-12)


@given(graphs())
def test_grounded_laplacian_is_the_positive_definite_follower_block(graph):
    rows = [k for k in range(graph.agents) if k not in graph.leaders]
    assert list(graph.followers) == rows
    L = graph.grounded_laplacian().toarray()
    assert L == pytest.approx(dense(graph)[np.ix_(rows, rows)], abs=1e-13)
    assert np.array_equal(L, L.T)
    values = np.linalg.eigvalsh(L)
    assert values[0] > 0.0
    assert graph.spectrum().eigenvalues == pytest.approx(values, rel=1e-9)
    # The paper's M; followers that lean on each other have a non-negative one.
    M = graph.inverse_grounded()
    assert M @ L == pytest.approx(np.eye(len(L)), abs=1e-10) and M.min() >= -1e-12


@given(graphs())
def test_networkx_agrees(graph):
    other, edges = nx.Graph(), zip(*graph.edges.T.tolist(), graph.weights, strict=True)
    other.add_nodes_from(range(graph.agents))
    other.add_weighted_edges_from(edges)
    L = graph.laplacian().toarray()
    assert L == pytest.approx(nx.laplacian_matrix(other).toarray(), abs=1e-12)
    for agent in range(graph.agents):
        assert graph.neighbours(agent) == tuple(sorted(other.neighbors(agent)))
    hops = [nx.single_source_shortest_path_length(other, k) for k in graph.leaders]
    nearest = [np.argmin([h[agent] for h in hops]) for agent in range(graph.agents)]
    assert graph.nearest_leader() == tuple(graph.leaders[k] for k in nearest)
    back = Graph.from_networkx(other, leaders=graph.leaders)
    assert back.laplacian().toarray() == pytest.approx(L, abs=0.0)
    assert back.leaders == graph.leaders


@given(graphs(most=5), st.integers(1, 2), st.integers(0, 10**6))
@settings(max_examples=12)  # every new shape is compiled
def test_disagreement_is_the_block_laplacian_times_the_states(graph, n, seed):
    y = np.random.default_rng(seed).normal(size=(graph.agents, n))
    block = np.kron(dense(graph), np.eye(n)) @ y.ravel()
    assert disagreement(graph, y).ravel() == pytest.approx(block, abs=1e-11)
    assert not disagreement(graph, np.full((graph.agents, n), y[0, 0])).any()
    # Agents that agree have none at all.
    assert not disagreement(graph, np.tile(1e6 * y[0], (graph.agents, 1))).any()


@given(graphs(most=5), st.randoms(use_true_random=False), st.integers(0, 10**6))
@settings(max_examples=12)
def test_renaming_agents_renames_everything(graph, random, seed):
    order = random.sample(range(graph.agents), graph.agents)
    renamed = relabelled(graph, order)
    places = np.ix_(order, order)
    assert renamed.laplacian().toarray()[places] == pytest.approx(graph.laplacian().toarray())
    assert sorted(order[k] for k in graph.leaders) == list(renamed.leaders)
    assert renamed.spectrum().eigenvalues == pytest.approx(graph.spectrum().eigenvalues, rel=1e-9)
    y = np.random.default_rng(seed).normal(size=(graph.agents, 2))
    there = disagreement(renamed, y[np.argsort(order)])
    assert there[order] == pytest.approx(disagreement(graph, y), abs=1e-11)
    assert relabelled(renamed, np.argsort(order)) == graph


def path_spectrum(followers):
    """Eigenvalues of a path whose one end is a leader."""
    k = np.arange(1, followers + 1)
    return 2.0 - 2.0 * np.cos((2 * k - 1) * np.pi / (2 * followers + 1))


@pytest.mark.parametrize(
    ("graph", "spectrum"),
    [
        (Graph([(0, 1), (1, 2), (1, 3)]), [2.0 - np.sqrt(3.0), 1.0, 2.0 + np.sqrt(3.0)]),
        (Graph.path(4), path_spectrum(3)),
        (Graph.star(6), np.ones(5)),
        (Graph.complete(6), [1.0, *[6.0] * 4]),
        # A chain with two fixed ends.
        (Graph.path(7, [0, 6]), 2.0 - 2.0 * np.cos(np.arange(1, 6) * np.pi / 6.0)),
    ],
    ids=["tree", "line", "star", "complete", "two ends"],
)
def test_spectra_in_closed_form(graph, spectrum):
    assert graph.spectrum().eigenvalues == pytest.approx(spectrum, rel=1e-12)


@pytest.mark.parametrize("followers", [1, 10, 400, 401, 1000])
def test_long_paths_have_the_spectrum_of_a_chain(followers):
    spectrum, wanted = Graph.path(followers + 1).spectrum(), path_spectrum(followers)
    assert spectrum.low == pytest.approx(wanted[0], rel=1e-9)
    assert spectrum.high == pytest.approx(wanted[-1], rel=1e-9)
    assert np.all(np.diff(spectrum.eigenvalues) >= 0.0)
    assert spectrum.total == followers
    assert len(spectrum.eigenvalues) == (followers if followers <= 400 else 2)


def test_parents_make_a_spectrum_of_the_weights_that_followers_feel():
    edges = [(0, 1, 2.0), (1, 2, 0.5), (1, 3, 2.0), (3, 4, 3.0)]
    assert Graph(edges).parent_spectrum().eigenvalues.tolist() == [0.5, 2.0, 3.0]
    led = Graph(edges, leaders=[3, 4]).parent_spectrum()
    assert (led.eigenvalues.tolist(), led.total) == ([0.5, 2.0], 2)


def same_edges(graph, other):
    ours = {tuple(edge) for edge in graph.edges.tolist()}
    return ours == {tuple(sorted(edge)) for edge in other.edges}


@pytest.mark.parametrize("agents", [3, 4, 9])
def test_named_graphs_are_those_of_networkx(agents):
    assert same_edges(Graph.path(agents), nx.path_graph(agents))
    assert same_edges(Graph.ring(agents), nx.cycle_graph(agents))
    assert same_edges(Graph.star(agents), nx.star_graph(agents - 1))
    assert same_edges(Graph.complete(agents), nx.complete_graph(agents))


def test_a_grid_is_numbered_row_by_row():
    other = nx.relabel_nodes(nx.grid_2d_graph(3, 4), lambda place: 4 * place[0] + place[1])
    graph = Graph.grid(3, 4)
    assert graph.agents == 12 and same_edges(graph, other)


def test_a_geometric_graph_links_exactly_the_points_that_are_near():
    graph = Graph.geometric(40, 0.3, seed=3)
    points = np.random.default_rng(3).uniform(size=(40, 2))
    other = nx.random_geometric_graph(40, 0.3, pos=dict(enumerate(points.tolist())))
    assert same_edges(graph, other)
    assert graph == Graph.geometric(40, 0.3, seed=3)
    assert graph != Graph.geometric(40, 0.3, seed=4)
    for seed in range(4):
        with pytest.raises(errors.GraphError, match="another `seed`") as told:
            Graph.geometric(7, 0.2, seed)
        advised = float(str(told.value).split("`radius` of ")[1].split()[0])
        assert Graph.geometric(7, advised, seed).agents == 7
        with pytest.raises(errors.GraphError, match="disconnected"):
            Graph.geometric(7, advised - 0.002, seed)


def test_edges_are_kept_as_given_with_the_smaller_agent_first():
    graph = Graph.from_edges([(2, 1, 0.5), (0, 1), (3, 1, 2)], leaders=[3])
    assert graph.edges.tolist() == [[1, 2], [0, 1], [1, 3]]
    assert graph.weights.tolist() == [0.5, 1.0, 2.0]
    assert (graph.agents, graph.leaders, graph.followers) == (4, (3,), (0, 1, 2))
    assert repr(graph) == "Graph(4 agents, 3 edges, leaders [3])"
    # Agents are numbered to the largest in an edge; leaders are sorted, each once.
    assert Graph.from_edges([(0, 5), *[(0, k) for k in range(1, 5)]]).agents == 6
    graph = Graph.from_edges([(0, 2), (1, 2), (2, 3)], leaders=[1, 0, 1])
    assert graph.leaders == (0, 1) and graph.followers == (2, 3)
    assert graph.nearest_leader() == (0, 1, 0, 0)


def test_graphs_are_values_that_cannot_be_changed():
    graph = Graph.path(3)
    assert graph == Graph([(1, 0), (1, 2)]) and hash(graph) == hash(Graph.path(3))
    assert graph != Graph.path(4) and graph != Graph.path(3, leaders=[1]) and graph != "graph"
    for values in (graph.edges, graph.weights):
        with pytest.raises(ValueError, match="read-only"):
            values[0] = 2


@given(graphs())
def test_outward_goes_by_distance_and_lists_the_neighbours_passed_on_the_way(graph):
    order = [agent for agent, _ in graph.outward()]
    far = nx.multi_source_dijkstra_path_length(
        nx.Graph([(int(i), int(j)) for i, j in graph.edges]), set(graph.leaders)
    )
    assert [(far[i], i) for i in order] == sorted((far[i], i) for i in range(graph.agents))
    for place, (agent, earlier) in enumerate(graph.outward()):
        passed = {j for j in graph.neighbours(agent) if j in order[:place]}
        assert set(earlier) == (set() if agent in graph.leaders else passed)
        assert bool(earlier) == (agent not in graph.leaders)


def exact_laplacian(graph):
    """The rows of the grounded Laplacian, in rational numbers."""
    place = {agent: k for k, agent in enumerate(graph.followers)}
    rows = [[Fraction(0)] * len(place) for _ in place]
    for (i, j), weight in zip(graph.edges.tolist(), graph.weights.tolist(), strict=True):
        for a, b in ((i, j), (j, i)):
            if a in place:
                rows[place[a]][place[a]] += Fraction(weight)
                if b in place:
                    rows[place[a]][place[b]] -= Fraction(weight)
    return rows


def exceeds(graph, bound):
    """Whether the smallest eigenvalue is above a number: exact signs of leading minors."""
    rows = exact_laplacian(graph)
    for k, row in enumerate(rows):
        row[k] -= Fraction(bound)
    return is_positive_definite(rows)


def least_quotient(graph, vector):
    """The smallest (L x)_i / x_i, exactly."""
    x = list(map(Fraction, vector.tolist()))
    rows = exact_laplacian(graph)
    products = (sum(a * b for a, b in zip(row, x, strict=True)) for row in rows)
    return min(product / b for product, b in zip(products, x, strict=True))


@settings(max_examples=25)
@given(
    parents=st.lists(st.integers(0, 5), min_size=1, max_size=6),
    decades=st.lists(st.floats(-8, 8), min_size=6, max_size=6),
)
def test_the_proved_eigenvalue_is_below_the_exact_one_and_sharp(parents, decades):
    edges = [(min(p, k), k + 1, 10.0 ** decades[k]) for k, p in enumerate(parents)]
    graph = Graph.from_edges(edges)
    spectrum = graph.spectrum()
    assert exceeds(graph, spectrum.proved * (1 - 1e-15))
    assert not exceeds(graph, spectrum.proved * (1 + 2e-9))
    # Floats alone would say more than is true of such weights.
    assert 0.0 < spectrum.low <= spectrum.proved * (1 + 2e-9)


@pytest.mark.parametrize("weights", [(1e-3, 1e13, 1.0), (1e-8, 1e8, 1e8), (1e-3, 1e11, 1.0)])
def test_heavy_edges_beside_light_ones_take_nothing_from_the_bound(weights):
    graph = Graph.from_edges([(k, k + 1, w) for k, w in enumerate(weights)])
    proved = graph.spectrum().proved
    assert exceeds(graph, proved * (1 - 1e-15)) and not exceeds(graph, proved * (1 + 2e-9))
    assert graph.spectrum().low == pytest.approx(proved, rel=2e-9)


def test_weights_that_sums_round_away_have_a_bound_or_are_refused():
    rng = np.random.default_rng(5)
    proved = 0
    for _ in range(40):
        agents = int(rng.integers(3, 12))
        edges = {tuple(sorted((int(rng.integers(0, i)), i))) for i in range(1, agents)}
        edges |= {tuple(sorted(map(int, rng.choice(agents, 2, False)))) for _ in range(agents)}
        weights = 10.0 ** rng.uniform(-18.0, 18.0, len(edges))
        graph = Graph([(*edge, w) for edge, w in zip(edges, weights, strict=True)])
        try:
            bound = graph.spectrum().proved
        except errors.GraphError as error:
            assert "too far apart" in str(error)
            continue
        proved += 1
        assert exceeds(graph, bound * (1 - 1e-15))
    assert proved > 20


def test_the_bound_of_a_long_line_is_that_of_its_closed_form():
    n = 460
    exact = 2.0 - 2.0 * np.cos(np.pi / (2 * (n - 1) + 1))
    spectrum = Graph.path(n).spectrum()
    assert exact * (1 - 1e-8) < spectrum.proved <= exact * (1 + 1e-10)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("decades", [0.0, 4.0])
def test_the_bound_in_floats_is_below_the_exact_one_and_near(seed, decades):
    rng = np.random.default_rng(seed)
    graph = Graph.grid(9, 14, leaders=[0, 30])
    weights = 10.0 ** rng.uniform(-decades, decades, len(graph.edges))
    graph = Graph([(i, j, w) for (i, j), w in zip(graph.edges, weights, strict=True)], [0, 30], 126)
    L = graph.grounded_laplacian().toarray()
    # Near the eigenvector, and far from it.
    vector = np.abs(np.linalg.eigh(L)[1][:, 0]) * rng.uniform(1.0 - 1e-9 * 10.0**seed, 1.0, len(L))
    found = rounded_bound(graph._grounded(), vector)
    exact = max(Fraction(0), least_quotient(graph, vector))
    assert Fraction(found) <= exact
    slack = 1e-12 * np.abs(weights).max()
    assert found >= float(exact) - slack


def test_both_ends_of_a_line_of_20000_are_those_of_its_closed_form():
    n = 20_000
    spectrum = Graph.path(n + 1).spectrum()
    for k, found in ((1, spectrum.low), (n, spectrum.high)):
        assert found == pytest.approx(4 * np.sin((2 * k - 1) * np.pi / (4 * n + 2)) ** 2, rel=1e-7)


@pytest.mark.parametrize(
    ("edges", "agents", "said"),
    [
        ([("a", 1)], None, "agents are whole numbers from 0 on"),
        ([(0, 1.5)], None, "agents are whole numbers from 0 on"),
        ([(0, float("nan"))], None, "agents are whole numbers from 0 on"),
        ([(0, 1), (1, 5)], 3, "an edge names agent 5, and with 3 agents the last is 2."),
        ([(0, 1), (1, 3)], 3, "an edge names agent 3, and with 3 agents the last is 2."),
    ],
)
def test_an_edge_is_of_agents_that_there_are(edges, agents, said):
    with pytest.raises(errors.GraphError) as caught:
        Graph(edges, agents=agents)
    assert said in str(caught.value)


@pytest.mark.parametrize("agents", [3.0, 2.5, "4", None, [3]])
@pytest.mark.parametrize(
    "make",
    [
        Graph.path,
        Graph.ring,
        Graph.star,
        Graph.complete,
        lambda n: Graph.grid(n, 2),
        lambda n: Graph.grid(2, n),
        lambda n: Graph.geometric(n, 2.0),
        lambda n: Graph([(0, 1)], agents=2.5 if n is None else n),
    ],
)
def test_a_number_of_agents_is_whole(make, agents):
    with pytest.raises(errors.GraphError, match="^the number of agents is .*whole number.*4.$"):
        make(agents)


def test_weights_of_which_eigenvalues_overflow_are_refused():
    with pytest.raises(errors.GraphError, match="is 1.7e.308, and must be positive, at most 1e.75"):
        Graph([(0, 1, 1.7e308)])
