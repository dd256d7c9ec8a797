"""The independent verifier of saved gains: accepted files, refused files, its own algebra."""

import json
import subprocess
import sys
from fractions import Fraction

import numpy as np
import planted_faults as STUDY
import pytest
from forgeries import forged, places, replaced
from hypothesis import given, settings
from hypothesis import strategies as st

import echelon as ech
from echelon.experiments.scenario import registry
from echelon.experiments.scenario.named_class import resolve
from echelon.guarantees.verifier import algebra
from echelon.guarantees.verifier.agent_claims import farthest_outside
from echelon.guarantees.verifier.findings import unchecked
from echelon.guarantees.verifier.saved_gain import SavedGraph
from echelon.guarantees.verifier.verify import judge

LINE = ech.Graph.path(4)


FAST = [
    "given, linear",
    "inner loop, double integrator",
    "contraction, pendulum, proof",
    "robust LQR, spring, samples",
    "robust LQR, planar quadrotor, T2",
]


def test_the_checker_loads_nothing_of_the_synthesis():
    code = (
        "import sys, echelon.guarantees.verifier.verify, echelon.agents.models\nprint(*sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    ours = {name.removeprefix("echelon.") for name in done.stdout.split() if "echelon." in name}
    assert "guarantees.verifier.algebra" in ours
    assert not ours & {"agents.models.linearization", "agents.models.model_check"}
    # `core.compiled` and `core.cache` save what is computed; the verifier never uses them.
    shared = {"core", "core.errors", "core.identity", "core.cache", "core.limits", "core.digits"}
    shared |= {"core.compiled", "core.numerics", "core.types", "core.words"}
    # A model traces its own functions once in a call, whoever calls them.
    shared |= {"core.trace"}
    # A vehicle may be read from a file.
    shared |= {"core.text_table"}
    shared |= {"agents", "guarantees"}
    packages = ("agents.models", "guarantees.verifier")
    assert {name for name in ours if not name.startswith(packages)} <= shared


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """The file of each fast case, as JSON reads it."""
    folder = tmp_path_factory.mktemp("gains")
    return {name: STUDY.saved(STUDY.SMALL[name], folder) for name in FAST}


@pytest.mark.parametrize("name", FAST)
def test_an_untouched_file_is_accepted_and_every_planted_fault_refused(files, name, tmp_path):
    told, model = files[name], STUDY.own_model(STUDY.SMALL[name])
    file = tmp_path / "gain.json"
    file.write_text(json.dumps(told))
    found = ech.verify(file, model)
    assert found.holds and {each.verdict for each in found.findings} == {"holds"}
    planted = list(STUDY.planted(told))
    missed = [what for _, what, faulty in planted if not STUDY.refused(faulty, tmp_path, model)]
    assert len(planted) >= 25 and missed == []


@settings(max_examples=25)
@given(seed=st.integers(0, 2**32 - 1), size=st.sampled_from([1e-6, 1e-4, 1e-2]))
def test_no_perturbation_of_the_metric_passes(files, seed, size, tmp_path_factory):
    told = json.loads(json.dumps(files["contraction, pendulum, proof"]))
    random = np.random.default_rng(seed)
    # Half of the size at least in every entry, and no sign that makes up for another.
    change = random.uniform(0.5, 1.0, (2, 2)) * random.choice([-1.0, 1.0])
    told["P"] = (np.array(told["P"]) * (1.0 + size * 0.5 * (change + change.T))).tolist()
    assert STUDY.refused(told, tmp_path_factory.getbasetemp(), None)


def verified(folder, model, graph, method, given=None):
    ech.save_gain(ech.synthesize(model, graph, method), model, graph, folder / "gain.json")
    return ech.verify(folder / "gain.json", given)


@pytest.mark.parametrize("name", registry.MODELS)
def test_every_bundled_model_is_made_again_from_its_file(name, tmp_path):
    kind = resolve(registry.MODELS[name])
    model = kind([[0.0, 1.0], [-2.0, 0.1]], [[0.0], [3.0]]) if name == "linear" else kind()
    found = verified(tmp_path, model, LINE, ech.gains.FixedGain())
    assert found.holds, found.sentence
    assert {each.verdict for each in found.findings} == {"holds"}


def test_large_graphs_are_checked_as_far_as_their_edges_are_there(tmp_path):
    model, method = ech.models.DoubleIntegrator(1), ech.gains.Riccati()
    for graph, verdict, claims in (
        (ech.Graph.path(501), "verified", []),
        (ech.Graph.complete(80), "incomplete", ["graph spectrum"]),
    ):
        found = verified(tmp_path, model, graph, method)
        assert found.verdict == verdict and found.holds is (claims == [])
        assert [x.claim for x in found.findings if x.verdict == "not checked"] == claims


def test_a_model_of_ones_own_must_be_given_and_is_never_imported(tmp_path):
    model, file = STUDY.Soft(), tmp_path / "gain.json"
    found = verified(tmp_path, model, LINE, ech.gains.Riccati())
    verdicts = {each.claim: each.verdict for each in found.findings}
    assert not found.holds and verdicts["equations of the model"] == "not checked"
    said = "Incomplete: 14 claims hold as stored; not checked: equations of the model."
    assert found.sentence == said
    assert ech.verify(file, model).sentence.startswith("Verified:")
    assert not ech.verify(file, ech.models.Pendulum()).holds
    told = json.loads(file.read_text())
    told["model"]["class"] = "antigravity:Thing"
    file.write_text(json.dumps(told))
    assert ech.verify(file).verdict == "incomplete" and "antigravity" not in sys.modules


def test_a_proof_that_holds_is_found_again_at_its_rate_and_not_far_above(files):
    told = files["contraction, pendulum, proof"]
    region = told["certificate"]["region"]
    base = np.array(region["hull"]["base"])
    hull = np.repeat(base[None], len(region["hull"]["values"]), axis=0)
    rows, columns = np.array(region["hull"]["places"]).T
    hull[:, rows, columns] = region["hull"]["values"]
    parts = (told["P"], told["model"]["B"], told["R"])
    parts = (*map(np.array, parts), hull, np.array(region["error"]), Fraction(region["strength"]))
    assert algebra.first_unproved(*parts, region["rate"]) is None
    assert algebra.first_unproved(*parts, region["rate"] * (1.0 + 1e-4)) is not None


SAME = {
    "model.parameters": "a parameter left out is its default; C is of outputs, which no gain reads",
    "graph.leaders": "a leader twice",
    "graph.edges": "another order",
    "graph": "older files leave out what is false, and sums that are all 1",
    "P": "an entry that B'P does not read: the claims hold of the other P too",
    "inner": "an axis that is not the slowest: the claims hold of the other loop too",
    "certificate.edge": "a larger one, which holds",
    "certificate.region.domain.input": "inputs of which nothing depends",
    "certificate.region.hull": "a corner twice, another order, an entry that corners replace",
    "certificate.region.error": "another order of equal rows",
}
"""Places of a gain file where a change may leave all claims true, and why."""


@pytest.mark.slow
@pytest.mark.parametrize("name", [*FAST[:3], "riccati, pendulum"])
def test_a_forged_field_of_a_gain_is_accepted_only_where_all_stays_true(name, tmp_path):
    told, model = STUDY.saved(STUDY.SMALL[name], tmp_path), STUDY.own_model(STUDY.SMALL[name])
    cases = [(what, false) for what, false in forged(told) if isinstance(false, dict)]
    passed = [what for what, false in cases if accepted(false, tmp_path, model)]
    odd = [what for what in passed if not what.startswith(tuple(SAME))]
    assert len(cases) > 300 and odd == []
    print(f"{name}: {len(cases)} forged, {len(passed)} of them say the same in another way")


def accepted(told, folder, model):
    (folder / "forged.json").write_text(json.dumps(told))
    try:
        return ech.verify(folder / "forged.json", model).holds
    except ech.EchelonError:
        return False


def test_a_method_of_ones_own_is_open(files, tmp_path):
    file = tmp_path / "gain.json"
    file.write_text(json.dumps(files["contraction, pendulum, proof"] | {"method": "contraction."}))
    found = ech.verify(file)
    open_ = [x.claim for x in found.findings if x.open]
    assert found.verdict == "incomplete" and open_ == ["method"]


def changed(told, **parts):
    """A file with another region."""
    certificate = told["certificate"]
    return told | {"certificate": certificate | {"region": certificate["region"] | parts}}


def with_graph(told, **parts):
    return told | {"graph": told["graph"] | parts}


def broken(told):
    """Files that are no gain, and what is said of each."""
    hull = told["certificate"]["region"]["hull"]
    model = told["model"] | {"parameters": {"damping": "0.5"}}
    no_text = "`model.parameters` must not hold numbers as text"
    kinds = "`certificate.region.kind` must be one of `proof`, `vertices`, `samples`"
    many = "`graph.edges` must be null for more than 2000 edges"
    return {
        "gain.json` must be a mapping.": [told],
        "`P` is missing": {key: told[key] for key in told if key != "P"},
        "`P` must be 2 x 2 finite numbers (to 1e50)": told | {"P": [[1.0]]},
        "`NaN` is not a finite number": told | {"R": [[float("nan")]]},
        "`Infinity` is not a finite number": told | {"coupling": float("inf")},
        "`R` must be 1 x 1 finite numbers": told | {"R": [["1.0"]]},
        "`coupling` must be a finite number (to 1e50)": told | {"coupling": 1e60},
        "`graph.directed` must be true or false": with_graph(told, directed="false"),
        no_text: told | {"model": model},
        "`guarantee` is unknown": told | {"guarantee": {"anywhere": {}}},
        "`coupl\\u0456ng` is unknown": told | {"coupl\u0456ng": 1e9},
        "`certificate.region.hull.theorem` is unknown": changed(told, hull=hull | {"theorem": 1}),
        "`graph.agents` must be a whole number from 2 on (to 1e9)": with_graph(told, agents=True),
        "`graph` must name agents from 0 to 3": with_graph(told, leaders=[7]),
        many: with_graph(told, edges=[[0, 1, 1.0]] * 2001),
        kinds: changed(told, kind="sure"),
        "`certificate.region.hull` must be a mapping": changed(told, hull=[]),
        "`certificate.region.domain.lower` is missing": changed(told, domain={}),
        "its `format` must be `echelon gain 2`": told | {"format": "echelon gain 1"},
    }


def test_what_is_no_gain_has_its_sentence(files, tmp_path):
    file = tmp_path / "gain.json"
    for wanted, content in broken(files["contraction, pendulum, proof"]).items():
        file.write_text(json.dumps(content))
        with pytest.raises(ech.EchelonError) as caught:
            ech.verify(file)
        assert wanted in str(caught.value)
        assert str(caught.value).count("\n") == 0


ODD = [None, 0, -1, 1e308, -1e50, 1e-320, 10**400, 10**9, "x", [], {}, True, [[1]], 2.5]
ODD += [f"echelon.agents.models.{name}" for name in ("oscillators:Nope", "_x:y")]
ODD += ["echelon.agents.models.model_check:check_model"]


@settings(max_examples=60)
@given(data=st.data())
def test_whatever_stands_in_a_file_it_is_refused_in_words(files, data, tmp_path_factory):
    told = files[data.draw(st.sampled_from(FAST[:3]))]
    path = data.draw(st.sampled_from(list(places(told))[1:]))
    file = tmp_path_factory.getbasetemp() / "odd.json"
    file.write_text(json.dumps(replaced(told, path, data.draw(st.sampled_from(ODD)))))
    try:
        found = ech.verify(file)
    except ech.EchelonError as error:
        assert str(error).count("\n") == 0
    else:
        verdicts = {each.verdict for each in found.findings}
        wanted = "incomplete" if "not checked" in verdicts else "verified"
        assert found.verdict == ("refused" if "refused" in verdicts else wanted)
        assert found.sentence.startswith(found.verdict.capitalize())
        assert found.holds is (found.verdict == "verified")


def test_the_command_prints_a_table_and_exits_by_what_holds(files, echelon, tmp_path):
    file, told = tmp_path / "gain.json", files["contraction, pendulum, proof"]
    file.write_text(json.dumps(told))
    code, out, err = echelon("verify", file)
    assert (code, err) == (0, "") and "recomputed" in out
    count = len(ech.verify(file).findings)
    assert out.splitlines()[-1] == f"Verified: {count} claims hold as stored."
    file.write_text(json.dumps(changed(told, radius=2.0)))
    code, out, _ = echelon("verify", file, "--json")
    told = json.loads(out)
    assert code == 1 and not told["holds"]
    assert told["sentence"] == "Refused: radius does not hold as stored."
    assert [x["claim"] for x in told["findings"] if x["verdict"] == "refused"] == ["radius"]
    file.write_text("no JSON")
    code, out, err = echelon("verify", file)
    assert (code, out) == (2, "") and "is not valid JSON" in err and err.count("\n") == 1


@given(
    st.integers(1, 4).flatmap(
        lambda n: st.lists(st.lists(st.integers(-3, 3), min_size=n, max_size=n), min_size=1)
    )
)
def test_a_gram_matrix_is_definite_exactly_when_its_rows_have_full_rank(rows):
    M = np.array(rows, float)
    gram = algebra.rows_of(M.T @ M)
    full = np.linalg.matrix_rank(M) == M.shape[1]
    assert algebra.is_positive_definite(gram) is bool(full)
    if full:
        one = algebra.product(gram, algebra.inverse(gram))
        assert all(x == (i == j) for i, row in enumerate(one) for j, x in enumerate(row))


def test_the_sign_of_a_minor_is_not_a_matter_of_rounding():
    # det = (1 + e) - 1 with e half of what float64 can see beside 1, and its negative.
    one, tiny = Fraction(1), Fraction(1, 2**60)
    for last, definite in ((1 + tiny, True), (1 - tiny, False), (one, False)):
        assert algebra.is_positive_definite([[one, one], [one, last]]) is definite
    # Of symmetric matrices to the last bit alone.
    assert algebra.is_positive_definite([[2 * one, tiny], [tiny, 2 * one]])
    assert not algebra.is_positive_definite([[2 * one, tiny], [0 * one, 2 * one]])
    assert not algebra.is_positive_definite([[one, 0 * one], [tiny, one]])


@pytest.mark.parametrize("followers", [3, 30, 450])
def test_the_spectrum_of_a_chain_is_its_closed_form(followers):
    edges = np.array([(k, k + 1, 1.0) for k in range(followers)])
    found, bound = algebra.spectrum(SavedGraph(followers + 1, (0,), edges, np.zeros(1)), edges)
    k = np.arange(1, followers + 1)
    wanted = 4.0 * np.sin((2 * k - 1) * np.pi / (4 * followers + 2)) ** 2
    assert found == pytest.approx(wanted, rel=1e-11)
    assert found[0] == pytest.approx(wanted[0], rel=1e-13)
    assert wanted[0] * (1.0 - 1e-11) <= bound <= wanted[0]
    many = wanted if followers <= 400 else wanted[[0, -1]]
    assert algebra.ends_of_many(found) == pytest.approx(many, rel=1e-11)


@given(st.integers(0, 10**6), st.integers(1, 5), st.integers(0, 3))
def test_the_rank_of_what_is_seen_is_that_of_the_part_that_is_built_in(seed, seen, hidden):
    random = np.random.default_rng(seed)
    n = seen + hidden
    A = np.zeros((n, n))
    # A chain is seen whole from its first state; the rest drives nothing and is never seen.
    A[np.arange(seen - 1), np.arange(1, seen)] = random.uniform(0.5, 2.0, seen - 1)
    A[seen:] = random.normal(size=(hidden, n))
    turn, _ = np.linalg.qr(random.normal(size=(n, n)))
    C = np.eye(n)[:1]
    assert algebra.observable(turn @ A @ turn.T, C @ turn.T) == seen


def test_the_exact_laplacian_loses_no_weight_and_eigenvalues_know_how_well_they_are_known():
    edges = np.array([(0, 1, 0.1), (1, 2, 0.2), (0, 2, 0.7)])
    rows = algebra.grounded_rows(SavedGraph(3, (0,), edges, np.zeros(1)), edges)
    assert rows[0][0] == Fraction(0.1) + Fraction(0.2) and rows[0][1] == -Fraction(0.2)
    value, slack = algebra.rightmost(np.diag([-3.0, -1.0]))
    assert value == -1.0 and slack < 1e-13
    value, slack = algebra.rightmost(np.array([[-1.0, 1.0], [0.0, -1.0]]))
    assert value == pytest.approx(-1.0, abs=1e-7) and 1e-10 < slack


@given(st.integers(0, 10**6))
def test_combinations_lie_inside_and_points_beyond_a_corner_do_not(seed):
    random = np.random.default_rng(seed)
    hull = random.normal(size=(9, 2, 3))
    hull[:, 0, 0] = 4.0
    weights = random.dirichlet(np.ones(9), 5)
    error = np.zeros((2, 3))
    assert farthest_outside(hull, error, np.tensordot(weights, hull, 1)) < 1e-12
    highest = hull[hull[:, 1, 1].argmax()]
    beyond = highest.copy()
    beyond[1, 1] += 0.1 * np.ptp(hull[:, 1, 1])
    # No combination reaches beyond the highest corner, and the nearest need not be far in others.
    assert 0.1 * (1.0 - 1e-9) <= farthest_outside(hull, error, beyond[None]) < 0.2
    off = highest.copy()
    off[0, 0] += 0.4
    assert farthest_outside(hull, error, off[None]) == pytest.approx(0.1 * 1000.0)
    error[0, 0] = 0.4
    assert farthest_outside(hull, error, off[None]) < 1e-9


def test_a_run_without_what_it_promised_is_told_so(echelon, here):
    (here / "run").mkdir()
    for summary, sentence in {
        '{"guarantee": {': "the file `run/summary.json` is not valid JSON: ",
        "[1]": "`run/summary.json` must be a mapping.",
        '{"gain": {"coupling": 1.0}}': "`run` has lost its `gain.json`; `echelon run run --out",
        '{"gain": null}': "`run/summary.json` is damaged: it has no `guarantee`.",
    }.items():
        (here / "run" / "summary.json").write_text(summary)
        code, _, fault = echelon("verify", "run")
        assert code == 2 and fault.startswith(f"echelon: {sentence}") and fault.count("\n") == 1


def test_a_verdict_names_a_few_claims_that_are_open_and_counts_the_rest():
    found = [unchecked(f"claim {k}", "", "no code") for k in range(9)]
    assert judge(found).sentence == (
        "Incomplete: no claim was checked; not checked: claim 0; claim 1; claim 2 and 6 more."
    )
    assert judge(found[:4]).sentence.endswith("not checked: claim 0; claim 1; claim 2; claim 3.")
