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


def test_after_the_plan_it_follows_the_reference():
    with precision("float64"):
        found = LAW.target(QUADROTOR, jnp.asarray(1.5))
        usual = (
            ech.laws.Tracking(LOOP).prepared(QUADROTOR, TREE).target(QUADROTOR, jnp.asarray(1.5))
        )
    for one, other in zip(found, usual, strict=True):
        assert np.asarray(one) == pytest.approx(np.asarray(other), abs=1e-12)


@pytest.mark.slow
def test_the_feedback_holds_the_plan_in_wind():
    wind = ech.Disturbance(constant={"vx": 1.0})
    held = led(LAW, disturbance=wind)
    # Open loop it would be 0.5 m off after a second.
    assert abs(held.states[-1, 0, 0] - LAW.states[-1, 0]) < 0.3
    result = led(LAW, formation=ech.Formation(DRAWN.offsets + np.eye(12)[1]))
    assert result.states[:, 0] - np.eye(12)[1] == pytest.approx(LAW.states, abs=1e-5)


def scenario(horizon, **simulation):
    leader = {"law": "optimal-tracking", "start_error": ERROR}
    given = {"name": "mine", "model": {"name": "quadrotor"}, "graph": {"name": "path", "agents": 3}}
    given |= {"formation": {"offsets": {1: [1, 0, 0], 2: [2, 0, 0]}}, "leader": leader}
    given |= {"reference": {"name": "lemniscate"}, "follower": {"feedforward": "relay"}}
    simulation |= {"horizon": horizon, "dt": 0.005, "store_every": 10}
    return ech.scenario_from_mapping(given | {"simulation": simulation})


def test_a_scenario_can_name_it():
    law = ech.build(scenario(1.0)).parts.drive.leader
    assert isinstance(law, ech.optimal.OptimalTracking)
    assert law.states == pytest.approx(LAW.states, abs=1e-5)
    assert rmse(ech.run(scenario(1.0))) == pytest.approx(rmse(led(LAW)), abs=1e-6)


@pytest.mark.parametrize("limits", [True, False])
def test_the_scenario_s_limits_are_those_of_the_plan(limits):
    law = ech.build(scenario(0.5, limits=limits)).parts.drive.leader
    G, low, high = (np.array(part) for part in QUADROTOR.input_limits)
    thrusts = law.inputs @ G.T
    assert bool(((thrusts >= low - 1e-9) & (thrusts <= high + 1e-9)).all()) is limits
    assert len(law.inputs) == 10


def test_what_it_cannot_lead_is_refused():
    small = ech.synthesize(ech.models.DoubleIntegrator(1), TREE, ech.gains.Riccati())
    law = ech.optimal.OptimalTracking
    with pytest.raises(LawError, match="no plan yet"):
        law(LOOP).target(QUADROTOR, jnp.asarray(0.0))
    with pytest.raises(PlanError, match="`VanDerPol` cannot be led along a reference"):
        law(LOOP).prepared(ech.models.VanDerPol(), TREE)
    with pytest.raises(LawError, match="`OptimalTracking` has P"):
        law(LOOP, gain=small).prepared(QUADROTOR, TREE)


def test_a_reference_that_is_too_fast_is_warned_of_with_the_ratio():
    # At rate w the lemniscate's acceleration grows as w^2, past the thrust to weight of 2.3.
    fast, law = ech.references.Lemniscate(rate=3.0), ech.optimal.OptimalTracking
    (told,) = law(fast, horizon=2.0).warnings(QUADROTOR, TREE)
    assert "is too fast for `Quadrotor`" in told and "times the range of the actuators" in told
    assert law(fast, horizon=2.0, limits=False).warnings(QUADROTOR, TREE) == ()
    assert (
        LAW.warnings(QUADROTOR, TREE) == () and LAW.prepared(QUADROTOR, TREE).states is LAW.states
    )
