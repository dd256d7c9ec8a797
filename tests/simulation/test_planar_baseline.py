"""The optimization baseline: pinned numbers, a second solver, effects of its defects."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import lsq_linear

import echelon as ech
from echelon.agents.models.planar_quadrotor import LinearPlanarQuadrotor
from echelon.core.errors import ModelError, PlanError
from echelon.core.numerics import precision
from echelon.simulation.optimal.planar_baseline import PlanarBaseline

MASS, INERTIA, GRAVITY = 0.028, 16.571710e-6, 9.81
TREE = ech.Graph.from_edges([(0, 1), (1, 2), (1, 3)])
HALF, TALL = 0.25, 0.5 * np.sqrt(0.75)
OFFSETS = np.array([[0.0, 0.0], [-0.5, 0.0], [-0.75, TALL], [-0.75, -TALL]])


def path(t):
    y = -np.pi + 2.0 * np.pi * t / 10.0
    return np.stack([y, np.sin(y)], axis=1)


def trapezoid(steps, gravity=GRAVITY):
    """Positions as an affine map of all inputs: states (N, 6) for no input, and for unit inputs."""
    dt = 10.0 / steps
    A, B, fall = np.zeros((6, 6)), np.zeros((6, 2)), np.zeros(6)
    A[0, 1] = A[2, 3] = A[4, 5] = 1.0
    A[1, 4] = -GRAVITY
    B[3, 0], B[5, 1] = 1.0 / MASS, 1.0 / INERTIA
    fall[3] = -gravity
    left, right = np.eye(6) - 0.5 * dt * A, np.eye(6) + 0.5 * dt * A
    x, free = np.array([-np.pi, 0, 0, 0, 0, 0]), []
    response, forced = np.zeros((6, 2 * (steps + 1))), []
    for k in range(steps + 1):
        free.append(x)
        forced.append(response)
        x = np.linalg.solve(left, right @ x + dt * fall)
        push = right @ response
        push[:, 2 * k : 2 * k + 2] += 0.5 * dt * B
        if k < steps:
            push[:, 2 * k + 2 : 2 * k + 4] += 0.5 * dt * B
        response = np.linalg.solve(left, push)
    return np.array(free), np.array(forced)


def leader_by_least_squares(steps, terminal=True, **reading):
    """The leader's states: least squares with bounds on the inputs, all states eliminated."""
    free, forced = trapezoid(steps, **reading)
    t = np.linspace(0.0, 10.0, steps + 1)
    weight = np.sqrt(np.where((t == 0.0) | (t == 10.0), 0.5, 1.0) * 10.0 / steps)
    rows = [weight[:, None] * forced[:, 0], weight[:, None] * forced[:, 2]]
    goals = [weight * (path(t) - free[:, [0, 2]])[:, axis] for axis in (0, 1)]
    rows.append(np.diag(np.repeat(weight, 2)))
    rows += [forced[-1]] if terminal else []
    goals += [np.zeros(2 * steps + 2), *([-free[-1]] if terminal else [])]
    bound = np.tile([1.2 * MASS * GRAVITY, INERTIA * np.pi / 10.0], steps + 1)
    found = lsq_linear(np.vstack(rows) * bound, np.concatenate(goals), (-1, 1), "bvls", tol=1e-14)
    assert found.success
    return free + forced @ (bound * found.x)


def deviation(states):
    gaps = states[:, [0, 2]] - path(np.linspace(0.0, 10.0, len(states)))
    return np.sqrt((gaps**2).sum(axis=1).mean())


def leader(**changes):
    baseline = PlanarBaseline.literal(**changes)
    found = ech.optimal.solve(baseline.leader(), [-np.pi, 0, 0, 0, 0, 0], baseline.reference)
    assert found.solved
    return baseline, found


@pytest.mark.parametrize(
    "changes, pinned",
    [
        ({"steps": 100}, 0.480),
        ({"steps": 400}, 0.467),
        ({"steps": 100, "terminal": "none"}, 0.181),
    ],
)
def test_the_leader_as_printed_deviates_by_what_was_found_for_it(changes, pinned):
    baseline, found = leader(**changes)
    assert baseline.tracking_rmse(found.states) == pytest.approx(pinned, abs=5e-4)
    assert deviation(found.states) == pytest.approx(baseline.tracking_rmse(found.states))


