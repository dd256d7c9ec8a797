"""Gain files with false claims: each is refused because of the false claim."""

import copy
import json
from fractions import Fraction
from itertools import product as combinations
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import planted_faults as STUDY
import pytest
import scipy.linalg
from hypothesis import example, given
from hypothesis import strategies as st

import echelon as ech
from echelon.guarantees.verifier import agent_claims, algebra
from echelon.guarantees.verifier.saved_gain import SavedGraph, SavedRegion

LINE = ech.Graph.path(4)


def agent(drift, input_map=jnp.ones_like, size=1):
    """A model of `size` states and one input, of functions of the state vector."""

    class Agent(ech.ControlAffine):
        state_names = tuple(f"x{k}" for k in range(size))
        input_names = ("u",)

        def drift(self, x):
            return drift(x)

        def input_map(self, x):
            return input_map(x)[:, None]

    return Agent()


@pytest.fixture
def said(tmp_path):
    """Verify a file's content: what is refused, or the sentence of what is no gain."""

    def call(told, model=None):
        file = tmp_path / "gain.json"
        file.write_text(told if isinstance(told, str) else json.dumps(told), "utf-8")
        try:
            found = ech.verify(file, model)
        except ech.EchelonError as error:
            return str(error)
        return [each.claim for each in found.findings if each.verdict == "refused"]

    return call


def saved(model, graph, method, folder):
    ech.save_gain(ech.synthesize(model, graph, method), model, graph, folder / "made.json")
    return json.loads((folder / "made.json").read_text("utf-8"))


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """Files as they are written, by name."""
    folder, pendulum = tmp_path_factory.mktemp("gains"), ech.models.Pendulum()
    plain, flat = agent(lambda x: -x), ech.models.Linear(np.eye(2), [[1.0], [1.0]])
    cases = {
        "proof": (pendulum, ech.gains.Contraction({"angle": 1.0}, rate=0.5)),
        "vertices": (pendulum, ech.gains.RobustLQR({"angle": (-0.6, 0.8)})),
        "drift": (pendulum, ech.gains.Monotone({"angle": 0.6})),
        "riccati": (pendulum, ech.gains.Riccati()),
        "plain": (plain, ech.gains.Contraction({"x0": 1.0}, rate=0.5)),
        "plain riccati": (plain, ech.gains.Riccati()),
        "growing": (flat, ech.gains.FixedGain(P=[[1.0, 0.0], [0.0, 1.0]], coupling=1.0)),
    }
    return {name: saved(model, LINE, method, folder) for name, (model, method) in cases.items()}


def edited(told, changes, value=None):
    """A copy in which entries at dotted paths are replaced, by a function of each or a value."""
    told = copy.deepcopy(told)
    for path, new in (changes if isinstance(changes, dict) else {changes: value}).items():
        part, (*way, last) = told, [int(key) if key.isdigit() else key for key in path.split(".")]
        for key in way:
            part = part[key]
        part[last] = new(part[last]) if callable(new) else new
    return told


CLAIM_OF = {
    "number of modes": ("certificate.modes", lambda x: x + 1),
    "graph": ("graph.edges.0", [1, 1, 1.0]),
    "lambda_min": ("certificate.lambda_min", lambda x: x * (1.0 + 1e-8)),
    "lambda_max": ("certificate.lambda_max", lambda x: x * (1.0 + 1e-8)),
    "kind of the slowest mode": ("certificate.kind", "samples"),
    "slowest mode, 1/s": ("certificate.abscissa", lambda x: x * (1.0 + 1e-6)),
    "observability rank": ("certificate.observable", 1),
    "the coupling is positive": ("coupling", 0.0),
    "strength": ("certificate.region.strength", lambda x: x * (1.0 + 1e-8)),
    "the rate is positive": ("certificate.region.rate", -5.0),
    "radius": ("certificate.region.radius", lambda x: x * (1.0 + 1e-8)),
    "the trim is an equilibrium": ("model.trim.1.0", 1e-6),
    "trim and input units": ("model.input_scale.0.0", 2.0),
    "R is symmetric and positive definite": ("R.0.0", 0.0),
}


@pytest.mark.parametrize("claim", CLAIM_OF)
def test_a_false_number_is_refused_by_the_claim_that_it_is_of(files, said, claim):
    assert claim in said(edited(files["proof"], *CLAIM_OF[claim]))


