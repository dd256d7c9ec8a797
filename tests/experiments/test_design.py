"""`design`: the table of methods, the recommendation, and pictures that claim no more than it."""

import json
import re

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg

import echelon as ech
from echelon.core.digits import at_most
from echelon.experiments.studies import basin
from echelon.experiments.studies.design import because, recommended
from echelon.output.plots.study_figures import save_design_figures

PATH = ech.Graph.path(4)
EIGENVALUES = 2.0 - 2.0 * np.cos(np.pi * np.array([1.0, 3.0, 5.0]) / 7.0)


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


@pytest.mark.parametrize("scenario", ["van-der-pol", "integrators"])
def test_what_is_said_to_be_missing_is_accepted_where_it_is_said_to_go(scenario):
    rows = {row.method: row for row in ech.design(ech.load_scenario(scenario)).designs}
    reason = rows["robust-lqr"].reason
    advice = reason.split("`")[1]
    assert reason == f"set `{advice}` to try it" and "HALF_WIDTH, ...}" in advice
    follower = ech.load_scenario(scenario, [advice.replace("HALF_WIDTH, ...", "0.5")]).follower
    assert follower.law == "consensus"
    assert follower.gain.method == "robust-lqr" and follower.gain.domain == {"position": 0.5}
    # All states of an integrator are symmetric, and it has an inner loop too.
    assert (rows["inner-loop"].reason == "") or scenario != "integrators"


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
    # A file that is missing ends it.
    with pytest.raises(ech.EchelonError, match=r"nowhere\.json"):
        ech.design(ech.load_scenario("van-der-pol", ["follower.gain={file: nowhere.json}"]))


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
    assert row["rate"] == region.rate and row["guarantee"]["conditions"]
    assert rows["inner-loop"]["reason"] and "coupling" not in rows["inner-loop"]
    assert rows[told["recommended"]]["kind"] in ("proof", "vertices")
    assert told["because"].startswith(f"Recommended: {told['recommended']}. ")
    assert_longest_step(rows["riccati"]["longest_step"])


def assert_longest_step(step):
    """The exact flow of pendulums under inputs that are held grows at a longer step alone."""
    model = ech.models.Pendulum()
    gain = ech.synthesize(model, PATH, ech.gains.Riccati())
    A, B = np.array([[0.0, 1.0], [-model.stiffness, -model.damping]]), np.array([[0.0], [1.0]])
    K = np.linalg.solve(gain.R, B.T @ gain.P)
    for dt, grows in ((1.001 * step, True), (0.999 * step, False)):
        flow = scipy.linalg.expm(dt * np.block([[A, B], [np.zeros((1, 3))]]))[:2]
        loops = [flow[:, :2] - k * gain.coupling * flow[:, 2:] @ K for k in EIGENVALUES]
        assert (max(np.abs(np.linalg.eigvals(loop)).max() for loop in loops) > 1.0) == grows


def test_the_table_and_its_sentence_are_whole(echelon):
    code, out, _ = echelon("design", "mine.yaml")
    assert code == 0 and "dt up to" in out and "certified" in out and "delay" in out
    assert "- inner-loop: `Pendulum` has no symmetric state" in out
    tables = out.partition("(1)")[0]
    assert max(map(len, tables.splitlines())) <= 80
    sentence = out.splitlines()[-1]
    assert sentence.startswith("Recommended: ") and sentence.endswith("is short enough.")


@pytest.mark.slow
def test_a_gain_that_needs_a_shorter_step_is_not_preferred_and_is_said_to():
    tried = ech.design(ech.load_scenario("paper")).designs
    steps = {d.method: d.step for d in tried if d.gain is not None}
    assert steps["riccati"] < steps["inner-loop"]
    between = 0.5 * (steps["riccati"] + steps["inner-loop"])
    short, best, long = (recommended(tried, step) for step in (0.005, between, 1.0))
    assert (short.method, best.method) == ("riccati", "inner-loop")
    alone = "Of 2 stable designs only this one is stable at the scenario's step."
    assert alone in because(best, tried, between)
    # The table has a faster one, and the sentence does not say otherwise.
    assert -best.promise.loop.slowest < max(-d.promise.loop.slowest for d in tried if d.stable)
    fastest = f"this one converges fastest ({at_most(-short.promise.loop.slowest)} 1/s)"
    assert fastest in because(short, tried, 0.005)
    assert "It needs a step below" in because(long, tried, 1.0)


@pytest.fixture(scope="module")
def cubic():
    parts = resting(Cubic(), ech.gains.FixedGain(P=[1.0, 1.0]))
    return basin.trial(parts, ech.Settings(horizon=1.0, dt=0.01)), basin.slice_of(parts, (0, 1))


