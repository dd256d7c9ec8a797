"""The step with a held input: the integrator with its substeps beside the exact flow."""

import numpy as np
import pytest
import scipy.linalg

import echelon as ech
from echelon.core.linear import discretize
from echelon.core.statement import Hypothesis
from echelon.core.words import Verdict

PATH = ech.Graph.path(4)


def parts_of(A, B, graph=PATH, **more):
    model = ech.models.Linear(A=A, B=B)
    gain = ech.synthesize(model, graph, ech.gains.Riccati(**more))
    laws = ech.Laws(ech.laws.TrimInput(), ech.laws.Consensus(gain))
    formation = ech.Formation.from_offsets(model, graph, {})
    return ech.Parts(model, graph, formation, laws, initial={model.state_names[0]: 0.1})


def exact_radius(parts, dt):
    """The spectral radius of the held loop, by SciPy's exponential and the path's own Laplacian."""
    A, B = (np.array(part, float) for part in (parts.model.A, parts.model.B))
    n, m = B.shape
    block = scipy.linalg.expm(np.block([[A, B], [np.zeros((m, n + m))]]) * dt)[:n]
    S = np.asarray(parts.model.input_scale, float)
    gain = parts.drive.gain
    K = gain.coupling * np.linalg.solve(gain.R, (B @ S).T @ gain.P)
    L = np.diag([2.0, 2.0, 1.0]) - np.eye(3, k=1) - np.eye(3, k=-1)
    F, G = block[:, :n], block[:, n:] @ S
    return max(abs(np.linalg.eigvals(F - k * G @ K)).max() for k in np.linalg.eigvalsh(L))


def sampling(parts, **settings):
    found = ech.guarantee(parts, ech.Settings(**settings))
    return found, found.hypotheses[Hypothesis.SAMPLING]


def test_an_integrator_that_damps_what_a_held_input_drives_guarantees_nothing():
    parts = parts_of([[0.0, 1.0], [-400.0, 0.0]], [[0.0], [1.0]])
    assert exact_radius(parts, 0.12) == pytest.approx(1.78, abs=0.01)
    found, line = sampling(parts, horizon=12.0, dt=0.12)
    assert line.verdict is Verdict.FAILS and not found.promised
    assert line.number == pytest.approx(exact_radius(parts, 0.12), rel=1e-6)
    # What runs with enough substeps is the exact flow, and grows.
    settings = ech.Settings(horizon=12.0, dt=0.12, substeps=50)
    assert not ech.guarantee(parts, settings).promised
    errors = np.abs(ech.simulate(parts, settings).errors).max(axis=(1, 2))
    assert errors[-1] > 1e6 * errors[0]
    found, _ = sampling(parts, horizon=12.0, dt=0.02)
    assert exact_radius(parts, 0.02) < 1.0 and found.promised


def test_a_stiff_model_asks_for_substeps_and_not_for_a_weaker_gain():
    A = [[0.0, 1.0, 0.0], [0.0, -20.0, 400.0], [0.0, -50.0, -50000.0]]
    parts = parts_of(A, [[0.0], [0.0], [1000.0]])
    assert exact_radius(parts, 0.01) < 1.0
    found, line = sampling(parts, horizon=3.0, dt=0.01)
    assert not found.promised and found.reasons == ("errors grow in steps of the integrator",)
    assert "lower the gain" not in line.remedy
    enough = int(line.remedy.partition("substeps: ")[2].partition("`")[0])
    more, line = sampling(parts, horizon=3.0, dt=0.01, substeps=enough)
    assert more.promised and line.verdict is Verdict.HOLDS
    settings = ech.Settings(horizon=3.0, dt=0.01, substeps=enough)
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
