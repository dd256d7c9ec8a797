"""Guarantees: all reports of one agree, and what they state is true."""

import dataclasses
import json
import re
from typing import final

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import echelon as ech
from echelon.core import statement
from echelon.core.digits import at_most
from echelon.core.statement import Hypothesis
from echelon.core.words import Feedforward, Kind, Theorem, Verdict
from echelon.experiments.scenario.named_class import resolve
from echelon.experiments.scenario.registry import METHODS
from echelon.guarantees.promises.case import Case
from echelon.guarantees.promises.closed_loop import loop_of
from echelon.guarantees.promises.hypotheses import agent_lines
from echelon.guarantees.promises.leaders import leaders_of
from echelon.guarantees.promises.promise import REQUIRED, Guarantee, promises
from echelon.laws.law import TrimInput

# ---- all tellers say the same ----

DOMAINS = {
    "integrators": "{}",
    "van-der-pol": "{position: 0.5, velocity: 0.5}",
    "planar-quadrotor": "{roll: 0.2, thrust: 1.0}",
    "unicycle": "{heading: 0.2}",
}
ATTITUDE = "{attitude: 0.1, rate: 0.2, thrust: 0.5}"


def changes(scenario, method, feedforward):
    """What makes of a bundled scenario one with this method and feed-forward, and little to run."""
    text = f"method: {method}"
    needs = {"P": "identity", "rate": "0.05", "domain": DOMAINS.get(scenario, ATTITUDE)}
    text += "".join(f", {key}: {needs[key]}" for key in resolve(METHODS[method]).needs)
    own = ech.load_scenario(scenario)
    return [
        f"follower.gain={{{text}}}",
        f"follower.feedforward={feedforward}",
        "follower.law=consensus",
        *(["leader.law=passive"] if str(own.leader.law) == "agreement" else []),
        f"simulation.horizon={2 * own.simulation.dt!r}",
        f"report.steady_window={own.simulation.dt!r}",
    ]


def core(told):
    """Theorem, kind, rate and verdicts of a promise told as JSON."""
    verdicts = {each["statement"]: each["verdict"] for each in told["hypotheses"]}
    return told["promised"], told["theorem"], told["kind"], told["rate"], verdicts


def tellers(scenario, built, method, folder):
    """What everyone tells of a scenario, by who tells it, each as JSON."""
    result = ech.simulate(*built)
    report = " ".join(ech.report(result).split())
    assert ech.guarantee(*built).sentence() in report
    (design,) = ech.design(scenario, method).designs
    (row,) = ech.compare(scenario, built, ("own",)).rows
    return {
        "check": ech.check(*built).promise.as_mapping(),
        "summary": json.loads(json.dumps(ech.summary(result)))["promise"],
        "dataset": json.loads(ech.dataset(result).attrs["promise"]),
        "design": design.promise.as_mapping(),
        "compare": row.flight.promise.as_mapping(),
    }


def agree(name, method, feedforward, folder):
    """Check that all tellers agree on a combination, or refuse it alike."""
    scenario = ech.load_scenario(name, changes(name, method, feedforward))
    try:
        built = ech.build(scenario)
    except ech.EchelonError as refused:
        for act in (ech.run, ech.compare):
            with pytest.raises(ech.EchelonError) as caught:
                act(scenario)
            assert str(caught.value) == str(refused)
        try:
            (row,) = ech.design(scenario, method).designs
        except ech.EchelonError as also:
            # With another gain, a fault of the feed-forward remains, and it is reported.
            given = ech.load_scenario(name, changes(name, "given", feedforward))
            if str(also) != str(refused):
                with pytest.raises(ech.EchelonError) as caught:
                    ech.build(given)
                assert str(also) == str(caught.value)
        else:  # where the method alone is at fault, it is a row with the same reason
            assert row.gain is None and str(refused).endswith(f": {row.reason}")
        return
    promise, gain = ech.guarantee(*built), built.parts.drive.gain
    told = tellers(scenario, built, method, folder)
    wanted = core(json.loads(json.dumps(promise.as_mapping())))
    assert {who: core(each) for who, each in told.items()} == dict.fromkeys(told, wanted)
    ech.save_gain(gain, built.parts.model, built.parts.graph, folder / "gain.json")
    verified = ech.verify(folder / "gain.json")
    assert verified.holds, verified.sentence
    region = gain.certificate.region
    if promise.theorem is not None:
        assert (promise.theorem, promise.kind) == (region.theorem, region.kind)
        assert promise.rate == pytest.approx(region.rate, rel=1e-9)
    elif feedforward != "parent":
        assert promise.loop.slowest == pytest.approx(gain.certificate.abscissa, abs=1e-9)
    assert not promise.hypotheses[Hypothesis.CLAIMS].fails


QUICK = [
    ("van-der-pol", "robust-lqr", "relay"),
    ("van-der-pol", "inner-loop", "none"),
    ("integrators", "contraction", "relay-velocity"),
    ("integrators", "riccati", "parent"),
    ("van-der-pol", "given", "none"),
]