def test_a_metric_is_symmetric_to_rounding_and_for_a_proof_to_the_bit(files, said):
    claim = "P is symmetric and positive definite"
    for size, proof, vertices in ((1e-10, [claim], [claim]), (1e-15, None, [])):
        for name, wanted in (("proof", proof), ("vertices", vertices)):
            units = np.sqrt(np.prod(np.diag(files[name]["P"])))
            found = said(edited(files[name], "P.0.1", lambda x, s=size * units: x + s))
            assert found == (["rate at the vertices, proved"] if wanted is None else wanted)


REGION = "certificate.region"


def test_a_domain_that_leaves_out_the_trim_is_refused(files, said):
    for lower in ("lower", "input_lower"):
        told = edited(files["vertices"], f"{REGION}.domain.{lower}.0", 0.01)
        assert "the trim lies in the domain" in said(told)


def test_a_drift_that_expands_its_metric_is_refused_at_the_corners(files, said):
    assert files["drift"]["certificate"]["region"]["rate"] == 0.0
    assert said(files["drift"]) == []
    assert "the rate is positive" in said(edited(files["proof"], f"{REGION}.rate", 0.0))
    told = edited(files["drift"], "P.0.0", lambda x: 1.5 * x)
    assert "rate at 2 vertices, 1/s" in said(told)
    # Nor is it promised to contract, even where it does.
    told = edited(files["plain"], {f"{REGION}.theorem": "A5", f"{REGION}.kind": "vertices"})
    assert "rate at 1 vertex, 1/s" in said(edited(told, f"{REGION}.rate", 0.5))
    assert "rate at 1 vertex, 1/s" not in said(edited(told, f"{REGION}.rate", 0.0))


def test_the_set_of_a_drift_shrinks_where_inputs_act_unlike(said, tmp_path):
    model = agent(lambda x: -x, lambda x: 2.0 + jnp.sin(x))
    told = saved(model, LINE, ech.gains.Monotone({"x0": 1.0}), tmp_path)
    assert said(told, model) == []
    # Of one state, x'P x <= r^2 reaches 1 at r^2 = P; the sums differ by the ends of the spectrum.
    low, high = told["graph"]["spectrum"][0], told["graph"]["spectrum"][-1]
    widest, radius = np.sqrt(told["P"][0][0]), told["certificate"]["region"]["radius"]
    assert radius == pytest.approx(widest * np.sqrt(low / high), rel=1e-9)
    for wrong in (1.001 * radius, widest, widest * np.sqrt(high / low)):
        assert said(edited(told, f"{REGION}.radius", wrong), model) != []


UNPROVED = "rate at the vertices, proved"


def test_a_rate_that_is_a_little_too_fast_is_refused_at_the_corners(files, said):
    for name, proofs in (("proof", [UNPROVED]), ("vertices", [])):
        told = edited(files[name], f"{REGION}.rate", lambda x: 1.05 * x)
        vertices = [claim for claim in said(told) if "vertices" in claim]
        assert vertices == ["rate at 2 vertices, 1/s", *proofs]
    # A proof for the drift alone may not need the coupling.
    told = edited(files["proof"], {f"{REGION}.theorem": "A5", f"{REGION}.rate": 0.0})
    assert UNPROVED in said(edited(told, f"{REGION}.strength", 0.0))
    # With the strength left standing, the corners hold by eigenvalues and the proof does not.
    assert {UNPROVED, "strength"} <= set(said(told))
    # A small error in one column of the corners is carried by a proof.
    assert said(edited(files["proof"], f"{REGION}.error.0.1", 1e-9)) == []
    for place in ("0.0", "0.1", "1.0", "1.1"):
        assert said(edited(files["proof"], f"{REGION}.error.{place}", 10.0)) == [UNPROVED]
        assert UNPROVED in said(edited(files["proof"], f"{REGION}.error.{place}", -1e-9))


def rate_at_the_trim(told):
    A, B = np.array(told["model"]["A"]), np.array(told["model"]["B"])
    P, R = np.array(told["P"]), np.array(told["R"])
    held = told["certificate"]["region"]["strength"] * P @ B @ np.linalg.solve(R, B.T @ P)
    return -0.5 * float(scipy.linalg.eigh(P @ A + A.T @ P - held, P, eigvals_only=True)[-1])