@pytest.mark.slow
def test_a_solver_of_another_kind_finds_the_same_flight():
    _, found = leader()
    wanted = leader_by_least_squares(100)
    assert found.states[:, [0, 2]] == pytest.approx(wanted[:, [0, 2]], abs=2e-3)
    assert deviation(found.states) == pytest.approx(deviation(wanted), abs=1e-6)


@pytest.mark.study
def test_the_thrust_is_the_whole_thrust_since_as_a_deviation_it_deviates_by_something_else():
    # Weighing the whole thrust lets the agent sink a little; weighing its deviation does not.
    as_deviation = leader_by_least_squares(100, False, gravity=0.0)
    assert deviation(as_deviation) == pytest.approx(0.1787, abs=1e-4)
    assert deviation(leader_by_least_squares(100, False)) == pytest.approx(0.1809, abs=1e-4)


def test_the_terminal_cost_as_printed_calls_the_leader_back_to_the_origin():
    ends = {}
    for terminal in ("origin", "none", "error"):
        baseline, found = leader(terminal=terminal)
        ends[terminal] = np.linalg.norm((found.states[-1] - baseline.reference[-1])[[0, 2]])
    assert ends["error"] < 0.05 < ends["none"] < 0.5 < 1.0 < ends["origin"]


def test_the_reference_is_the_printed_curve_and_moves_as_its_states_say():
    baseline = PlanarBaseline.literal(steps=1000)
    assert baseline.reference[:, [0, 2]] == pytest.approx(path(np.linspace(0.0, 10.0, 1001)))
    rates = np.gradient(baseline.reference[:, [0, 2]], 0.01, axis=0, edge_order=2)
    assert rates == pytest.approx(baseline.reference[:, [1, 3]], abs=1e-4)
    # Its speed along y is constant, so that the linear agent follows it upright.
    assert not baseline.reference[:, 4:].any()


def distances(plans, pairs=((1, 0), (2, 1), (3, 1))):
    """Distances over time, one row for each pair; those of the tree when left out."""
    gaps = [(plans[i].states - plans[j].states)[:, [0, 2]] for i, j in pairs]
    return np.array([np.linalg.norm(gap, axis=1) for gap in gaps])


@pytest.mark.slow
def test_the_linear_distance_term_makes_the_followers_fly_apart():
    plans = PlanarBaseline.literal().plans(TREE, OFFSETS)
    assert all(plan.solved for plan in plans)
    found = distances(plans)
    assert found[:, 0] == pytest.approx(0.5)
    assert found.max(axis=1) == pytest.approx([42.6, 78.3, 78.5], abs=0.5)
    # The cost as printed is far below what flying in formation costs.
    formed = PlanarBaseline.repaired().plans(TREE, OFFSETS)
    assert all(p.cost < -100.0 < 0.0 < q.cost for p, q in zip(plans[1:], formed[1:], strict=True))


def test_without_the_call_to_the_origin_only_the_actuators_end_the_flight():
    pair = ech.Graph.path(2)
    first, second = PlanarBaseline.literal(terminal="none").plans(pair, OFFSETS[:2])
    assert first.solved and second.solved
    apart = distances([first, second], [(1, 0)])[0]
    # Full torque for 10 s rolls by 5 pi and carries the linear agent g pi/10 T^4 / 24 = 1284 m.
    reach = GRAVITY * np.pi / 10.0 * 10.0**4 / 24.0
    assert apart[-1] == pytest.approx(reach, rel=0.02)
    assert (np.diff(apart) > 0.0).all()


def test_repaired_followers_keep_the_distance_and_arrive_with_their_neighbours():
    plans = PlanarBaseline.repaired().plans(TREE, OFFSETS)
    assert all(plan.solved for plan in plans)
    assert distances(plans) == pytest.approx(np.full((3, 101), 0.5), abs=1e-6)
    for i, j in ((1, 0), (2, 1), (3, 1)):
        moving = (plans[i].states - plans[j].states)[-1, [1, 3, 4, 5]]
        assert np.abs(moving).max() < 0.02
    assert deviation(plans[0].states) == pytest.approx(0.179, abs=5e-4)
    limit = np.array([1.2 * MASS * GRAVITY, INERTIA * np.pi / 10.0])
    assert all((np.abs(plan.inputs) <= limit * (1 + 1e-6)).all() for plan in plans)


