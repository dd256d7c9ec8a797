"""Proofs in exact arithmetic: they agree with clear float results and decide unclear ones."""

import itertools
import math
import warnings
from fractions import Fraction

import numpy as np
import pytest
from hull_checks import NO_INPUTS, euler_rate_quadrotor, quadrotor_box
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from echelon.core.errors import GainError
from echelon.synthesis.certificates.exact_proofs import prove_contraction
from echelon_ranges import value_hull


def negative_definite(M):
    """The proof that M < 0: that of A + A' < 0 for A = M / 2, in the metric of the identity."""
    n, none = len(M), np.zeros((len(M), len(M)))
    return prove_contraction((M / 2)[None], none, none[:, :1], np.eye(n), 0.0, 0.0)


@given(seed=st.integers(0, 10_000), n=st.integers(1, 8), shift=st.sampled_from([-0.1, 0.1]))
def test_definiteness_agrees_with_eigenvalues_of_clear_margin(seed, n, shift):
    rng = np.random.default_rng(seed)
    Q = np.linalg.qr(rng.normal(size=(n, n)))[0]
    eigenvalues = -rng.uniform(0.1, 3.0, n)
    eigenvalues[0] = shift
    M = Q @ np.diag(eigenvalues) @ Q.T
    M = (M + M.T) / 2
    scale = 2.0 ** rng.integers(-20, 20, n)
    found = negative_definite(M * np.outer(scale, scale))
    assert found.holds == (np.linalg.eigvalsh(M).max() < 0.0) == (shift < 0)
    assert (found.smallest_pivot > 0.0) == found.holds


@given(G=arrays(np.int64, (4, 3), elements=st.integers(-9, 9)))
def test_a_matrix_of_low_rank_is_not_definite_however_little_it_lacks(G):
    M = -(G @ G.T).astype(float)
    assert not negative_definite(M).holds
    assert not negative_definite(M + 2.0**-40 * np.eye(4)).holds
    assert negative_definite(M - 2.0**-40 * np.eye(4)).holds


def test_a_zero_pivot_is_refused_wherever_it_stands():
    M = np.array([[0.0, 1.0, 0.0], [1.0, -5.0, 0.0], [0.0, 0.0, -1.0]])
    for matrix in (M, *map(np.diag, ([0.0, -1.0, -2.0], [-1.0, 0.0, 2.0], [-1.0, -2.0, 0.0]))):
        assert not negative_definite(matrix).holds


def test_pivots_are_those_of_the_factorization():
    G = np.tril(np.arange(1.0, 17.0).reshape(4, 4))
    np.fill_diagonal(G, 1.0)
    found = negative_definite(-G @ np.diag([3.0, 0.5, 7.0, 2.0]) @ G.T)
    assert found.holds and found.smallest_pivot == 0.5


@pytest.mark.parametrize(("steps", "holds"), [(-1, False), (0, False), (1, True)])
def test_what_floats_cannot_see_is_decided(steps, holds):
    a = 1.0 + 2.0**-30
    corner = a * a  # 2^-60 below the exact square
    for _ in range(abs(steps)):
        corner = math.nextafter(corner, math.inf if steps > 0 else 0.0)
    M = np.array([[-1.0, a], [a, -corner]])
    assert abs(np.linalg.eigvalsh(M).max()) < 1e-15
    assert negative_definite(M).holds is holds


def test_fractions_are_taken_as_they_are():
    a = Fraction(1) + Fraction(1, 2**30)
    M = np.array([[Fraction(-1), a], [a, -a * a]])
    assert not negative_definite(M).holds
    M[1, 1] -= Fraction(1, 2**200)
    assert negative_definite(M).holds


def margin(A, B, P, rho, rate):
    """The largest eigenvalue of the inequality's left side in the metric of P."""
    root = np.linalg.inv(np.linalg.cholesky(P))
    M = P @ A + A.T @ P - rho * P @ B @ B.T @ P + 2 * rate * P
    return np.linalg.eigvalsh(root @ (M + M.T) / 2 @ root.T).max()


