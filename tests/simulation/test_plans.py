"""Plans of whole formations against other solutions of the same problems, and their replay."""

import sys

import casadi as ca
import jax.numpy as jnp
import numpy as np
import pytest
from oracles import GRAVITY
from runs import simulate_plans

import echelon as ech
from echelon.core.errors import MissingExtraError, PlanError
from echelon.core.numerics import precision
from echelon.simulation.optimal.formation_plan import plan_formation
from echelon.simulation.optimal.objectives import PlanTimes, grid

QUADROTOR = ech.models.Quadrotor.crazyflie()
LOOP = ech.references.Lemniscate()
TREE = ech.Graph.from_edges([(0, 1), (1, 2), (1, 3)], leaders=[0])
OFFSETS = {1: (1, 0, 0), 2: (1, 0.8, 0), 3: (1, -0.8, 0)}
DRAWN = ech.Formation.from_offsets(QUADROTOR, TREE, OFFSETS)
SHORT = {"horizon": 1.0, "dt": 0.01}


def starts(**moved):
    """States (4, 12) on the goals, but for the leader and agents moved by a vector in space."""
    x = np.asarray(ech.laws.Tracking(LOOP).prepared(QUADROTOR, TREE).start(QUADROTOR), float)
    states = x + DRAWN.offsets
    states[0, :2] += -0.3, 0.2
    for name, by in moved.items():
        states[int(name[1:]), :3] += by
    return states


def planned(states, *, limits=True, **how):
    planning = ech.optimal.TrackingOptions(**how)
    times, how = grid(1.0, 0.01, planning.interval), {"planning": planning, "limits": limits}
    return plan_formation(QUADROTOR, TREE, DRAWN, states, times, reference=LOOP, **how)


def hand_written(x, v, mass, J):
    """xdot of the quadrotor in CasADi's words, from v = (T / m - g, J^-1 tau)."""
    (sr, sp, sy), (cr, cp, cy) = ([f(x[6 + k]) for k in range(3)] for f in (ca.sin, ca.cos))
    p, q, r = x[9], x[10], x[11]
    lift, turn = v[0] + GRAVITY, (sr * q + cr * r) / cp
    return ca.vertcat(
        x[3:6],
        (cr * sp * cy + sr * sy) * lift,
        (cr * sp * sy - sr * cy) * lift,
        cr * cp * lift - GRAVITY,
        p + sp * turn,
        cr * q - sr * r,
        turn,
        v[1] + (J[1] - J[2]) * q * r / J[0],
        v[2] + (J[2] - J[0]) * r * p / J[1],
        v[3] + (J[0] - J[1]) * p * q / J[2],
    )


def motors(v, mass, J):
    """Thrust of each motor at (+-l, +-l), from the normalized input."""
    arm, spin = 0.0325, 0.005964552
    tau = ca.DM(np.array(J)) * v[1:]
    signs = [(1, 1, 1), (1, -1, -1), (-1, -1, 1), (-1, 1, -1)]  # left, front, spin
    return ca.vertcat(
        *(
            mass * (v[0] + GRAVITY) / 4
            + (left * tau[0] - front * tau[1]) / (4 * arm)
            + way * tau[2] / (4 * spin)
            for left, front, way in signs
        )
    )


def by_hand(start, wanted, inputs, steps, step, limited, weight):
    """States and normalized inputs of the leader's problem, all of it written here."""
    mass, J = 0.028, (16.571710e-6, 16.655602e-6, 29.261652e-6)
    x, v = ca.SX.sym("x", 12), ca.SX.sym("v", 4)
    y, h = x, step / 5
    for _ in range(5):
        k1 = hand_written(y, v, mass, J)
        k2 = hand_written(y + h / 2 * k1, v, mass, J)
        k3 = hand_written(y + h / 2 * k2, v, mass, J)
        k4 = hand_written(y + h * k3, v, mass, J)
        y = y + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    flow = ca.Function("flow", [x, v], [y])
    opti = ca.Opti()
    X, V = opti.variable(12, steps + 1), opti.variable(4, steps)
    R = weight * np.array([1 / 25, 1 / 400, 1 / 400, 1 / 400])
    cost = 0
    for k in range(steps):
        opti.subject_to(X[:, k + 1] == flow(X[:, k], V[:, k]))
        opti.subject_to(opti.bounded(-0.45 * np.pi, X[7, k + 1], 0.45 * np.pi))
        if limited:
            opti.subject_to(opti.bounded(0, motors(V[:, k], mass, J) / 0.15975, 1))
        for node in (k, k + 1):
            e = X[[0, 1, 2, 8], node] - wanted[node]
            d = V[:, k] - inputs[node]
            cost += step / 2 * (ca.sumsqr(e) + ca.dot(ca.DM(R), d**2))
    opti.subject_to(X[:, 0] == start)
    opti.minimize(cost)
    opti.set_initial(X, np.tile(start[:, None], steps + 1))
    opti.solver("ipopt", {"print_time": False}, {"print_level": 0, "sb": "yes"})
    found = opti.solve()
    return np.array(found.value(X)).T, np.array(found.value(V)).T


