"""Several leaders: each has its row, line and name, and reports say who follows whom."""

import re

import networkx as nx
import numpy as np
import pytest
from hypothesis import given, settings
from oracles import connected

import echelon as ech
from echelon.agents.network.hearing import who_hears_whom
from echelon.agents.references import Circle
from echelon.output.plots.run_figures import figures

# 0 - 1 - 2 - 3 - 4, with 5 beside 2 and leader 6, whom only leader 4 hears.
GRAPH = ech.Graph.from_edges([(0, 1), (1, 2), (2, 3), (3, 4), (2, 5), (4, 6)], leaders=[0, 4, 6])


@pytest.fixture(scope="module")
def flown():
    model = ech.models.DoubleIntegrator(2)
    offsets = {k: [float(k), 0.1 * k * k] for k in range(1, 7)}
    formation = ech.Formation.from_offsets(model, GRAPH, offsets)
    gain = ech.synthesize(model, GRAPH, ech.gains.Riccati())
    laws = ech.Laws(ech.laws.Tracking(Circle(radius=2.0)), ech.laws.Consensus(gain))
    initial = {0: [2.3, 0.0, 0.0, 1.0], "position": 0.5}
    return ech.simulate(
        ech.Parts(model, GRAPH, formation, laws, initial), ech.Settings(horizon=2.0, dt=0.02)
    )


def test_each_leader_has_its_row_with_its_own_numbers(flown):
    leaders = ech.metrics(flown).leaders
    assert [each.agent for each in leaders] == [0, 4, 6]
    offsets = flown.formation.offsets
    for each in leaders:
        away = flown.states[:-1, each.agent] - flown.reference[:-1] - offsets[each.agent]
        wanted = np.sqrt((away[:, :2] ** 2).sum(axis=1).mean())
        assert each.rmse == pytest.approx(wanted, rel=1e-9)
    # The first starts off its circle, the others do not.
    assert leaders[0].rmse > 10.0 * leaders[1].rmse
    rows = re.findall(r"^(leader \d+) +(\S+)", ech.report(flown), re.MULTILINE)
    assert rows == [(f"leader {each.agent}", f"{each.rmse:.4g}") for each in leaders]
    told = ech.summary(flown)["leaders"]
    assert [each["rmse"] for each in told] == [each.rmse for each in leaders]


def test_each_leader_is_drawn_and_named(flown):
    names, drawn = ["leader 0", "leader 4", "leader 6"], figures(flown)
    axes = figures(flown)["leader_3d"].axes[0]
    lines = {line.get_label(): line for line in axes.lines}
    assert set(names) <= set(lines) and "reference" in lines
    assert len({repr(lines[name]._dash_pattern) for name in names}) == 3
    for name, agent in zip(names, flown.graph.leaders, strict=True):
        assert lines[name].get_xdata() == pytest.approx(flown.states[:, agent, 0])
    # A reference for each, of which the legend names one.
    wanted = [flown.reference[:, 0] + flown.formation.offsets[k, 0] for k in flown.graph.leaders]
    xs = [line.get_xdata() for line in axes.lines if len(line.get_xdata()) == len(flown.times)]
    assert all(any(np.allclose(x, path, atol=1e-12) for x in xs) for path in wanted)
    for figure in ("trajectories", "tracking"):
        told = [text.get_text() for text in drawn[figure].legends[0].get_texts()]
        assert all(any(name in each for each in told) for name in names)


def test_it_is_said_who_follows_whom(flown):
    said = (
        "follower 1 hears leader 0; follower 2 hears leader 0 through 1; "
        "follower 3 hears leader 4; follower 5 hears leader 0 through 2; nobody hears leader 6"
    )
    assert who_hears_whom(GRAPH) == said
    assert f"Leaders: {said}; goals are relative to the nearest leader." in " ".join(
        ech.report(flown).split()
    )
    checked = ech.check(flown.parts, flown.settings)
    (line,) = [line for line in checked.lines if line.name == "who follows whom"]
    assert line.text == said and line.number_text == "3 leaders, 4 followers"


def test_of_flocks_it_is_said_in_numbers():
    assert who_hears_whom(ech.Graph.path(1000, leaders=[0, 999])) == "; ".join(
        f"of 499 followers nearest to leader {k} 1 hears it, the farthest through 498"
        for k in (0, 999)
    )
    many = ech.Graph.path(1000, leaders=range(0, 1000, 20))
    assert who_hears_whom(many) == (
        "99 of 950 followers hear one of 50 leaders directly, the farthest through 18; 10 to 28 "
        "are nearest to the same"
    )


@given(connected(weighted=False))
@settings(max_examples=30)
def test_what_is_said_of_a_small_graph_is_so(drawn):
    edges, leaders, agents = drawn
    graph, seen, leaders = ech.Graph.from_edges(edges, leaders, agents), nx.Graph(edges), {*leaders}
    told = who_hears_whom(graph)
    heard = {leader: set(seen[leader]) - leaders for leader in leaders}
    deaf = sorted(leader for leader in leaders if not heard[leader])
    assert ("nobody hears" in told) == bool(deaf)
    for part in told.split("; "):
        left, _, right = part.partition("hears" if "hears" in part else "hear")
        if left.startswith("nobody"):
            continue
        way, _, through = right.partition(" through ")
        for agent in map(int, re.findall(r"\d+", left)):
            named = {int(k) for k in re.findall(r"\d+", way)}
            if not through:
                assert named == set(seen[agent]) & leaders
                continue
            (leader,) = named
            hops = nx.single_source_shortest_path_length(seen, leader)
            assert hops[agent] == min(nx.shortest_path_length(seen, k, agent) for k in leaders)
            assert hops[int(through)] == hops[agent] - 1 and seen.has_edge(int(through), agent)
