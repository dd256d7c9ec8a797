"""Margins of linear loops: closed forms, and a second independent computation for each."""

import itertools

import numpy as np
import pytest
import scipy.linalg
import scipy.optimize
from hypothesis import given, settings
from hypothesis import strategies as st

from echelon.agents.models import Quadrotor
from echelon.core.errors import GainError
from echelon.core.linear import matrix_exponential
from echelon.synthesis.certificates.margins import (
    ClosedLoop,
    detectability,
    input_scaling,
    invariant_ellipsoid,
    modes,
    peak_gain,
    slowest_between,
    stiffness,
    string_gain,
)

ONE = np.eye(1)
CHAIN = np.array([[0.0, 1.0], [0.0, 0.0]])
PUSH = np.array([[0.0], [1.0]])
LINE = 2.0 - 2.0 * np.cos(np.pi * np.array([1.0, 3.0, 5.0]) / 7.0)  # grounded spectrum, 3 followers
EDGE = 0.5 / LINE[0]


def with_rows(K):
    """P such that B'P = K for the input map (0, ..., 0, 1)': only the last row matters."""
    P = np.zeros((len(K), len(K)))
    P[-1] = K
    return P


def chain(K, last, coupling=1.0, spectrum=(1.0,)):
    """A chain of integrators with this last row of A, under the feedback K."""
    A = np.eye(len(K), k=1)
    A[-1] = last
    return ClosedLoop(A, np.eye(len(K))[:, -1:], with_rows(K), ONE, coupling, np.array(spectrum))


def scalar(a, p, coupling=1.0, spectrum=(1.0,)):
    """x' = a x + u under u = -coupling eigenvalue p x."""
    return ClosedLoop(a * ONE, ONE, p * ONE, ONE, coupling, spectrum)


def feedback(loop):
    """B R^-1 B'P times the coupling."""
    return loop.coupling * loop.B @ np.linalg.solve(loop.R, loop.B.T @ loop.P)


def hovering_quadrotor():
    """A, B, P, R of the quadrotor at hover with its own weights, built by hand."""
    A, B = np.zeros((12, 12)), np.zeros((12, 4))
    A[0:3, 3:6] = A[6:9, 9:12] = np.eye(3)
    A[3, 7], A[4, 6] = 9.81, -9.81
    B[5, 0] = B[9, 1] = B[10, 2] = B[11, 3] = 1.0
    Q, R = (np.diag(weights) for weights in Quadrotor().weights)
    return A, B, scipy.linalg.solve_continuous_are(A, B, Q, R), R


QUAD = hovering_quadrotor()
QUAD_ON_LINE = ClosedLoop(*QUAD, EDGE, LINE)


def random_loop(seed, n=3, m=1):
    """A Riccati loop on a random plant, with more than enough coupling on three modes."""
    rng = np.random.default_rng(seed)
    A, B, R = rng.normal(size=(n, n)), rng.normal(size=(n, m)), np.diag(rng.uniform(0.5, 2.0, m))
    P = scipy.linalg.solve_continuous_are(A, B, np.eye(n), R)
    return ClosedLoop(A, B, P, R, 1.2 * EDGE, LINE), rng


def abscissa(A):
    return float(np.linalg.eigvals(A).real.max())


@given(st.integers(0, 10**6), st.floats(0.0, 8.0))
@settings(max_examples=20)
def test_stiffness_is_the_ratio_of_rates(seed, decades):
    rng = np.random.default_rng(seed)
    rates = 10.0 ** np.append(rng.uniform(0.0, decades, 2), [0.0, decades])
    # Each of two strengths shifts all rates alike, and the feedback moves nothing else.
    loop = ClosedLoop(-np.diag(rates), np.zeros((4, 1)), np.eye(4), ONE, 1.0, [1.0, 2.0])
    assert stiffness(loop) == pytest.approx(10.0**decades, rel=1e-12)
    assert stiffness(scalar(-1.0, 1.0, 1.0, [1.0, 3.0])) == pytest.approx(4.0 / 2.0)
    assert stiffness(scalar(1.0, 1.0, 1.0, [1.0, 3.0])) == np.inf


@pytest.mark.parametrize(
    ("extremes", "holds"),
    [
        ([0.1, 3.0], False),
        ([0.1, 0.29], True),
        ([0.1, 0.3], False),
        ([1.8, 9.0], True),
        ([0.2, 0.2], True),
        ([1.0, 1.0], False),
    ],
)
def test_a_loop_that_only_its_extremes_bear_is_not_called_stable_between_them(extremes, holds):
    # s^3 + (1 + k) s^2 + (1 + k) s + 0.5 + 4 k: Routh asks (1 + k)^2 > 0.5 + 4 k, |k - 1| > 0.71.
    loop = chain([4.0, 1.0, 1.0], [-0.5, -1.0, -1.0], 1.0, extremes)
    assert (slowest_between(loop._replace(between=True)) < 0.0) is holds
    assert slowest_between(QUAD_ON_LINE) < 0.0


