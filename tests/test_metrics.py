"""The numbers of a run, against closed forms on made-up runs."""

import dataclasses

import numpy as np
import pytest
from runs import simulate

import echelon as ech
from echelon.core.errors import Outcome
from echelon.engine.result import Result, Settings
from echelon.results.metrics import formation_errors, metrics, output_errors


def made_up(
    states, model, graph, offsets=None, reference=None, inputs=None, outcome=Outcome.COMPLETED
):
    """Return a result with the given states (T, N, n) at one-second frames."""
    states = np.asarray(states, float)
    frames, agents, n = states.shape
    m = len(model.input_names)
    trim = np.broadcast_to(np.asarray(model.trim[1], float), (frames, agents, m))
    return Result(
        times=np.arange(frames, dtype=float),
        states=states,
        inputs=trim if inputs is None else inputs,
        reference=reference,
        saturated=np.linspace(0.0, 0.5, agents),
        outcome=outcome,
        message=outcome.value,
        warnings=(),
        model=model,
        graph=graph,
        formation=ech.Formation(np.zeros((agents, n)) if offsets is None else offsets),
        leader=ech.laws.TrimInput(),
        follower=ech.laws.TrimInput(),
        settings=Settings(float(frames - 1), 1.0, "rk4", True, 1, "float64", 0),
        wall_time=0.0,
    )


@pytest.fixture
def exponential():
    """Two agents in space, the follower off by 2^-t (3, 0, 4) from its goal (1, 0, 0) ahead."""
    model, graph = ech.models.SingleIntegrator(3), ech.Graph.path(2)
    t = np.arange(21.0)
    leader = np.column_stack([np.sin(t), t, 0 * t])
    goal = leader + [1.0, 0.0, 0.0]
    follower = goal + 2.0 ** -t[:, None] * [3.0, 0.0, 4.0]
    offsets = [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]]
    return made_up(np.stack([leader, follower], axis=1), model, graph, offsets)


def test_formation_error_is_the_vector_to_the_goal(exponential):
    t = exponential.times
    assert np.allclose(formation_errors(exponential)[:, 1], 5.0 * 2.0**-t, rtol=1e-12)
    assert not formation_errors(exponential)[:, 0].any()
    numbers = metrics(exponential, steady_window=2.0).followers[0]
    assert numbers.rmse == pytest.approx(np.sqrt(np.mean(25.0 * 4.0**-t)), rel=1e-12)
    assert numbers.steady_rmse == pytest.approx(np.sqrt(np.mean(25.0 * 4.0 ** -t[-3:])), rel=1e-9)


def test_settling_time_is_when_one_centimetre_is_kept_for_good(exponential):
    # 5 * 2^-8 = 0.0195 is above, 5 * 2^-9 = 0.0098 below.
    assert metrics(exponential).followers[0].settling_time == 9.0
    states = exponential.states.copy()
    states[15, 1] += 1.0
    again = dataclasses.replace(exponential, states=states)
    assert metrics(again).followers[0].settling_time == 16.0
    states = exponential.states.copy()
    states[-1, 1] += 1.0
    never = dataclasses.replace(exponential, states=states)
    assert metrics(never).followers[0].settling_time is None


def test_edge_error_is_that_of_the_distance(exponential):
    offset = np.array([1.0, 0.0, 0.0]) + 2.0 ** -exponential.times[:, None] * [3.0, 0.0, 4.0]
    expected = np.sqrt(np.mean((np.linalg.norm(offset, axis=1) - 1.0) ** 2))
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


def test_effort_is_of_the_normalized_input_about_the_trim():
    model, graph = ech.models.Quadrotor.crazyflie(), ech.Graph.path(2)
    inputs = np.tile(np.asarray(model.trim[1]), (4, 2, 1))
    inputs[:, 1] += np.asarray(model.input_scale) @ [3.0, 0.0, 4.0, 0.0]
    result = made_up(np.zeros((4, 2, 12)), model, graph, inputs=inputs)
    assert metrics(result).followers[0].effort == pytest.approx(5.0, rel=1e-12)


def test_what_does_not_exist_is_none():
    model, graph = ech.models.VanDerPol(), ech.Graph.path(3)
    numbers = metrics(made_up(np.zeros((3, 3, 2)), model, graph))
    assert numbers.leader.rmse is None and numbers.minimum_distance is None
    diverged = made_up(np.zeros((3, 3, 2)), model, graph, outcome=Outcome.DIVERGED)
    numbers = metrics(diverged)
    assert all(each.rmse is None and each.settling_time is None for each in numbers.followers)
    assert numbers.worst_steady is None and numbers.edges[0].distance_rmse is None


def test_a_run_without_a_frame_has_no_numbers():
    model, graph = ech.models.SingleIntegrator(2), ech.Graph.path(2)
    result = made_up(np.zeros((1, 2, 2)), model, graph, outcome=Outcome.INTERRUPTED)
    nothing = dataclasses.replace(
        result, times=result.times[:0], states=result.states[:0], inputs=result.inputs[:0]
    )
    numbers = metrics(nothing)
    assert numbers.followers[0].rmse is None and numbers.minimum_distance is None
    assert "interrupted" in ech.report(nothing)


def test_the_relay_is_a_fixed_point_of_the_formation():
    """Started on their goals, followers told the leader's input stay there to rounding."""
    model, graph = ech.models.Quadrotor.crazyflie(), ech.Graph.path(3)
    formation = ech.Formation.from_offsets(model, graph, {1: (1, 0, 0), 2: (2, 0, 0)})
    result = simulate(
        model,
        graph,
        formation,
        leader=ech.laws.Tracking(ech.references.Lemniscate()),
        follower=ech.laws.Consensus(
            ech.synthesize(model, graph, ech.gains.Riccati()), feedforward="relay"
        ),
        start_error={"x": -6.0, "y": 3.0},
        horizon=2.0,
        dt=0.01,
    )
    assert formation_errors(result).max() < 1e-13
    assert result.saturated[0] > 0.0
