"""The guarantee of a run, computed again: honest files agree, and no forged field does."""

import json
import os
import subprocess
import sys

import numpy as np
import pytest
from forgeries import at, forged, places, replaced

import echelon as ech
from echelon.experiments.results.summary import OBSERVED, statement, summary
from echelon.experiments.scenario.scenario import bundled_scenarios
from echelon.experiments.studies.design import with_gain
from echelon.experiments.studies.recomputation import compare_claims, compare_gain, with_leader_gain
from echelon.guarantees.verifier.stored_values import compare_values
from echelon.synthesis.gains import domain_methods
from echelon.synthesis.gains.gain_file import save_gain

SMALL = {
    "name": "small",
    "model": {"name": "double-integrator", "parameters": {"dimension": 2}},
    "graph": {"name": "path", "agents": 4},
    "follower": {"gain": {"method": "riccati"}},
    "initial": {"spread": {"position": 1.0}},
    "simulation": {"horizon": 0.2, "dt": 0.01},
}
MOTORS = (
    "reference={name: hover}",
    "leader={law: stopping-point, start_error: {x: 5}, roots: [2, 2.5, 3], speed: 0.7}",
    "follower={law: stopping-point, roots: [2, 2.5, 3], speed: [1.4, 1.4, 0.7, 0.3]}",
)
PROVED = (
    "follower.gain={method: robust-lqr, domain: {position: 3.0, velocity: 4.0}, exact: true}",
    "initial.spread={position: 0.1, velocity: 0.1}",
    "simulation.dt=0.001",
)


AGREEMENT = {
    "model": {"name": "single-integrator"},
    "leader": {"law": "agreement"},
    "follower": {"law": "agreement"},
}


def stated(experiment, name):
    """The summary of a run, as its file has it, without what only the run gives."""
    return dict.fromkeys(OBSERVED) | json.loads(json.dumps(statement(*experiment, name)))


@pytest.mark.slow
@pytest.mark.parametrize("change", [{}, AGREEMENT])
def test_no_forged_field_of_a_summary_agrees_with_its_scenario(change):
    scenario = ech.scenario_from_mapping(SMALL | change)
    experiment = ech.build(scenario)
    document = stated(experiment, "small")
    own = json.loads(json.dumps(summary(ech.run(scenario))))
    assert own.keys() == document.keys() - {"event_outcomes"}
    assert not refused(compare_claims(own, experiment, "small"))
    count, missed = accepted(document, experiment, "small", sample(150))
    assert count == 150 and missed == []


def refused(findings):
    return [x.claim for x in findings if x.verdict == "refused"]


def accepted(document, experiment, name, pick):
    """The forged fields among those picked that agree with the scenario, and how many there are."""
    cases = list(pick(forged(document, OBSERVED)))
    return len(cases), [
        what
        for what, false in cases
        if isinstance(false, dict) and not refused(compare_claims(false, experiment, name))
    ]


def sample(count):
    def pick(cases):
        cases = list(cases)
        return [cases[k] for k in np.random.default_rng(0).permutation(len(cases))[:count]]

    return pick


CASES = {name: () for name in bundled_scenarios()}
CASES |= {"paper-radio, both ways": ("graph.directed=false",)}
CASES |= {"paper-global, motors": MOTORS, "van-der-pol, proved": PROVED}


SAMPLED = ("yaw-turn", "paper-global, motors", "van-der-pol, proved")


@pytest.mark.parametrize(
    ("case", "pick"),
    [
        *(pytest.param(case, sample(200), marks=pytest.mark.slow) for case in SAMPLED),
        *(pytest.param(case, list, marks=pytest.mark.study) for case in CASES),
    ],
)
def test_no_forged_field_of_any_guarantee_agrees_with_its_scenario(case, pick):
    name = case.partition(",")[0]
    experiment = ech.build(ech.load_scenario(name, CASES[case]))
    document = stated(experiment, name)
    assert not refused(compare_claims(document, experiment, name))
    count, missed = accepted(document, experiment, name, pick)
    assert missed == [] and count >= 200


AREA = {"position": 3.0, "velocity": 4.0}
SOLVED = SMALL | {
    "reference": {"name": "circle", "radius": 1.0, "rate": 0.3},
    "leader": {
        "law": "tracking",
        "gain": {"method": "contraction", "domain": AREA, "rate": 0.3},
    },
}


def test_a_gain_of_the_leader_is_that_of_its_file_where_solvers_end_elsewhere(monkeypatch):
    document = stated(ech.build(ech.scenario_from_mapping(SOLVED)), "small")
    solve, noise = domain_methods.contraction, np.random.default_rng(0).normal(size=(4, 4)) * 3e-5

    def another_machine(*arguments, **named):
        metric = solve(*arguments, **named)
        return metric._replace(P=metric.P * (1.0 + noise + noise.T))

    monkeypatch.setattr(domain_methods, "contraction", another_machine)
    experiment = ech.build(ech.scenario_from_mapping(SOLVED))
    # By its own solution the other machine would call an honest file a forgery.
    assert refused(compare_claims(document, experiment, "small"))

    def verified(document):
        own, findings = with_leader_gain(experiment, document["leader_gain"])
        return refused([*findings, *compare_claims(document, own, "small")])

    assert verified(document) == []
    P = np.array(document["leader_gain"]["P"])
    for false in ((P * 1.01).tolist(), (P * 1.0001).tolist(), (-P).tolist(), P[:2].tolist(), "P"):
        forged_gain = document["leader_gain"] | {"P": false}
        assert verified(document | {"leader_gain": forged_gain})
    assert verified(document | {"leader_gain": None})


