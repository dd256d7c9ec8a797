"""Model predictive control against linear theory, its order of planning, recovery from failures."""

import json
import math
import sys

import numpy as np
import pytest
import scipy.linalg
from runs import simulate, simulate_mpc, simulate_plans

import echelon as ech
from echelon.core.errors import MissingExtraError, PlanError
from echelon.simulation.optimal.horizon import Answer, Horizon

CART = ech.models.DoubleIntegrator(1)
PAIR = ech.Graph.path(2)
APART = ech.Formation([[0.0, 0.0], [-1.0, 0.0]])
QUADROTOR = ech.models.Quadrotor.crazyflie()
TREE = ech.Graph.from_edges([(0, 1), (1, 2), (1, 3)], leaders=[0])
DRAWN = ech.Formation.from_offsets(QUADROTOR, TREE, {1: (1, 0, 0), 2: (1, 0.8, 0), 3: (1, -0.8, 0)})
LOOP = ech.references.Lemniscate()
BRIEF = {"horizon": 0.2, "dt": 0.01, "reference": LOOP, "initial": {"position": 0.2}, "seed": 1}


def cart_run(mpc, states, horizon=2.0, **more):
    return simulate_mpc(
        CART, PAIR, APART, mpc=mpc, initial=np.array(states), horizon=horizon, dt=0.05, **more
    )


def swarm(**more):
    return simulate_mpc(QUADROTOR, TREE, DRAWN, **{**BRIEF, **more})


def regulator(Q, R, dt):
    """K of the least sum of dt (x'Qx + u'Ru) on held inputs, by iterating the recursion."""
    A, B = np.array([[1.0, dt], [0.0, 1.0]]), np.array([[dt**2 / 2], [dt]])
    P = np.diag(Q)
    for _ in range(5000):
        K = np.linalg.solve(dt * np.diag(R) + B.T @ P @ B, B.T @ P @ A)
        P = dt * np.diag(Q) + A.T @ P @ (A - B @ K)
    return A - B @ K, K


@pytest.mark.parametrize("simulate_drive", [simulate_mpc, simulate_plans])
def test_native_code_is_refused_before_a_solver_plans(simulate_drive, monkeypatch):
    for drive in (ech.optimal.Plans, ech.optimal.RecedingHorizon):
        monkeypatch.setattr(drive, "stepper", lambda *_: pytest.fail("it planned"))
    refused = "^`engine` is `native`, and must be `auto` or `jax` where a solver drives agents"
    with pytest.raises(ech.errors.SimulationError, match=refused):
        simulate_drive(CART, PAIR, APART, horizon=0.2, dt=0.1, engine="native")


@pytest.mark.parametrize("horizon", [0.1, 4.0])
def test_without_limits_every_horizon_is_the_linear_regulator(horizon):
    # The cost from the horizon's end on is the regulator's, so that a short one is no worse.
    Q, R = [3.0, 0.5], [0.2]
    mpc = ech.optimal.MPC(period=0.1, horizon=horizon, state_weight=Q, input_weight=R)
    result = cart_run(mpc, [[0.0, 0.0], [0.5, -0.3]], store_every=2)
    closed, K = regulator(Q, R, 0.1)
    x = np.array([1.5, -0.3])
    for state, u in zip(result.states[:-1, 1], result.inputs[:-1, 1], strict=True):
        assert state == pytest.approx(x + [-1.0, 0.0], abs=1e-6)
        assert u == pytest.approx(-K @ x, abs=1e-5)
        x = closed @ x
    assert np.abs(result.states[:, 0]).max() < 1e-6


def test_a_follower_of_a_moving_leader_has_no_lag():
    # The leader is off its goal too; the difference between the two obeys the regulator alone.
    Q, R = [3.0, 0.5], [0.2]
    mpc = ech.optimal.MPC(period=0.1, horizon=1.0, state_weight=Q, input_weight=R)
    result = cart_run(mpc, [[2.0, 1.0], [0.5, -0.3]], store_every=2)
    closed, _ = regulator(Q, R, 0.1)
    gap = result.states[:, 1] - result.states[:, 0] - APART.offsets[1]
    powers = [np.linalg.matrix_power(closed, k) @ gap[0] for k in range(len(gap))]
    assert gap == pytest.approx(np.array(powers), abs=1e-5)


