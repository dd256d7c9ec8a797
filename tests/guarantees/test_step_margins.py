"""Factors and delays that a step bears, against eigenvalues of whole matrices and closed forms."""

import numpy as np
import pytest
import scipy.linalg

import echelon as ech
from echelon.guarantees.local.spectra import Split
from echelon.guarantees.local.step_margins import delay_margin, gain_margin


def radius(W):
    return float(np.abs(np.linalg.eigvals(W)).max())


def late(F, K, value, steps):
    """A step with z so many steps late: all states are kept, by definition."""
    n = len(F)
    W = np.zeros((n * (steps + 1),) * 2, complex)
    W[:n, :n] = F
    W[:n, n * steps :] += value * K
    W[n:, : n * steps] = np.eye(n * steps)
    return radius(W)


def drawn(seed):
    """A loop of drawn agents that decays, its eigenvalues of a graph real or complex."""
    rng = np.random.default_rng(seed)
    while True:
        n, m = rng.integers(1, 5), rng.integers(1, 3)
        A, B, dt = rng.normal(size=(n, n)), rng.normal(size=(n, m)), rng.choice([0.05, 0.2])
        P = scipy.linalg.solve_continuous_are(A, B, np.eye(n), np.eye(m))
        block = np.block([[A, B], [np.zeros((m, n + m))]])
        flow = scipy.linalg.expm(dt * block)[:n]
        F, K = flow[:, :n], -flow[:, n:] @ B.T @ P
        values = np.sort(rng.uniform(0.6, 3.0, 4))
        if seed % 3 == 0:
            values = values + 1j * np.append(0.0, rng.uniform(0.0, 0.5, 3))
        if max(radius(F + k * K) for k in values) < 1.0:
            return Split(F, K, values)


@pytest.mark.parametrize("seed", range(12))
def test_factors_are_where_a_scan_finds_the_edges(seed):
    split = drawn(seed)
    scan = np.geomspace(1e-3, 1e3, 2000)
    strengths = (scan[:, None] * split.eigenvalues)[..., None, None]
    bad = (np.abs(np.linalg.eigvals(split.F + strengths * split.K)).max((1, 2)) >= 1.0).nonzero()[0]
    low, high = scan[bad[bad < 1000]][-1:], scan[bad[bad >= 1000]][:1]
    found = gain_margin(split)
    assert found.low == pytest.approx(*low, rel=0.01) if low.size else found.low <= 1e-3
    assert found.high == pytest.approx(*high, rel=0.01) if high.size else found.high >= 1e3


@pytest.mark.parametrize("seed", range(12))
def test_one_step_more_than_the_delay_margin_grows_and_no_less(seed):
    split = drawn(seed)
    found = delay_margin(split)
    tried = range(min(found.steps, 14) + 1)
    for steps in tried:
        assert max(late(split.F, split.K, k, steps) for k in split.eigenvalues) < 1.0
    if found.steps <= 40:
        assert late(split.F, split.K, found.eigenvalue, found.steps + 1) > 1.0
        larger = split.eigenvalues[np.abs(split.eigenvalues) > abs(found.eigenvalue)]
        assert all(late(split.F, split.K, k, found.steps + 1) < 1.0 for k in larger)


@pytest.mark.parametrize("steps", [0, 1, 2, 7, 19])
def test_a_delayed_integrator_has_a_closed_form(steps):
    # x+ = x - k x(t - d) decays exactly for 0 < k < 2 cos(d pi / (2 d + 1)) (Levin and May).
    edge = 2.0 * np.cos(steps * np.pi / (2.0 * steps + 1.0))
    one = np.eye(1)
    inside, outside = (Split(one, -x * edge * one, np.array([0.3, 1.0])) for x in (0.999, 1.001))
    assert delay_margin(inside).steps == steps and delay_margin(outside).steps == steps - 1
    assert gain_margin(Split(one, -one, np.array([0.5, 1.0]))) == pytest.approx((0.0, 2.0))


def test_a_loop_weaker_than_its_damping_bears_any_delay():
    found = delay_margin(Split(0.5 * np.eye(1), -0.2 * np.eye(1), np.ones(1)))
    assert found.last and found.steps >= 1000


def test_what_lies_between_two_eigenvalues_counts():
    # x'' of period 8 steps, damped at both ends of the strengths and lost in their midst.
    F, K = np.array([[0.0, 1.0], [-0.9, 1.2]]), np.array([[0.0, 0.0], [-0.1, 0.0]])
    ends = np.array([0.2, 0.8])
    whole = delay_margin(Split(F, K, ends, between=True)).steps
    assert whole <= delay_margin(Split(F, K, ends)).steps
    for k in np.linspace(*ends, 9):
        assert max(late(F, K, k, steps) for steps in range(min(whole, 30) + 1)) < 1.0


@pytest.mark.slow
def test_with_the_coupling_at_the_edge_the_steps_of_paper_neither_grow_nor_decay():
    scenario = ech.load_scenario("paper")
    parts, settings = ech.build(scenario)
    lines = {line.statement.value: line for line in ech.check(parts, settings).lines}
    found = ech.guarantee(parts, settings)
    margin = gain_margin(found.steps)
    assert lines["gain margin"].number == margin.low and margin.high < 3.0
    edges = ((margin.low, 1.001), (margin.low, 0.999), (margin.high, 0.999), (margin.high, 1.001))
    radii = [
        ech.guarantee(
            *ech.build(
                ech.load_scenario("paper", [f"follower.gain.coupling={by * found.coupling}"])
            )
        ).case.local.radius
        for by in (edge * near for edge, near in edges)
    ]
    assert [each < 1.0 for each in radii] == [True, False, True, False]
    assert radii == pytest.approx([1.0] * 4, abs=1e-2)