def test_a_file_whose_model_cannot_be_made_is_incomplete_whatever_its_hull(
    files, tmp_path, echelon
):
    told, file = files["vertices"], tmp_path / "gain.json"
    trim_alone = {"base": told["model"]["A"], "places": [], "values": []}
    told = edited(told, {f"{REGION}.hull": trim_alone, f"{REGION}.error": [[0.0, 0.0]] * 2})
    told = edited(told, f"{REGION}.rate", rate_at_the_trim(told))
    for path, value in (("model.parameters", None), ("model.class", "somebody.else:Pendulum")):
        file.write_text(json.dumps(edited(told, path, value)))
        found = ech.verify(file)
        assert found.verdict == "incomplete" and not found.holds
        assert found.sentence.endswith("not checked: equations of the model.")
    code, out, err = echelon("verify", file)
    assert (code, err) == (5, "") and found.sentence in " ".join(out.split())
    assert out.splitlines()[-1].endswith(f"echelon verify {file} --scenario SCENARIO")
    code, out, _ = echelon("verify", file, "--json")
    told = json.loads(out)
    assert code == 5 and (told["verdict"], told["holds"]) == ("incomplete", False)


def test_the_model_of_a_scenario_completes_the_check(tmp_path, echelon):
    (tmp_path / "own.py").write_text(
        "import jax.numpy as jnp\nimport echelon as ech\n"
        "class Own(ech.ControlAffine):\n"
        "    state_names, input_names = ('x',), ('u',)\n"
        "    def drift(self, x): return -x\n"
        "    def input_map(self, x): return jnp.ones((1, 1), x.dtype)\n"
    )
    (tmp_path / "own.yaml").write_text(
        "name: own\nmodel: {python: 'own.py:Own'}\ngraph: {name: path, agents: 4}\n"
        "follower: {gain: {method: riccati}}\nsimulation: {horizon: 1.0, dt: 0.1}\n"
    )
    told = tmp_path / "gain.json"
    code, _, err = echelon("design", tmp_path / "own.yaml", "--method", "riccati", "--out", told)
    assert (code, err) == (0, "")
    assert echelon("verify", told)[0] == 5
    assert echelon("verify", told, "--scenario", tmp_path / "own.yaml")[0] == 0


def test_a_small_graph_has_edges_with_weights_and_not_too_many_agents(files, said):
    told = edited(files["riccati"], "graph.edges", None)
    for key in ("lambda_min", "lambda_max"):
        told["certificate"][key] *= 1000.0
    told["graph"]["spectrum"] = [1000.0 * x for x in told["graph"]["spectrum"]]
    assert "`graph.edges` must not be null: 4 agents have fewer edges than the limit." in said(told)
    # Without weight it moves nobody, and the spectrum is the same.
    weightless = edited(files["riccati"], "graph.edges", lambda x: [*x, [0, 2, 0.0]])
    assert said(weightless) == ["graph"]
    words = "`graph.agents` must be a whole number from 2 on (to 1e9)"
    for agents, refused in ((10**9 + 1, True), (10**9, False)):
        assert (words in said(edited(files["riccati"], "graph.agents", agents))) == refused


def test_of_two_equal_keys_none_is_read(files, said):
    text = json.dumps(files["riccati"])
    twice = text[:-1] + ', "coupling": 1e-9}'
    assert said(twice).endswith("gain.json` is not valid JSON: `coupling` occurs twice.")
    inner = text.replace('"lambda_min":', '"lambda_min": 1e3, "lambda_min":')
    assert said(inner).endswith("`lambda_min` occurs twice.")


