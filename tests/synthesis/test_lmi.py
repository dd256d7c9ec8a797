"""One metric for many Jacobians: closed forms, Riccati equations, solvers with wrong results."""

import itertools
import sys

import cvxpy
import numpy as np
import pytest
import scipy.linalg
import scipy.optimize
from hypothesis import given, settings
from hypothesis import strategies as st

from echelon.agents.models import Quadrotor
from echelon.core.errors import GainError, MissingExtraError
from echelon.synthesis.certificates import lmi
from echelon.synthesis.certificates.lmi import (
    axis_modes,
    contraction,
    monotone,
    obstacle,
    rate_of,
    robust_lqr,
)

GRAVITY = 9.81
DOUBLE_INTEGRATOR = np.array([[0.0, 1.0], [0.0, 0.0]])
FAR_APART = np.array([[[0.0]], [[4.0]]])
PUSH = np.array([[0.0], [1.0]])
INPUTS = np.zeros((12, 4))
INPUTS[5, 0] = INPUTS[9, 1] = INPUTS[10, 2] = INPUTS[11, 3] = 1.0


def pendulum(angle, gravity, damping):
    """The two vertices of the Jacobians of (x2, -g sin x1 - d x2) over |x1| <= angle."""
    stiffness = (gravity, gravity * np.cos(angle))
    return np.array([[[0.0, 1.0], [-k, -damping]] for k in stiffness])


def vehicle(roll, pitch, yaw, thrust):
    """The Jacobian of (v, R e3 T - g e3, rates, 0); angles as (cos, sin), thrust T in m/s^2."""
    (cr, sr), (cp, sp), (cy, sy) = roll, pitch, yaw
    A = np.zeros((12, 12))
    A[0:3, 3:6] = A[6:9, 9:12] = np.eye(3)
    A[3:6, 6:9] = thrust * np.array(
        [
            [cr * sy - sr * sp * cy, cr * cp * cy, sr * cy - cr * sp * sy],
            [-cr * cy - sr * sp * sy, cr * cp * sy, sr * sy + cr * sp * cy],
            [-sr * cp, -cr * sp, 0.0],
        ]
    )
    return A


def trapezoid(degrees):
    """Four points (cos, sin) whose hull holds the arc of angles up to +- degrees."""
    t = np.radians(degrees)
    ends = [(np.cos(t), np.sin(t)), (1.0, np.tan(0.5 * t))]
    return [(c, sign * s) for c, s in ends for sign in (1.0, -1.0)]


def hull(tilt, yaw, spread):
    thrusts = (GRAVITY - spread, GRAVITY + spread)
    arcs = (trapezoid(tilt), trapezoid(tilt), trapezoid(yaw))
    return np.array([vehicle(*point) for point in itertools.product(*arcs, thrusts)])


HOVER = vehicle(*[(1.0, 0.0)] * 3, GRAVITY)


def well_conditioned(rng, n):
    return np.linalg.qr(rng.normal(size=(n, n)))[0] @ np.diag(rng.uniform(0.5, 2.0, n))


def test_a_double_integrator_has_no_metric_and_the_mode_is_named():
    with pytest.raises(GainError) as caught:
        monotone(DOUBLE_INTEGRATOR[None], names=["position", "velocity"])
    assert str(caught.value) == (
        "no P > 0 keeps this drift from expanding: matrix 0 has a Jordan block on the imaginary "
        "axis, at 0 1/s along `position`, `velocity`; damp it by an inner loop, shrink the "
        "domain, or take a method with feedback."
    )


def test_a_hovering_quadrotor_without_drag_has_none():
    found = obstacle(np.stack([HOVER] * 20))
    assert (found.vertex, found.eigenvalue, found.defective) == (0, 0.0, True)
    # Position is fed by velocity and yaw by its rate; the tilt only drives the velocity.
    assert found.states == (0, 1, 2, 3, 4, 5, 8, 11)


@pytest.mark.parametrize("size", [1.0, 1e6])
def test_a_mode_grows_from_a_thousand_millionth_of_the_fastest_on(size):
    for growth, grows in ((3e-9, True), (3e-10, False), (-3e-9, False)):
        found = obstacle(size * np.diag([-1.0, growth])[None])
        assert (found is not None) is grows
        if found is not None:
            assert (found.eigenvalue, found.states) == (growth * size, (1,))