def test_the_weights_left_out_are_the_model_s_on_what_it_shows():
    Q, R = ech.optimal.MPC().weights(QUADROTOR)
    own = np.array(QUADROTOR.weights[0])
    shown = [0, 1, 2, 8]
    assert Q[shown] == pytest.approx(own[shown]) and R == pytest.approx(
        np.array(QUADROTOR.weights[1]) / 100.0
    )
    hidden = [k for k in range(12) if k not in shown]
    assert Q[hidden] == pytest.approx(own[hidden] / 25.0)


@pytest.mark.slow
def test_quadrotors_close_up_within_their_motors_limits():
    result = swarm(horizon=1.6, initial={"position": 0.5, "attitude": 0.2}, store_every=2)
    assert result.outcome is ech.Outcome.COMPLETED
    error = np.linalg.norm(result.errors[:, 1:, :3], axis=2)
    assert error[0].max() > 0.3 and error[-1].max() < 0.02
    G, low, high = (np.array(part) for part in QUADROTOR.input_limits)
    thrusts = result.inputs @ G.T
    assert (thrusts >= low - 1e-7).all() and (thrusts <= high + 1e-7).all()
    figures = result.work
    assert figures.failures == 0 and figures.solves == 4 * 80


@pytest.mark.slow
def test_each_plans_after_those_before_it_with_the_plans_they_have_just_made(monkeypatch):
    asked, given = [], Horizon.solve

    def watched(self, start, targets, near):
        answer = given(self, start, targets, near)
        asked.append((start, targets, answer.course))
        return answer

    monkeypatch.setattr(Horizon, "solve", watched)
    result = swarm(store_every=2)
    last = asked[-4:]
    for place, agent in enumerate((0, 1, 2, 3)):
        assert last[place][0] == pytest.approx(result.states[-2, agent], abs=1e-12)
    for place, before in ((1, 0), (2, 1), (3, 1)):
        shift = DRAWN.displacement(before, place)
        assert last[place][1].states == pytest.approx(last[before][2].states + shift, abs=1e-12)
        assert np.array_equal(last[place][1].inputs, last[before][2].inputs)


def failing(monkeypatch, when):
    """Let the solver fail where `when(number of the call)` says so; return what it answered."""
    calls, given = [], Horizon.solve

    def solve(self, start, targets, near):
        answer = given(self, start, targets, near)
        calls.append(answer)
        return Answer(None, "MADE_UP") if when(len(calls) - 1) else answer

    monkeypatch.setattr(Horizon, "solve", solve)
    return calls


# The carts' first plans take one solution (the leader, where it shall be) and two (the follower);
# from then on, period k asks number 2 k + 1 for the leader and 2 k + 2 for the follower.


def test_after_a_failure_the_last_plan_goes_on_shifted(monkeypatch):
    calls = failing(monkeypatch, lambda number: number in (10, 12))
    mpc = ech.optimal.MPC(period=0.1, horizon=1.0)
    result = cart_run(mpc, [[0.0, 0.0], [0.5, -0.3]], store_every=2)
    figures = result.work
    assert figures.failures == 2 and result.outcome is ech.Outcome.COMPLETED
    assert figures.solves == 2 * 20 and len(calls) == 2 * 20 + 1
    plan = calls[8].course.inputs
    assert np.abs(plan[:3]).min() > 0.1
    for later in (0, 1, 2):
        assert result.inputs[3 + later, 1] == pytest.approx(plan[later], abs=1e-12)


def test_a_failure_can_end_the_run_and_keeps_what_was_flown(monkeypatch):
    failing(monkeypatch, lambda number: number == 10)
    mpc = ech.optimal.MPC(period=0.1, horizon=1.0, on_failure="stop")
    result = cart_run(mpc, [[0.0, 0.0], [0.5, -0.3]])
    assert result.outcome is ech.Outcome.INTERRUPTED
    assert result.message == (
        "The run was stopped, since the solver of agent 1 failed (`MADE_UP`) at t = 0.4 s; "
        "what was computed is kept."
    )
    assert result.times[-1] == pytest.approx(0.4) and np.isfinite(result.states).all()


def test_a_run_that_diverges_says_so_and_makes_no_plan_from_a_state_that_is_not_finite(monkeypatch):
    starts, given = [], Horizon.solve

    def solve(self, start, targets, near):
        starts.append(start)
        return given(self, start, targets, near)

    monkeypatch.setattr(Horizon, "solve", solve)
    wild = ech.Disturbance(constant={"p": 1e200})
    result = swarm(disturbance=wild, limits=False, horizon=0.1)
    assert result.outcome is ech.Outcome.DIVERGED and np.isfinite(result.states).all()
    assert "stopped being finite" in result.message and np.isfinite(starts).all()