def test_a_rate_that_rounding_leaves_open_is_refused(files, said):
    # Every state grows as e^t, and in a metric this close to singular rounding is of that size.
    told, narrow = copy.deepcopy(files["growing"]), 2.0**-50
    P = np.array([[1.0, 1.0 - narrow], [1.0 - narrow, 1.0]])
    reach = np.linalg.norm(scipy.linalg.solve_triangular(np.linalg.cholesky(P), np.eye(2)), axis=0)
    told["P"], told["certificate"]["observable"] = P.tolist(), 1
    told["certificate"]["region"] = {
        "kind": "vertices",
        "theorem": "T1",
        "rate": 5.33,
        "radius": float(1.0 / reach.max()),
        "strength": 2.0 * told["certificate"]["lambda_min"],
        "domain": {"lower": [-1, -1], "upper": [1, 1], "input_lower": [0], "input_upper": [0]},
        "hull": {"base": [[1, 0], [0, 1]], "places": [], "values": []},
        "error": [[0, 0], [0, 0]],
    }
    STUDY.abscissa_put_right(told)
    for changes in ({}, {"theorem": "A5", "rate": 0.0, "strength": 0.0}):
        told["certificate"]["region"] |= changes
        assert {"rate at 1 vertex, 1/s", "rate at 260 states, 1/s"} <= set(said(told))


def test_the_sign_of_a_mode_that_rounding_leaves_open_is_refused(said, tmp_path):
    # It grows at 1e-5 1/s, and rounding at 1e10 rad/s is 1e-4 1/s.
    model = ech.models.Linear([[0.0, 1e10], [-1e10, 2e-5]], [[0.0], [1.0]])
    method = ech.gains.FixedGain(P=[[1.0, 0.0], [0.0, 1.0]], coupling=1e-9)
    told = saved(model, LINE, method, tmp_path)
    assert said(told) == []
    for claimed in (-1.4e-4, -1e-5, -1e-12):
        assert said(edited(told, "certificate.abscissa", claimed)) == ["slowest mode, 1/s"]


@pytest.mark.parametrize("units", [[1.0, 1.0], [1.0, 0.1]])
def test_honest_gains_with_a_badly_conditioned_input_weight_are_accepted(said, tmp_path, units):
    turn = np.linalg.qr(np.random.default_rng(0).normal(size=(2, 2)))[0]
    R = np.outer(units, units) * (turn @ np.diag([1.0, 1e9]) @ turn.T)
    method = ech.gains.Riccati(R=(0.5 * (R + R.T)).tolist())
    told = saved(ech.models.DoubleIntegrator(2), LINE, method, tmp_path)
    assert said(told) == []
    faster = edited(told, "certificate.abscissa", lambda x: x * (1.0 + 1e-5))
    assert said(faster) == ["slowest mode, 1/s"]


def exact_bounds(edges, agents, leaders):
    """lambda_min to 12 digits, by bisection with exact signs of minors."""
    graph = SavedGraph(agents, leaders, edges, np.zeros(1))
    rows = algebra.grounded_rows(graph, edges)

    def below(x):
        shifted = [[v - x * (i == j) for j, v in enumerate(row)] for i, row in enumerate(rows)]
        return algebra.is_positive_definite(shifted)

    low, high = Fraction(1, 2**90), Fraction(2**90)
    while high > low * (1 + Fraction(1, 10**13)):
        # Halved in exponents first, since the weights are of all sizes.
        middle = Fraction(float(low) ** 0.5 * float(high) ** 0.5)
        low, high = (middle, high) if below(middle) else (low, middle)
    return float(low), float(high)


@given(st.integers(0, 10**6))
@example(14671)  # the next eigenvalue is a quarter larger, and of agents far away
def test_the_smallest_eigenvalue_is_known_to_all_digits_whatever_the_weights(seed):
    random = np.random.default_rng(seed)
    tree = [(int(random.integers(k)), k) for k in range(1, 6)]
    more = [pair for pair in ((0, 5), (1, 4), (2, 5), (3, 5)) if pair not in tree]
    pairs = tree + more[: random.integers(len(more) + 1)]
    edges = np.array([(i, j, 10.0 ** random.uniform(-8.0, 13.0)) for i, j in pairs])
    values, bound = algebra.spectrum(SavedGraph(6, (0,), edges, np.zeros(1)), edges)
    low, high = exact_bounds(edges, 6, (0,))
    assert low * (1.0 - 1e-12) <= values[0] <= high * (1.0 + 1e-12)
    assert bound <= high and bound >= low * (1.0 - 1e-10)


