"""`design`: the table of methods, the recommendation, and pictures that claim no more than it."""

import json

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
from runs import simulate

import echelon as ech
from echelon.core.digits import at_most
from echelon.experiments.studies.basin import (
    chosen_slice,
    converged,
    observed_radius,
    side_of,
    slice_of,
    trial,
)
from echelon.experiments.studies.design import because, recommended
from echelon.output.plots.study_figures import save_design_figures

PATH = ech.Graph.path(4)


class Cubic(ech.ControlAffine):
    """x' = -x + x^3, which no input moves, beside y' = -y + u: it returns from |x| < 1 alone."""

    state_names = ("x", "y")
    input_names = ("u",)

    def drift(self, x):
        return jnp.stack([-x[0] + x[0] ** 3, -x[1]])

    def input_map(self, x):
        return jnp.array([[0.0], [1.0]], x.dtype)


SCENARIO = """
name: mine
model: {name: pendulum}
graph: {name: path, agents: 4}
leader: {law: passive}
follower: {gain: {method: robust-lqr, domain: {angle: 0.5}}}
simulation: {horizon: 1.0, dt: 0.01}
"""


@pytest.fixture
def echelon(echelon, here):
    (here / "mine.yaml").write_text(SCENARIO)
    return echelon


def parts_of(scenario):
    return ech.build(ech.load_scenario(scenario))


# ---- the table ----


def test_what_is_said_to_be_missing_is_accepted_where_it_is_said_to_go():
    rows = {row.method: row for row in ech.design(ech.load_scenario("van-der-pol")).designs}
    reason = rows["robust-lqr"].reason
    assert reason == (
        "set `follower.gain={method: robust-lqr, domain: {position: HALF_WIDTH, ...}}` to try it"
    )
    advice = reason.split("`")[1].replace("HALF_WIDTH, ...", "0.5")
    gain = ech.load_scenario("van-der-pol", [advice]).follower.gain
    assert gain.method == "robust-lqr" and gain.domain == {"position": 0.5}


def test_a_law_without_a_gain_is_advised_one_that_takes_it():
    rows = {row.method: row for row in ech.design(ech.load_scenario("integrators")).designs}
    advice = rows["robust-lqr"].reason.split("`")[1].replace("HALF_WIDTH, ...", "0.5")
    follower = ech.load_scenario("integrators", [advice]).follower
    assert follower.law == "consensus" and follower.gain.method == "robust-lqr"


def test_a_scenario_whose_own_gain_cannot_be_made_has_the_other_methods_tried():
    # The Jacobian depends on the velocity too, which the domain does not bound.
    own = "follower.gain={method: robust-lqr, domain: {position: 0.5}}"
    scenario = ech.load_scenario("van-der-pol", [own])
    with pytest.raises(ech.EchelonError, match="unbounded"):
        ech.build(scenario)
    found = ech.design(scenario)
    rows = {row.method: row for row in found.designs}
    assert rows["robust-lqr"].gain is None and "unbounded" in rows["robust-lqr"].reason
    assert rows["riccati"].stable and found.recommended is rows["riccati"]


def test_a_gain_file_that_is_missing_ends_a_design():
    scenario = ech.load_scenario("van-der-pol", ["follower.gain={file: nowhere.json}"])
    with pytest.raises(ech.EchelonError, match=r"nowhere\.json"):
        ech.design(scenario)


def test_every_method_has_its_row_and_the_numbers_are_those_of_its_gain(echelon):
    code, out, err = echelon("design", "mine.yaml", "--json")
    told = json.loads(out, parse_constant=pytest.fail)
    rows = {row["method"]: row for row in told["methods"]}
    assert (code, err) == (0, "")
    assert set(rows) >= {"riccati", "inner-loop", "monotone", "robust-lqr", "contraction"}
    gain = ech.synthesize(ech.models.Pendulum(), PATH, ech.gains.RobustLQR({"angle": 0.5}))
    row, region = rows["robust-lqr"], gain.certificate.region
    assert row["condition"] == pytest.approx(np.linalg.cond(gain.P), rel=1e-4)
    assert row["radius"] == pytest.approx(region.radius, rel=1e-4)
    assert (row["kind"], row["theorem"]) == (str(region.kind), str(region.theorem))
    assert row["rate"] == region.rate and row["promise"]["hypotheses"]
    assert rows["inner-loop"]["reason"] and "coupling" not in rows["inner-loop"]
    strongest = max(
        ("proof", "vertices", "samples", None).index(row.get("kind"))
        for row in rows.values() if row["method"] == told["recommended"]
    )  # fmt: skip
    assert strongest <= 1 and told["because"].startswith(f"Recommended: {told['recommended']}. ")


