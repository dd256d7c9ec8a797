"""`check`: the finite condition, lines about regions, guarantees no larger than their proofs."""

import dataclasses
import json
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate
from hypothesis import given, settings
from hypothesis import strategies as st
from in_words import in_words

import echelon as ech
from echelon.core.digits import at_most
from echelon.core.linear import longest_step
from echelon.core.statement import Hypothesis
from echelon.core.words import Kind, Theorem, Verdict
from echelon.experiments.studies.assumptions import pair_values

PATH = ech.Graph.path(4)
LOW, _, HIGH = PATH.spectrum().eigenvalues


class Line1(ech.ControlAffine):
    """x' = slope x + u."""

    slope: float = -1.0
    state_names = ("x",)
    input_names = ("u",)

    def drift(self, x):
        return self.slope * x

    def input_map(self, x):
        return jnp.ones((1, 1), x.dtype)


class Weakening(ech.models.Pendulum):
    """A pendulum whose input loses strength away from the trim."""

    def input_map(self, x):
        return jnp.stack([0.0 * x[0], jnp.cos(x[0])])[:, None]


def scenario(follower, **sections):
    told = {
        "name": "mine",
        "model": {"name": "pendulum"},
        "graph": {"name": "path", "agents": 4},
        "leader": {"law": "passive"},
        "follower": follower,
        "simulation": {"horizon": 2.0, "dt": 0.01},
    }
    return ech.scenario_from_mapping(told | sections)


def checked(follower, **sections):
    return lines_of(ech.build(scenario(follower, **sections)))


SINGLE = {"name": "single-integrator"}


def own_gain(coupling):
    return {"gain": {"method": "given", "P": "identity", "coupling": coupling}}


ROBUST = {"gain": {"method": "robust-lqr", "domain": {"angle": 0.5}}}


@pytest.fixture(scope="module")
def robust():
    """The parts of a pendulum with a region, its leader at rest, and their settings."""
    return ech.build(scenario(ROBUST))


def lines_of(built):
    found = ech.check(*built)
    return {line.name: line for line in found.lines}, found.promise


def with_gain(built, gain, **changes):
    """The same under another gain, perhaps with another model."""
    parts = built.parts
    follower = dataclasses.replace(parts.drive.follower, gain=gain)
    drive = dataclasses.replace(parts.drive, follower=follower)
    return built._replace(parts=parts.replace(drive=drive, **changes))


def with_claim(built, **changes):
    """The same under a gain that says something else of its region."""
    gain = built.parts.drive.gain
    region = dataclasses.replace(gain.certificate.region, **changes)
    certificate = dataclasses.replace(gain.certificate, region=region)
    return with_gain(
        built, ech.Gain(gain.P, gain.R, gain.coupling, gain.method, certificate, gain.inner)
    )


def goals(*offsets):
    return ech.Formation([[offset] for offset in offsets])


def test_the_sign_is_that_of_goals_that_pull_together():
    # f = -x: (1 - 0) P (-1 - 0) = -P; the paper's d_ij = xi_j - xi_i would turn it.
    good = ech.finite_condition(np.eye(1) * 2.0, Line1(-1.0), goals(0.0, 1.0))
    assert (good.verdict, good.largest, good.least) == (Verdict.HOLDS, pytest.approx(-2.0), 2.0)
    bad = ech.finite_condition(np.eye(1) * 2.0, Line1(0.5), goals(0.0, 1.0, 3.0))
    assert (bad.verdict, bad.largest) == (Verdict.FAILS, pytest.approx(9.0))
    assert set(bad.pair) == {0, 2} and bad.agents == 3


def test_goals_that_f_does_not_tell_apart_make_it_empty():
    agent = ech.models.Quadrotor()
    formation = ech.Formation.from_offsets(agent, PATH, {1: (1, 0, 0), 2: (0, 3, 0)})
    # Smaller than I it is refused even then, and a multiple of it is not.
    for size, verdict in ((1.0, Verdict.VACUOUS), (0.5, Verdict.FAILS)):
        assert ech.finite_condition(size * np.eye(12), agent, formation).verdict is verdict
    # Of a swarm a thousand agents are compared.
    found = ech.finite_condition(np.eye(1), Line1(-1.0), goals(*np.linspace(0.0, 1.0, 5000)))
    assert (found.verdict, found.agents) == (Verdict.HOLDS, 1000)
    for P, said in ((np.eye(2), r"has shape \(2, 2\), but `Line1`"), (-np.eye(1), "definite")):
        with pytest.raises(ech.EchelonError, match=said):
            ech.finite_condition(P, Line1(), goals(0.0, 1.0))


