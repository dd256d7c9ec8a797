"""Steps and margins of networks: true for every eigenvalue, by NumPy on drawn loops."""

import sys
from pathlib import Path

import numpy as np
import pytest
import scipy.linalg

import echelon as ech
from echelon.core.statement import Hypothesis, Topic
from echelon.core.words import Verdict
from echelon.synthesis.certificates.margins import ClosedLoop, delay_margin

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "benchmarks"))
from held_loops import delayed_growth, growth, radii  # noqa: E402

STRENGTHS = np.geomspace(0.5, 5.0, 60)
DT = 0.2


def lost_between(seed, lost):
    """A drawn loop that decays at both ends of STRENGTHS, and some strengths at which it is lost.

    `lost` tells of drawn loops at which strengths they are.
    """
    rng = np.random.default_rng(seed)
    while True:
        A, B, root = (rng.normal(size=(2000, 3, k)) for k in (3, 1, 3))
        P = root @ root.swapaxes(1, 2) + 0.05 * np.eye(3)
        K = B.swapaxes(1, 2) @ P
        ends = growth(2.0 * A, B, K, STRENGTHS[[0, -1]]).max(axis=1) < -1e-3
        A, B, P, K = 2.0 * A[ends], B[ends], P[ends], K[ends]
        bad = lost(A, B, K)
        few = np.flatnonzero(~bad[:, 0] & ~bad[:, -1] & bad.any(axis=1))
        if len(few):
            return A[few[0]], B[few[0]], P[few[0]], STRENGTHS[bad[few[0]]]


def lost_in_steps(A, B, K):
    """At which strengths a step of DT is too long for loops that decay in continuous time."""
    bad = radii(A, B, K, STRENGTHS, DT) >= 1.0
    return bad & (growth(A, B, K, STRENGTHS).max(axis=1) < -1e-3)[:, None]