def test_the_vertex_with_the_unstable_mode_is_named():
    As = np.stack([-np.eye(2), np.diag([-1.0, 0.3])])
    found = obstacle(As)
    assert (found.vertex, found.defective, found.states) == (1, False, (1,))
    assert found.eigenvalue == pytest.approx(0.3)
    with pytest.raises(GainError, match=r"matrix 1 has an unstable mode, at 0\.3 1/s along `x2`"):
        monotone(As)


def blocks(seed, block, decays, rest=0.0):
    """A block beside modes that decay, which it may feel, in coordinates at random."""
    rng = np.random.default_rng(seed)
    A = scipy.linalg.block_diag(block, -np.diag(rng.uniform(*decays, 2)))
    A[: len(block), len(block) :] = rest * rng.normal(size=(len(block), 2))
    T = well_conditioned(rng, len(A))
    return obstacle((T @ A @ np.linalg.inv(T))[None])


@given(st.integers(0, 10**6), st.integers(2, 4), st.sampled_from([0.0, 0.7, 3.0]))
@settings(max_examples=40)
def test_jordan_blocks_on_the_axis_are_found_in_any_coordinates(seed, size, frequency):
    cell = np.array([[0.0, frequency], [-frequency, 0.0]])
    block = np.kron(np.eye(size), cell) + np.kron(np.eye(size, k=1), np.eye(2))
    found = blocks(seed, block, (0.5, 3.0))
    assert found is not None and found.defective
    assert found.eigenvalue == pytest.approx(1j * frequency, abs=1e-6)


@pytest.mark.parametrize("pace", [1e-7, 1.0, 1e7])
def test_modes_on_the_axis_are_as_many_at_any_pace(pace):
    T = well_conditioned(np.random.default_rng(0), 3)
    A = T @ np.diag([0.0, -1.0, -0.3]) @ np.linalg.inv(T)
    [(where, right, left)] = axis_modes(pace * A)
    assert where == pytest.approx(0.0, abs=1e-9 * pace) and right.shape == left.shape == (3, 1)
    assert abs(right[:, 0] @ T[:, 0]) == pytest.approx(np.linalg.norm(T[:, 0]))


@given(st.integers(0, 10**6), st.integers(1, 3), st.sampled_from([0.0, 0.7]))
@settings(max_examples=40)
def test_repeated_modes_on_the_axis_without_a_jordan_block_are_no_obstacle(seed, copies, frequency):
    cell = np.array([[0.0, frequency], [-frequency, 0.0]])
    assert blocks(seed, np.kron(np.eye(copies), cell), (0.1, 3.0), rest=1.0) is None


def test_units_do_not_hide_a_jordan_block():
    units = np.array([1e-6, 1e4])
    assert obstacle((DOUBLE_INTEGRATOR * units / units[:, None])[None]).defective


def test_a_pendulum_under_gravity_loses_its_metric_at_the_closed_form():
    # k1 <= stiffness <= k2 with damping d has a common metric where sqrt(k2) - sqrt(k1) < d.
    edge = np.arccos((1.0 - 0.5 / np.sqrt(GRAVITY)) ** 2)
    assert edge == pytest.approx(0.787, abs=5e-4)
    inside = pendulum(edge - 1e-3, GRAVITY, 0.5)
    metric = monotone(inside)
    X = metric.P @ inside + (metric.P @ inside).swapaxes(1, 2)
    assert np.linalg.eigvalsh(X).max() < 0.0 and metric.margin < 0.0 and metric.rate > 0.0
    assert np.linalg.eigvalsh(metric.P)[0] == pytest.approx(1.0)
    with pytest.raises(GainError) as caught:
        monotone(pendulum(edge + 1e-3, GRAVITY, 0.5))
    assert str(caught.value) == (
        "no constant metric of condition number below 10000 was found that no vertex of 2 expands, "
        "though none alone forbids it; shrink the domain, add damping by an inner loop, or take a "
        "method with feedback."
    )
    with pytest.raises(GainError, match=r"matrix 1 has an unstable mode, at 0\.0528"):
        monotone(pendulum(1.6, 1.0, 0.5))