@given(st.integers(0, 10**6), st.floats(0.1, 10.0))
@settings(max_examples=20, deadline=None)
def test_the_condition_is_linear_in_p(seed, factor):
    rng = np.random.default_rng(seed)
    A, d = rng.normal(size=(3, 3)), rng.normal(size=(5, 5, 3))
    f = d @ A.T
    P, Q = ((M @ M.T) + np.eye(3) for M in rng.normal(size=(2, 3, 3)))
    both = pair_values(P, d, f) + factor * pair_values(Q, d, f)
    assert pair_values(P + factor * Q, d, f) == pytest.approx(both, rel=1e-9, abs=1e-9)
    model = ech.models.Linear(A=A.tolist(), B=np.eye(3).tolist())
    formation = ech.Formation(rng.normal(size=(5, 3)))
    verdicts = [ech.finite_condition(M, model, formation).verdict for M in (P, Q, P + Q)]
    # What two pass, their sum passes.
    assert verdicts[:2] != [Verdict.HOLDS] * 2 or verdicts[2] is Verdict.HOLDS


@given(st.integers(0, 10**6))
@settings(max_examples=10, deadline=None)
def test_the_largest_pair_is_the_largest(seed):
    rng = np.random.default_rng(seed)
    A, xi = rng.normal(size=(2, 2)), rng.normal(size=(150, 2))
    model = ech.models.Linear(A=A.tolist(), B=[[0.0], [1.0]])
    found = ech.finite_condition(np.eye(2), model, ech.Formation(xi))
    pairs = {(i, j): (xi[i] - xi[j]) @ A @ (xi[i] - xi[j]) for i in range(150) for j in range(i)}
    assert found.largest == pytest.approx(max(pairs.values()), rel=1e-9)
    at = max(found.pair), min(found.pair)
    assert pairs[at] == pytest.approx(max(pairs.values()), rel=1e-9)


def test_the_region_is_told_and_the_promise_says_it(robust):
    lines, found = lines_of(robust)
    gain, line = robust.parts.drive.gain, lines["region of the gain"]
    region = gain.certificate.region
    assert line.verdict is Verdict.HOLDS and line.kind is region.kind is Kind.VERTICES
    assert (line.number, line.number_text) == (region.rate, f"{at_most(region.rate)} 1/s")
    assert found.promised and "(vertices of a hull, T1)" in in_words(found)
    assert f"{at_most(region.rate)} 1/s or faster" in in_words(found)
    assert f"<= {at_most(region.radius)}^2" in in_words(found)
    assert (found.theorem, found.kind, found.rate) == (Theorem.T1, Kind.VERTICES, region.rate)
    # No point of the certified set leaves the domain.
    angles = np.linspace(0.0, 2.0 * np.pi, 4001)
    circle = np.column_stack([np.cos(angles), np.sin(angles)])
    root = np.linalg.cholesky(gain.P).T
    edge = lines["certified set"].number * np.linalg.solve(root, circle.T)
    assert np.abs(edge[0]).max() == pytest.approx(0.5, rel=5e-3)