def test_an_agent_that_is_not_reached_has_eigenvalue_zero(files, said):
    edges = np.array([(0, 1, 1.0), (2, 3, 1e-3)])
    found = algebra.spectrum(SavedGraph(4, (0,), edges, np.zeros(1)), edges)
    assert (found.values[0], found.bound) == (0.0, 0.0)
    told = edited(files["riccati"], "graph.edges", [[0, 1, 1.0], [1, 2, 1.0], [0, 2, 1.0]])
    assert "lambda_min is positive" in said(told)


def between(graph, folder):
    """Agents that are stable for weak and for strong feedback, and for none between.

    The roots were drawn. Returns the file, the drift (4, 4) and the feedback (4,).
    """
    a, k = [0.08033771, 0.83319848, 2.60835077, 2.917598], [204.267, 187.671, 50.974, 0.26772]
    A = np.vstack([np.eye(4)[1:], np.negative(a)])
    P = np.diag([1e6, 1e6, 1e6, k[3]])
    P[3, :3] = P[:3, 3] = k[:3]
    model = ech.models.Linear(A, np.eye(4)[:, 3:])
    told = saved(model, graph, ech.gains.FixedGain(P=P.tolist(), coupling=1.0), folder)
    return told, A, np.array(k)


def test_an_eigenvalue_is_known_to_rounding_of_the_largest(said, tmp_path):
    one, stiff, weak = 1.3, 3.7e12, 1e-4
    graph = ech.Graph([(0, 1, one), (1, 2, stiff), (0, 3, weak)])
    told, A, k = between(graph, tmp_path)
    # Of one s = x^2 - (one + 2 stiff) x + one stiff: the small root by the product of both.
    largest = 0.5 * ((one + 2 * stiff) + np.sqrt((one + 2 * stiff) ** 2 - 4 * one * stiff))
    feedback = one * stiff / largest * np.outer(np.eye(4)[3], k)
    true = float(np.linalg.eigvals(A - feedback).real.max())
    assert true > 0.2  # the mode between is the slowest
    assert said(edited(told, "certificate.abscissa", true)) == []
    assert said(edited(told, "certificate.abscissa", 0.9 * true)) == ["slowest mode, 1/s"]


def test_modes_between_those_that_were_looked_at_must_decay(said, tmp_path):
    told, _, _ = between(ech.Graph.path(461), tmp_path)
    told["certificate"]["modes"], spectrum = 2, told["graph"]["spectrum"]
    told["graph"]["spectrum"] = [spectrum[0], spectrum[-1]]
    STUDY.abscissa_put_right(told)
    assert told["certificate"]["abscissa"] < -0.1
    assert said(told) == ["all modes between decay"]
    assert "all modes between decay" in said(edited(told, "graph.edges", None))


@jax.custom_jvp
def slippery(x):
    return 5.0 * x


slippery.defjvp(lambda at, along: (slippery(at[0]), 0.0 * along[0]))

# Every derivative that JAX finds of these is -1.
FALSE_SLOPES = {
    "a step": lambda x: 5.0 * jnp.where(x > 1e-3, 1.0, 0.0),
    "a low step far off": lambda x: 0.01 * jnp.where(x > 0.3, 1.0, 0.0),
    "a sign": lambda x: 5.0 * jnp.sign(x),
    "Heaviside's function": lambda x: 5.0 * jnp.heaviside(x - 0.2, 0.0),
    "rounding": lambda x: 0.5 * jnp.round(2.0 * x),
    "a stopped gradient": lambda x: 5.0 * jax.lax.stop_gradient(x),
    "a small one": lambda x: 1e-3 * jax.lax.stop_gradient(x),
    "one on a part": lambda x: jnp.where(x > 0.5, jax.lax.stop_gradient(x - 0.5), 0.0),
    "another slope": slippery,
    "another slope on a part": lambda x: slippery(jnp.maximum(x - 0.5, 0.0)) * 0.2,
}


SAMPLED = {f"{REGION}.kind": "samples", f"{REGION}.error": [[0.0]]}


@pytest.mark.parametrize("name", FALSE_SLOPES)
def test_a_drift_that_its_derivatives_do_not_tell_of_leaves_the_hull(files, said, name):
    model = agent(lambda x: -x + FALSE_SLOPES[name](x))
    told = edited(files["plain"], "model.parameters", None)
    assert said(told, agent(lambda x: -x)) == []
    assert "secants lie in the hull" in said(told, model)
    if name != "a small one":  # which leaves the rate of pairs within what samples promise
        assert "pairs converge at the rate" in said(edited(told, SAMPLED), model)