@given(st.floats(0.3, 3.0), st.floats(0.5, 4.0), st.sampled_from([0.9, 1.1]))
@settings(max_examples=15)
def test_any_interval_of_stiffness_follows_the_closed_form(root, damping, part):
    stiffness = (root**2, (root + part * damping) ** 2)
    As = np.array([[[0.0, 1.0], [-k, -damping]] for k in stiffness])
    if part < 1.0:
        assert monotone(As, condition_max=1e6).margin < 0.0
    else:
        with pytest.raises(GainError, match="was found that no vertex of 2 expands"):
            monotone(As, condition_max=1e6)


@given(st.floats(0.1, 10.0))
@settings(max_examples=10)
def test_an_undamped_oscillator_has_its_energy_for_a_metric(frequency):
    metric = monotone(np.array([[[0.0, 1.0], [-(frequency**2), 0.0]]]))
    energy = np.diag([frequency**2, 1.0]) / min(1.0, frequency**2)
    assert metric.P == pytest.approx(energy, rel=1e-6)
    assert metric.rate == 0.0 and abs(metric.margin) < 1e-9


def test_a_position_behind_a_damped_velocity_has_the_best_metric_of_its_family():
    damping = 0.7
    # P A + A'P must send the position to zero, so P = [[t, t/d], [t/d, 1]] with t <= d^2.
    family = scipy.optimize.minimize_scalar(
        lambda t: np.linalg.cond([[t, t / damping], [t / damping, 1.0]]),
        bounds=(1e-6, damping**2 - 1e-9),
        method="bounded",
    )
    metric = monotone(np.array([[[0.0, 1.0], [0.0, -damping]]]))
    assert metric.condition == pytest.approx(family.fun, rel=1e-4)
    assert metric.rate == 0.0 and metric.margin < 1e-12


def test_vertices_share_a_metric_where_there_is_one():
    As = np.array([[[0.0, 1.0], [-4.0, 0.0]], [[0.0, 1.0], [-4.0, -0.5]]])
    assert monotone(As).P == pytest.approx(np.diag([4.0, 1.0]), rel=1e-6)
    with pytest.raises(GainError, match="was found"):
        monotone(np.array([[[0.0, 1.0], [-4.0, 0.0]], [[0.0, 1.0], [-1.0, 0.0]]]))
    assert monotone(np.zeros((3, 4, 4))).P == pytest.approx(np.eye(4), abs=1e-6)


def test_a_metric_that_needs_the_whole_allowed_condition_is_none():
    fast = np.array([[[0.0, 1.0], [-(20.0**2), 0.0]]])
    assert monotone(fast, condition_max=401.0).condition == pytest.approx(400.0, rel=1e-6)
    with pytest.raises(GainError, match="condition number below 400 was found"):
        monotone(fast, condition_max=400.0)


def test_one_vertex_gives_the_riccati_gain():
    A, Q, R = np.array([[0.0, 1.0], [2.0, -0.3]]), np.diag([3.0, 1.0]), np.array([[0.5]])
    metric = robust_lqr(A[None], PUSH, Q, R)
    assert metric.P == pytest.approx(scipy.linalg.solve_continuous_are(A, PUSH, Q, R), rel=1e-3)
    assert metric.rho == 1.0 and metric.rate > 0.0 and metric.margin < 0.0


def test_scalar_vertices_give_the_riccati_gain_of_the_worst():
    As, one = np.array([[[-1.0]], [[0.5]], [[2.0]]]), np.eye(1)
    metric = robust_lqr(As, one, one, one)
    assert metric.P[0, 0] == pytest.approx(2.0 + np.sqrt(5.0), rel=1e-4)
    assert metric.rate == pytest.approx(0.5 * metric.P[0, 0] - 2.0, rel=1e-9)
    assert rate_of(metric.P, As, one, one, 2.0) == pytest.approx(metric.P[0, 0] - 2.0, rel=1e-9)