HEAVY = {"robust-lqr", "contraction"}


def combinations():
    """All of them: of a quarter of the scenarios and methods a feed-forward, the rest as a study.

    Variants of `paper` have its agents: one light method in turn is drawn of each. A hull of a
    quadrotor takes a minute or two, and one is drawn. What is an experiment of another law has
    nothing of its own under this one.
    """
    words, every = list(map(str, Feedforward)), sorted(ech.bundled_scenarios())
    laws = {name: str(ech.load_scenario(name).follower.law) for name in every}
    light = [method for method in METHODS if method not in HEAVY]
    for i, scenario in enumerate(name for name in every if laws[name] != "stopping-point"):
        variant = scenario.startswith("paper-") or scenario == "yaw-turn"
        for j, method in enumerate(METHODS):
            chosen = method == light[i % len(light)] if variant else True
            again = scenario == "paper" and method == "contraction"
            for k, feedforward in enumerate(words):
                drawn = (i + 2 * j) % (4 * len(words)) == k and chosen and not again
                marks = pytest.mark.slow if drawn else pytest.mark.study
                yield pytest.param(scenario, method, feedforward, marks=marks)


@pytest.mark.parametrize(("scenario", "method", "feedforward"), [*QUICK, *combinations()])
def test_all_who_tell_of_a_promise_say_the_same(scenario, method, feedforward, tmp_path):
    agree(scenario, method, feedforward, tmp_path)


# ---- what is promised is of what runs ----

PATH = ech.Graph.path(4)


def parts_of(model, graph, gain, feedforward="relay", leader=None, **more):
    """Agents on their goals, all alike, behind a leader that rests unless another is given."""
    law = ech.laws.Consensus(gain, feedforward=feedforward)
    goals = ech.Formation(np.zeros((graph.agents, len(model.state_names))))
    leader = ech.laws.TrimInput() if leader is None else leader
    return ech.Parts(model, graph, goals, ech.Laws(leader, law), **more)


def settings(**changes):
    return ech.Settings(**{"horizon": 1.0, "dt": 0.01, **changes})


def true_slowest(model, graph, gain):
    """The slowest eigenvalue of all followers together, from Kronecker products."""
    with jax.enable_x64(True):
        x = jnp.asarray(np.asarray(model.trim[0], float))
        A = np.asarray(jax.jacfwd(model.normalized_drift)(x))
        B = np.asarray(model.normalized_input_map(x))
    L = graph.grounded_laplacian().toarray()
    K = gain.coupling * B @ np.linalg.solve(gain.R, B.T @ gain.P)
    return float(np.linalg.eigvals(np.kron(np.eye(len(L)), A) - np.kron(L, K)).real.max())


def test_a_gain_of_another_graph_is_promised_what_it_does_on_this_one():
    model, path = ech.models.DoubleIntegrator(1), ech.Graph.path(12)
    gain = ech.synthesize(model, ech.Graph.complete(6), ech.gains.Riccati(coupling=0.3))
    parts = parts_of(model, path, gain)
    found = ech.guarantee(parts, settings())
    slowest = true_slowest(model, path, gain)
    assert gain.certificate.abscissa < 1.1 * slowest < 0.0
    assert found.loop.slowest == pytest.approx(slowest, rel=1e-6)
    low = path.spectrum().low
    assert found.edge == pytest.approx(0.5 / low, rel=1e-9)
    assert f"Note: the gain was made for lambda_min 1, and this graph has {low:.4g}" in (
        found.sentence()
    )
    report = " ".join(ech.report(ech.simulate(parts, settings(horizon=0.02))).split())
    assert (
        found.sentence() in report and f"slowest mode decays at {at_most(-slowest)} 1/s" in report
    )


def test_an_edited_coupling_is_promised_what_it_does():
    model = ech.models.Linear(A=[[0.0, 1.0], [1.0, 0.0]], B=[[0.0], [1.0]])
    gain = ech.synthesize(model, PATH, ech.gains.Riccati())
    weak = ech.Gain(gain.P, gain.R, 0.2, gain.method, gain.certificate)
    found = ech.guarantee(parts_of(model, PATH, weak), settings())
    slowest = true_slowest(model, PATH, weak)
    assert gain.certificate.stable and slowest > 0.0 and not found.promised
    assert found.loop.slowest == pytest.approx(slowest, rel=1e-9)
    assert "and this model at coupling 0.2 has" in found.sentence()


def test_a_run_says_what_check_says_of_a_step_too_long():
    changes = ["graph={name: grid, rows: 10, columns: 15}", "formation={name: grid, columns: 15}"]
    changes += ["simulation.horizon=0.01", "report.steady_window=0.005"]
    built = ech.build(ech.load_scenario("planar-quadrotor", changes))
    found = ech.guarantee(*built)
    assert found.reasons == ("with the input held over the step `dt` the disagreement grows",)
    report = " ".join(ech.report(ech.simulate(*built)).split())
    assert found.sentence() in report and "stable" not in report