@pytest.mark.parametrize("seed", range(4))
def test_a_contraction_with_a_margin_is_proved_and_a_planted_fault_is_refused(seed):
    sound = case(seed)
    proof = prove_contraction(**sound)
    assert proof.holds and proof.proved == 1 + len(sound["vertices"]) and proof.failed is None
    assert proof.smallest_pivot > 0.0
    margins = [margin(A, *map(sound.get, ("B", "P", "rho", "rate"))) for A in sound["vertices"]]
    assert max(margins) < -0.05
    for fault in FAULTS:
        proof = prove_contraction(**case(seed, **fault))
        assert not proof.holds and proof.failed is not None and proof.smallest_pivot <= 0.0, fault
        assert proof.proved == proof.failed + 1
        assert proof.failed == 3 or "vertices" not in fault


def case(seed, n=4, count=5, **changes):
    """Vertices that contract at 1.2 and not much faster in the metric of P; what a proof needs.

    The drift's symmetric part in the metric lies between -1.5 and -1.3 where the input does not
    act, and up to 1 where it does.
    """
    rng = np.random.default_rng(seed)
    G = rng.normal(size=(n, n)) + 3 * np.eye(n)
    P = G.T @ G
    Q = np.linalg.qr(rng.normal(size=(n, n)))[0]

    def vertex():
        skew = rng.normal(size=(n, n))
        rates = np.r_[1.0, -rng.uniform(1.3, 1.5, n - 1)]
        return np.linalg.solve(G, (Q @ np.diag(rates) @ Q.T + skew - skew.T) @ G)

    sound = {"vertices": np.array([vertex() for _ in range(count)]), "error": np.zeros((n, n))}
    sound |= {"B": np.linalg.solve(G, Q[:, :1]), "P": (P + P.T) / 2, "rho": 6.0, "rate": 1.2}
    return sound | {
        name: change(sound[name]) if callable(change) else change
        for name, change in changes.items()
    }


FAULTS = [
    {"vertices": lambda v: np.r_[v[:3], v[3:4] + 3 * np.eye(4), v[4:]]},
    {"rate": 1.6},
    {"rho": 2.0},
    {"B": lambda B: 0 * B},
    {"error": lambda error: error + 0.5},
    {"P": np.eye(4)},
    {"P": lambda P: P - 40 * np.eye(4)},
    {"P": lambda P: -P},
    {"P": lambda P: 0 * P},
]


@pytest.mark.parametrize("seed", range(4))
def test_no_matrix_within_a_proved_error_violates_the_inequality(seed):
    sound, rng = case(seed), np.random.default_rng(seed)
    metric = [sound[name] for name in ("B", "P", "rho", "rate")]
    shape, sizes = np.abs(rng.normal(size=(4, 4))), 2.0 ** np.arange(-12, 4)
    proofs = [prove_contraction(**sound | {"error": s * shape}).holds for s in sizes]
    assert proofs == sorted(proofs, reverse=True) and proofs[0] and not proofs[-1]
    widest = sizes[sum(proofs) - 1] * shape
    for A, _ in itertools.product(sound["vertices"], range(200)):
        assert margin(A + widest * rng.choice([-1.0, 1.0], (4, 4)), *metric) < 0.0


def test_an_unstable_system_contracts_in_no_metric():
    unstable, none = np.diag([1.0, -1.0])[None], np.zeros((2, 2))
    P = np.diag([-1.0, 1.0])
    assert margin(unstable[0], none, np.eye(2), 0.0, 0.5) > 0.0
    assert np.linalg.eigvalsh(P @ unstable[0] + unstable[0].T @ P + P).max() < 0.0
    proof = prove_contraction(unstable, none, none, P, 0.0, 0.5)
    assert not proof.holds and proof.failed == -1 and proof.proved == 0