@pytest.mark.slow
def test_a_quadrotor_in_euler_rates_contracts_on_its_whole_hull():
    Q, R = (np.diag(weights) for weights in Quadrotor().weights)
    As = hull(20.0, 10.0, 2.0)
    metric = robust_lqr(As, INPUTS, Q, R)
    assert metric.rate >= 0.2 and metric.condition <= 500.0
    assert metric.rate == rate_of(metric.P, As, INPUTS, R, 1.0)
    assert rate_of(metric.P, As, INPUTS, R, 2.0) > metric.rate
    P, S = metric.P, INPUTS @ np.linalg.solve(R, INPUTS.T)
    lqr = P @ As + (P @ As).swapaxes(1, 2) + Q - P @ S @ P
    assert np.linalg.eigvalsh(lqr).max() <= 1e-6 * np.linalg.norm(P @ S @ P, 2)
    # No mode of a loop of this strength or more decays slower than the metric promises.
    for A in As:
        for strength in (1.0, 30.0):
            abscissa = np.linalg.eigvals(A - 0.5 * strength * S @ P).real.max()
            assert abscissa <= -metric.rate + 1e-9


def test_the_weakest_contraction_of_a_scalar_has_a_closed_form():
    As, B = np.array([[[0.3]], [[1.0]]]), np.full((1, 1), 2.0)
    metric = contraction(As, B, rate=0.5)
    assert metric.rho == pytest.approx(2.0 * (1.0 + 0.5) / 4.0, rel=1e-4)
    assert metric.P[0, 0] == pytest.approx(1.0, rel=1e-4) and metric.rate >= 0.5


@pytest.mark.parametrize(("drift", "told", "taken"), [(-1.0, 1.0, 0.0), (1.0, 0.995, 1.01)])
def test_a_strength_that_a_solver_tells_wrong_is_mended(drift, told, taken, monkeypatch):
    solve, strengths = lmi._least, []

    def solve_badly(cp, goal, cones, gaps):
        found = solve(cp, goal, cones, gaps)
        goal.value = told * goal.value
        strengths.append(taken * float(goal.value))
        return found

    monkeypatch.setattr(lmi, "_least", solve_badly)
    metric = contraction(np.array([[[drift]]]), np.ones((1, 1)), rate=0.5)
    assert [metric.rho] == strengths and metric.rate >= 0.5


def test_a_contraction_is_no_stronger_than_the_riccati_gain_of_the_shifted_plant():
    A, rate = np.array([[0.0, 1.0], [-1.0, 0.4]]), 0.6
    metric = contraction(A[None], PUSH, rate)
    shifted = A + rate * np.eye(2)
    W = np.linalg.inv(scipy.linalg.solve_continuous_are(shifted, PUSH, 1e-3 * np.eye(2), np.eye(1)))
    assert metric.rho <= 1.0 / np.linalg.eigvalsh(W)[0]
    assert rate <= metric.rate <= rate + 1e-3
    assert metric.rate == rate_of(metric.P, A[None], PUSH, None, metric.rho)
    assert metric.condition <= 1e4 and np.linalg.eigvalsh(metric.P)[-1] <= 1.0 + 1e-6


def test_the_input_map_may_differ_from_vertex_to_vertex():
    A, Q, R = np.array([[0.0, 1.0], [1.0, 0.0]]), np.eye(2), np.eye(1)
    As, Bs = np.stack([A, A]), np.stack([0.5 * PUSH, PUSH])
    metric = robust_lqr(As, Bs, Q, R)
    each = [rate_of(metric.P, A[None], B, R, 1.0) for B in Bs]
    assert metric.rate == pytest.approx(min(each)) and min(each) > 0.0
    # The weaker input alone decides, since a stronger one only adds damping.
    assert metric.P == pytest.approx(robust_lqr(A[None], Bs[0], Q, R).P, rel=1e-3)
    assert contraction(As, Bs, rate=0.1).rate >= 0.1


def test_what_no_input_moves_cannot_be_contracted():
    A = np.diag([0.5, 0.0])
    with pytest.raises(GainError, match=r"one gain contracts on all of the 1 matrices"):
        robust_lqr(A[None], PUSH, np.eye(2), np.eye(1))
    with pytest.raises(GainError, match=r"one gain contracts at 0\.2 1/s on all of the 1 matrices"):
        contraction(-0.1 * np.eye(2)[None], PUSH, rate=0.2)


