"""Guarantees for random agents, attacked by code that shares nothing with echelon."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from attack import attack, promise_of, study
from attack_systems import random_system
from zoo import study as try_specimen

import echelon as ech
from echelon.core.numerics import precision
from echelon.core.words import Theorem
from echelon.synthesis.certificates.jacobians import model_jacobian


@pytest.mark.parametrize("number", [1, 2, 5])
def test_the_attacked_plant_is_the_model(number):
    system = random_system(5, number)
    plant, rng = system.plant, np.random.default_rng(number)
    n, m = plant.B.shape
    x, w = rng.uniform(-1.0, 1.0, n), rng.uniform(-1.0, 1.0, m)
    model = system.model

    @jax.jit
    def values(x, w):
        slope = model_jacobian(model)(x, w)
        return slope, model.normalized_drift(x), model.normalized_input_map(x)

    with precision("float64"):
        there = jnp.asarray(x + np.array(model.trim[0]))
        slope, drift, G = map(np.asarray, values(there, jnp.asarray(w)))
    assert np.allclose(plant.drift(x[None])[0], drift, 1e-10, 1e-12)
    assert np.allclose(np.broadcast_to(plant.input_map(x[None]), (1, n, m))[0], G, 1e-12, 1e-14)
    bent = np.einsum("iaj,a->ij", plant.g.slope(n).at(x[None])[0], w)
    assert np.allclose(plant.A + plant.f.slope(n).at(x[None])[0] + bent, slope, 1e-10, 1e-12)


def test_a_plant_with_its_loop_closed_is_the_plant_under_that_input():
    rng = np.random.default_rng(0)
    plant = next(s.plant for s in (random_system(6, k) for k in range(99)) if not s.plant.constant)
    n, m = plant.B.shape
    K, x = rng.normal(size=(m, n)), rng.normal(size=(7, n))
    wanted = plant.drift(x) - np.einsum("kia,ka->ki", plant.input_map(x), x @ K.T)
    assert np.allclose(plant.closed(K).drift(x), wanted)


@pytest.mark.parametrize(
    ("every", "least"),
    [(3, 8), pytest.param(1, 20, marks=pytest.mark.study)],
    ids=["a third", "all"],
)
def test_no_promise_for_random_systems_is_false(every, least):
    # Agents of one shape compile once; the study has all.
    numbers = [k for k in range(400) if random_system(11, k).plant.B.shape == (3, 2)][::every]
    records = [record for number in numbers for record in study(11, number, 3)]
    attacked = [record for record in records if "margin" in record]
    assert len(attacked) >= least and {r["theorem"] for r in attacked} == {"T1", "T2", "A5"}
    assert {r["kind"] for r in attacked} == {"proof", "vertices"}
    assert [(r["number"], r["method"], r["violations"]) for r in attacked if r["violations"]] == []


@pytest.fixture(scope="module")
def tight():
    """A promise with little to spare: the weakest feedback that contracts, and a bent drift."""
    for number in range(2, 99, 3):
        system = random_system(12, number)
        if not system.plant.constant:
            continue
        try:
            gain = ech.synthesize(
                system.model, system.graph, ech.gains.Contraction(system.domain(), rate=1.0)
            )
        except ech.EchelonError:
            continue
        promise = promise_of(system, gain)
        if promise is not None and gain.certificate.edge > 0.1 and len(promise.P) > 1:
            return promise
    raise AssertionError("no such system")


def test_a_true_promise_survives(tight):
    found = attack(tight, np.random.default_rng(0))
    assert found.violations == [] and 0.0 <= found.margin < 0.5 and found.runs == 16


FALSE = {
    "a raised rate": lambda p, slack: replace(p, rate=p.rate + 1.2 * slack + 0.01),
    "a shrunk coupling": lambda p, slack: replace(p, coupling=0.5 * p.coupling),
    "a wider domain": lambda p, slack: p.widened(6.0),
    "a missing edge": lambda p, slack: replace(p, grounded=0.3 * p.grounded),
}


@pytest.mark.parametrize("name", FALSE)
def test_a_false_promise_does_not(tight, name):
    slack = attack(tight, np.random.default_rng(0)).margin
    found = attack(FALSE[name](tight, slack), np.random.default_rng(0))
    assert any(told.startswith("state") for told in found.violations)
    assert found.margin < -found.tolerance


def test_simulation_alone_finds_a_drift_that_expands():
    system = random_system(0, 9)
    gain = ech.synthesize(system.model, system.graph, ech.gains.RobustLQR(system.domain()))
    promise = promise_of(system, gain)
    found = attack(replace(promise, coupling=-promise.coupling), np.random.default_rng(0))
    assert {told.partition(":")[0] for told in found.violations} == {"state", "set", "run"}


def test_a_varying_input_map_certifies_no_set():
    # From the boundary of {sum delta'P delta <= r^2} of this system a follower leaves the domain.
    system = random_system(1, 50)
    method = ech.gains.Contraction(system.domain(), rate=0.2, exact=False)
    region = ech.synthesize(system.model, system.graph, method).certificate.region
    assert (region.theorem, region.radius) == (Theorem.T2, None)


def test_a_drift_that_contracts_by_itself_takes_any_coupling():
    model, graph = ech.models.Linear(-np.eye(2), np.eye(2)), ech.Graph.path(3)
    gain = ech.synthesize(model, graph, ech.gains.Contraction({"x1": 1.0}, rate=0.5))
    assert gain.coupling > 0.0 and gain.certificate.region.rate >= 0.5


# ---- awkward agents ----


@pytest.mark.parametrize(
    ("count", "least"),
    [
        (8, 0),
        pytest.param(30, 3, marks=pytest.mark.study),
        pytest.param(100, 10, marks=pytest.mark.study),
    ],
)
def test_no_promise_for_an_awkward_agent_is_false(count, least):
    found = [try_specimen(3, number) for number in range(count)]
    assert [r for r in found if r.get("violations")] == []
    assert sum("promised" in r for r in found) >= least
