"""A leader that follows an optimal plan of its own."""

import jax.numpy as jnp
import numpy as np
import pytest
from runs import simulate

import echelon as ech
from echelon.core.errors import LawError, PlanError
from echelon.core.numerics import precision

QUADROTOR = ech.models.Quadrotor.crazyflie()
TREE = ech.Graph.from_edges([(0, 1), (1, 2)], leaders=[0])
DRAWN = ech.Formation.from_offsets(QUADROTOR, TREE, {1: (1, 0, 0), 2: (2, 0, 0)})
LOOP = ech.references.Lemniscate()
ERROR = {"x": -0.3, "y": 0.2}
GAIN = ech.synthesize(QUADROTOR, TREE, ech.gains.Riccati())


def led(leader, **more):
    # The same frames in every run, so that JAX compiles but what differs.
    given = {"horizon": 1.0, "dt": 0.005, "start_error": ERROR, "store_every": 10, **more}
    formation = given.pop("formation", DRAWN)
    follower = ech.laws.Consensus(GAIN, feedforward="relay")
    return simulate(QUADROTOR, TREE, formation, leader=leader, follower=follower, **given)


def prepared(**how):
    law = ech.optimal.OptimalTracking(LOOP, horizon=1.0, start_error=ERROR, **how)
    return law.prepared(QUADROTOR, TREE)


LAW = prepared()


def rmse(result):
    return ech.metrics(result).leader.rmse


@pytest.mark.slow
def test_it_errs_less_than_tracking_and_still_less_without_limits():
    usual, best = led(ech.laws.Tracking(LOOP)), led(LAW)
    free = led(prepared(limits=False), limits=False)
    assert rmse(free) < rmse(best) < 0.9 * rmse(usual)


@pytest.mark.slow
def test_undisturbed_it_flies_its_plan():
    result = led(LAW)
    assert result.states[:, 0] == pytest.approx(LAW.states, abs=1e-5)
    # The limits have nothing to change, but for what the feedback adds for rounding's sake.
    G, low, high = (np.array(part) for part in QUADROTOR.input_limits)
    thrusts = LAW.inputs @ G.T
    assert (thrusts >= low - 1e-9).all() and (thrusts <= high + 1e-9).all()
    assert result.inputs[:-1, 0] == pytest.approx(LAW.inputs, abs=1e-5)


@pytest.mark.study
def test_between_its_times_the_plan_is_the_motion_from_the_last_one():
    # The state at the end of an interval, reached from its beginning, is the next one planned.
    with precision("float64"):
        for k in (0, 7, 19):
            before = LAW.target(QUADROTOR, jnp.asarray(0.05 * (k + 1) - 1e-5))[0]
            assert np.asarray(before) == pytest.approx(LAW.states[k + 1], abs=1e-2)
            at = LAW.target(QUADROTOR, jnp.asarray(0.05 * k))
            assert np.asarray(at[0]) == pytest.approx(LAW.states[k], abs=1e-12)
            assert np.array_equal(np.asarray(at[1]), LAW.inputs[k])


def test_after_the_plan_it_follows_the_reference():
    with precision("float64"):
        found = LAW.target(QUADROTOR, jnp.asarray(1.5))
        usual = (
            ech.laws.Tracking(LOOP).prepared(QUADROTOR, TREE).target(QUADROTOR, jnp.asarray(1.5))
        )
    for one, other in zip(found, usual, strict=True):
        assert np.asarray(one) == pytest.approx(np.asarray(other), abs=1e-12)


def test_the_feedback_holds_the_plan_in_wind():
    wind = ech.Disturbance(constant={"vx": 1.0})
    held = led(LAW, disturbance=wind)
    # Open loop it would be 0.5 m off after a second.
    assert abs(held.states[-1, 0, 0] - LAW.states[-1, 0]) < 0.3