@given(st.integers(0, 10**6))
@settings(max_examples=30)
def test_the_rate_does_not_depend_on_coordinates_and_grows_with_the_strength(seed):
    rng = np.random.default_rng(seed)
    As, B, R = rng.normal(size=(3, 3, 3)), rng.normal(size=(3, 2)), np.diag([1.0, 2.0])
    L = rng.normal(size=(3, 3)) + 3.0 * np.eye(3)
    P, T = L @ L.T, well_conditioned(rng, 3)
    inverse = np.linalg.inv(T)
    turned = rate_of(inverse.T @ P @ inverse, T @ As @ inverse, T @ B, R, 1.5)
    rate = rate_of(P, As, B, R, 1.5)
    assert turned == pytest.approx(rate, rel=1e-7, abs=1e-7)
    assert rate_of(P, As) <= rate_of(P, As, B, R, 1.0) + 1e-9 <= rate + 2e-9
    # By definition: the inequality holds at the rate and not above it.
    damping = 1.5 * P @ B @ np.linalg.solve(R, B.T) @ P
    X = P @ As + (P @ As).swapaxes(1, 2) - damping + 2.0 * rate * P
    assert np.linalg.eigvalsh(X).max() == pytest.approx(0.0, abs=1e-8 * np.linalg.norm(P, 2))


def lies(problem, **_):
    for variable in problem.variables():
        variable.value = np.ones(variable.shape)


def fails(problem, **_):
    raise cvxpy.SolverError("numerical trouble")


NARROW = pendulum(1.0, 1.0, 0.5)


@pytest.mark.parametrize(
    ("solve", "call", "sentence"),
    [
        (lies, lambda: monotone(NARROW), "that no vertex of 2 expands"),
        (fails, lambda: monotone(NARROW), "that no vertex of 2 expands"),
        (
            lies,
            lambda: robust_lqr(FAR_APART, np.eye(1), np.eye(1), 9.0 * np.eye(1)),
            "one gain contracts on all of the 2 matrices",
        ),
        (lies, lambda: contraction(FAR_APART, np.eye(1), 0.1), "one gain contracts at 0.1 1/s"),
    ],
)
def test_a_solver_that_lies_or_fails_is_told_as_no_metric(monkeypatch, solve, call, sentence):
    monkeypatch.setattr(cvxpy.Problem, "solve", solve)
    with pytest.raises(GainError, match=sentence):
        call()


def test_a_missing_solver_is_told_with_the_line_that_adds_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "cvxpy", None)
    with pytest.raises(MissingExtraError) as caught:
        monotone(NARROW)
    assert str(caught.value) == (
        "a metric for a polytope of Jacobians needs cvxpy and clarabel; "
        "install them with `pip install '.[certify]'` in echelon's clone."
    )
    # What eigenvalues forbid is told without it.
    with pytest.raises(GainError, match="Jordan block"):
        monotone(DOUBLE_INTEGRATOR[None])


def test_bad_input_is_one_sentence():
    metrics = np.diag([1.0, -1.0]), np.array([[1.0, 0.5], [0.0, 1.0]]), np.diag([1.0, np.inf])
    for call, sentence in (
        (lambda: monotone(np.eye(2)), r"^`As` has shape \(2, 2\), and must be \(K, n, n\)"),
        (lambda: monotone(np.full((1, 2, 2), np.nan)), "finite numbers"),
        (
            lambda: contraction(-np.eye(2)[None], PUSH, -1.0),
            r"^`rate` is -1\.0, and must be finite and not negative\.$",
        ),
        *(
            (lambda P=P: rate_of(P, -np.eye(2)[None]), "^`P` must be a symmetric positive definite")
            for P in metrics
        ),
    ):
        with pytest.raises(GainError, match=sentence):
            call()


def test_few_vertices_are_solved_for_and_all_are_checked(monkeypatch):
    rng = np.random.default_rng(1)
    As = np.array([[[0.0, 1.0], [-k, -2.0]] for k in np.sort(rng.uniform(0.5, 3.0, 300))])
    seen = []
    solve = cvxpy.Problem.solve

    def counted(problem, **options):
        seen.append(len(problem.constraints))
        return solve(problem, **options)

    monkeypatch.setattr(cvxpy.Problem, "solve", counted)
    metric = monotone(As)
    assert max(seen) < 60 and metric.margin < 0.0
    extremes = monotone(As[[0, -1]])
    assert metric.P == pytest.approx(extremes.P, rel=1e-3)
    assert rate_of(metric.P, As) == metric.rate