def test_a_leader_that_reacts_does_so_by_the_gain_of_its_followers():
    leader = {"law": "tracking", "reacts": True}
    parts = ech.build(ech.scenario_from_mapping(SOLVED | {"leader": leader})).parts
    gain = ech.synthesize(parts.model, parts.graph, ech.gains.Riccati(coupling=9.0))
    reaction = with_gain(parts, gain).drive.leader.reaction
    assert (reaction.P == gain.P).all() and reaction.coupling == 9.0


def test_all_that_a_check_prints_is_compared():
    experiment = ech.build(ech.scenario_from_mapping(SMALL))
    document = json.loads(json.dumps(ech.check(*experiment).as_mapping()))
    assert not refused(compare_claims(document, experiment, "small"))
    # Each is compared with a check of its own, which takes a while.
    count, missed = accepted({"lines": document["lines"]}, experiment, "small", sample(3))
    assert count == 3 and missed == []


def test_a_gain_of_other_parts_or_another_method_is_refused(tmp_path):
    experiment, file = ech.build(ech.scenario_from_mapping(SMALL)), tmp_path / "gain.json"
    model, graph = experiment.parts.model, experiment.parts.graph

    def false(gain, graph=graph, model=model):
        save_gain(gain, model, graph, file)
        return refused(compare_gain(file, experiment))

    gain = experiment.parts.drive.gain
    assert false(gain) == []
    assert false(ech.synthesize(model, graph, ech.gains.InnerLoop()))
    assert false(ech.synthesize(model, graph, ech.gains.Riccati(coupling=2.0 * gain.coupling)))
    ring = ech.Graph.ring(4)
    assert false(ech.synthesize(model, ring, ech.gains.Riccati()), ring) == ["gain.json"]
    # With the eigenvalues of the path, and other agents.
    last = ech.Graph.from_edges([(0, 2), (2, 1), (1, 3)], leaders=[0])
    assert false(ech.synthesize(model, last, ech.gains.Riccati()), last) == [
        "gain.json: graph.edges"
    ]
    other = ech.models.DoubleIntegrator(3)
    assert false(ech.synthesize(other, graph, ech.gains.Riccati()), model=other) == ["gain.json"]


def moved(document, size):
    """A document whose numbers are changed by a fraction, and whose residuals are other ones."""
    draw = np.random.default_rng(0)
    for path in places(document):
        value = at(document, path)
        if isinstance(value, float):
            new = value * (1.0 + size * draw.choice([-1.0, 1.0]))
            document = replaced(document, path, new if abs(value) > 1e-12 else 3e-16)
    return document


def test_rounding_is_no_forgery_and_a_third_digit_is():
    experiment = ech.build(ech.scenario_from_mapping(SMALL))
    document = stated(experiment, "small")
    assert not refused(compare_claims(moved(document, 1e-8), experiment, "small"))
    assert len(refused(compare_claims(moved(document, 1e-3), experiment, "small"))) > 10


SAME = [
    (1.0, 1.0 + 1e-8),
    (-0.0, 0.0),
    (3, 3.0),
    (2e-16, -1e-17),
    ([1.0, 2e-16], [1.0, 0.0]),
    ([np.inf, 1.0], [np.inf, 1.0]),
    ([], []),
    ("up to 2e-16 at 4 states", "up to 1e-17 at 4 states"),
]
DIFFERENT = [
    (1.0, 1.0 + 1e-5),
    (1, True),
    (None, 0.0),
    ("1.0", 1.0),
    (2e-9, 1e-9),
    (10**299, 1.0),
    ([np.inf, 1.0], [np.inf, 2.0]),
    ([[1.0], [2.0, 3.0]], [[1.0], [2.0]]),
    ([1.0], 1.0),
    ([], {}),
    ("up to 2e-16 at 4 states", "up to 2e-16 at 5 states"),
    ("0.943 1/s", "0.944 1/s"),
    ("T5", "T4"),
    ("any start", "any  start"),
    ("z", "\u2124"),
]


def test_which_values_agree():
    for pairs, agree in ((SAME, True), (DIFFERENT, False)):
        for stored, value in pairs:
            findings = list(compare_values("x", stored, value))
            assert (refused(findings) == []) is agree, (stored, value)
            assert all(x.claim.startswith("x") and x.by_scenario for x in findings)


@pytest.mark.slow
def test_a_run_is_verified_where_libraries_round_in_another_way(tmp_path):
    """BLAS without vectors of a later processor, and XLA without its optimizer."""
    scenario = ech.load_scenario("yaw-turn", ["simulation.horizon=0.5"])
    ech.save_run(ech.run(scenario), tmp_path / "run", figures=False)
    rounding = {"OPENBLAS_CORETYPE": "Prescott", "XLA_FLAGS": "--xla_backend_optimization_level=0"}
    rounding |= {"ECHELON_CACHE": "off", "JAX_ENABLE_COMPILATION_CACHE": "0"}
    command = [sys.executable, "-m", "echelon", "verify", str(tmp_path / "run")]
    done = subprocess.run(command, env={**os.environ, **rounding}, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout
