"""The numbers of a run, against closed forms on constructed runs."""

import dataclasses

import numpy as np
import pytest
from runs import made_up

import echelon as ech
from echelon.core.errors import Outcome
from echelon.experiments.results.metrics import metrics, output_errors
from echelon.experiments.results.recording import recording_of
from echelon.experiments.results.summary import summary


@pytest.fixture
def exponential():
    """Two agents in space, the follower off by 2^-t (3, 0, 4) from its goal (1, 0, 0) ahead."""
    model, graph = ech.models.SingleIntegrator(3), ech.Graph.path(2)
    t = np.arange(21.0)
    leader = np.column_stack([np.sin(t), t, 0 * t])
    goal = leader + [1.0, 0.0, 0.0]
    follower = goal + 2.0 ** -t[:, None] * [3.0, 0.0, 4.0]
    offsets = [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]]
    return made_up(np.stack([leader, follower], axis=1), model, graph, offsets, window=2.0)


def follower_moved(result, frame):
    """The same run with the follower a metre off its path in one frame."""
    states = result.states.copy()
    states[frame, 1] += 1.0
    return made_up(states, result.model, result.graph, result.formation.offsets, window=2.0)


def test_formation_error_is_the_vector_to_the_goal(exponential):
    t = exponential.times
    assert np.allclose(exponential.formation_errors[:, 1], 5.0 * 2.0**-t, rtol=1e-12)
    assert not exponential.formation_errors[:, 0].any()
    numbers = metrics(exponential).followers[0]
    # Steps begin at all frames but the last; two of them in the window of 2 s.
    squares = 25.0 * 4.0 ** -t[:-1]
    assert numbers.rmse == pytest.approx(np.sqrt(np.mean(squares)), rel=1e-12)
    assert numbers.steady_rmse == pytest.approx(np.sqrt(np.mean(squares[-2:])), rel=1e-9)


def test_settling_time_is_when_one_centimetre_is_kept_for_good(exponential):
    # 5 * 2^-8 = 0.0195 is above, 5 * 2^-9 = 0.0098 below.
    assert metrics(exponential).followers[0].settling_time == 9.0
    assert metrics(follower_moved(exponential, 15)).followers[0].settling_time == 16.0
    assert metrics(follower_moved(exponential, 19)).followers[0].settling_time == 20.0
    assert metrics(follower_moved(exponential, 20)).followers[0].settling_time is None


def test_edge_error_is_that_of_the_distance(exponential):
    offset = np.array([1.0, 0.0, 0.0]) + 2.0 ** -exponential.times[:, None] * [3.0, 0.0, 4.0]
    expected = np.sqrt(np.mean((np.linalg.norm(offset[:-1], axis=1) - 1.0) ** 2))
    numbers = metrics(exponential)
    assert numbers.edges[0].edge == (0, 1)
    assert numbers.edges[0].distance_rmse == pytest.approx(expected, rel=1e-12)
    assert numbers.minimum_distance == pytest.approx(np.linalg.norm(offset, axis=1).min())


def test_leader_error_by_output_with_the_heading_wound():
    model, graph = ech.models.Unicycle(), ech.Graph.path(2)
    reference = np.tile([1.0, 2.0, 3.1], (5, 1))
    states = np.stack([reference + [0.3, 0.4, 2 * np.pi + 0.1], reference], axis=1)
    result = made_up(states, model, graph, reference=reference)
    numbers = metrics(result)
    assert numbers.leader.rmse == pytest.approx(0.5)
    by_output = numbers.leader.rmse_by_output
    assert by_output["x"] == pytest.approx(0.3) and by_output["y"] == pytest.approx(0.4)
    assert by_output["heading"] == pytest.approx(0.1)
    assert np.allclose(output_errors(result), [[0.3, 0.4, 0.1]])


@pytest.fixture(scope="module")
def stored():
    """The same saturating flight, with all frames stored and with few."""
    model, graph = ech.models.PlanarQuadrotor(), ech.Graph.path(3)
    follower = ech.laws.Consensus(ech.synthesize(model, graph, ech.gains.Riccati()))
    leader = ech.laws.Tracking(ech.references.Circle(radius=1.0, rate=0.5))
    formation = ech.Formation.line(model, graph)
    parts = ech.Parts(
        model, graph, formation, ech.Laws(leader, follower), initial={"position": 2.0}
    )
    chosen = ech.Settings(horizon=4.0, dt=0.02, seed=1, steady_window=0.8)
    return [ech.simulate(parts, chosen._replace(store_every=every)) for every in (1, 7, 100)]


def test_no_mean_depends_on_the_frames_that_are_stored(stored):
    every, *few = map(metrics, stored)
    assert every.followers[1].saturated > 0.0 and every.followers[1].effort > 0.1
    for numbers in few:
        for one, other in zip(every.followers, numbers.followers, strict=True):
            assert one == pytest.approx(other, rel=1e-12)
        for one, other in zip(every.leader, numbers.leader, strict=True):
            assert one == pytest.approx(other, rel=1e-12)
        edges = [edge.distance_rmse for edge in every.edges]
        assert edges == pytest.approx([edge.distance_rmse for edge in numbers.edges], rel=1e-12)
    # Where every step is stored they are those of the frames.
    result = stored[0]
    rms = np.sqrt(np.mean(result.formation_errors[:-1] ** 2, axis=0))
    assert [each.rmse for each in every.followers] == pytest.approx(rms[1:].tolist(), rel=1e-12)
    trim, scale = result.model.trim[1], np.asarray(result.model.input_scale)
    v = np.linalg.solve(scale, (result.inputs[:-1, 1] - np.asarray(trim)).T)
    effort = np.sqrt(np.mean(np.sum(v**2, axis=0)))
    assert every.followers[0].effort == pytest.approx(effort, rel=1e-12)
    by_output = np.sqrt(np.mean(output_errors(result)[:-1] ** 2, axis=0))
    assert list(every.leader.rmse_by_output.values()) == pytest.approx(by_output, rel=1e-9)


def test_what_does_not_exist_is_none():
    model, graph = ech.models.VanDerPol(), ech.Graph.path(3)
    numbers = metrics(made_up(np.zeros((3, 3, 2)), model, graph))
    assert numbers.leader.rmse is None and numbers.minimum_distance is None
    diverged = made_up(np.zeros((3, 3, 2)), model, graph, outcome=Outcome.DIVERGED)
    numbers = metrics(diverged)
    assert all(each.rmse is None and each.settling_time is None for each in numbers.followers)
    assert numbers.worst_steady is None and numbers.edges[0].distance_rmse is None
    # Nor has a run without a frame any number.
    model, graph = ech.models.SingleIntegrator(2), ech.Graph.path(2)
    result = made_up(np.zeros((1, 2, 2)), model, graph, outcome=Outcome.INTERRUPTED)
    gone = {name: getattr(result, name)[:0] for name in ("times", "states", "inputs")}
    nothing = dataclasses.replace(result, **gone)
    numbers = metrics(nothing)
    assert numbers.followers[0].rmse is None and numbers.minimum_distance is None
    assert "interrupted" in ech.report(nothing)


def passing(agents=12, offset=1e3):
    """Agents in a row far apart; the second and the fifth pass each other in the sixth frame."""
    model, graph = ech.models.Quadrotor.crazyflie(), ech.Graph.path(agents)
    states = np.zeros((11, agents, 12))
    states[:, :, 1] = offset * np.arange(agents)
    times = np.arange(11.0)
    states[:, 4, 1] = offset + 0.1
    states[:, 4, 0] = 0.5 * (times - 5.0)
    return made_up(states, model, graph)


@pytest.mark.parametrize("agents", [5, 12])
def test_the_closest_pair_is_who_was_closest_and_when(agents):
    result = passing(agents)
    closest = metrics(result).closest
    assert closest.agents == (1, 4) and closest.time == 5.0
    assert closest.distance == pytest.approx(0.1)
    again = recording_of(result)
    assert again.closest_pair() == closest and again.radius == pytest.approx(0.07)
    told = summary(result)
    assert told["minimum_distance"] == closest.distance and told["closest_agents"] == (1, 4)
    assert told["minimum_distance_time_s"] == 5.0
    assert told["vehicle_radius"] == pytest.approx(0.07)


@pytest.mark.filterwarnings("error")
def test_any_agents_with_a_place_have_a_closest_pair():
    model = ech.models.SingleIntegrator(dimension=1)
    states = np.array([[[0.0], [3.0], [5.0]], [[0.0], [3.0], [3.5]]])
    found = made_up(states, model, ech.Graph.path(3)).approaches()
    assert [(*pair.agents, pair.distance, pair.time) for pair in found] == [
        (1, 2, 2.0, 0.0),
        (1, 2, 0.5, 1.0),
    ]
    # In one place, with a frame without numbers.
    model, states = ech.models.SingleIntegrator(2), np.zeros((3, 12, 2))
    states[0] = np.nan
    result = made_up(states, model, ech.Graph.path(12))
    one, other = metrics(result).closest.agents
    assert one < other and metrics(result).closest[::2] == (0.0, 1.0)
    assert result.radius is None and not metrics(result).closest.touch(None)
    # So far off that squares are beyond floats.
    states = np.array([[[0.0, 0.0], [3e200, 4e200], [3e300, 0.0]]])
    result = made_up(states, model, ech.Graph.path(3))
    assert result.closest_pair().distance == pytest.approx(5e200)


@pytest.mark.parametrize(("apart", "touch"), [(0.1399, True), (0.1401, False)])
def test_a_report_warns_of_agents_closer_than_two_radii(apart, touch):
    model, graph = ech.models.Quadrotor.crazyflie(), ech.Graph.path(2)
    states = np.zeros((2, 2, 12))
    states[:, 1, 0] = apart
    text = " ".join(ech.report(made_up(states, model, graph)).split())
    assert ("Warning: agents 0 and 1 came within 0.14 m at 0 s" in text) == touch
    assert ("Smallest distance: 0.14 m, agents 0 and 1 at 0 s" in text) != touch


def test_a_larger_vehicle_has_a_larger_radius_and_an_abstract_agent_none():
    for model in (ech.models.Quadrotor(arm=0.065), ech.models.PlanarQuadrotor(arm=0.065)):
        assert model.radius == pytest.approx(0.14)

    class Wheel(ech.models.Pendulum):
        radius: float = -1.0

    assert made_up(np.zeros((2, 2, 2)), Wheel(), ech.Graph.path(2)).radius is None