def test_the_step_that_is_told_is_the_longest(echelon):
    _, out, _ = echelon("design", "mine.yaml", "--method", "riccati", "--json")
    (row,) = json.loads(out)["methods"]
    gain = ech.synthesize(ech.models.Pendulum(), PATH, ech.gains.Riccati())
    A, B = np.array([[0.0, 1.0], [-1.0, -0.5]]), np.array([[0.0], [1.0]])
    A[1, 0], A[1, 1] = -ech.models.Pendulum().stiffness, -ech.models.Pendulum().damping
    K = np.linalg.solve(gain.R, B.T @ gain.P)

    def grows(dt):
        radii = []
        for k in gain.coupling * PATH.spectrum().eigenvalues:
            flow = scipy.linalg.expm(dt * np.block([[A, B], [np.zeros((1, 3))]]))
            radii.append(np.abs(np.linalg.eigvals(flow[:2, :2] - k * flow[:2, 2:] @ K)).max())
        return max(radii) > 1.0

    assert grows(1.001 * row["longest_step"]) and not grows(0.999 * row["longest_step"])


def test_the_table_and_its_sentence_are_whole(echelon):
    code, out, _ = echelon("design", "mine.yaml")
    assert code == 0 and "dt up to" in out and "certified" in out and "delay" in out
    assert "- inner-loop: `Pendulum` has no symmetric state" in out
    tables = out.partition("(1)")[0]
    assert max(map(len, tables.splitlines())) <= 80
    sentence = out.splitlines()[-1]
    assert sentence.startswith("Recommended: ") and sentence.endswith("is short enough.")


def test_a_gain_that_needs_a_shorter_step_is_not_preferred_and_is_said_to(echelon):
    tried = ech.design(ech.load_scenario("paper")).designs
    steps = {d.method: d.step for d in tried if d.gain is not None}
    assert steps["riccati"] < steps["inner-loop"]
    between = 0.5 * (steps["riccati"] + steps["inner-loop"])
    assert recommended(tried, 0.005).method == "riccati"
    best = recommended(tried, between)
    assert best.method == "inner-loop"
    assert "Of 2 stable designs only this one is stable at the scenario's step." in (
        because(best, tried, between)
    )
    # The table has a faster one, and the sentence does not say otherwise.
    assert -best.promise.loop.slowest < max(-d.promise.loop.slowest for d in tried if d.stable)
    rate = at_most(-recommended(tried, 0.005).promise.loop.slowest)
    assert f"this one converges fastest ({rate} 1/s)" in (
        because(recommended(tried, 0.005), tried, 0.005)
    )
    long = recommended(tried, 1.0)
    assert "It needs a step below" in because(long, tried, 1.0)


def test_agents_whose_states_are_all_symmetric_have_an_inner_loop_too(echelon):
    code, out, _ = echelon("design", "integrators", "--json")
    rows = {row["method"]: row for row in json.loads(out)["methods"]}
    assert code == 0 and rows["inner-loop"]["reason"] == ""


# ---- the slice ----


@pytest.fixture(scope="module")
def cubic():
    parts = resting(Cubic(), ech.gains.FixedGain(P=[1.0, 1.0]))
    return trial(parts, ech.Settings(horizon=1.0, dt=0.01)), slice_of(parts, (0, 1))


def resting(model, method, feedforward="relay"):
    """Agents on a path behind a leader that rests, all on their goals."""
    gain = ech.synthesize(model, PATH, method)
    follower = ech.laws.Consensus(gain, feedforward=feedforward)
    goals = ech.Formation.from_offsets(model, PATH, {})
    return ech.Parts(model, PATH, goals, ech.Laws(ech.laws.TrimInput(), follower))


def test_a_known_basin_is_observed_and_not_overstated(cubic):
    run, plane = cubic
    radius = observed_radius(run, plane)
    # Three followers alike: r^2 = 3 (x^2 + y^2), and only |x| < 1 returns.
    ratio = 10.0 ** (3.0 / (side_of(3) - 1))
    assert 1.0 / ratio < plane.extents(radius)[0] < 1.0
    starts = np.array([[0.9, 0.0], [-0.9, 5.0], [1.1, 0.0], [0.0, 20.0], [-3.0, 0.0], [0.0, 0.0]])
    assert converged(run, plane, starts).tolist() == [True, True, False, True, False, True]


def test_the_ellipse_has_the_radius_that_it_says(cubic):
    _, plane = cubic
    points = plane.ellipse(2.0, 90)
    assert np.einsum("si,ij,sj->s", points, plane.form, points) == pytest.approx(4.0)
    assert np.abs(points).max(axis=0) == pytest.approx(plane.extents(2.0), rel=2e-3)


