"""The paper's V along runs: its value, its derivative, and when it may rise."""

import numpy as np
import pytest

import echelon as ech
from echelon.experiments.results.dataset import dataset
from echelon.experiments.results.lyapunov import lyapunov
from echelon.experiments.results.summary import summary

DRAG = 0.7


def double_integrators(leaders=(0,), horizon=4.0, dt=0.005, **chosen):
    model, graph = ech.models.DoubleIntegrator(2, drag=DRAG), ech.Graph.ring(5, leaders=leaders)
    gain = ech.synthesize(model, graph, ech.gains.Riccati())
    laws = ech.Laws(ech.laws.TrimInput(), ech.laws.Consensus(gain))
    initial, formation = {"position": 1.0, "velocity": 1.0}, ech.Formation.circle(model, graph)
    parts = ech.Parts(model, graph, formation, laws, initial=initial)
    return ech.simulate(parts, ech.Settings(horizon, dt, seed=3, **chosen))


def test_the_data_of_a_run_hold_v_and_its_derivatives_and_the_ends_of_the_spectrum():
    result = double_integrators(horizon=1.0, dt=1e-3)
    data, told = dataset(result), summary(result)
    V, rate, drift = (data[f"lyapunov{name}"].values for name in ("", "_rate", "_drift"))
    # Inputs are held, so that the slope of V is known to a step; what drag alone does is a part.
    assert rate[1:-1] == pytest.approx(np.gradient(V, 1e-3)[1:-1], rel=0.01, abs=0.01 * V[0])
    assert (V > 0.0).all() and (rate < 0.0).all() and (drift > rate).all()
    # A ring of 5 grounded at one agent is a chain of 4 between two fixed ends.
    ends = 2.0 - 2.0 * np.cos(np.pi * np.array([1.0, 4.0]) / 5.0)
    assert [told["lambda_min"], told["lambda_max"]] == pytest.approx(ends)


def test_v_is_the_kronecker_form_of_the_paper():
    result = double_integrators()
    P = result.drive.gain.P
    followers = list(result.graph.followers)
    M = result.graph.inverse_grounded()
    L = result.graph.laplacian().toarray()
    y = result.states - result.formation.offsets
    z = np.einsum("ij,tja->tia", L, y)[:, followers].reshape(len(y), -1)
    expected = 0.5 * np.einsum("ti,ij,tj->t", z, np.kron(M, P), z)
    assert np.allclose(lyapunov(result).value, expected, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("leaders", [(0,), (0, 2)])
def test_the_rate_is_the_derivative_of_v(leaders):
    result = double_integrators(leaders)
    v = lyapunov(result)
    dt = result.settings.dt
    # The input is held over a step, so the slope is one-sided: V(t + dt) - V(t) = dt V' + O(dt^2).
    slope = np.diff(v.value) / dt
    assert np.abs(slope - v.rate[:-1]).max() < 0.05 * np.abs(v.rate).max()
    finer = double_integrators(leaders, dt=0.0025, store_every=2)
    w = lyapunov(finer)
    coarse = np.abs(np.diff(v.value) - 0.5 * dt * (v.rate[1:] + v.rate[:-1])).sum()
    fine = np.abs(np.diff(w.value) - 0.5 * dt * (w.rate[1:] + w.rate[:-1])).sum()
    assert fine < 0.6 * coarse


@pytest.mark.slow
def test_v_falls_wherever_theory_says_so_and_the_step_is_short():
    v = lyapunov(double_integrators())
    assert not v.forbidden().any()
    assert v.value[-1] < 1e-2 * v.value[0]
    # Under a monotone drift it never rises, which is said where every step was seen.
    for every, said in ((1, "V never increased: "), (400, "between the 4 stored times: ")):
        result = monotone(store_every=every)
        v, text = lyapunov(result), " ".join(ech.report(result).split())
        assert (v.drift <= 1e-12).all() and not v.rises().any() and said in text


def monotone(horizon=10.0, dt=0.01, **chosen):
    """First-order agents with a stable drift: P = 1 is monotone, so V may never rise."""
    model, graph = ech.models.Linear([[-1.0]], [[1.0]]), ech.Graph.path(4)
    gain = ech.synthesize(model, graph, ech.gains.FixedGain("identity"))
    laws = ech.Laws(ech.laws.TrimInput(), ech.laws.Consensus(gain, "none"))
    goals = ech.Formation.from_offsets(model, graph, {})
    parts = ech.Parts(model, graph, goals, laws, initial={"x1": 1.0})
    return ech.simulate(parts, ech.Settings(horizon, dt, **chosen))


def test_the_printed_algorithm_is_caught_where_v_rises_against_theory():
    result = monotone(integrator="printed", dt=1.0)
    v = lyapunov(result)
    assert v.forbidden().sum() > 3
    assert "Warning: V increased at " in ech.report(result)
    assert "halve" not in ech.report(result)


def test_laws_without_a_metric_have_no_v():
    model, graph = ech.models.VanDerPol(), ech.Graph.path(3)
    drive = ech.Laws(ech.laws.TrimInput(), ech.laws.TrimInput())
    parts = ech.Parts(model, graph, ech.Formation.from_offsets(model, graph, {}), drive)
    result = ech.simulate(parts, ech.Settings(horizon=0.1, dt=0.01))
    assert lyapunov(result) is None
    assert "lyapunov" not in ech.dataset(result)