@pytest.mark.slow
@pytest.mark.parametrize("limited", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_the_leader_s_plan_is_that_of_a_problem_written_by_hand(limited):
    states = starts()
    made = planned(states, limits=limited, input_weight=1e-3)
    times = made.grid.times
    law = ech.laws.Tracking(LOOP).prepared(QUADROTOR, TREE)
    with precision("float64"):
        both = [law.target(QUADROTOR, jnp.asarray(t)) for t in times]
    x, u = (np.stack([np.asarray(pair[k]) for pair in both]) for k in (0, 1))
    scale = np.array([0.028, 16.571710e-6, 16.655602e-6, 29.261652e-6])
    v = (u - np.array([0.028 * GRAVITY, 0, 0, 0])) / scale
    found = by_hand(states[0], x[:, [0, 1, 2, 8]], v, 20, 0.05, limited, 1e-3)
    plan = made.plans[0]
    assert plan.solved
    assert plan.states == pytest.approx(found[0], abs=1e-4)
    assert (plan.inputs - [0.028 * GRAVITY, 0, 0, 0]) / scale == pytest.approx(found[1], abs=0.05)


def test_on_linear_agents_the_plans_are_least_squares():
    # Double integrators, no limits: the gap, the trapezoidal cost and the order of the graph.
    cart, steps, dt = ech.models.DoubleIntegrator(1), 20, 0.1
    graph = ech.Graph.from_edges([(0, 1), (1, 2), (0, 2, 3.0)], leaders=[0])
    formation = ech.Formation([[0, 0], [-1, 0], [-2, 0]])
    states = np.array([[0.5, 0.0], [0.0, 1.0], [-1.0, 0.3]])
    planning, times = (
        ech.optimal.TrackingOptions(interval=dt, input_weight=0.1),
        PlanTimes(steps, 1, dt),
    )
    how = {"reference": None, "planning": planning, "limits": True}
    made = plan_formation(cart, graph, formation, states, times, **how)
    A, B = np.array([[1, dt], [0, 1]]), np.array([dt**2 / 2, dt])
    powers = [np.linalg.matrix_power(A, k) for k in range(steps + 1)]
    reach = np.zeros((steps + 1, 2, steps))
    for k in range(1, steps + 1):
        reach[k] = A @ reach[k - 1]
        reach[k, :, k - 1] += B
    half = np.ones(steps + 1)
    half[[0, -1]] = 0.5
    # The output is the position.
    roots = np.sqrt(dt * np.kron(half, [1.0, 0.0]))
    R = dt * 0.1 * np.asarray(cart.weights[1])[0]

    def best(start, wanted, pushed):
        free = np.stack([p @ start for p in powers])
        rows = np.vstack([roots[:, None] * reach.reshape(-1, steps), np.sqrt(R) * np.eye(steps)])
        # The input of an interval counts half against the target's at either of its ends.
        mean = 0.5 * (pushed[:-1] + pushed[1:])
        right = np.concatenate([roots * (wanted - free).ravel(), np.sqrt(R) * mean])
        u = np.linalg.lstsq(rows, right, rcond=None)[0]
        return free + reach @ u, u

    def held(u):
        return np.append(u, u[-1])

    leader = best(states[0], np.zeros((steps + 1, 2)), np.zeros(steps + 1))
    first = best(states[1], leader[0] + [-1, 0], held(leader[1]))
    mean = 0.75 * (leader[0] + [-2, 0]) + 0.25 * (first[0] + [-1, 0])
    second = best(states[2], mean, held(0.75 * leader[1] + 0.25 * first[1]))
    for plan, (x, u) in zip(made.plans, (leader, first, second), strict=True):
        assert plan.states == pytest.approx(x, abs=1e-6)
        assert plan.inputs[:, 0] == pytest.approx(u, abs=1e-6)


@pytest.mark.slow
def test_an_agent_knows_the_plans_before_it_and_no_others():
    same, far = planned(starts()), planned(starts(a3=(0.1, -0.2, 0.1)))
    for agent in (0, 1, 2):
        assert np.array_equal(same.plans[agent].states, far.plans[agent].states)
    assert not np.allclose(same.plans[3].states, far.plans[3].states, atol=1e-3)
    moved = planned(starts(a1=(0.1, 0.1, 0.0)))
    assert np.array_equal(same.plans[0].states, moved.plans[0].states)
    for agent in (2, 3):
        assert not np.allclose(same.plans[agent].states, moved.plans[agent].states, atol=1e-3)


@pytest.mark.study
def test_followers_arrive_at_their_offsets_or_at_their_distances():
    states = starts(a1=(-0.193, 0, 0), a3=(0, 0.18, 0))
    offset = planned(states, limits=False)
    gap = offset.plans[3].states - offset.plans[1].states - (DRAWN.offsets[3] - DRAWN.offsets[1])
    assert np.linalg.norm(gap[0, :3]) == pytest.approx(np.hypot(0.193, 0.18))
    assert np.abs(gap[15:, :3]).max() < 0.01
    apart = planned(states, limits=False, specification="distance")
    steps = apart.plans[3].states - apart.plans[1].states
    length = np.linalg.norm(steps[:, :3], axis=1)
    assert abs(length[0] - 0.8) > 0.1 and np.abs(length[15:] - 0.8).max() < 0.01
    # A distance leaves the direction free, and the cheaper one is not that of the offset.
    assert np.abs(steps[-1, :3] - [0, -0.8, 0]).max() > 0.05


@pytest.mark.slow
def test_the_replay_of_plans_is_the_plans():
    states = starts(a1=(-0.193, 0, 0))
    made = planned(states, limits=False)
    given = {"reference": LOOP, "initial": states, "limits": False, "store_every": 5, **SHORT}
    result = simulate_plans(QUADROTOR, TREE, DRAWN, **given)
    found = np.stack([plan.states for plan in made.plans], axis=1)
    assert result.states == pytest.approx(found, abs=1e-6)
    assert result.inputs[:-1] == pytest.approx(np.stack([p.inputs for p in made.plans], axis=1))
    assert result.times == pytest.approx(made.grid.times)
    assert not result.saturated.any()


VAN_DER_POL = ech.models.VanDerPol(), ech.Graph.path(2), ech.Formation(np.zeros((2, 2)))
OPTIONS = ech.optimal.TrackingOptions
REFUSED = [
    (OPTIONS, {"interval": 0.0}, "`interval` is 0.0, and must be a positive finite number of sec"),
    (
        OPTIONS,
        {"input_weight": -1.0},
        "`input_weight` is -1.0, and must be finite and not negative",
    ),
    (OPTIONS, {"specification": "angle"}, "`specification` is `angle`, allowed are `offset`, `dis"),
    (planned, {"states": starts(), "output_weight": [1.0, 2.0]}, "must be 4 finite numbers that "),
    (grid, {"horizon": 0.001, "dt": 0.01, "interval": 0.05}, "`horizon` is 0.001 s, and must be "),
    (simulate_plans, {"reference": LOOP}, "`VanDerPol` cannot be led along a reference"),
    (
        simulate_plans,
        {"planning": OPTIONS(specification="distance")},
        "`VanDerPol` has no position",
    ),
    (simulate_plans, {"reference": 1.0}, "`reference` is a `float`, and must be"),
]


@pytest.mark.parametrize(("call", "given", "sentence"), REFUSED)
def test_what_cannot_be_planned_is_refused(call, given, sentence):
    run = VAN_DER_POL if call is simulate_plans else ()
    with pytest.raises(ech.EchelonError) as caught:
        call(*run, **given, **(SHORT if run else {}))
    assert sentence in str(caught.value)


class Corridor(ech.models.DoubleIntegrator):
    """A cart with brakes in a corridor, whose equations end with it."""

    chart = {"x": (-1.0, 1.0)}
    input_limits = ech.models.Limits(((1.0,),), (-1.0,), (1.0,))


def test_a_problem_without_a_solution_says_which_constraint_and_by_how_much():
    # From 0.5 at a speed of 2 the brakes stop it at 2.5, and the plan's corridor ends at 0.9.
    still = ech.Formation(np.zeros((2, 2)))
    how = {"initial": np.array([[0.0, 0.0], [0.5, 2.0]]), "horizon": 2.0, "dt": 0.1}
    with pytest.raises(PlanError, match=r"^there is no plan for agent 1: .*`[\w ]+` by [\d.]+ at"):
        simulate_plans(Corridor(1), ech.Graph.path(2), still, **how)


def test_a_missing_extra_is_told(monkeypatch):
    monkeypatch.setitem(sys.modules, "casadi", None)
    with pytest.raises(MissingExtraError, match=r"pip install '\.\[optimal\]'"):
        simulate_plans(QUADROTOR, TREE, DRAWN, reference=LOOP, **SHORT)