AT_THE_TRIM = {
    **{name: FALSE_SLOPES[name] for name in ("a sign", "a stopped gradient", "a small one")},
    "another slope": slippery,
    "a bend to the right": jax.nn.relu,
    "a bend to the left": lambda x: jax.nn.relu(-x),
}


@pytest.mark.parametrize("name", AT_THE_TRIM)
def test_a_slope_at_the_trim_that_is_none_is_refused(files, said, name):
    model = agent(lambda x: -x + AT_THE_TRIM[name](x))
    assert said(files["plain riccati"], model) == ["A at the trim, by difference quotients"]


def test_samples_promise_a_rate_to_two_parts_in_a_hundred(said, tmp_path):
    method = ech.gains.Contraction({"x0": 1.0}, rate=1.0)
    told = saved(agent(lambda x: -4.0 * x), LINE, method, tmp_path)
    rate, turn = rate_at_the_trim(told), 2.0 * np.pi
    told = edited(told, SAMPLED | {f"{REGION}.rate": rate})
    for slower, wanted in (
        (0.015, []),
        (0.025, ["pairs converge at the rate", "rate at 258 states, 1/s"]),
    ):
        # Its slope is -4 at the trim and at the corners, and -4 + height between them.
        height = slower * rate
        model = agent(lambda x, h=height: -4.0 * x + h * (x / 2 - jnp.sin(turn * x) / (2 * turn)))
        assert said(told, model) == wanted


def test_a_curved_agent_has_its_slope_at_the_trim(said, tmp_path):
    for model in (
        agent(lambda x: -x + 40.0 * x**2),
        agent(lambda x: x**2 * jnp.sign(x)),
        agent(lambda x: jnp.sin(9.0 * x), lambda x: 2.0 + jnp.sin(x)),
    ):
        assert said(saved(model, LINE, ech.gains.Riccati(), tmp_path), model) == []


OUTSIDE = "Jacobians lie in the hull"
NARROW = agent(lambda x: -x + 0.05 * jnp.exp(-(((x - 0.3) / 0.003) ** 2)))
BEYOND = {
    "an input map that switches": (
        agent(lambda x: -x, lambda x: jnp.where(x > 0.5, 0.0, 1.0)),
        "g is constant (T1)",
    ),
    "no number on a part": (agent(lambda x: -x + 0.0 * jnp.sqrt(0.9 - x)), OUTSIDE),
    "a steep place": (agent(lambda x: -x + 1e-4 * jnp.tanh(x / 1e-4)), OUTSIDE),
    "a narrow bump": (NARROW, "secants lie in the hull"),
}


@pytest.mark.parametrize("name", BEYOND)
def test_what_happens_on_a_part_of_the_domain_is_seen(files, said, name):
    model, claim = BEYOND[name]
    assert claim in said(files["plain"], model)


def test_a_branch_far_off_along_a_state_without_bounds_is_seen(said, tmp_path):
    def model(far):
        return agent(
            lambda x: jnp.stack([x[1], -x[1] + far(x[0])]),
            lambda x: jnp.array([0.0, 1.0], x.dtype),
            2,
        )

    plain = model(jnp.zeros_like)
    told = saved(plain, LINE, ech.gains.RobustLQR({"x1": 2.0}), tmp_path)
    assert said(told, plain) == []
    beyond = model(lambda x: 50.0 * jnp.maximum(x - 40.0, 0.0))
    assert "secants lie in the hull" in said(told, beyond)


def test_a_model_that_fails_has_its_sentence(files, tmp_path):
    def fails(x):
        raise RuntimeError("no such wind\nfor long")

    (tmp_path / "gain.json").write_text(json.dumps(files["plain"]))
    found = ech.verify(tmp_path / "gain.json", agent(fails))
    assert found.verdict == "refused"
    assert found.findings[-1].text == "Agent cannot be evaluated: no such wind"
    for wrong in (agent(lambda x: jnp.zeros(3)), agent(lambda x: -x, lambda x: jnp.zeros(5))):
        assert ech.verify(tmp_path / "gain.json", wrong).verdict == "refused"