def test_the_leader_s_excursion_is_taken_off_the_margin(robust):
    error = {"angle": 0.1, "rate": 0.3}
    lines, found = checked(ROBUST, leader={"law": "passive", "start_error": error})
    model, times = robust.parts.model, np.linspace(0.0, 2.0, 201)
    solved = scipy.integrate.solve_ivp(
        lambda t, x: np.asarray(model.drift(jnp.asarray(x))), (0.0, 2.0), [0.1, 0.3],
        rtol=1e-8, t_eval=times,
    )  # fmt: skip
    reach = np.abs(solved.y[0]).max()
    assert 0.1 < reach < 0.5
    alone, _ = lines_of(robust)
    share = lines["certified set"].number / alone["certified set"].number
    assert share == pytest.approx((0.5 - reach) / 0.5, rel=2e-2)
    assert lines["certified set"].kind is Kind.SAMPLES
    assert "as in a run of its own" in in_words(found)
    # One that leaves the domain leaves no set.
    lines, found = checked(ROBUST, leader={"law": "passive", "start_error": {"angle": 0.6}})
    line = lines["certified set"]
    assert (line.verdict, line.number_text, line.number) == (Verdict.FAILS, "empty", 0.0)
    assert "the leader alone reaches 0.6 in `angle`, and the domain 0.5" in line.text
    assert "no start is certified" in in_words(found)


class Yielding(ech.models.Pendulum):
    """A pendulum whose weight gives way, by a function that has no enclosure."""

    def drift(self, x):
        return jnp.stack([x[1], -jax.scipy.special.erf(x[0]) - self.damping * x[1]])


@pytest.mark.parametrize(
    ("model", "method", "told", "untold"),
    [
        (
            ech.models.Pendulum(),
            ech.gains.RobustLQR({"angle": 0.5}, exact=True),
            "exact proof",
            "seen",
        ),
        (Yielding(), ech.gains.RobustLQR({"angle": 0.5}, exact=True), "seen at samples", "proof"),
        (Weakening(), ech.gains.RobustLQR({"angle": 0.2}), "starts close to the goals", "sum_i"),
        (ech.models.Pendulum(), ech.gains.Riccati(), "how close is not known", "T1"),
        (
            ech.models.Pendulum(),
            ech.gains.Monotone({"angle": 0.5}),
            "V never rises from",
            "converges",
        ),
    ],
)
def test_the_promise_is_as_strong_as_its_argument(robust, model, method, told, untold):
    gain = ech.synthesize(model, PATH, method)
    lines, found = lines_of(with_gain(robust, gain, model=model))
    assert found.promised and told in in_words(found) and untold not in in_words(found)
    assert not found.hypotheses[Hypothesis.CLAIMS].fails
    if isinstance(model, Yielding):  # why a proof became samples is said
        why = lines["region of the gain"].text.partition("no more than samples, since ")[2]
        assert "erf" in why and "erf" in gain.certificate.region.why


@pytest.mark.parametrize(
    "changes",
    [
        {"rate": 5.0},
        {"kind": Kind.SAMPLES},
        {"theorem": Theorem.T2},
        {"hull": np.array([[[-9.0, 0.0], [0.0, -9.0]]]), "rate": 9.0},
    ],
)
def test_what_a_gain_says_of_itself_is_not_believed_but_compared(robust, changes):
    true, found = (ech.guarantee(*each) for each in (robust, with_claim(robust, **changes)))
    assert (found.theorem, found.kind, found.rate) == (true.theorem, true.kind, true.rate)
    told = [key for key in changes if key != "hull"]
    assert found.hypotheses[Hypothesis.CLAIMS].fails is bool(told)
    assert "but the gain says" in in_words(found) and " but " not in in_words(true)


def test_where_only_the_drift_is_known_the_set_pays_for_the_graph_if_g_varies(robust):
    for model, share in ((ech.models.Pendulum(), 1.0), (Weakening(), np.sqrt(LOW / HIGH))):
        gain = ech.synthesize(model, PATH, ech.gains.Monotone({"angle": 0.5}))
        lines, _ = lines_of(with_gain(robust, gain, model=model))
        radius, W = lines["certified set"].number, np.linalg.inv(gain.P)
        assert gain.certificate.region.radius == pytest.approx(radius)
        assert radius == pytest.approx(share * 0.5 / np.sqrt(W[0, 0]), rel=5e-3)


def test_a_linear_agent_is_certified_everywhere():
    model = {"name": "double-integrator", "parameters": {"dimension": 1}}
    gain = {"method": "contraction", "domain": {}, "rate": 0.2}
    lines, found = checked({"gain": gain}, model=model)
    assert lines["certified set"].number_text == "radius inf"
    assert "from everywhere" in in_words(found)


