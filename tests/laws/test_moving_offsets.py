"""Agents follow offsets that change with time: exactly by stopping points, else with a lag."""

import jax.numpy as jnp
import numpy as np
import pytest

import echelon as ech
from echelon.agents.network.formation_motion import OffsetMotion, Reshape, Rotate, Scale
from echelon.core.errors import LawError, SimulationError
from echelon.simulation.engine.prepare import prepare

AGENT = ech.models.DoubleIntegrator()
GRAPH = ech.Graph.from_edges([[0, 1], [1, 2]])

APART = ech.Safety(radii=(0.1, 0.1, 0.1))
CIRCLE = ech.references.Circle(center=(0, 0, 1), radius=1.0, rate=0.5)


def parts(changes, follower=None, leader=None, offsets=None, world=None):
    """Return carts with a formation that changes, by default from their places."""
    formation = ech.Formation.from_offsets(AGENT, GRAPH, offsets or {1: (1, 0), 2: (0, 1)})
    leader = leader or ech.laws.StoppingLeader(reference=CIRCLE)
    drive = ech.Laws(leader, follower or ech.laws.StoppingPoint())
    formation = formation.moving(AGENT, GRAPH, changes)
    return ech.Parts(AGENT, GRAPH, formation, drive, world=world or ech.World())


def late_error(one, horizon, dt=0.005):
    """Return the largest error of a follower in the last 2 s, m."""
    result = ech.simulate(one, ech.Settings(horizon=horizon, dt=dt))
    return result.formation_errors[result.times > horizon - 2.0].max()


class Wave(OffsetMotion):
    """Heights that rise and fall."""

    def __call__(self, place, t):
        return place.at[-1].add(0.2 * jnp.sin(t))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("changes", "feedforward", "network", "most"),
    [
        ([Rotate(0.5), Scale(0.4, 0.7), Wave()], "relay", None, 5e-5),
        # Parents pass on the rate without their own offset, and messages may be late.
        ([Rotate(0.5)], "parent", None, 2e-4),
        ([Rotate(0.5)], "relay", ech.Network(delay=0.02, loss=0.2), 3e-4),
    ],
)
def test_stopping_points_follow_a_formation_that_moves(changes, feedforward, network, most):
    law = ech.laws.StoppingPoint(feedforward=feedforward)
    assert late_error(parts(changes, law, world=ech.World(network=network)), 6.0) < most


@pytest.mark.slow
def test_what_held_inputs_leave_shrinks_with_the_step():
    law = ech.laws.StoppingPoint(coupling=30.0)
    errors = [late_error(parts([Rotate(2.0)], law), 8.0, dt) for dt in (0.01, 0.005)]
    assert errors[0] > 1.8 * errors[1] > 0.0


@pytest.mark.slow
def test_a_reshape_is_followed_to_the_end_the_leader_s_too():
    goals = ech.Formation.from_offsets(AGENT, GRAPH, {0: (0.5, 0), 1: (-1, 0), 2: (0, -1)})
    change = Reshape(goals.offsets, 2.5, 3.0)
    result = ech.simulate(parts([change]), ech.Settings(horizon=8.0, dt=0.005))
    during = (result.times > 2.5) & (result.times < 5.5)
    assert result.formation_errors[during].max() < 1e-3
    assert result.formation_errors[-1].max() < 5e-5
    away = result.states[-1, 0, :2] - result.reference[-1, :2]
    assert away == pytest.approx([0.5, 0.0], abs=1e-2)
    # Errors of leaders are off the reference at their own offset.
    assert np.sqrt(result.sums.tracking[1] / result.sums.steps[1]).max() < 1e-2


def test_states_lag_behind_and_the_run_warns():
    gain = ech.synthesize(AGENT, GRAPH, ech.gains.Riccati())
    laws = ech.laws.Consensus(gain, feedforward="relay"), ech.laws.Tracking(CIRCLE)
    result = ech.simulate(parts([Rotate(0.5)], *laws), ech.Settings(6.0, 0.005))
    [sentence] = (x for x in result.warnings if "lags" in x)
    assert "`Consensus`" in sentence and "`stopping-point`" in sentence
    largest = result.formation_errors[result.times > 4.8 - 1e-9].max()
    assert 0.01 < largest < 0.5
    assert f"observed {largest:.3g} m at most from 4.8 s on" in ech.report(result)


def test_agents_alone_do_what_simulate_does():
    one = parts([Rotate(0.7)])
    result = ech.simulate(one, ech.Settings(horizon=0.05, dt=0.01, engine="jax"))
    agents = [ech.Agent(one, k, dt=0.01) for k in range(3)]
    with pytest.raises(SimulationError, match=r"call `hello\(x, t\)`"):
        agents[1].hello(result.states[0, 1])
    for k, t in enumerate(result.times[:-1]):
        for message in [a.hello(result.states[k, a.number], t) for a in agents]:
            for agent in agents:
                agent.receive(message)
        for agent in agents:
            u, message = agent.step(t, result.states[k, agent.number])
            for other in agents:
                other.receive(message)
            assert u == pytest.approx(result.inputs[k, agent.number], abs=1e-12)


@pytest.mark.slow
def test_no_offset_of_a_moving_formation_is_faster_than_safety_allows():
    safe = ech.laws.StoppingPoint(safety=APART, speed=1.0)
    fast = {1: (2.0, 0), 2: (0, 1.0)}
    result = ech.simulate(
        parts([Rotate(1.0)], safe, offsets=fast), ech.Settings(horizon=4.0, dt=0.005)
    )
    # At 2 m/s the first one cannot follow at 1 m/s, and the second one just so.
    late = result.states[result.times > 2.5]
    speeds = np.abs(late[:, 1:, 2:] - late[:, :1, 2:])
    assert 0.99 < speeds.max() < 1.0 + 1e-3
    assert result.least_distances().min() > 0.2


def test_safety_needs_a_leader_on_its_path_and_warns_of_no_ways_that_meet():
    goals = ech.Formation.from_offsets(AGENT, GRAPH, {1: (0, 1), 2: (1, 0)})
    beside = ech.Formation.from_offsets(AGENT, GRAPH, {0: (0.5, 0), 1: (-1, 0)})
    safe, settings = ech.laws.StoppingPoint(safety=APART), ech.Settings(4.0, 0.005)

    def warnings(goals, *law):
        return prepare(parts([Reshape(goals.offsets, 1.0, 2.0)], *law), settings).warnings

    text = "in the reshape at 1 s agents 1 and 2 come within"
    assert any(text in x for x in warnings(goals))
    assert not any(text in x for x in warnings(goals, safe))
    with pytest.raises(LawError, match="whose own offset must be constant"):
        warnings(beside, safe)


@pytest.mark.slow
def test_quadrotors_follow_a_formation_that_turns_breathes_and_changes():
    agent = ech.models.Quadrotor.crazyflie()
    one = ech.Formation.from_offsets(agent, GRAPH, {1: (1, 0, 0), 2: (0, 1, 0)})
    other = ech.Formation.from_offsets(agent, GRAPH, {1: (-1, 0, 0), 2: (0, -1, 0)})
    changes = [Rotate(0.5), Scale(0.4, 0.7), Reshape(other.offsets, 4.0, 3.0)]
    drive = ech.Laws(ech.laws.StoppingLeader(), ech.laws.StoppingPoint())
    moving = ech.Parts(agent, GRAPH, one.moving(agent, GRAPH, changes), drive)
    result = ech.simulate(moving, ech.Settings(horizon=9.0, dt=0.005))
    errors = result.formation_errors.max(axis=1)
    assert errors[(result.times > 3.5)].max() < 1e-3
    assert errors[result.times > 8.5].max() < 1e-4


def test_what_knows_constant_offsets_alone_refuses_others():
    one, settings = parts([Rotate(0.5)]), ech.Settings(horizon=1.0, dt=0.01)
    with pytest.raises(SimulationError, match="derivatives are of constant ones"):
        ech.gradient(one, settings, lambda sums: sums.errors[0].sum(), ["P"])
    with pytest.raises(SimulationError, match="the formation changes with time"):
        ech.state_space(one)