def crowd(lost, count):
    """A star of so many followers, one of which has a lost strength; its eigenvalues, ascending."""
    low, high = STRENGTHS[0], STRENGTHS[-1]
    near = np.geomspace(1.0, (lost[0] / low) ** 0.5, count // 2)
    far = np.geomspace(1.0, (high / lost[-1]) ** 0.5, count - 1 - len(near))
    weights = np.sort(np.concatenate([low * near, [np.sqrt(lost[0] * lost[-1])], high / far]))
    return ech.Graph([(0, k + 1, w) for k, w in enumerate(weights)]), weights


def parts_of(A, B, P, graph):
    model = ech.models.Linear(A, B)
    gain = ech.synthesize(model, graph, ech.gains.FixedGain(P=P.tolist(), coupling=1.0))
    drive = ech.Laws(ech.laws.TrimInput(), ech.laws.Consensus(gain, feedforward="relay"))
    return ech.Parts(model, graph, ech.Formation(np.zeros((graph.agents, len(A)))), drive)


@pytest.mark.parametrize("count", [33, 61, 500])
def test_a_step_that_one_follower_in_the_midst_does_not_bear_is_refused(count):
    A, B, P, lost = lost_between(count, lost_in_steps)
    graph, weights = crowd(lost, count)
    assert radii(A, B, B.T @ P, weights, DT).max() > 1.0
    settings = ech.Settings(2.0, DT)
    found = ech.guarantee(parts_of(A, B, P, graph), settings)
    assert found.hypotheses[Hypothesis.SAMPLING].verdict is Verdict.FAILS
    longest = found.longest_step(settings)
    assert radii(A, B, B.T @ P, weights, 0.999 * longest).max() < 1.0
    if count <= 400:
        assert radii(A, B, B.T @ P, weights, 1.01 * longest).max() > 1.0


def lost_if_stronger(A, B, K):
    """At which strengths the loop is lost in continuous time."""
    return growth(A, B, K, STRENGTHS) >= 0.0


def within(A, K, B, lost, high):
    """Where the loop stays stable around strengths that are not lost, by a fine scan."""
    scan = np.geomspace(1e-3, 1e3, 4000)
    bad = growth(A, B, K, scan) >= 0.0
    middle = np.sqrt(lost[-1] * STRENGTHS[-1]) if high else np.sqrt(STRENGTHS[0] * lost[0])
    at = np.searchsorted(scan, middle)
    below, above = np.flatnonzero(bad[:at]), np.flatnonzero(bad[at:])
    low = scan[below[-1] + 1] if len(below) else scan[0]
    return 1.05 * low, 0.95 * (scan[at + above[0] - 1] if len(above) else scan[-1])


@pytest.mark.parametrize(("seed", "count", "high"), [(1, 33, True), (2, 61, False), (5, 450, True)])
def test_margins_hold_inside_and_not_outside_for_every_follower(seed, count, high):
    A, B, P, lost = lost_between(seed, lost_if_stronger)
    K = B.T @ P
    low, top = within(A, K, B, lost, high)
    weights = np.sort(np.append([low, top], np.random.default_rng(0).uniform(low, top, count - 2)))
    graph = ech.Graph([(0, k + 1, w) for k, w in enumerate(weights)])
    found = ech.check(parts_of(A, B, P, graph), ech.Settings(1.0, 0.001)).lines
    lines = {line.statement: line for line in found}
    lower, upper = (float(x) for x in lines[Topic.GAIN].number_text.split(" to "))
    for factor, inside in ((lower, 1.01), (upper, 0.99)):
        if 0.0 < factor < np.inf:
            # Three digits are shown.
            assert growth(A, B, K, inside * factor * weights).max() < 0.0
            assert growth(A, B, K, (2.0 - inside) * factor * weights).max() > 0.0
    delay = lines[Topic.DELAY].number
    some = weights[np.linspace(0, count - 1, 150).astype(int)]
    for factor, decays in ((0.99, True), (1.01, False)):
        worst = max(delayed_growth(A, k * B @ K, factor * delay) for k in some)
        assert (worst < 0.0) == decays or count > 150 and not decays


@pytest.mark.parametrize("seed", range(30))
def test_chains_of_integrators_with_two_inputs_have_a_delay_margin(seed):
    rng = np.random.default_rng(seed)
    orders = rng.integers(1, 5, 2)
    n = int(orders.sum())
    A, B = np.zeros((n, n)), np.zeros((n, 2))
    for first, order, k in zip((0, orders[0]), orders, range(2)):
        A[range(first, first + order - 1), range(first + 1, first + order)] = 1.0
        B[first + order - 1, k] = 1.0
    turn = rng.normal(size=(2, 2))
    B = B @ turn
    P = scipy.linalg.solve_continuous_are(A, B, np.diag(rng.uniform(0.1, 10.0, n)), np.eye(2))
    lam = 2.0 - 2.0 * np.cos(np.pi * np.array([1.0, 3.0, 5.0]) / 7.0)
    margin = delay_margin(ClosedLoop(A, B, P, np.eye(2), 0.6 / lam[0], lam))
    G = 0.6 / lam[0] * B @ B.T @ P
    for factor, decays in ((0.99, True), (1.01, False)):
        worst = max(delayed_growth(A, k * G, factor * margin.delay, 12) for k in lam)
        assert (worst < 0.0) == decays


def test_the_slowest_mode_between_two_eigenvalues_is_none_too_fast():
    # At strength 1 the modes nearly touch the axis, and at both ends they are far from it.
    A = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [-0.5, -1.0, -1.0]])
    A = A - 0.3 * np.eye(3)
    B, P = np.array([[0.0], [0.0], [1.0]]), np.diag([40.0, 40.0, 1.0])
    P[2, :2] = P[:2, 2] = 4.0, 1.0
    graph = ech.Graph.path(460)
    loop = ech.guarantee(parts_of(A, B, P, graph), ech.Settings(1.0, 0.001)).loop
    eigenvalues = 2.0 - 2.0 * np.cos(np.pi * (2.0 * np.arange(1, 460) - 1.0) / 919.0)
    worst = growth(A, B, B.T @ P, eigenvalues).max()
    assert loop.closed.between and worst < 0.0
    assert worst <= loop.slowest <= worst + 1e-3