@pytest.mark.slow
def test_the_figures_are_kept_with_the_result_which_says_what_agents_were_sent():
    result = swarm(horizon=0.1)
    figures, information = result.work, result.drive.information
    assert json.loads(ech.dataset(result).attrs["solver"]) == figures._asdict()
    assert figures.method == "mpc" and figures.solver == "piqp" and figures.solves == 4 * 5
    assert 0.0 < figures.median_ms <= figures.p99_ms <= figures.worst_ms
    assert information.leader == ("the reference",)
    assert information.follower[0].startswith("the plans that the neighbours before it")
    rest = {"leader": ech.laws.TrimInput(), "follower": ech.laws.TrimInput()}
    assert simulate(CART, PAIR, APART, **rest, horizon=0.1, dt=0.05).work is None
    # Failures are counted and survived.
    result = swarm(mpc=ech.optimal.MPC(options={"piqp": {"max_iter": 1}}), horizon=0.1)
    assert result.work.failures == result.work.solves == 20
    assert result.outcome is ech.Outcome.COMPLETED


@pytest.mark.parametrize(
    ("how", "sentence"),
    [
        ({"period": 0.0}, "`period` is 0.0, and must be a positive finite number of seconds."),
        ({"period": "fast"}, "`period` is fast, and must be a positive finite number of seconds."),
        ({"horizon": 0.01}, "`horizon` is 0.01 s, and must be at least one `period` of 0.02 s."),
        ({"iterations": 0}, "`iterations` is 0, and must be a whole number from 1 on."),
        ({"iterations": 1.5}, "`iterations` is 1.5, and must be a whole number from 1 on."),
        ({"iterations": math.nan}, "`iterations` is nan, and must be a whole number from 1 on."),
        ({"on_failure": "cry"}, "`on_failure` is `cry`, allowed are `shift`, `stop`."),
        ({"solver": "pipq"}, "`solver` is `pipq`, allowed are `piqp`, `proxqp`, `osqp`, "),
        ({"state_weight": [1.0]}, "`state_weight` is [1.0], and must be 2 finite numbers that are"),
        ({"input_weight": [0.0]}, "`input_weight` is [0.0], and must be positive."),
        ({"options": {"no_such": 1}}, "`piqp` refuses the problem or its options: "),
    ],
)
def test_what_is_out_of_range_or_does_not_fit_the_model_is_refused(how, sentence):
    if "period" not in how and "horizon" not in how:
        how = {"period": 0.1, **how}
    with pytest.raises(PlanError) as caught:
        cart_run(ech.optimal.MPC(**how), [[0, 0], [0, 0]])
    assert str(caught.value).startswith(sentence)


def test_a_state_that_nothing_brings_back_is_told():
    places, times = ech.Formation([[0.0], [1.0]]), {"horizon": 1.0, "dt": 0.1}
    with pytest.raises(PlanError, match="the cost from the horizon's end on does not exist"):
        simulate_mpc(ech.models.Linear([[0.0]], [[0.0]]), PAIR, places, **times)


def test_a_missing_extra_is_told(monkeypatch):
    monkeypatch.setitem(sys.modules, "casadi", None)
    with pytest.raises(MissingExtraError, match=r"pip install '\.\[optimal\]'"):
        swarm()


def test_the_terminal_cost_is_that_of_the_discrete_riccati_equation():
    # Another solver of the same equation, on the quadrotor at hover.
    horizon = Horizon(QUADROTOR, ech.optimal.MPC(), 3, 0.02, limits=True)
    last = horizon._weight.toarray()[-12:, -12:]
    A, B = np.zeros((12, 12)), np.zeros((12, 4))
    A[:3, 3:6] = A[6:9, 9:] = np.eye(3)
    A[3, 7], A[4, 6] = 9.81, -9.81
    B[5, 0] = 1.0
    B[9:, 1:] = np.eye(3)
    flow = scipy.linalg.expm(0.02 * np.block([[A, B], [np.zeros((4, 16))]]))
    Q, R = (0.02 * np.diag(w) for w in ech.optimal.MPC().weights(QUADROTOR))
    F, G = flow[:12, :12], flow[:12, 12:]
    P = np.zeros((12, 12))
    for _ in range(4000):
        P = Q + F.T @ P @ F - F.T @ P @ G @ np.linalg.solve(R + G.T @ P @ G, G.T @ P @ F)
    assert last == pytest.approx(P, rel=1e-6, abs=1e-9)