def test_one_step_of_the_integrator_that_runs_decides():
    # x'' = -100 x - 0.1 x': Euler's factor |1 + s dt| exceeds 1 where the exact flow decays.
    model = ech.models.Linear(A=[[0.0, 1.0], [-100.0, -0.1]], B=[[0.0], [1.0]])
    gain = ech.synthesize(model, ech.Graph.ring(5), ech.gains.Riccati(Q=[1e-4, 1e-4]))
    parts = parts_of(model, ech.Graph.ring(5), gain, initial={"x1": 1.0})
    for integrator, holds in (("rk4", True), ("euler", False), ("printed", False)):
        run = settings(integrator=integrator, dt=0.05, horizon=10.0)
        found, result = ech.guarantee(parts, run), ech.simulate(parts, run)
        assert found.promised is holds
        with np.errstate(over="ignore"):
            sizes = np.linalg.norm(result.errors, axis=(1, 2))
        assert bool(sizes[-40:].max() < sizes[:40].max()) is holds
    assert found.hypotheses[Hypothesis.SAMPLING].number > 1.0


def test_the_printed_step_keeps_no_offset():
    model = ech.models.Linear(A=[[-0.5]], B=[[1.0]])
    gain = ech.synthesize(model, ech.Graph.path(2), ech.gains.FixedGain("identity", coupling=0.2))
    parts = parts_of(model, ech.Graph.path(2), gain)
    assert ech.guarantee(parts, settings(integrator="printed", dt=1.0)).promised
    away = parts.replace(formation=ech.Formation([[0.0], [1.0]]))
    step = ech.guarantee(away, settings(integrator="printed", dt=1.0)).hypotheses[
        Hypothesis.SAMPLING
    ]
    assert step.fails and "ignores the goals" in step.text


@pytest.mark.parametrize(
    "change", ["model.parameters={motor_thrust: 0.1}", "plant.parameters.motor_thrust=0.1"]
)
def test_vehicles_that_cannot_hold_their_trim_are_promised_nothing(change):
    short = ["simulation.horizon=0.01", "report.steady_window=0.005"]
    scenario = ech.load_scenario("planar-quadrotor", [change, *short])
    built = ech.build(scenario)
    found = ech.guarantee(*built)
    assert not found.promised
    told = "the actuators deliver `thrust` 0.2 of 0.2747 N, and cannot hold the trim"
    assert told in found.sentence()
    assert found.hypotheses[Hypothesis.TRIM_WITHIN_LIMITS].number == pytest.approx(0.728, abs=1e-3)
    designs = ech.design(scenario, "riccati")
    assert not designs.recommended.promise.promised and told in designs.because
    assert told in " ".join(ech.report(ech.simulate(*built)).split())
    unlimited = built.settings._replace(limits=False)
    assert ech.guarantee(built.parts, unlimited).promised


def leaders_apart(gain_of, gap):
    model, graph = ech.models.DoubleIntegrator(1), ech.Graph.path(4, leaders=(0, 3))
    gain = ech.synthesize(model, graph, gain_of)
    states = np.zeros((4, 2))
    states[3, 0] = gap
    return parts_of(model, graph, gain, initial=states)


def test_leaders_that_disagree_leave_no_proof_and_containment_is_said():
    method = ech.gains.Contraction({}, rate=0.5)
    together, apart = (leaders_apart(method, gap) for gap in (0.0, 1.0))
    found = ech.guarantee(together, settings())
    assert (found.theorem, found.kind) == (Theorem.T1, Kind.PROOF)
    assert found.hypotheses[Hypothesis.LEADERS_AGREE].verdict is Verdict.HOLDS
    found = ech.guarantee(apart, settings(horizon=20.0))
    assert not found.promised and found.theorem is None and found.region is None
    line = found.hypotheses[Hypothesis.LEADERS_AGREE]
    assert line.fails and line.number == pytest.approx(1.0)
    assert "end in the leaders' convex hull" in found.sentence()
    # They do: the followers stand between the leaders, and off their goals for good.
    last = ech.simulate(apart, settings(horizon=20.0)).states[-1, :, 0]
    assert last[1:3] == pytest.approx([1 / 3, 2 / 3], abs=1e-3)


def test_free_leaders_of_a_limit_cycle_are_said_to_drift_apart():
    changes = ["graph={name: ring, agents: 12, leaders: [0, 6]}", "leader.start_error={}",
               "initial={states: {0: [2.0, 0.0], 6: [-1.0, 0.5]}}"]  # fmt: skip
    built = ech.build(ech.load_scenario("van-der-pol", changes))
    found, result = ech.guarantee(*built), ech.simulate(*built)
    line = found.hypotheses[Hypothesis.LEADERS_AGREE]
    away = np.linalg.norm(result.states[:, 6] - result.states[:, 0], axis=1)
    assert not found.promised and line.number == pytest.approx(away.max(), rel=1e-2)
    assert "leader 6 starts 3.04 off the place that leader 0 gives it" in line.text
    assert "Cause" not in ech.report(result)