def test_a_scalar_loop_is_worst_where_its_input_is_weakest():
    worst = input_scaling(scalar(1.0, 2.0, 3.0, [0.5, 1.0]))
    assert worst.abscissa == pytest.approx(1.0 - 0.7 * 3.0)
    assert (worst.scales, worst.eigenvalue) == ((0.7,), 0.5)
    # A spread that turns an input around is refused.
    with pytest.raises(GainError, match=r"^`spread` is 1\.0 on 1 inputs; allowed are \[0, 1\)"):
        input_scaling(scalar(-1.0, 1.0), spread=1.0)


@given(st.integers(0, 10**6))
@settings(max_examples=10)
def test_the_worst_corner_is_no_better_than_any_corner(seed):
    (A, B, P, R, c, lam, _), _ = loop, _ = random_loop(seed, m=2)
    worst, K = input_scaling(loop, spread=0.2), np.linalg.solve(R, B.T @ P)

    def corner(k, scales):
        return abscissa(A - c * k * B @ np.diag(scales) @ K)

    corners = itertools.product(lam, itertools.product((0.8, 1.2), repeat=2))
    assert worst.abscissa == pytest.approx(max(corner(*each) for each in corners))
    assert corner(worst.eigenvalue, worst.scales) == pytest.approx(worst.abscissa)


def test_a_quadrotor_with_thrust_and_torques_off_by_30_percent_still_decays():
    hover = np.zeros((4, 12, 12))
    hover[0, 3:6, 6:9] = QUAD[0][3:6, 6:9]  # the tilt pushes with the trim thrust
    worst = input_scaling(QUAD_ON_LINE, 0.3, hover)
    assert worst.abscissa == pytest.approx(-0.094, abs=1e-3)
    # Roll and pitch are alike, so that rounding decides which of the two is the worse.
    assert worst.scales[0] == pytest.approx(1.3)
    assert min(worst.scales[1:3]) == pytest.approx(0.7)
    # With the thrust of the trim known exactly there is more room.
    assert input_scaling(QUAD_ON_LINE).abscissa < -0.4


@given(st.integers(0, 10**6), st.integers(1, 6), st.floats(-6.0, 4.0))
@settings(max_examples=30)
def test_exponentials_of_a_stack_are_scipy_s(seed, n, size):
    rng = np.random.default_rng(seed)
    X = 10.0**size * rng.normal(size=(3, n, n))
    X -= (np.linalg.eigvals(X).real.max() + 0.1) * np.eye(n)
    error = 1e-15 * np.linalg.norm(X, 1, axis=(1, 2)).max() + 1e-14
    for found, one in zip(matrix_exponential(X), X, strict=True):
        wanted = scipy.linalg.expm(one)
        assert found == pytest.approx(wanted, rel=1e-9, abs=error * np.abs(wanted).max() + 1e-300)
    assert np.array_equal(matrix_exponential(np.zeros((2, n, n))), [np.eye(n)] * 2)


@given(st.integers(0, 10**6), st.integers(1, 4))
@settings(max_examples=10)
def test_modes_that_do_not_turn_have_the_l1_norm_of_their_sum(seed, n):
    # T diag(s) T^-1 with T >= 0 and T^-1 E >= 0: every entry of exp(A t) E is a sum of positive
    # exponentials, whose integral is -A^-1 E.
    rng = np.random.default_rng(seed)
    T, slow = rng.uniform(0.0, 1.0, (n, n)) + n * np.eye(n), -(10.0 ** rng.uniform(-3, 4, n))
    A, E = T @ np.diag(slow) @ np.linalg.inv(T), T @ rng.uniform(0.1, 1.0, (n, 1))
    loop = ClosedLoop(A, np.zeros((n, 1)), np.eye(n), ONE, 1.0, [1.0])
    assert peak_gain(loop, E) == pytest.approx(np.linalg.solve(-A, E)[:, 0], rel=1e-6)


def l1_by_trapezoids(A, E):
    """Integral of the row norms of exp(A t) E by a plain sum over one long sequence of powers."""
    horizon = 40.0 / -abscissa(A)
    # A step of 1/50 of the fastest time constant: the rule is then off by 1/30,000 of its part.
    steps = max(50_000, int(50.0 * horizon * np.abs(np.linalg.eigvals(A)).max()))
    h = horizon / steps
    block, values = E[None], np.array([scipy.linalg.expm(A * h)])
    while len(block) <= steps:
        block = np.concatenate([block, values[-1] @ block])
        values = np.array([values[-1] @ values[-1]])
    sizes = np.linalg.norm(block, axis=-1)
    return h * (sizes.sum(0) - 0.5 * sizes[0])


def test_a_scalar_disturbance_has_one_bound_by_both_arguments():
    for bound in (invariant_ellipsoid, peak_gain):
        assert bound(scalar(1.0, 1.0, 1.0, [3.0]), 0.5 * ONE, 4.0) == pytest.approx([1.0], rel=1e-6)


@pytest.mark.parametrize("damping", [0.02, 0.3, 0.9])
def test_an_oscillator_s_l1_norm_has_a_closed_form(damping):
    found = peak_gain(chain([1.0, 2.0 * damping], [0.0, 0.0]), PUSH)
    turn = np.pi * damping / np.sqrt(1.0 - damping**2)
    assert found[0] == pytest.approx(1.0 / np.tanh(0.5 * turn), rel=1e-6)


def test_stiff_and_slow_states_are_integrated_together():
    A = np.diag([-1e4, -1e-3])
    loop = ClosedLoop(A, np.zeros((2, 1)), np.eye(2), ONE, 1.0, [1.0])
    E = np.array([[1.0], [1.0]])
    assert peak_gain(loop, E) == pytest.approx([1e-4, 1e3], rel=1e-6)
    assert invariant_ellipsoid(loop, E)[1] == pytest.approx(1e3, rel=1e-6)


@given(st.integers(0, 10**6), st.integers(1, 2))
@settings(max_examples=10)
def test_the_ellipsoid_is_no_tighter_than_the_exact_norm(seed, q):
    loop, rng = random_loop(seed)
    E = rng.normal(size=(3, q))
    outer, exact = invariant_ellipsoid(loop, E), peak_gain(loop, E)
    assert (outer >= exact * (1.0 - 1e-6)).all()
    closed = modes(loop)
    assert exact == pytest.approx(np.max([l1_by_trapezoids(A, E) for A in closed], 0), rel=2e-4)


@given(st.integers(0, 10**6))
@settings(max_examples=10)
def test_the_ellipsoid_is_the_best_of_its_family(seed):
    loop, rng = random_loop(seed)
    E = rng.normal(size=(3, 1))
    closed = modes(loop)
    limit = -2.0 * max(map(abscissa, closed))

    def squares(alpha):
        shifted = closed + 0.5 * alpha * np.eye(3)
        solved = [scipy.linalg.solve_continuous_lyapunov(S, -E @ E.T / alpha) for S in shifted]
        return np.max([np.diag(X) for X in solved], 0)

    found = invariant_ellipsoid(loop, E) ** 2
    tried = np.array([squares(alpha) for alpha in limit * np.linspace(0.002, 0.998, 400)])
    assert (found <= tried.min(0) * (1.0 + 1e-6)).all()
    assert found == pytest.approx(tried.min(0), rel=1e-2)


def test_the_ellipsoid_holds_for_every_follower_of_the_whole_network():
    loop, rng = random_loop(5)
    L = np.array([[2.0, -1.0, 0.0], [-1.0, 2.0, -1.0], [0.0, -1.0, 1.0]])
    E = rng.normal(size=(3, 1))
    whole = np.kron(np.eye(3), loop.A) - np.kron(L, feedback(loop))
    exact = l1_by_trapezoids(whole, np.kron(np.eye(3), E)).reshape(3, 3)
    assert (exact <= invariant_ellipsoid(loop, E)).all()


def test_a_quadrotor_pushed_by_1_metre_per_second_squared():
    E = np.eye(12)[:, 3:6]
    outer, exact = (bound(QUAD_ON_LINE, E) for bound in (invariant_ellipsoid, peak_gain))
    assert outer[:3].max() == pytest.approx(0.53, abs=5e-3)
    assert exact[:3].max() == pytest.approx(0.46, abs=5e-3)
    # Nothing turns the vehicle in yaw.
    assert max(outer[8], exact[8]) < 1e-9


@pytest.mark.parametrize(
    ("coupling", "gain"), [(0.5, 2.445), (1.0, 1.494), (2.52, 1.171), (10.0, 1.042)]
)
def test_a_chain_of_quadrotors_amplifies_less_with_more_coupling(coupling, gain):
    A, B, P, R = QUAD
    found = string_gain(ClosedLoop(A, B, P, R, coupling, [1.0]))
    assert found.gain == pytest.approx(gain, abs=1e-3)
    K = coupling * np.linalg.solve(R, B.T @ P)
    assert found.gain == pytest.approx(norm_by_bisection(A - B @ K, B, K), rel=1e-5)