def resting(model, method, graph=PATH):
    """Agents behind a leader that rests, all on their goals."""
    follower = ech.laws.Consensus(ech.synthesize(model, graph, method), feedforward="relay")
    goals = ech.Formation.from_offsets(model, graph, {})
    return ech.Parts(model, graph, goals, ech.Laws(ech.laws.TrimInput(), follower))


def test_a_known_basin_is_observed_and_not_overstated(cubic):
    run, plane = cubic
    radius = basin.observed_radius(run, plane)
    # Three followers alike: r^2 = 3 (x^2 + y^2), and only |x| < 1 returns.
    ratio = 10.0 ** (3.0 / (basin.side_of(3) - 1))
    assert 1.0 / ratio < plane.extents(radius)[0] < 1.0
    starts = np.array([[0.9, 0.0], [-0.9, 5.0], [1.1, 0.0], [0.0, 20.0], [-3.0, 0.0], [0.0, 0.0]])
    assert basin.converged(run, plane, starts).tolist() == [True, True, False, True, False, True]
    points = plane.ellipse(2.0, 90)
    assert np.einsum("si,ij,sj->s", points, plane.form, points) == pytest.approx(4.0)
    assert np.abs(points).max(axis=0) == pytest.approx(plane.extents(2.0), rel=2e-3)


def test_a_slice_stays_inside_the_chart():
    agent = ech.models.Quadrotor()
    plane = basin.slice_of(
        resting(agent, ech.gains.Riccati()), (0, agent.state_names.index("pitch"))
    )
    assert plane.limits[1] < np.pi / 2 and plane.limits[0] == 30.0


def test_a_slice_runs_the_loop_that_simulate_runs():
    parts, settings = ech.build(ech.load_scenario("planar-quadrotor"))
    gain, followers = parts.drive.gain, list(parts.graph.followers)
    run, pair = basin.trial(parts, settings), basin.chosen_slice(parts.model, "y,roll")
    still = resting(parts.model, ech.gains.Riccati(), graph=parts.graph)
    still = still.replace(drive=ech.Laws(ech.laws.TrimInput(), ech.laws.Consensus(gain)))
    trim = np.array(parts.model.trim[0])
    for start in ([0.5, 0.2], [25.0, 1.0]):
        states = np.tile(trim, (parts.graph.agents, 1))
        states[np.ix_(followers, pair)] += start
        chosen = ech.Settings(run.horizon, 0.005, store_every=run.steps)
        result = ech.simulate(still.replace(initial=states), chosen)
        y = result.states[[0, -1]][:, followers] - trim
        first, last = np.sqrt(np.einsum("tfi,ij,tfj->t", y, gain.P, y))
        found = basin.converged(run, basin.slice_of(parts, pair), np.array([start]))[0]
        assert found == (last <= run.decay * first)


def test_the_pair_is_the_one_asked_for_or_a_telling_one():
    quad, cart = ech.models.Quadrotor(), ech.models.VanDerPol()
    assert basin.chosen_slice(quad, " roll , y ") == (6, 1)
    velocity, angle = (quad.state_names[k] for k in basin.chosen_slice(quad, None))
    assert (velocity, angle) in {("vx", "pitch"), ("vy", "roll")}
    assert basin.chosen_slice(cart, None) == (0, 1)
    different = "allowed are two different states such as `y,roll`."
    for asked, sentence in (
        ("y,rol", "did you mean `roll`?"), ("y", different), ("y,y", different),
        ("y,z,roll", different),
    ):  # fmt: skip
        with pytest.raises(ech.EchelonError, match=re.escape(sentence)) as caught:
            basin.chosen_slice(quad, asked)
        assert "`--slice`" in str(caught.value)


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


@pytest.mark.slow
def test_where_nothing_is_certified_the_picture_says_so(tmp_path):
    parts = resting(Cubic(), ech.gains.FixedGain(P=[1.0, 1.0]))
    _, radii = save_design_figures(parts, ech.Settings(horizon=1.0, dt=0.01), tmp_path)
    assert radii.certified is None and "certified none" in radii.sentence()
    assert radii.observed < radii.largest


def test_one_state_has_modes_and_no_slice(tmp_path):
    parts = resting(ech.models.Linear([[0.0]], [[1.0]]), ech.gains.Riccati())
    paths, radii = save_design_figures(parts, ech.Settings(horizon=1.0, dt=0.01), tmp_path)
    assert [path.name for path in paths] == ["modes.png", "modes.pdf"] and radii is None