def test_a_leader_with_an_offset_flies_beside_the_plan():
    result = led(LAW, formation=ech.Formation(DRAWN.offsets + np.eye(12)[1]))
    assert result.states[:, 0] - np.eye(12)[1] == pytest.approx(LAW.states, abs=1e-5)


def test_it_is_planned_once():
    assert LAW.prepared(QUADROTOR, TREE).states is LAW.states


@pytest.mark.study
def test_in_single_precision_it_leads_the_same():
    double, single = (led(LAW, precision=p) for p in ("float64", "float32"))
    assert single.states == pytest.approx(double.states, abs=2e-3)


def test_a_scenario_can_name_it(tmp_path):
    text = """
name: mine
model: {name: quadrotor}
graph: {name: path, agents: 3}
formation: {offsets: {1: [1, 0, 0], 2: [2, 0, 0]}}
reference: {name: lemniscate}
leader: {law: optimal-tracking, start_error: {x: -0.3, y: 0.2}}
follower: {feedforward: relay}
simulation: {horizon: 1.0, dt: 0.005, store_every: 10}
"""
    file = tmp_path / "mine.yaml"
    file.write_text(text)
    scenario = ech.load_scenario(file)
    parts, _ = ech.build(scenario)
    assert isinstance(parts.drive.leader, ech.optimal.OptimalTracking)
    assert parts.drive.leader.states == pytest.approx(LAW.states, abs=1e-5)
    result = ech.run(scenario)
    assert rmse(result) == pytest.approx(rmse(led(LAW)), abs=1e-6)


@pytest.mark.parametrize("limits", [True, False])
def test_the_scenario_s_limits_are_those_of_the_plan(limits):
    mapping = {
        "name": "mine",
        "model": {"name": "quadrotor"},
        "graph": {"name": "path", "agents": 2},
        "reference": {"name": "lemniscate"},
        "leader": {"law": "optimal-tracking", "start_error": {"x": -0.3}},
        "simulation": {"horizon": 0.5, "dt": 0.005, "limits": limits},
    }
    law = ech.build(ech.scenario_from_mapping(mapping)).parts.drive.leader
    G, low, high = (np.array(part) for part in QUADROTOR.input_limits)
    thrusts = law.inputs @ G.T
    assert bool(((thrusts >= low - 1e-9) & (thrusts <= high + 1e-9)).all()) is limits
    assert len(law.inputs) == 10


def test_without_a_plan_it_leads_nobody():
    law = ech.optimal.OptimalTracking(LOOP)
    with pytest.raises(LawError, match="no plan yet"):
        law.target(QUADROTOR, jnp.asarray(0.0))


def test_a_model_without_a_flatness_map_is_refused():
    model = ech.models.VanDerPol()
    with pytest.raises(PlanError, match="`VanDerPol` cannot be led along a reference"):
        ech.optimal.OptimalTracking(LOOP).prepared(model, TREE)


def test_a_gain_of_another_model_is_refused():
    small = ech.synthesize(ech.models.DoubleIntegrator(1), TREE, ech.gains.Riccati())
    with pytest.raises(LawError, match="`OptimalTracking` has P"):
        ech.optimal.OptimalTracking(LOOP, gain=small).prepared(QUADROTOR, TREE)


def test_a_reference_that_is_too_fast_is_warned_of_with_the_ratio():
    # At rate w the lemniscate's acceleration grows as w^2, past the thrust to weight of 2.3.
    fast = ech.optimal.OptimalTracking(ech.references.Lemniscate(rate=3.0), horizon=2.0)
    (told,) = fast.warnings(QUADROTOR, TREE)
    assert "is too fast for `Quadrotor`" in told and "times the range of the actuators" in told
    assert LAW.warnings(QUADROTOR, TREE) == ()
    free = ech.optimal.OptimalTracking(
        ech.references.Lemniscate(rate=3.0), horizon=2.0, limits=False
    )
    assert free.warnings(QUADROTOR, TREE) == ()