def test_a_slice_stays_inside_the_chart():
    agent = ech.models.Quadrotor()
    plane = slice_of(resting(agent, ech.gains.Riccati()), (0, agent.state_names.index("pitch")))
    assert plane.limits[1] < np.pi / 2 and plane.limits[0] == 30.0


def test_a_slice_runs_the_loop_that_simulate_runs():
    parts, settings = parts_of("planar-quadrotor")
    gain, model = parts.drive.gain, parts.model
    run = trial(parts, settings)
    pair = chosen_slice(model, "y,roll")
    for start in ([0.5, 0.2], [25.0, 1.0]):
        states = np.zeros((parts.graph.agents, len(model.state_names))) + np.array(model.trim[0])
        for follower in parts.graph.followers:
            states[follower, pair] += start
        result = simulate(
            model,
            parts.graph,
            ech.Formation.from_offsets(model, parts.graph, {}),
            leader=ech.laws.TrimInput(),
            follower=ech.laws.Consensus(gain, feedforward="relay"),
            initial=states,
            horizon=run.horizon,
            dt=0.005,
            store_every=run.steps,
        )
        y = result.states[[0, -1]][:, list(parts.graph.followers)] - np.array(model.trim[0])
        first, last = np.sqrt(np.einsum("tfi,ij,tfj->t", y, gain.P, y))
        plane = slice_of(parts, pair)
        assert converged(run, plane, np.array([start]))[0] == (last <= run.decay * first)


def test_the_pair_is_the_one_asked_for_or_a_telling_one():
    quad, cart = ech.models.Quadrotor(), ech.models.VanDerPol()
    assert chosen_slice(quad, " roll , y ") == (6, 1)
    velocity, angle = chosen_slice(quad, None)
    assert (quad.state_names[velocity], quad.state_names[angle]) in {
        ("vx", "pitch"),
        ("vy", "roll"),
    }
    assert chosen_slice(cart, None) == (0, 1)


@pytest.mark.parametrize(
    ("asked", "sentence"),
    [
        ("y,rol", "did you mean `roll`?"),
        ("y", "allowed are two different states such as `y,roll`."),
        ("y,y", "allowed are two different states such as `y,roll`."),
        ("y,z,roll", "allowed are two different states such as `y,roll`."),
    ],
)
def test_a_slice_that_is_none_is_one_sentence(asked, sentence):
    with pytest.raises(ech.EchelonError) as caught:
        chosen_slice(ech.models.Quadrotor(), asked)
    assert sentence in str(caught.value) and "`--slice`" in str(caught.value)


# ---- pictures ----


@pytest.mark.slow
def test_both_pictures_are_written_and_both_radii_are_said(echelon, tmp_path):
    call = ("design", "mine.yaml", "--method", "robust-lqr", "--figures", "figs")
    code, out, err = echelon(*call)
    assert (code, err) == (0, "")
    names = {path.name for path in (tmp_path / "figs").iterdir()}
    assert names == {
        f"{name}.{kind}" for name in ("modes", "certified_set") for kind in ("png", "pdf")
    }
    assert (tmp_path / "figs" / "modes.png").read_bytes()[:4] == b"\x89PNG"
    said = out.splitlines()[-1]
    gain = ech.synthesize(ech.models.Pendulum(), PATH, ech.gains.RobustLQR({"angle": 0.5}))
    assert f"certified {at_most(gain.certificate.region.radius)}; observed" in said
    code, _, err = echelon(*call, "--force", "--slice", "angle,rat")
    assert code == 2 and "did you mean `rate`?" in err and err.count("\n") == 1
    (tmp_path / "file").write_text("")
    code, _, err = echelon(*call[:-1], "file")
    assert code == 2 and "is a file; give a folder" in err and err.count("\n") == 1


def test_where_nothing_is_certified_the_picture_says_so(tmp_path):
    parts = resting(Cubic(), ech.gains.FixedGain(P=[1.0, 1.0]))
    _, radii = save_design_figures(parts, ech.Settings(horizon=1.0, dt=0.01), tmp_path)
    assert radii.certified is None and "certified none" in radii.sentence()
    assert radii.observed < radii.largest


def test_one_state_has_modes_and_no_slice(tmp_path):
    scenario = ech.scenario_from_mapping(
        {
            "name": "one",
            "model": {"name": "linear", "parameters": {"A": [[0.0]], "B": [[1.0]]}},
            "graph": {"name": "path", "agents": 3},
            "leader": {"law": "passive"},
            "simulation": {"horizon": 1.0, "dt": 0.01},
        }
    )
    paths, radii = save_design_figures(*ech.build(scenario), tmp_path)
    assert [path.name for path in paths] == ["modes.png", "modes.pdf"] and radii is None