def test_a_follower_of_two_neighbours_must_turn_with_them_which_its_torque_does_not_allow():
    triangle = ech.Graph.from_edges([(0, 1), (0, 2), (1, 2)])
    offsets = np.array([[0.0, 0.0], [-0.5, 0.0], [-0.25, TALL]])
    *others, third = PlanarBaseline.repaired().plans(triangle, offsets)
    assert all(plan.solved for plan in others) and not third.solved
    [missed] = third.violations
    assert missed.name == "squared distance"
    assert missed.amount == pytest.approx(0.0029, abs=2e-4)
    assert "smallest possible violations: `squared distance` by 0.00" in third.message
    # A penalty finds the compromise.
    plans = PlanarBaseline.repaired(separation="penalty").plans(triangle, offsets)
    assert all(plan.solved for plan in plans)
    assert np.abs(distances(plans, [(1, 0), (2, 0), (2, 1)]) - 0.5).max() < 0.06


def test_an_open_loop_adds_up_the_noise():
    baseline, found = leader()
    added = baseline.with_noise(found, seed=3) - found.states
    t = found.times
    w = np.diff(added[:, 5]) / 0.1
    assert len(set(w.round(12))) == 100
    assert w.std() == pytest.approx(0.2, rel=0.25)
    # A push w from s to s + h moves y at t by -g w ((t - s)^4 - (t - s - h)^4) / 24.
    for k in (1, 50, 100):
        since = t[k] - t[:k]
        wanted = -GRAVITY * w[:k] @ (since**4 - (since - 0.1) ** 4) / 24.0
        assert added[k, 0] == pytest.approx(wanted, rel=1e-9)
    assert not added[:, [2, 3]].any()
    assert (baseline.with_noise(found, seed=3) == baseline.with_noise(found, seed=3)).all()
    assert (baseline.with_noise(found, seed=4) != baseline.with_noise(found, seed=3)).any()


def test_the_agent_is_the_linearization_of_the_planar_quadrotor_at_hover():
    linear, full = LinearPlanarQuadrotor(), ech.models.PlanarQuadrotor()
    places = [full.state_names.index(name) for name in linear.state_names]
    rng = np.random.default_rng(0)
    with precision("float64"):
        for size in (1e-3, 1e-4):
            x = size * rng.normal(size=6)
            u = np.array(full.trim[1]) + size * np.diag(full.input_scale) * rng.normal(size=2)
            whole = np.zeros(6)
            whole[places] = x
            wanted = np.asarray(full.velocity(jnp.asarray(whole), jnp.asarray(u)))[places]
            got = np.asarray(linear.velocity(jnp.asarray(x), jnp.asarray(u)))
            assert got == pytest.approx(wanted, abs=100.0 * size**2)
            assert np.asarray(linear.output(jnp.asarray(x))).tolist() == x[[0, 2]].tolist()


def test_the_limits_of_the_agent_are_the_printed_ones():
    model = LinearPlanarQuadrotor()
    top = np.array([1.2 * MASS * GRAVITY, INERTIA * np.pi / 10.0])
    assert model.input_limits.high == pytest.approx(top)
    with precision("float64"):
        assert np.asarray(model.limit(jnp.asarray(5.0 * top))).tolist() == pytest.approx(top)
        assert np.asarray(model.limit(jnp.asarray(-5.0 * top))).tolist() == pytest.approx(-top)
        inside = 0.999 * top
        assert np.asarray(model.limit(jnp.asarray(inside))).tobytes() == inside.tobytes()


def test_bad_input_is_told():
    with pytest.raises(PlanError, match="^`terminal` is `start`, allowed are `origin`"):
        PlanarBaseline.literal(terminal="start")
    with pytest.raises(PlanError, match=r"^`offsets` has shape \(2, 2\), and 4 agents need"):
        PlanarBaseline.repaired().plans(TREE, OFFSETS[:2])
    with pytest.raises(ModelError, match="`mass` of `LinearPlanarQuadrotor` is 0.0"):
        LinearPlanarQuadrotor(mass=0.0)