def norm_by_bisection(A, B, C):
    """The H-infinity norm of C (s I - A)^-1 B: beyond it no Hamiltonian eigenvalue is imaginary."""
    low, high = 0.0, 1e3
    while high - low > 1e-8 * high:
        middle = 0.5 * (low + high)
        H = np.block([[A, B @ B.T / middle], [-C.T @ C / middle, -A.T]])
        values = np.linalg.eigvals(H)
        touches = np.abs(values.real).min() < 1e-9 * np.linalg.norm(H)
        low, high = (middle, high) if touches else (low, middle)
    return high


@given(st.integers(0, 10**6), st.integers(1, 2))
@settings(max_examples=15)
def test_string_gain_agrees_with_the_hamiltonian(seed, m):
    (A, B, P, R, *_), _ = random_loop(seed, m=m)
    found = string_gain(ClosedLoop(A, B, P, R, 1.0, [1.0]))
    K = np.linalg.solve(R, B.T @ P)
    assert found.gain == pytest.approx(norm_by_bisection(A - B @ K, B, K), rel=1e-4)
    T = K @ np.linalg.solve(1j * found.frequency * np.eye(3) - A + B @ K, B)
    assert np.linalg.norm(T, 2) == pytest.approx(found.gain)


def test_a_chain_of_integrators_passes_on_what_it_gets():
    assert string_gain(scalar(0.0, 1.0, 2.0)) == pytest.approx((1.0, 0.0))


def test_the_paper_s_gain_never_sees_positions_and_yaw():
    A, B, _, _ = QUAD
    found = detectability(A, B.T)
    assert [mode.eigenvalue for mode in found] == pytest.approx([0.0] * 4)
    seen = {int(np.flatnonzero(mode.direction)[0]) for mode in found}
    assert seen == {0, 1, 2, 8}
    assert all(np.count_nonzero(mode.direction) == 1 for mode in found)
    assert detectability(A, B.T @ QUAD[2]) == []


def test_a_hidden_mode_that_decays_is_no_matter():
    A = np.diag([-1.0, 0.5, 2.0])
    [found] = detectability(A, np.array([[1.0, 0.0, 1.0]]))
    assert found.eigenvalue == pytest.approx(0.5)
    assert np.abs(found.direction) == pytest.approx([0.0, 1.0, 0.0])
    assert detectability(A, np.array([[0.0, 1.0, 1.0]])) == []


def test_a_velocity_that_is_seen_does_not_show_the_position():
    found = detectability(CHAIN, np.array([[0.0, 1.0]]))
    assert [(m.eigenvalue, *np.abs(m.direction)) for m in found] == [(0.0, 1.0, 0.0)]
    assert detectability(CHAIN, np.array([[1.0, 0.0]])) == []
    # Nothing is seen of the chain: one eigenvector, although two states stay unseen.
    assert len(detectability(CHAIN, np.zeros((1, 2)))) == 1


@given(st.integers(0, 10**6), st.booleans(), st.integers(1, 2))
@settings(max_examples=30)
def test_a_planted_hidden_mode_is_found_in_any_coordinates(seed, turning, copies):
    rng = np.random.default_rng(seed)
    cell = np.array([[0.2, 1.5], [-1.5, 0.2]]) if turning else np.array([[0.2]])
    hidden = np.kron(np.eye(copies), cell)
    r = len(hidden)
    A = np.block([[hidden, rng.normal(size=(r, 3))], [np.zeros((3, r)), rng.normal(size=(3, 3))]])
    C = np.hstack([np.zeros((2, r)), rng.normal(size=(2, 3))])
    T = np.linalg.qr(rng.normal(size=A.shape))[0]
    A, C = T @ A @ T.T, C @ T.T
    found = detectability(A, C)
    assert len(found) == r
    for value, direction in found:
        assert value.real == pytest.approx(0.2, abs=1e-6)
        assert np.linalg.norm(direction) == pytest.approx(1.0)
        assert np.abs(C @ direction).max() < 1e-7
        assert np.abs(A @ direction - value * direction).max() < 1e-6
    assert np.linalg.matrix_rank(np.array([d for _, d in found]), tol=1e-3) == r


def test_a_loop_that_does_not_decay_has_no_margin():
    with pytest.raises(GainError) as caught:
        modes(scalar(2.0, 1.0, 1.0, [1.5, 4.0]))
    assert str(caught.value) == (
        "margins need a loop that decays, and the mode of eigenvalue 1.5 has abscissa 0.5 1/s."
    )
