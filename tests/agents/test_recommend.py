"""Recommended leaders and edges: they shorten the slowest disagreement of a formation the most."""

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import echelon as ech
from echelon.agents.network.topology import _Large
from echelon.core.digits import at_least
from echelon.experiments.studies.speedup import speedup, time_constant


def slowest(edges, leaders, agents):
    """The smallest eigenvalue of the grounded Laplacian, put together by hand."""
    L = np.zeros((agents, agents))
    for i, j, w in edges:
        L[i, i] += w
        L[j, j] += w
        L[i, j] -= w
        L[j, i] -= w
    kept = [k for k in range(agents) if k not in leaders]
    return np.linalg.eigvalsh(L[np.ix_(kept, kept)])[0]


@st.composite
def graphs(draw):
    agents = draw(st.integers(4, 8))
    # A tree of earlier parents is connected; more pairs come on top.
    pairs = {(draw(st.integers(0, k - 1)), k) for k in range(1, agents)}
    all_pairs = list(itertools.combinations(range(agents), 2))
    pairs |= set(draw(st.lists(st.sampled_from(all_pairs), max_size=4)))
    edges = [(i, j, draw(st.sampled_from([0.5, 1.0, 3.0]))) for i, j in sorted(pairs)]
    return ech.Graph.from_edges(edges, agents=agents), edges


@settings(max_examples=30)
@given(graphs())
def test_one_more_leader_or_edge_is_the_best_of_all(drawn):
    graph, edges = drawn
    agents = graph.agents
    (leader,) = ech.network.recommend_leaders(graph, 1)
    best = max(slowest(edges, {0, k}, agents) for k in range(1, agents))
    assert slowest(edges, {0, leader}, agents) == pytest.approx(best, rel=1e-9)
    linked = {(i, j) for i, j, _ in edges}
    free = [pair for pair in itertools.combinations(range(agents), 2) if pair not in linked]
    if free:
        (pair,) = ech.network.recommend_edges(graph, 1)
        best = max(slowest([*edges, (*each, 1.0)], {0}, agents) for each in free)
        assert pair in free
        assert slowest([*edges, (*pair, 1.0)], {0}, agents) == pytest.approx(best, rel=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, *(pytest.param(k, marks=pytest.mark.study) for k in (1, 2))])
def test_the_best_edge_is_among_those_that_are_tried_of_many(seed):
    random, agents = np.random.default_rng(seed), 40
    edges = [(int(random.integers(max(0, k - 3), k)), k, 1.0) for k in range(1, agents)]
    linked = {(i, j) for i, j, _ in edges}
    free = [pair for pair in itertools.combinations(range(agents), 2) if pair not in linked]
    assert len(free) > 700
    (pair,) = ech.network.recommend_edges(ech.Graph.from_edges(edges, agents=agents), 1)
    best = max(slowest([*edges, (*each, 1.0)], {0}, agents) for each in free)
    assert slowest([*edges, (*pair, 1.0)], {0}, agents) == pytest.approx(best, rel=1e-9)


@settings(max_examples=15)
@given(graphs(), st.integers(0, 3))
def test_each_further_leader_raises_lambda_min_and_keeps_the_earlier_ones(drawn, count):
    graph, edges = drawn
    count = min(count, graph.agents - 2)
    chosen = ech.network.recommend_leaders(graph, count)
    assert len(set(chosen)) == count and 0 not in chosen
    values = [slowest(edges, {0, *chosen[:k]}, graph.agents) for k in range(count + 1)]
    assert (np.diff(values) >= -1e-12).all()
    if count:
        assert chosen[:-1] == ech.network.recommend_leaders(graph, count - 1)


@pytest.mark.slow
def test_on_a_line_the_second_leader_stands_at_two_thirds():
    # Between two leaders a chain of k is as slow as an open one of k / 2: k = 2 (N - k).
    assert ech.network.recommend_leaders(ech.Graph.path(31))[0] in (20, 21)
    (pair,) = ech.network.recommend_edges(ech.Graph.path(31))
    assert pair[0] == 0 and 15 <= pair[1] <= 30