def test_rounding_is_carried_and_decides():
    def holds(error, rate):
        one = np.ones((1, 1))
        return prove_contraction(-one[None], error * one, 0 * one, one, 0.0, rate).holds

    just_below = math.nextafter(1.0, 0.0)
    assert holds(0.0, just_below) and not holds(0.0, 1.0)
    assert holds(2.0**-60, just_below) and not holds(2.0**-53, just_below)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"error": np.zeros((3, 3))}, "shape (3, 3), and must fit the 4 states of `P`."),
        ({"B": np.zeros(4)}, "`B` has shape (4,)"),
        ({"vertices": np.zeros((0, 4, 4))}, "`vertices` is empty"),
        ({"vertices": np.full((1, 4, 4), math.nan)}, "`vertices` holds an entry"),
        ({"P": np.triu(np.ones((4, 4)))}, "`P` is not symmetric"),
        ({"P": np.full((4, 4), -math.inf)}, "`P` holds an entry that is no finite number."),
        ({"rho": Fraction(1, 3)}, "`rho` holds an entry that is no whole number over a power of"),
        ({"error": np.full((4, 4), -1e-9)}, "must not be negative"),
        ({"rho": -1.0}, "must not be negative"),
        ({"rate": math.inf}, "`rate` holds an entry that is no finite number."),
        # One entry among others.
        (
            {"P": np.where(np.eye(4), Fraction(3, 4), Fraction(1, 3))},
            "no whole number over a power",
        ),
    ],
)
def test_arguments_that_do_not_fit_are_refused(change, words):
    with pytest.raises(GainError) as caught:
        prove_contraction(**case(0, **change))
    assert words in str(caught.value)


ALPHA = 0.095


def least_coupling(vertices, B, rate, scale, largest=1e4):
    """Solve min rho over W = P^-1 on scaled states; returns P and rho, promised by nobody."""
    import cvxpy as cp

    n = len(B)
    W, rho = cp.Variable((n, n), symmetric=True), cp.Variable()
    A, b = vertices * scale / scale[:, None], B / scale[:, None]
    bounds = [np.eye(n) << W, W << largest * np.eye(n)]
    rates = [a @ W + W @ a.T - rho * b @ b.T + 2 * rate * W << -1e-6 * np.eye(n) for a in A]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the solver may stop early; what counts is checked below
        cp.Problem(cp.Minimize(rho), bounds + rates).solve(solver="CLARABEL")
    P = np.linalg.inv(W.value) / np.outer(scale, scale)
    return (P + P.T) / 2, 1.001 * float(rho.value)


@pytest.fixture(scope="module")
def quadrotor():
    hull = value_hull(euler_rate_quadrotor, quadrotor_box(), NO_INPUTS)
    B = np.zeros((13, 4))
    B[[12, 9, 10, 11], range(4)] = 1.0
    scale = np.repeat([1.0, 1.0, 0.3, 3.0, 3.0], [3, 3, 3, 3, 1])
    P, rho = least_coupling(hull.vertices, B, ALPHA, scale)
    return hull, B, P, rho


def test_the_quadrotor_contracts_for_certain(quadrotor):
    hull, B, P, rho = quadrotor
    assert len(hull.vertices) == 128 and 0.0 < hull.error.max() < 1e-14
    assert max(margin(A, B, P, rho, ALPHA) for A in hull.vertices) < 0.0
    proof = prove_contraction(hull.vertices, hull.error, B, P, rho, ALPHA)
    assert proof.holds and proof.proved == 129


def test_the_quadrotor_is_refused_what_is_not_so(quadrotor):
    hull, B, P, rho = quadrotor
    sound = {"vertices": hull.vertices, "error": hull.error, "B": B, "P": P, "rho": rho}
    noise = np.random.default_rng(0).normal(size=P.shape)
    noise *= 0.01 * np.sqrt(np.outer(np.diagonal(P), np.diagonal(P)))
    wider = value_hull(euler_rate_quadrotor, quadrotor_box(tilt=0.9, yaw=0.7), NO_INPUTS)
    for change in (
        {"rate": 2.5 * ALPHA},
        {"rho": 0.5 * rho},
        {"error": hull.error + 1e-2},
        {"P": P + noise + noise.T},
        {"vertices": wider.vertices, "error": wider.error},
    ):
        assert not prove_contraction(**sound | {"rate": ALPHA} | change).holds


def test_a_metric_may_be_asymmetric_by_rounding_only_and_its_symmetric_part_counts():
    none = np.zeros((2, 2))

    def proved(off):
        P = np.array([[4.0, 1.0 + off], [1.0, 2.0]])
        return prove_contraction(-np.eye(2)[None], none, none[:, :1], P, 0.0, 0.5)

    with pytest.raises(GainError, match="`P` is not symmetric"):
        proved(4e-9 * (1.0 + 1e-6))
    found = proved(4e-9 * (1.0 - 1e-6))
    # The pivots of P and of P itself less 2 rate P / 2: those of [[4, 1 + off / 2], [., 2]].
    assert found.holds and found.smallest_pivot == pytest.approx(1.75 - 1e-9, rel=1e-12)