def test_leaders_that_come_together_leave_the_linearization():
    built = ech.build(ech.load_scenario("planar-quadrotor", ["graph.leaders=[0, 3]"]))
    states = {0: (0.0, 1.5, 0.0, 0.0, 0.0, 0.0)}
    built = built._replace(parts=built.parts.replace(initial=states, start_error={}))
    found = ech.guarantee(*built)
    assert found.promised and found.theorem is None
    assert "brings them together" in found.hypotheses[Hypothesis.LEADERS_AGREE].text


def test_what_decays_unseen_is_no_cause():
    # (x, v) = (-2, 1) decays at the drag's own 0.5 1/s, and B'P = (0.5, 1) does not feel it.
    model = ech.models.DoubleIntegrator(2, drag=0.5)
    half = 0.5 * np.eye(2)
    felt = np.block([[np.eye(2), half], [half, np.eye(2)]]).tolist()
    for P, holds in ((felt, True), ("identity", False)):
        gain = ech.synthesize(model, PATH, ech.gains.FixedGain(P))
        parts = parts_of(model, PATH, gain, initial={"position": 1.0})
        found = ech.guarantee(parts, settings())
        line = found.hypotheses[Hypothesis.DETECTABLE]
        assert line.number == 2 and line.fails is not holds and found.promised is holds
        assert ("no input feels 2 of 4 directions" in line.text) is not holds


def test_below_the_edge_the_edge_is_the_cause_and_not_the_step():
    changes = ["graph={name: path, agents: 4}", "follower.gain.coupling=0.5"]
    scenario = ech.load_scenario("planar-quadrotor", [*changes, "simulation.horizon=12"])
    report = " ".join(ech.report(ech.run(scenario)).split())
    assert "Cause" not in report
    line = ech.guarantee(*ech.build(scenario)).hypotheses[Hypothesis.COUPLING]
    assert "coupling 0.5 is below the edge 2.525" in line.text
    assert "step `dt` is too long" not in report


def test_a_v_of_rounding_blames_nobody():
    model = ech.models.DoubleIntegrator(2, drag=0.7)
    gain = ech.synthesize(model, PATH, ech.gains.Riccati())
    result = ech.simulate(
        parts_of(model, PATH, gain, leader=ech.laws.Tracking(ech.references.Circle())), settings()
    )
    v = ech.lyapunov(result)
    assert v.value.max() < 1e-28 and not v.rises().any() and not v.forbidden().any()


def test_only_a_law_that_keeps_the_theorem_is_promised_it():
    model, circle = ech.models.DoubleIntegrator(2), ech.laws.Tracking(ech.references.Circle())
    gain = ech.synthesize(model, PATH, ech.gains.Contraction({}, rate=0.3))
    theorems = {}
    for feedforward in map(str, Feedforward):
        for leader in (None, circle):
            parts = parts_of(model, PATH, gain, feedforward, leader)
            found = ech.guarantee(parts, settings())
            theorems[feedforward, leader is None] = found.theorem
            assert found.promised
    proved = {"none": (True, False), "relay": (True, True), "relay-velocity": (True, True),
              "parent": (False, False)}  # fmt: skip
    for name, (rest, moving) in proved.items():
        assert theorems[name, True] == (Theorem.T1 if rest else None)
        assert theorems[name, False] == (Theorem.T1 if moving else None)
    # What `none` is not promised, it does not keep: errors grow from nothing behind a circle.
    parts = parts_of(model, PATH, gain, "none", circle)
    errors = ech.simulate(parts, settings(horizon=10.0)).errors
    assert np.abs(errors[0]).max() == 0.0 and np.abs(errors[-1]).max() > 0.1
    assert "once the leader's input rests at its trim" in (
        ech.guarantee(parts, settings()).sentence()
    )


def test_a_parent_that_is_the_leader_relays():
    model, star = ech.models.DoubleIntegrator(1), ech.Graph.star(4)
    for graph, kept in ((star, True), (PATH, False)):
        gain = ech.synthesize(model, graph, ech.gains.Contraction({}, rate=0.3))
        relayed, passed_on = (
            ech.guarantee(parts_of(model, graph, gain, feedforward), settings())
            for feedforward in ("relay", "parent")
        )
        assert relayed.region is not None
        assert (passed_on.region is not None) == kept
        if kept:
            assert passed_on.region.rate == relayed.region.rate


def test_the_relayed_velocity_has_no_local_theorem_where_g_varies():
    model, bounds = ech.models.PlanarQuadrotor(), {"roll": 0.2, "thrust": 1.0}
    gain = ech.synthesize(model, PATH, ech.gains.RobustLQR(bounds))
    moving = ech.laws.Tracking(ech.references.Circle(radius=0.2, rate=0.1))
    theorems = [
        ech.guarantee(
            parts.replace(drive=ech.Laws(leader, parts.drive.follower)), settings(dt=0.002)
        ).theorem
        for leader in (moving, ech.laws.TrimInput())
        for parts in [parts_of(model, PATH, gain, name) for name in ("relay", "relay-velocity")]
    ]
    # A leader that keeps to its trim makes no velocity that g could turn.
    assert theorems == [Theorem.T2, None, Theorem.T2, Theorem.T2]