def test_a_held_integrator_bears_two_time_constants():
    one = np.eye(1)
    for k in (0.5, 3.0):
        assert longest_step(0.0 * one, one, [k * one, 0.1 * k * one]) == pytest.approx(2.0 / k)
    # x' = -x - k x(t_k): e^-h - k (1 - e^-h) > -1, h < log((k + 1) / (k - 1)).
    assert longest_step(-one, one, [3.0 * one]) == pytest.approx(np.log(2.0), rel=1e-4)
    assert longest_step(-one, one, [0.5 * one]) == np.inf


@pytest.mark.parametrize(("share", "verdict"), [(0.99, Verdict.HOLDS), (1.01, Verdict.FAILS)])
def test_a_step_too_long_for_the_gain_takes_the_promise_away(share, verdict):
    dt = share * 2.0 / float(HIGH)
    lines, found = checked(own_gain(1.0), model=SINGLE, simulation={"horizon": 16 * dt, "dt": dt})
    assert lines["step, input held"].verdict is verdict
    assert found.promised is (verdict is Verdict.HOLDS)
    assert ("is too long for this gain" in in_words(found)) is not found.promised


def test_followers_that_ignore_each_other_are_promised_what_they_do_alone():
    _, found = checked({"law": "passive"})
    # A pendulum with damping comes to rest by itself, s^2 + 0.5 s + 9.81.
    assert found.slowest == pytest.approx(-0.25, rel=0.02)
    quadrotor = {"model": {"name": "planar-quadrotor"}, "simulation": {"horizon": 1.0, "dt": 0.002}}
    for trim in (False, True):
        lines, found = checked({"trim": trim}, **quadrotor)
        verdict = lines["Definition 1, f(0) = 0"].verdict
        assert (verdict is Verdict.HOLDS) == found.promised == trim
        assert ("leaves out the trim input" in in_words(found)) != trim


def test_wind_is_left_out_of_the_promise_and_said_to_be():
    wind, plant = {"disturbance": {"rms": {"rate": 0.1}}}, {"plant": {"scale": {"damping": 1.1}}}
    # Another plant is part of the loop that is looked at.
    told = ((wind, "wind or noise acts"), (plant, ""), ({}, ""))
    for sections, words in told:
        lines, found = checked({}, **sections)
        fails = lines["Assumption 3, exact states"].verdict is Verdict.FAILS
        assert found.promised and fails == ("ignores" in in_words(found)) == bool(words)
        assert words in in_words(found)


def test_every_failure_says_what_to_change():
    for name in ("paper-literal", "paper"):
        for line in ech.check(*ech.build(ech.load_scenario(name))).lines:
            assert line.statement and line.text, line.statement
            assert isinstance(line.kind, Kind) and isinstance(line.verdict, Verdict)


def test_a_long_path_says_which_eigenvalues_it_looked_at():
    graph, step = {"name": "path", "agents": 601}, {"horizon": 1.0, "dt": 1e-6}
    lines, found = checked({}, graph=graph, model=SINGLE, simulation=step)
    assert "over 1200 modes of the steps that run" in lines["disagreement decays"].text
    where = lines["disturbance, network"].text
    assert where.endswith("lambda_min, lambda_max and 30 values between them")
    assert found.promised
    # Margins are not asked for where rounding hides the slowest mode.
    strong = {"gain": {"method": "riccati", "coupling": 1e11}}
    lines, _ = checked(strong, model={"name": "double-integrator"})
    assert "lost in rounding" in lines["margins"].text and "gain margin" not in lines


def test_a_pushed_integrator_lags_by_its_slowest_mode_and_a_chain_passes_on_what_it_gets():
    lines, _ = checked(own_gain(3.0), model=SINGLE)
    for statement in ("disturbance, network", "disturbance, one mode"):
        values = [float(part.split()[1]) for part in lines[statement].number_text.split(", ")]
        assert values == pytest.approx([1.0 / (3.0 * LOW)] * len(values), rel=5e-3)
        assert lines[statement].number == pytest.approx(1.0 / (3.0 * LOW), rel=1e-6)
    assert lines["string gain"].number_text == "1, 1 over 3 links"
    assert lines["string gain"].verdict is Verdict.NOT_NEEDED
    lines, _ = checked(own_gain(3.0), model=SINGLE, graph={"name": "ring", "agents": 4})
    assert "string gain" not in lines


