"""Steps and margins of networks: true for every eigenvalue, by NumPy on drawn loops."""

import numpy as np
import pytest
import scipy.linalg
from held_loops import growth, radii

import echelon as ech
from echelon.core.linear import discretize
from echelon.core.statement import Hypothesis, Topic
from echelon.core.words import Verdict

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
    """Weights of so many followers, one of which has a lost strength, ascending."""
    low, high = STRENGTHS[0], STRENGTHS[-1]
    near = np.geomspace(1.0, (lost[0] / low) ** 0.5, count // 2)
    far = np.geomspace(1.0, (high / lost[-1]) ** 0.5, count - 1 - len(near))
    return np.sort(np.concatenate([low * near, [np.sqrt(lost[0] * lost[-1])], high / far]))


def star(weights):
    return ech.Graph([(0, k + 1, w) for k, w in enumerate(weights)])


def parts_of(A, B, P, graph):
    model = ech.models.Linear(A, B)
    gain = ech.synthesize(model, graph, ech.gains.FixedGain(P=P.tolist(), coupling=1.0))
    return parts_under(model, graph, gain)


def parts_under(model, graph, gain, **more):
    laws = ech.Laws(ech.laws.TrimInput(), ech.laws.Consensus(gain, feedforward="relay"))
    goals = ech.Formation(np.zeros((graph.agents, len(model.state_names))))
    return ech.Parts(model, graph, goals, laws, **more)


@pytest.mark.parametrize("count", [33, 500])
def test_a_step_that_one_follower_in_the_midst_does_not_bear_is_refused(count):
    A, B, P, lost = lost_between(count, lost_in_steps)
    weights, settings = crowd(lost, count), ech.Settings(2.0, DT)
    assert radii(A, B, B.T @ P, weights, DT).max() > 1.0
    found = ech.guarantee(parts_of(A, B, P, star(weights)), settings)
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
    dt = 0.0001
    found = ech.check(parts_of(A, B, P, star(weights)), ech.Settings(1.0, dt)).lines
    lines = {line.statement: line for line in found}
    lower, upper = (float(x) for x in lines[Topic.GAIN].number_text.split(" to "))
    for factor, inside in ((lower, 1.01), (upper, 0.99)):
        if 0.0 < factor < np.inf:
            # Three digits are shown.
            assert radii(A, B, K, inside * factor * weights, dt).max() < 1.0
            assert radii(A, B, K, (2.0 - inside) * factor * weights, dt).max() > 1.0
    steps, some = (
        round(lines[Topic.DELAY].number / dt),
        weights[np.linspace(0, count - 1, 30).astype(int)],
    )
    F, G = discretize(A, B, dt)
    for late, decays in ((steps, True), (steps + 1, False)):
        whole = np.zeros((len(some), *[3 * (late + 1)] * 2))
        whole[:, :3, :3], whole[:, 3:, : 3 * late] = F, np.eye(3 * late)
        whole[:, :3, 3 * late :] -= some[:, None, None] * (G @ K)
        worst = np.abs(np.linalg.eigvals(whole)).max()
        assert (worst < 1.0) == decays or count > 30 and not decays


@pytest.mark.parametrize("shift", [0.3, 0.0])
def test_the_slowest_mode_between_two_eigenvalues_is_none_too_fast(shift):
    # At strength 1 modes nearly touch the axis, or pass it, and at both ends they are far from it.
    A = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [-0.5, -1.0, -1.0]]) - shift * np.eye(3)
    B, P = np.array([[0.0], [0.0], [1.0]]), np.diag([40.0, 40.0, 1.0])
    P[2, :2] = P[:2, 2] = 4.0, 1.0
    found = ech.guarantee(parts_of(A, B, P, ech.Graph.path(460)), ech.Settings(1.0, 0.001))
    eigenvalues = 2.0 - 2.0 * np.cos(np.pi * (2.0 * np.arange(1, 460) - 1.0) / 919.0)
    loop, worst = found.loop, growth(A, B, B.T @ P, eigenvalues).max()
    assert loop.closed.between and found.promised == (worst < 0.0) == (shift > 0.0)
    assert loop.slowest > 0.0 if shift == 0.0 else worst <= loop.slowest <= worst + 1e-3


PATH = ech.Graph.path(4)


def held_parts(A, B):
    model = ech.models.Linear(A=A, B=B)
    gain = ech.synthesize(model, PATH, ech.gains.Riccati())
    return parts_under(model, PATH, gain, initial={model.state_names[0]: 0.1})


def exact_radius(parts, dt):
    """The spectral radius of the held loop, by SciPy's exponential and the path's own Laplacian."""
    A, B = (np.array(part, float) for part in (parts.model.A, parts.model.B))
    n, m = B.shape
    block = scipy.linalg.expm(np.block([[A, B], [np.zeros((m, n + m))]]) * dt)[:n]
    S, gain = np.asarray(parts.model.input_scale, float), parts.drive.gain
    K = gain.coupling * np.linalg.solve(gain.R, (B @ S).T @ gain.P)
    L = np.diag([2.0, 2.0, 1.0]) - np.eye(3, k=1) - np.eye(3, k=-1)
    F, G = block[:, :n], block[:, n:] @ S
    return max(abs(np.linalg.eigvals(F - k * G @ K)).max() for k in np.linalg.eigvalsh(L))


def sampling(parts, settings):
    found = ech.guarantee(parts, settings)
    return found, found.hypotheses[Hypothesis.SAMPLING]


def test_an_integrator_that_damps_what_a_held_input_drives_guarantees_nothing():
    parts = held_parts([[0.0, 1.0], [-400.0, 0.0]], [[0.0], [1.0]])
    assert exact_radius(parts, 0.12) == pytest.approx(1.78, abs=0.01)
    found, line = sampling(parts, ech.Settings(horizon=12.0, dt=0.12))
    assert line.verdict is Verdict.FAILS and not found.promised
    assert line.number == pytest.approx(exact_radius(parts, 0.12), rel=1e-6)
    # What runs with enough substeps is the exact flow, and grows.
    settings = ech.Settings(horizon=12.0, dt=0.12, substeps=50)
    assert not ech.guarantee(parts, settings).promised
    errors = np.abs(ech.simulate(parts, settings).errors).max(axis=(1, 2))
    assert errors[-1] > 1e6 * errors[0]
    found, _ = sampling(parts, ech.Settings(horizon=12.0, dt=0.02))
    assert exact_radius(parts, 0.02) < 1.0 and found.promised


@pytest.mark.slow
def test_a_stiff_model_asks_for_substeps_and_not_for_a_weaker_gain():
    A = [[0.0, 1.0, 0.0], [0.0, -20.0, 400.0], [0.0, -50.0, -50000.0]]
    parts, settings = held_parts(A, [[0.0], [0.0], [1000.0]]), ech.Settings(horizon=3.0, dt=0.01)
    assert exact_radius(parts, 0.01) < 1.0
    found, line = sampling(parts, settings)
    told = "errors grow in steps of the integrator, and not if agents move exactly"
    assert not found.promised and found.reasons == (told,)
    assert "lower the gain" not in line.remedy
    enough = int(line.remedy.partition("substeps: ")[2].partition("`")[0])
    settings = settings._replace(substeps=enough)
    more, line = sampling(parts, settings)
    assert more.promised and line.verdict is Verdict.HOLDS
    errors = np.abs(ech.simulate(parts, settings).errors).max(axis=(1, 2))
    assert errors[-1] < errors[0]


@pytest.mark.parametrize("integrator", ["rk4", "euler"])
@pytest.mark.parametrize("substeps", [1, 2, 7])
def test_substeps_are_steps_of_the_integrator_one_after_another(integrator, substeps):
    draws = np.random.default_rng(0)
    A, B = draws.normal(size=(3, 3)), draws.normal(size=(3, 2))
    F, G = discretize(A, B, 0.3 / substeps, integrator)
    whole = np.eye(3), np.zeros((3, 2))
    for _ in range(substeps):
        whole = F @ whole[0], F @ whole[1] + G
    for part, own in zip(discretize(A, B, 0.3, integrator, substeps), whole, strict=True):
        np.testing.assert_allclose(part, own, atol=1e-14)