def test_two_eigenvalues_do_not_stand_for_those_between_them():
    # s^3 + (1 + k) s^2 + (1 + k) s + 0.5 + 4 k decays but for |k - 1| < 0.71 (Routh).
    model = ech.models.Linear(
        A=[[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [-0.5, -1.0, -1.0]], B=[[0.0], [0.0], [1.0]]
    )
    P = [[40.0, 0.0, 4.0], [0.0, 40.0, 1.0], [4.0, 1.0, 1.0]]
    graph = ech.Graph.path(460)
    gain = ech.synthesize(model, graph, ech.gains.FixedGain(P))
    found = ech.guarantee(parts_of(model, graph, gain), settings())
    assert gain.certificate.modes == 2 and gain.certificate.abscissa < 0.0
    assert found.loop.slowest > 0.0 and not found.promised


def test_agents_that_are_all_alike_agree_at_the_rate_of_the_whole_graph():
    built = ech.build(ech.load_scenario("integrators", ["simulation.horizon=30"]))
    found, L = ech.guarantee(*built), built.parts.graph.laplacian().toarray()
    assert found.rate == pytest.approx(np.linalg.eigvalsh(L)[1])
    errors = np.linalg.norm(ech.simulate(*built).errors, axis=(1, 2))
    seen = -np.log(errors[-1] / errors[-200]) / (199 * 0.1)
    # The input is held over steps of 0.01 s.
    assert seen == pytest.approx(-np.log1p(-0.01 * found.rate) / 0.01, rel=1e-5)


# ---- whether a run is covered ----


@pytest.fixture(scope="module")
def swinging():
    """Pendulums with a certified set, the last one swinging with so many of its radii."""
    model = ech.models.Pendulum()
    gain = ech.synthesize(model, PATH, ech.gains.RobustLQR({"angle": 0.5}, exact=True))

    def start(factor):
        states = np.zeros((4, 2))
        radius = gain.certificate.region.radius
        states[3, 1] = factor * radius / np.sqrt(gain.P[1, 1])
        return parts_of(model, PATH, gain, initial=states)

    return start


@pytest.mark.parametrize(
    ("factor", "told"),
    [
        (0.9, "The proof covers this run: the starts lie in the certified set"),
        (1.02, "but all agents stayed in the domain"),
        (4.0, "The proof does not cover this run: agent 3 left the domain at 0."),
    ],
)
def test_the_report_says_whether_the_proof_covers_the_run(swinging, factor, told):
    parts = swinging(factor)
    report = " ".join(ech.report(ech.simulate(parts, settings())).split())
    assert told in report
    starts = ech.guarantee(parts, settings()).hypotheses[Hypothesis.STARTS]
    assert starts.fails is (factor > 1.0)
    assert "guaranteed for linear agents" not in report


def test_a_limit_and_a_wind_leave_a_run_uncovered(swinging):
    world = ech.World(disturbance=ech.Disturbance(constant={"rate": 0.01}))
    parts = swinging(0.5).replace(world=world)
    report = " ".join(ech.report(ech.simulate(parts, settings())).split())
    assert "The proof does not cover this run: wind or noise acts on the agents." in report


# ---- before a run, and in its data ----


def test_a_run_that_will_grow_says_what_would_not(echelon):
    quick = ["--set", "simulation.horizon=0.5", "--set", "simulation.dt=0.05", "--no-figures"]
    code, out, err = echelon("run", "planar-quadrotor", *quick, "--out", "o")
    assert code == 0 and err.startswith("echelon: Nothing is guaranteed: with the input held over")
    assert "There is a guarantee with `--set simulation.dt=" in err
    shorter = err.partition("`--set simulation.dt=")[2].partition("`")[0]
    change = f"simulation.dt={shorter}"
    assert ech.guarantee(*ech.build(ech.load_scenario("planar-quadrotor", [change]))).promised
    _, _, err = echelon("run", "planar-quadrotor", *quick, "--out", "p", "--json")
    assert err == ""


def test_the_data_of_a_run_hold_the_whole_promise():
    model = ech.models.Pendulum()
    gain = ech.synthesize(model, PATH, ech.gains.Riccati())
    parts = parts_of(model, PATH, gain)
    result = ech.simulate(parts, settings(horizon=0.1))
    told, data = ech.summary(result)["promise"], ech.dataset(result)
    assert told == ech.guarantee(parts, settings(horizon=0.1)).as_mapping()
    # These lines are there only for laws that turn, graphs that switch, motors, networks, ...
    apart = {Hypothesis.HEADING_FRAME, Hypothesis.SWITCHING, Hypothesis.LIMITS}
    apart |= {Hypothesis.MESSAGES, Hypothesis.OWN_STATE, Hypothesis.SEPARATION, Hypothesis.EVENTS}
    always = {h.value for h in Hypothesis if h not in apart}
    assert {each["statement"] for each in told["hypotheses"]} == always
    for each in told["hypotheses"]:
        assert each["number"] is None or isinstance(each["number"], (int, float))
    np.testing.assert_array_equal(data["P"], gain.P)
    np.testing.assert_array_equal(data["R"], gain.R)
    assert float(data["coupling"]) == gain.coupling


def test_a_promise_is_computed_once_for_as_long_as_its_parts_live():
    model = ech.models.Pendulum()
    parts = parts_of(model, PATH, ech.synthesize(model, PATH, ech.gains.Riccati()))
    first = ech.guarantee(parts, settings())
    assert ech.guarantee(parts, settings()) is first
    assert ech.guarantee(ech.simulate(parts, settings()).parts, settings()) is first
    assert ech.guarantee(parts, settings(dt=0.02)) is not first


def test_plans_are_promised_nothing():
    model = ech.models.DoubleIntegrator(2)
    goals = ech.Formation(np.zeros((4, 4)))
    parts = ech.Parts(model, PATH, goals, ech.optimal.Plans(ech.references.Circle()))
    assert ech.guarantee(parts, settings()).sentence() == (
        "Nothing is guaranteed: no theorem covers `Plans`. What would help: use laws that a "
        "theorem covers."
    )


# ---- what is told of the model itself ----


def of_one_state(drift, states="x"):
    """A model of chained integrators whose last rate is a function and the input."""

    class Chain(ech.ControlAffine):
        state_names = tuple(states)
        input_names = ("push",)

        def drift(self, x):
            return drift(x)

        def input_map(self, x):
            return jnp.zeros((len(states), 1)).at[-1, 0].set(1.0)

    return Chain()


@pytest.mark.parametrize(
    ("low", "high", "promised"),
    [(-1.0, 1.0, True), (0.0, 1.0, False), (-1.0, 0.0, False), (0.2, 1.0, False)],
)
def test_a_trim_needs_room_on_both_sides_of_its_input(low, high, promised):
    model = of_one_state(lambda x: -x)
    type(model).input_limits = ech.models.Limits(((1.0,),), (low,), (high,))
    gain = ech.synthesize(model, PATH, ech.gains.FixedGain("identity", coupling=0.5))
    promise = ech.guarantee(parts_of(model, PATH, gain), settings())
    assert promise.promised == promised
    unlimited = ech.guarantee(parts_of(model, PATH, gain), settings(limits=False))
    assert unlimited.promised
    if not promised:
        assert "actuators" in promise.sentence()


def test_nothing_linear_is_promised_where_the_drift_bends_at_the_trim():
    model = of_one_state(lambda x: -x + 3.0 * jnp.abs(x))
    gain = ech.synthesize(model, PATH, ech.gains.FixedGain("identity", coupling=0.5))
    promise = ech.guarantee(parts_of(model, PATH, gain), settings())
    assert not promise.promised
    assert "the rate of `x` bends or jumps with `x` at the trim" in promise.sentence()


def test_slopes_of_both_sides_that_contract_are_promised_without_a_linearization():
    model = of_one_state(lambda x: -2.0 * x + jnp.maximum(x, 0.0))
    gain = ech.synthesize(model, PATH, ech.gains.FixedGain("identity", coupling=0.5))
    promise = ech.guarantee(parts_of(model, PATH, gain), settings())
    assert promise.promised and (promise.kind, promise.theorem) == (Kind.VERTICES, Theorem.T1)
    # The slower side, -1, and c times the smallest eigenvalue of the graph.
    assert promise.rate == pytest.approx(1.0 + 0.5 * PATH.spectrum().low, rel=1e-6)
    assert promise.domain == "x in [-0.001, 0.001]"


def slowest_of_sides(sides, gain, graph):
    """Return how slowly the modes decay on the slower side, 1/s, for constant slopes (n, n)."""
    B, loop = np.eye(2)[:, 1:], np.zeros((1, 2)) if gain.inner is None else gain.inner
    modes = np.linalg.eigvalsh(graph.grounded_laplacian().toarray())
    pull = gain.coupling * np.linalg.solve(gain.R, B.T @ gain.P)
    closed = [A - B @ (loop + mode * pull) for A in sides for mode in modes]
    return -max(np.linalg.eigvals(A).real.max() for A in closed)


def test_an_inner_loop_closes_around_the_slopes_of_both_sides():
    model = of_one_state(lambda x: jnp.stack([x[1], -0.5 * jnp.maximum(x[1], 0.0)]), "xv")
    gain = ech.synthesize(model, PATH, ech.gains.InnerLoop())
    assert gain.inner is not None
    promise = ech.guarantee(parts_of(model, PATH, gain), settings())
    assert promise.promised and (promise.kind, promise.theorem) == (Kind.VERTICES, Theorem.T1)
    sides = [np.array([[0.0, 1.0], [0.0, -slope]]) for slope in (0.0, 0.5)]
    assert 0.0 < promise.rate <= slowest_of_sides(sides, gain, PATH) + 1e-9


@pytest.mark.parametrize("feedforward", ["none", "relay", "relay-velocity"])
def test_a_leader_at_its_trim_has_no_velocity_that_a_bend_of_g_could_turn(feedforward):
    class Bent(ech.ControlAffine):
        state_names, input_names = ("x",), ("push",)

        def drift(self, x):
            return -2.0 * x + jnp.maximum(x, 0.0)

        def input_map(self, x):
            return (1.0 + 0.3 * jnp.abs(x))[:, None]

    gain = ech.synthesize(Bent(), PATH, ech.gains.FixedGain("identity", coupling=0.5))
    law = ech.laws.Consensus(gain, feedforward=feedforward)
    parts = parts_of(Bent(), PATH, gain).replace(drive=ech.Laws(ech.laws.TrimInput(), law))
    promise = ech.guarantee(parts, settings())
    assert promise.promised and (promise.kind, promise.theorem) == (Kind.VERTICES, Theorem.T2)
    # g is 1 at the trim, and 1.0003 at the edge of what was looked at.
    assert promise.rate == pytest.approx(1.0 + 0.5 * PATH.spectrum().low, rel=1e-3)


def test_a_hull_of_both_sides_is_promised_across_a_bend():
    model = of_one_state(lambda x: -2.0 * x + jnp.maximum(x, 0.0))
    gain = ech.synthesize(model, PATH, ech.gains.Contraction({"x": 2.0}, coupling=1.0))
    promise = ech.guarantee(parts_of(model, PATH, gain), settings())
    assert promise.promised and promise.kind is Kind.PROOF
    # The slower side, and what the feedback adds to it.
    assert promise.rate >= 0.99


def fence(x):
    return jnp.stack([x[1], -x[1] - x[0] - 2.0 * jnp.maximum(x[0] - 5.0, 0.0)])


@pytest.mark.parametrize(
    ("drift", "domain", "verdict", "kind"),
    [
        (lambda x: jnp.stack([x[1], -x[1]]), {"v": 2.0}, "holds", "proof"),
        (fence, {"x": 6.0, "v": 2.0}, "fails", "samples"),
        (lambda x: jnp.stack([x[1], -x[1] - jnp.sin(x[1])]), {"v": 1.0}, "holds", "proof"),
    ],
)
def test_offsets_are_proved_on_the_domain_or_said_to_be_tried(drift, domain, verdict, kind):
    model = of_one_state(drift, "xv")
    gain = ech.synthesize(model, PATH, ech.gains.RobustLQR(domain, exact=True))
    parts = dataclasses.replace(
        parts_of(model, PATH, gain), formation=ech.Formation(np.arange(4.0)[:, None] * [1.0, 0.0])
    )
    promise = ech.guarantee(parts, settings())
    line = promise.hypotheses[Hypothesis.SYMMETRY]
    assert (str(line.verdict), str(line.kind)) == (verdict, kind)
    assert promise.promised == (verdict == "holds")
    assert promise.kind is (Kind.PROOF if verdict == "holds" else Kind.LINEARIZATION)


def dragging(x):
    """A mass that a wind from behind does not slow down: the slope of its drag jumps at rest."""
    return jnp.stack([x[1], -0.5 * jnp.maximum(x[1], 0.0)])


NOTHING_LINEAR = ("slowest mode", "on every mode decays", "by linearization")


@pytest.mark.parametrize("method", [ech.gains.Riccati(), ech.gains.RobustLQR({"v": 1.0})])
def test_no_mode_and_no_edge_is_told_of_a_model_that_bends_at_its_trim(method):
    model = of_one_state(dragging, "xv")
    gain = ech.synthesize(model, PATH, method)
    parts = parts_of(model, PATH, gain, initial={"x": 0.1})
    promise, run = ech.guarantee(parts, settings()), settings(horizon=0.1)
    assert promise.promised and promise.theorem is Theorem.T1
    assert promise.sentence().startswith("Guaranteed on a domain only")
    told = promise.as_mapping()
    assert (told["slowest_mode"], told["edge"]) == (None, None)
    for text in (promise.sentence(), ech.report(ech.simulate(parts, run))):
        assert not any(words in " ".join(text.split()) for words in NOTHING_LINEAR)
    for line in ech.check(parts, settings()).lines:
        # What a gain says of itself is compared, and promises nothing.
        told = line.statement is not Hypothesis.CLAIMS and line.kind is Kind.LINEARIZATION
        assert not told or line.verdict is not Verdict.HOLDS, line
    # Every side of the trim, held: the rate promised is below that of any of them.
    B, K = np.array([[0.0], [1.0]]), np.linalg.solve(gain.R, np.array([[0.0, 1.0]]) @ gain.P)
    low = gain.coupling * PATH.spectrum().low
    sides = [np.array([[0.0, 1.0], [0.0, -drag]]) - low * B @ K for drag in (0.0, 0.5)]
    assert promise.rate <= min(-np.linalg.eigvals(A).real.max() for A in sides)


def test_a_step_too_long_for_one_side_of_a_bend_is_not_promised():
    # A stiff side, which the derivative that JAX takes at the trim does not show.
    model = of_one_state(lambda x: -x - 300.0 * jnp.maximum(x - 0.0, 0.0) ** 1)
    gain = ech.synthesize(model, PATH, ech.gains.FixedGain("identity"))
    parts = parts_of(model, PATH, gain)
    for dt, holds in ((0.005, True), (0.05, False)):
        promise = ech.guarantee(parts, settings(dt=dt))
        assert (
            promise.promised is holds and promise.hypotheses[Hypothesis.SAMPLING].fails is not holds
        )


def test_design_ranks_no_mode_of_a_model_that_bends():
    model = of_one_state(dragging, "xv")
    parts = parts_of(model, PATH, ech.synthesize(model, PATH, ech.gains.Riccati()))
    rows = ech.design((parts, settings()), "riccati")
    (row,) = rows.designs
    assert row.stable and row.fastest is None and row.factors is None
    assert "slowest mode" not in rows.because


# ---- a law with a theorem of its own ----


@final
@dataclasses.dataclass(frozen=True, eq=False, kw_only=True)
class RestPromise(Guarantee):
    """What is guaranteed of followers that rest: nothing grows."""

    @classmethod
    def of(cls, prepared, settings, brief=False):
        leaders = leaders_of(prepared.parts, prepared.problem.states)
        case = Case(prepared.parts, settings, loop_of(prepared.parts), leaders)
        own = (statement.holds(name, Kind.PROOF, "it rests") for name in REQUIRED)
        lines = {line.statement: line for line in (*agent_lines(case), *own)}
        return cls(loop=case.loop, hypotheses=lines, without="", leader_mode=None)

    ground = None
    rate = slowest = 0.0

    def longest_step(self, settings):
        return float("inf")

    def guarantee(self):
        return "Followers rest where they start."

    def why_covered(self):
        return "nobody moved"


class Rest(TrimInput):
    """Followers that rest, with a theorem of their own."""

    prover = f"{__name__}:RestPromise"


def test_a_law_names_what_proves_its_guarantee():
    model = ech.models.SingleIntegrator(2)
    goals = ech.Formation(np.zeros((4, 2)))
    parts = ech.Parts(model, PATH, goals, ech.Laws(TrimInput(), Rest()))
    found = ech.guarantee(parts, settings())
    assert type(found) is RestPromise and found.decays
    assert found.as_mapping()["sentence"] == "Followers rest where they start."
    assert ech.check(parts, settings()).promise is found
    report = ech.report(ech.simulate(parts, settings(horizon=0.1)))
    assert "Followers rest where they start." in report
    seeds = [settings()._replace(seed=k) for k in range(2)]
    assert [type(each) for each in promises(parts, seeds)] == [RestPromise, RestPromise]
    other = parts.replace(drive=ech.Laws(TrimInput(), TrimInput()))
    assert not ech.guarantee(other, settings()).promised


def test_no_remedy_asks_for_a_step_of_zero_or_less():
    given = {
        "name": "cut",
        "model": {"name": "double-integrator", "parameters": {"dimension": 2}},
        "graph": {"name": "ring", "agents": 6},
        "formation": {"name": "line"},
        "reference": {"name": "circle", "radius": 3.0, "rate": 0.3},
        "events": [{"at": 5.0, "cut": [0, 1]}],
    }
    for dt in (0.01, 0.001):
        given["simulation"] = {"horizon": 15.0, "dt": dt}
        promise = ech.guarantee(*ech.build(ech.scenario_from_mapping(given)))
        for line in promise.hypotheses.values():
            for number in re.findall(r"(?:below|than|to) (-?[\d.e+-]*\d|inf|nan)", line.remedy):
                assert 0.0 < float(number) < np.inf, line.remedy
        assert not promise.promised and "no one P is known" in promise.sentence()
        assert "grows" not in promise.sentence()


# ---- models of one's own ----


class Reversed(ech.models.DoubleIntegrator):
    """Its difference of two states has the wrong sign, which no slope of f or g shows."""

    def difference(self, x, y):
        return y - x


def test_a_difference_that_is_not_x_minus_y_leaves_nothing_guaranteed():
    model = Reversed(dimension=1)
    gain = ech.synthesize(model, PATH, ech.gains.Riccati())
    laws = ech.Laws(TrimInput(), ech.laws.Consensus(gain))
    formation = ech.Formation.from_offsets(model, PATH, {})
    parts = ech.Parts(model, PATH, formation, laws, initial={"position": 0.1})
    result = ech.simulate(parts, settings())
    assert np.abs(result.errors[-1]).max() > 10.0 * np.abs(result.errors[0]).max()
    found = ech.guarantee(parts, settings())
    assert not found.promised and found.slowest is None
    assert "is not x - y" in found.sentence()