def test_large_graphs_are_thinned_and_still_gain():
    graph = ech.Graph.path(700)
    before = graph.spectrum().low
    (leader,) = ech.network.recommend_leaders(graph)
    after = ech.Graph.path(700, leaders=(0, leader)).spectrum().low
    assert abs(leader / 699 - 2 / 3) < 0.01 and after / before == pytest.approx(9.0, rel=0.05)
    (pair,) = ech.network.recommend_edges(graph)
    linked = ech.Graph.from_edges([*graph.edges.tolist(), pair])
    assert pair[0] == 0 and linked.spectrum().low > 3.0 * before


@settings(max_examples=10)
@given(st.integers(0, 10**6))
def test_what_a_large_graph_is_told_by_iteration_is_its_eigenvalue(seed):
    graph = ech.Graph.geometric(60, 0.35, seed=seed % 50)
    large, random = _Large(graph), np.random.default_rng(seed)
    edges = [(i, j, 1.0) for i, j in graph.edges]
    k = int(random.integers(1, 60))
    wanted = slowest(edges, {0, k}, 60)
    assert large.with_penalty([k - 1], [1.0], 0.0) == pytest.approx(wanted, rel=1e-2)
    i, j = sorted(random.choice(np.arange(1, 60), 2, replace=False).tolist())
    wanted = slowest([*edges, (i, j, 1.0)], {0}, 60)
    assert large.with_penalty([i - 1, j - 1], [1.0, -1.0], 1.0) == pytest.approx(wanted, rel=1e-2)
    wanted = slowest([*edges, (0, j, 1.0)], {0}, 60)
    assert large.with_penalty([j - 1], [-1.0], 1.0) == pytest.approx(wanted, rel=1e-2)


def test_the_time_constant_of_an_inner_loop_grows_as_the_square_of_a_line():
    model = ech.models.DoubleIntegrator(2)
    graphs = [ech.Graph.path(size + 1) for size in (10, 30, 90)]
    gain = ech.synthesize(model, graphs[0], ech.gains.InnerLoop())
    times = [time_constant(model, graph, gain) for graph in graphs]
    assert times[0] == pytest.approx(-1.0 / gain.certificate.abscissa, rel=1e-12)
    lows = np.array([graph.spectrum().low for graph in graphs])
    # First order: a position's zero eigenvalue moves by -c lambda times a constant of the loop.
    assert times * lows == pytest.approx(times[-1] * lows[-1], rel=0.05)
    assert np.log(times[2] / times[1]) / np.log(3.0) == pytest.approx(2.0, abs=0.05)


def test_what_is_told_is_what_the_changed_graph_has():
    model, graph = ech.models.Quadrotor.crazyflie(), ech.Graph.path(11)
    gain = ech.synthesize(model, graph, ech.gains.InnerLoop())
    found = speedup(model, graph, gain, leaders=1, edges=2)
    led = ech.Graph.path(11, leaders=(0, *found.leaders))
    linked = ech.Graph.from_edges([*graph.edges.tolist(), *found.edges])
    for told, changed in ((found.with_leaders, led), (found.with_edges, linked)):
        again = ech.synthesize(model, changed, ech.gains.InnerLoop()).certificate.abscissa
        assert told == pytest.approx(-1.0 / again, rel=1e-9) and told < 0.5 * found.now
    (i, j), (k, m) = found.edges
    assert found.sentence() == (
        f"The slowest disagreement decays with a time constant of {at_least(found.now)} s; "
        f"{at_least(found.with_leaders)} s with agent {found.leaders[0]} as a further leader; "
        f"{at_least(found.with_edges)} s with further edges {i}-{j}, {k}-{m}."
    )


def test_what_does_not_shorten_is_not_recommended():
    model, graph = ech.models.Quadrotor.crazyflie(), ech.Graph.from_edges([(0, 1), (1, 2), (1, 3)])
    found = speedup(model, graph, ech.synthesize(model, graph, ech.gains.Riccati()))
    assert not found.edges and found.with_edges == found.now
    assert found.leaders == () or found.with_leaders < found.now
    assert "edge" not in found.sentence()


def test_more_than_there_is_cannot_be_had():
    graph = ech.Graph.complete(4)
    with pytest.raises(ech.EchelonError, match="from 0 to 2, so that a follower remains"):
        ech.network.recommend_leaders(graph, 3)
    with pytest.raises(ech.EchelonError, match="from 0 to 0, the pairs that are not linked yet"):
        ech.network.recommend_edges(graph)
    assert ech.network.recommend_leaders(graph, 0) == () == ech.network.recommend_edges(graph, 0)