def test_a_gain_about_another_equilibrium_or_in_other_units_is_not_that_of_the_model(files, said):
    tens = {"model.input_scale.0.0": 10.0, "R.0.0": lambda x: 100.0 * x}
    tens |= {f"model.B.{k}.0": lambda x: 10.0 * x for k in range(2)}
    assert said(edited(files["riccati"], tens)) == ["trim and input units"]

    class Upturned(ech.models.Pendulum):
        trim = ((np.pi, 0.0), (0.0,))

    assert "trim and input units" in said(files["riccati"], Upturned())


def test_a_domain_stays_where_the_equations_hold(files, said):
    for chart, refused in (((-0.5, 2.0), True), ((-2.0, 1.0), True), ((-1.1, 1.1), False)):
        model = agent(lambda x: -x)
        type(model).chart = {"x0": chart}
        assert said(files["plain"], model) == ["the domain lies inside the chart"] * refused


def domain(bounded, lower=-1.0):
    """A gain, as far as points ask for it, and a domain of six states and of four inputs.

    Of these ten, the first `bounded` have bounds.
    """
    low = np.where(np.arange(10) < bounded, lower, -np.inf)
    high = np.where(np.arange(10) < bounded, 2.0, np.inf)
    bounds = (low[:6], high[:6], low[6:], high[6:])
    hull, error = np.zeros((1, 6, 6)), np.zeros((6, 6))
    gain = SimpleNamespace(P=np.eye(6))
    return gain, SavedRegion("vertices", "T1", 1.0, None, 1.0, *bounds, hull, error)


def test_all_corners_are_looked_at_while_they_are_few():
    for bounded in (0, 1, 4, 7, 8, 10):
        found = agent_claims.points(*domain(bounded))
        x = np.hstack([found.states, found.inputs])
        # As many random points and points of the lattice as of random corners.
        assert len(x) == (2**bounded if bounded <= 7 else 128) + 256
        assert found.corners == (2**bounded if bounded <= 7 else 0)
        corners = {tuple(row) for row in x[: found.corners, :bounded]}
        assert len(corners) == found.corners
        assert corners <= set(combinations((-1.0, 2.0), repeat=bounded))
        assert ((x[:, :bounded] >= -1.0) & (x[:, :bounded] <= 2.0)).all()
        assert (x[-1] == 0.0).all()


def test_a_quarter_of_the_pairs_is_about_the_trim_and_a_quarter_about_other_points():
    gain, region = domain(6)
    known = agent_claims.points(gain, region)
    ones, others, _ = agent_claims.pairs(gain, region, known)
    middle, apart = 0.5 * (ones + others), np.abs(ones - others).max(axis=1)
    at_rest = (np.abs(middle) <= 0.5 * apart[:, None]).all(axis=1) & (apart < 0.1)
    near = (np.abs(middle - known.states) <= apart[:, None]).all(axis=1) & (apart < 0.1)
    assert at_rest.sum() >= 0.15 * len(ones) and (near & ~at_rest).sum() >= 0.15 * len(ones)
    assert (apart > 0.5).sum() >= 0.4 * len(ones)
    assert apart[apart > 0.0].min() < 1e-4


@given(st.integers(0, 10**6))
def test_means_of_corners_have_secants_in_bounds_that_some_corner_reaches(seed):
    random = np.random.default_rng(seed)
    hull, error = random.normal(size=(300, 3, 3)), np.abs(random.normal(size=(3, 3)))
    normals, steps = random.normal(size=(2, 20, 3))
    bounds = agent_claims.support(hull, 0.0 * error, normals, steps)
    every = np.einsum("kn,hnm,km->kh", normals, hull, steps)
    assert bounds.high == pytest.approx(every.max(axis=1), rel=1e-12)
    assert bounds.low == pytest.approx(every.min(axis=1), rel=1e-12)
    sizes = np.abs(normals)[:, None] @ np.abs(hull).max(axis=0) @ np.abs(steps)[:, :, None]
    assert bounds.size == pytest.approx(sizes[:, 0, 0], rel=1e-12)
    wider = agent_claims.support(hull, error, normals, steps)
    for signs in combinations((-1.0, 1.0), repeat=2):
        moved = np.einsum("kn,nm,km->k", normals, error * np.outer([1, *signs], [1, 1, 1]), steps)
        assert (bounds.high + moved <= wider.high + 1e-12).all()
        assert (bounds.low + moved >= wider.low - 1e-12).all()