def test_a_parents_input_fed_forward_leaves_one_mode_on_any_tree():
    # Riccati for a chain of ten on the coupling of one link: A - c B K alone must decay.
    follower = {"gain": {"method": "riccati", "coupling": 1.0}, "feedforward": "parent"}
    chain = {"graph": {"name": "path", "agents": 11}, "model": {"name": "double-integrator"}}
    lines, found = checked(follower, **chain)
    assert found.promised
    assert lines["coupling"].number_text == "c 1, edge 0.5"
    # Q = R = I on (x, v): s^2 + sqrt(3) s + 1, whose roots have real part -sqrt(3)/2.
    dt = found.case.settings.dt
    step = np.array([[1.0, dt], [0.0, 1.0]]) - np.outer([0.5 * dt**2, dt], [1.0, 3.0**0.5])
    rate = -np.log(np.abs(np.linalg.eigvals(step)).max()) / dt
    assert rate == pytest.approx(3.0**0.5 / 2.0, rel=0.01)
    assert lines["disagreement decays"].number == pytest.approx(-rate)
    assert found.rate == pytest.approx(rate) and found.theorem is None
    assert "disturbance, network" not in lines
    lines, found = checked({**follower, "feedforward": "relay"}, **chain)
    assert lines["coupling"].verdict is Verdict.FAILS


def written(gain, model="planar-quadrotor", agents=3):
    Path("mine.yaml").write_text(
        f"name: mine\nmodel: {{name: {model}}}\ngraph: {{name: path, agents: {agents}}}\n"
        f"follower: {{gain: {{{gain}}}}}\nsimulation: {{horizon: 1.0, dt: 0.001}}\n"
    )


@pytest.mark.parametrize("command", ["check", "design"])
def test_bad_input_is_one_sentence(echelon, command):
    domain = "method: robust-lqr, domain"
    for model, gain, sentence in (
        ("quadrotor", f"{domain}: {{pitch: 1.6}}", "holds only inside (-1.571"),
        ("pendulum", f"{domain}: {{angle: [0.5, 0.2]}}", "lower end below its up"),
        ("pendulum", f"{domain}: {{angle: [0.0, 0.0]}}", "lower end below its up"),
        ("pendulum", "method: given, P: [1.0, .nan]", "allowed is a number from"),
        ("pendulum", f"{domain}: {{angle: .inf}}", "allowed is a number from"),
    ):
        written(gain, model)
        code, out, err = echelon(command, "mine.yaml")
        assert code == 2 and out == ""
        assert err.count("\n") == 1 and err.startswith("echelon: ") and sentence in err


def test_a_gain_file_keeps_its_region_and_is_of_its_model_and_graph_alone(echelon):
    written("method: robust-lqr, domain: {angle: 0.5}", "pendulum")
    before = json.loads(echelon("check", "mine.yaml", "--json")[1])
    assert echelon("design", "mine.yaml", "--method", "robust-lqr", "--out", "gain.json")[0] == 0
    written("file: gain.json", "pendulum")
    code, out, _ = echelon("check", "mine.yaml", "--json")
    assert code == 0 and json.loads(out) == before and before["guarantee"]["theorem"] == "T1"
    for agents, model, sentence in (
        (5, "pendulum", "made for a graph of 3 agents"),
        (3, "van-der-pol", "was made for `Pendulum` with state_names"),
    ):
        written("file: gain.json", model, agents)
        code, _, err = echelon("check", "mine.yaml")
        assert code == 2 and sentence in err and err.count("\n") == 1


def test_a_missing_solver_names_its_pip_line(echelon, monkeypatch):
    monkeypatch.setitem(sys.modules, "cvxpy", None)
    written("method: robust-lqr, domain: {angle: 0.5}", "pendulum")
    code, _, err = echelon("check", "mine.yaml")
    assert code == 4 and "pip install" in err and err.count("\n") == 1
