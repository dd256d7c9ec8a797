"""Guarantees for random agents, attacked by code that shares nothing with echelon."""

import contextlib
from dataclasses import replace

import numpy as np
import pytest
from attack import attack, promise_of, study
from attack_systems import random_system
from zoo import FAMILIES, judge
from zoo import study as try_specimen

import echelon as ech
from echelon.core.words import Theorem


@pytest.mark.parametrize(("every", "least"), [(3, 8), pytest.param(1, 20, marks=pytest.mark.study)])
def test_no_promise_for_random_systems_is_false(every, least):
    # Agents of one shape compile once; the study has all.
    numbers = [k for k in range(400) if random_system(11, k).plant.B.shape == (3, 2)][::every]
    records = [record for number in numbers for record in study(11, number, 3)]
    attacked = [record for record in records if "margin" in record]
    assert len(attacked) >= least and {r["theorem"] for r in attacked} == {"T1", "T2", "A5"}
    assert {r["kind"] for r in attacked} == {"proof", "vertices"}
    assert [(r["number"], r["method"], r["violations"]) for r in attacked if r["violations"]] == []


FALSE = {
    "a raised rate": lambda p, slack: replace(p, rate=p.rate + 1.2 * slack + 0.01),
    "a shrunk coupling": lambda p, slack: replace(p, coupling=0.5 * p.coupling),
    "a wider domain": lambda p, slack: p.widened(6.0),
    "a missing edge": lambda p, slack: replace(p, grounded=0.3 * p.grounded),
}


def test_a_true_promise_survives_the_attack_and_a_false_one_does_not():
    """A promise with little to spare: the weakest feedback that contracts, and a bent drift."""
    systems = (random_system(12, k) for k in range(2, 99, 3))
    for system in (system for system in systems if system.plant.constant):
        method = ech.gains.Contraction(system.domain(), rate=1.0)
        with contextlib.suppress(ech.EchelonError):
            gain = ech.synthesize(system.model, system.graph, method)
            promise = promise_of(system, gain)
            if promise is not None and gain.certificate.edge > 0.1 and len(promise.P) > 1:
                break
    true = attack(promise, np.random.default_rng(0))
    assert true.violations == [] and 0.0 <= true.margin < 0.5 and true.runs == 16
    for forge in FALSE.values():
        found = attack(forge(promise, true.margin), np.random.default_rng(0))
        assert any(told.startswith("state") for told in found.violations)
        assert found.margin < -found.tolerance


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


@pytest.mark.slow
@pytest.mark.parametrize(
    ("count", "least"), [(8, 0), pytest.param(100, 10, marks=pytest.mark.study)]
)
def test_no_promise_for_an_awkward_agent_is_false(count, least):
    found = [try_specimen(3, number) for number in range(count)]
    assert [r for r in found if r.get("violations")] == []
    assert sum("promised" in r for r in found) >= least


ONE = "plants", "paths", "differences", "subclasses", "units", "leaders' inputs"
FEW = dict.fromkeys(ONE, range(1)) | {"limits": range(7, 8), "limits of chains": range(5, 6)}
"""Of those that take long one; with limits, one with a guarantee."""


@pytest.mark.parametrize("family", FAMILIES)
def test_nothing_false_is_guaranteed_of_a_few(family):
    findings = [judge(family, 5, number) for number in FEW.get(family, range(2))]
    assert [finding.false for finding in findings if finding.false] == []