def test_a_jump_is_found_by_halving_however_low_it_is():
    at, height = 0.123456, 1e-4
    x, y = np.array([[1.0]]), np.array([[-1.0]])
    hull, exact = np.array([[[-1.0]], [[1.0]]]), np.zeros((1, 1))
    bounds, small = (agent_claims.support(size * hull, exact, x, x - y) for size in (1.0, 1e-6))

    def found(function, slack=0.0, within=bounds):
        return agent_claims.steepest(lambda z: (function(z), slack + 0.0 * z), x, y, x, within)

    def velocity(states):
        return 0.5 * states + height * (states > at)

    assert found(velocity) > 1.0 and found(lambda z: 0.5 * z) < 0.0
    # In other units it is the same.
    in_micro = found(lambda z: 1e-6 * velocity(z), within=small)
    assert in_micro == pytest.approx(found(velocity), rel=1e-9)
    # What rounding may be is taken off.
    assert found(velocity, height) < 0.0 and found(lambda z: z * np.nan) == np.inf


def test_samples_are_measured_by_the_nearest_matrix_as_a_part_of_the_largest():
    known = np.array([[[4.0, 1.0]], [[2.0, 0.0]]])
    near, from_all = [[2.0, 0.004]], agent_claims.farthest_from_all
    assert from_all(known, np.array([near])) == pytest.approx(1e-3)
    assert from_all(known, np.array([near, [[4.4, 1.0]]])) == pytest.approx(0.1)
    assert from_all(known, np.array([[[np.nan, 1.0]], near])) == np.inf
    assert from_all(0.0 * known, 0.0 * known) == 0.0
    # No matrix that is no number lies in a hull.
    hull = np.array([[[0.0, 1.0]], [[2.0, 1.0]]])
    for wrong in ([[np.nan, 1.0]], [[1.0, np.nan]], [[np.inf, 1.0]]):
        samples = np.array([[[1.0, 1.0]], wrong, [[1.0, 1.0]]])
        assert agent_claims.farthest_outside(hull, np.zeros((1, 2)), samples) == np.inf


@given(st.integers(0, 10**6))
def test_a_proof_at_a_corner_holds_for_every_matrix_within_its_error(seed):
    random = np.random.default_rng(seed)
    A = random.normal(size=(2, 2)) - 2.0 * np.eye(2)
    M = random.normal(size=(2, 2))
    P, error = M @ M.T + np.eye(2), np.abs(random.normal(size=(2, 2))) * 0.3
    error[:, random.integers(2)] = 0.0
    B, R = np.array([[0.0], [1.0]]), np.eye(1)

    def slowest(A):
        turned = P @ A + (P @ A).T - 0.4 * P @ B @ B.T @ P
        return -0.5 * scipy.linalg.eigh(turned, P, eigvals_only=True)[-1]

    # The largest rate that Gershgorin's rows leave, by the formula of the docstring in floats.
    spread = np.abs(P) @ error
    lost = np.diag(spread.sum(axis=0) + spread.sum(axis=1))
    held = 0.4 * P @ B @ B.T @ P
    edge = -0.5 * scipy.linalg.eigh(P @ A + A.T @ P - held + lost, P, eigvals_only=True)[-1]
    parts, strength = (P, B, R, A[None]), Fraction(2, 5)
    for moved in (error, -error):
        assert algebra.first_unproved(*parts, moved, strength, edge - 1e-9) is None
        assert algebra.first_unproved(*parts, moved, strength, edge + 1e-9) == 0
    signs = [np.reshape(s, (2, 2)) for s in combinations((-1.0, 1.0), repeat=4)]
    assert all(slowest(A + s * error) >= edge - 1e-9 for s in signs)
    # Without an error it is the rate itself that decides.
    assert algebra.first_unproved(*parts, 0.0 * error, strength, slowest(A) - 1e-9) is None
    assert algebra.first_unproved(*parts, 0.0 * error, strength, slowest(A) + 1e-9) == 0
    two = (P, B, R, np.stack([A - np.eye(2), A]))
    assert algebra.first_unproved(*two, 0.0 * error, strength, slowest(A) + 1e-9) == 1
