"""Guarantees: all reports of one agree, and what they state is true."""

import dataclasses
import json
import re
from typing import final

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from in_words import in_words

import echelon as ech
from echelon.core import statement
from echelon.core.claim import Claim, ClaimKind
from echelon.core.digits import at_most
from echelon.core.identity import digest
from echelon.core.statement import Hypothesis
from echelon.core.words import Feedforward, Kind, Theorem, Verdict
from echelon.experiments.scenario.named_class import resolve
from echelon.experiments.scenario.registry import METHODS
from echelon.guarantees.promises import promise as module
from echelon.guarantees.promises.case import GuaranteeInputs
from echelon.guarantees.promises.closed_loop import loop_of
from echelon.guarantees.promises.hypotheses import agent_lines
from echelon.guarantees.promises.leaders import leaders_of
from echelon.guarantees.promises.promise import REQUIRED, Guarantee, promises
from echelon.laws.law import TrimInput

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
    verdicts = {each["name"]: each["verdict"] for each in told["conditions"]}
    return told["verdict"], told["theorem"], told["kind"], told["numbers"].get("rate"), verdicts


def tellers(scenario, built, method):
    """What everyone tells of a scenario, by who tells it, each as JSON."""
    result = ech.simulate(*built)
    assert in_words(ech.guarantee(*built)) in " ".join(ech.report(result).split())
    (design,) = ech.design(scenario, method).designs
    (row,) = ech.compare(scenario, built, ("own",)).rows
    return {
        "check": ech.check(*built).promise.as_mapping(),
        "summary": json.loads(json.dumps(ech.summary(result)))["guarantee"],
        "dataset": json.loads(ech.dataset(result).attrs["guarantee"]),
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
            with pytest.raises(ech.EchelonError, match=f"^{re.escape(str(refused))}$"):
                act(scenario)
        return
    promise, gain = ech.guarantee(*built), built.parts.drive.gain
    told = tellers(scenario, built, method)
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


def combinations():
    """Of a quarter of the scenarios and methods a feed-forward.

    Variants of `paper` have its agents: one light method in turn is drawn of each. A hull of a
    quadrotor takes a minute or two, and one is drawn. What is an experiment of another law has
    nothing of its own under this one.
    """
    words, every = list(map(str, Feedforward)), sorted(ech.bundled_scenarios())
    # What is refused as printed has no gain.
    able = [method for method in METHODS if not resolve(METHODS[method]).literal]
    light = [method for method in able if method not in ("robust-lqr", "contraction")]
    laws = {name: str(ech.load_scenario(name).follower.law) for name in every}
    for i, scenario in enumerate(name for name in every if laws[name] != "stopping-point"):
        variant = scenario.startswith("paper-") or scenario == "yaw-turn"
        for j, method in enumerate(able):
            chosen = method == light[i % len(light)] if variant else True
            k = (i + 2 * j) % (4 * len(words))
            if chosen and k < len(words) and (scenario, method) != ("paper", "contraction"):
                yield pytest.param(scenario, method, words[k], marks=pytest.mark.slow)


@pytest.mark.parametrize(("scenario", "method", "feedforward"), [*QUICK, *combinations()])
def test_all_who_tell_of_a_promise_say_the_same(scenario, method, feedforward, tmp_path):
    agree(scenario, method, feedforward, tmp_path)


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


def test_a_gain_of_another_graph_or_coupling_is_promised_what_it_does():
    model, path = ech.models.DoubleIntegrator(1), ech.Graph.path(12)
    gain = ech.synthesize(model, ech.Graph.complete(6), ech.gains.Riccati(coupling=0.3))
    parts = parts_of(model, path, gain)
    found, slowest = ech.guarantee(parts, settings()), true_slowest(model, path, gain)
    assert gain.certificate.abscissa < 1.1 * slowest < 0.0
    assert found.loop.slowest == pytest.approx(slowest, rel=1e-6)
    low = path.spectrum().low
    assert found.edge == pytest.approx(0.5 / low, rel=1e-9)
    note = f"but the gain was made for lambda_min 1, and this graph has {low:.4g}"
    assert note in in_words(found)
    report = " ".join(ech.report(ech.simulate(parts, settings(horizon=0.02))).split())
    assert in_words(found) in report
    assert found.slowest == pytest.approx(slowest, rel=0.01)
    assert f"rate {at_most(-found.slowest)} 1/s eventually" in report
    # An edited coupling, too weak for a model that grows.
    model = ech.models.Linear(A=[[0.0, 1.0], [1.0, 0.0]], B=[[0.0], [1.0]])
    gain = ech.synthesize(model, PATH, ech.gains.Riccati())
    weak = ech.Gain(gain.P, gain.R, 0.2, gain.method, gain.certificate)
    found = ech.guarantee(parts_of(model, PATH, weak), settings())
    slowest = true_slowest(model, PATH, weak)
    assert gain.certificate.stable and slowest > 0.0 and not found.promised
    assert found.loop.slowest == pytest.approx(slowest, rel=1e-9)
    assert "and this model at coupling 0.2 has" in in_words(found)


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
    assert found.hypotheses[Hypothesis.DISAGREEMENT_DECAY].number > 0.0
    # The printed step keeps no offset.
    model, printed = (
        ech.models.Linear(A=[[-0.5]], B=[[1.0]]),
        settings(integrator="printed", dt=1.0),
    )
    pair = ech.Graph.path(2)
    gain = ech.synthesize(model, pair, ech.gains.FixedGain("identity", coupling=0.2))
    parts = parts_of(model, pair, gain)
    assert ech.guarantee(parts, printed).promised
    away = parts.replace(formation=ech.Formation([[0.0], [1.0]]))
    assert ech.guarantee(away, printed).hypotheses[Hypothesis.REST].fails


@pytest.mark.slow
@pytest.mark.parametrize(
    "change", ["model.parameters={motor_thrust: 0.1}", "plant.parameters.motor_thrust=0.1"]
)
def test_vehicles_that_cannot_hold_their_trim_are_promised_nothing(change):
    short = ["simulation.horizon=0.01", "report.steady_window=0.005"]
    scenario = ech.load_scenario("planar-quadrotor", [change, *short])
    built = ech.build(scenario)
    found, designs = ech.guarantee(*built), ech.design(scenario, "riccati")
    told = "the actuators deliver `thrust` 0.2 of 0.2747 N, and cannot hold the trim"
    report = " ".join(ech.report(ech.simulate(*built)).split())
    assert not found.promised and designs.recommended is None
    assert told in in_words(found) and told in designs.because and told in report
    assert found.hypotheses[Hypothesis.TRIM_WITHIN_LIMITS].number == pytest.approx(0.728, abs=1e-3)
    assert ech.guarantee(built.parts, built.settings._replace(limits=False)).promised


def test_leaders_that_disagree_leave_no_proof_and_containment_is_said():
    model, graph = ech.models.DoubleIntegrator(1), ech.Graph.path(4, leaders=(0, 3))
    gain = ech.synthesize(model, graph, ech.gains.Contraction({}, rate=0.5))
    states = np.zeros((4, 2))
    found = ech.guarantee(parts_of(model, graph, gain, initial=states), settings())
    assert (found.theorem, found.kind) == (Theorem.T1, Kind.PROOF)
    assert found.hypotheses[Hypothesis.LEADERS_AGREE].verdict is Verdict.HOLDS
    apart = parts_of(model, graph, gain, initial=states + [[0, 0], [0, 0], [0, 0], [1, 0]])
    found = ech.guarantee(apart, settings(horizon=20.0))
    assert not found.promised and found.theorem is None and found.region is None
    line = found.hypotheses[Hypothesis.LEADERS_AGREE]
    assert line.fails and line.number == pytest.approx(1.0)
    assert "end in the leaders' convex hull" in in_words(found)
    # They do: the followers stand between the leaders, and off their goals for good.
    last = ech.simulate(apart, settings(horizon=20.0)).states[-1, :, 0]
    assert last[1:3] == pytest.approx([1 / 3, 2 / 3], abs=1e-3)


def test_leaders_that_come_together_leave_the_linearization_and_free_ones_drift_apart():
    built = ech.build(ech.load_scenario("planar-quadrotor", ["graph.leaders=[0, 3]"]))
    states = {0: (0.0, 1.5, 0.0, 0.0, 0.0, 0.0)}
    found = ech.guarantee(built.parts.replace(initial=states, start_error={}), built.settings)
    assert found.promised and found.theorem is None
    assert "brings them together" in found.hypotheses[Hypothesis.LEADERS_AGREE].text
    # Those of a limit cycle.
    changes = ["graph={name: ring, agents: 12, leaders: [0, 6]}", "leader.start_error={}",
               "initial={states: {0: [2.0, 0.0], 6: [-1.0, 0.5]}}"]  # fmt: skip
    built = ech.build(ech.load_scenario("van-der-pol", changes))
    found, result = ech.guarantee(*built), ech.simulate(*built)
    line = found.hypotheses[Hypothesis.LEADERS_AGREE]
    away = np.linalg.norm(result.states[:, 6] - result.states[:, 0], axis=1)
    assert not found.promised and line.number == pytest.approx(away.max(), rel=1e-2)
    assert "leader 6 starts 3.04 off the place that leader 0 gives it" in line.text
    assert "Cause" not in ech.report(result)


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


def test_a_v_of_rounding_blames_nobody():
    model, circle = ech.models.DoubleIntegrator(2, drag=0.7), ech.references.Circle()
    gain = ech.synthesize(model, PATH, ech.gains.Riccati())
    parts = parts_of(model, PATH, gain, leader=ech.laws.Tracking(circle))
    v = ech.lyapunov(ech.simulate(parts, settings()))
    assert v.value.max() < 1e-28 and not v.rises().any() and not v.forbidden().any()


@pytest.mark.slow
def test_only_a_law_that_keeps_the_theorem_is_promised_it():
    model, circle = ech.models.DoubleIntegrator(2), ech.laws.Tracking(ech.references.Circle())
    gain = ech.synthesize(model, PATH, ech.gains.Contraction({}, rate=0.3))
    kept = {"none": (True, False), "relay": (True, True), "relay-velocity": (True, True)}
    for feedforward in map(str, Feedforward):
        proved = kept.get(feedforward, (False, False))
        for leader, proves in zip((None, circle), proved, strict=True):
            found = ech.guarantee(parts_of(model, PATH, gain, feedforward, leader), settings())
            assert found.promised and found.theorem == (Theorem.T1 if proves else None)
    # What `none` is not promised, it does not keep: errors grow from nothing behind a circle.
    parts = parts_of(model, PATH, gain, "none", circle)
    errors = ech.simulate(parts, settings(horizon=10.0)).errors
    assert np.abs(errors[0]).max() == 0.0 and np.abs(errors[-1]).max() > 0.1
    rests = "the leader's input rests at its trim"
    assert rests in in_words(ech.guarantee(parts, settings()))


def test_a_parent_that_is_the_leader_relays():
    model = ech.models.DoubleIntegrator(1)
    for graph, kept in ((ech.Graph.star(4), True), (PATH, False)):
        gain = ech.synthesize(model, graph, ech.gains.Contraction({}, rate=0.3))
        relayed, passed_on = (
            ech.guarantee(parts_of(model, graph, gain, feedforward), settings()).region
            for feedforward in ("relay", "parent")
        )
        assert relayed is not None and (passed_on is not None) == kept
        assert not kept or passed_on.rate == relayed.rate


@pytest.mark.slow
def test_the_relayed_velocity_has_no_local_theorem_where_g_varies():
    model, bounds = ech.models.PlanarQuadrotor(), {"roll": 0.2, "thrust": 1.0}
    gain = ech.synthesize(model, PATH, ech.gains.RobustLQR(bounds))
    moving = ech.laws.Tracking(ech.references.Circle(radius=0.2, rate=0.1))
    # A leader that keeps to its trim makes no velocity that g could turn.
    for leader, velocity in ((moving, None), (None, Theorem.T2)):
        for feedforward, theorem in (("relay", Theorem.T2), ("relay-velocity", velocity)):
            parts = parts_of(model, PATH, gain, feedforward, leader)
            assert ech.guarantee(parts, settings(dt=0.002)).theorem is theorem


def test_agents_that_are_all_alike_agree_at_the_rate_of_the_whole_graph():
    built = ech.build(ech.load_scenario("integrators", ["simulation.horizon=30"]))
    found, L = ech.guarantee(*built), built.parts.graph.laplacian().toarray()
    # The input is held over steps of 0.01 s.
    assert found.rate == pytest.approx(-np.log1p(-0.01 * np.linalg.eigvalsh(L)[1]) / 0.01)
    errors = np.linalg.norm(ech.simulate(*built).errors, axis=(1, 2))
    seen = -np.log(errors[-1] / errors[-200]) / (199 * 0.1)
    assert seen == pytest.approx(found.rate, rel=1e-5)


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


WIND = ech.World(disturbance=ech.Disturbance(constant={"rate": 0.01}))
NOT = "The proof does not cover this run: "


@pytest.mark.parametrize(
    ("factor", "world", "told"),
    [
        (0.9, ech.World(), "The proof covers this run: the starts lie in the certified set"),
        (1.02, ech.World(), "The proof covers this run: all agents were in the certified set at"),
        (4.0, ech.World(), f"{NOT}agent 3 left the domain at 0."),
        (0.5, WIND, f"{NOT}wind or noise acts on the agents."),
    ],
)
def test_the_report_says_whether_the_proof_covers_the_run(swinging, factor, world, told):
    parts = swinging(factor).replace(world=world)
    report = " ".join(ech.report(ech.simulate(parts, settings())).split())
    assert told in report
    starts = ech.guarantee(parts, settings()).hypotheses[Hypothesis.STARTS]
    assert starts.fails is (factor > 2.0)
    assert "guaranteed for linear agents" not in report


@pytest.mark.slow
def test_a_run_that_will_grow_says_what_would_not(echelon):
    quick = ["--set", "simulation.horizon=0.5", "--set", "simulation.dt=0.05", "--no-figures"]
    code, _, err = echelon("run", "planar-quadrotor", *quick, "--out", "o")
    assert code == 0 and err.startswith("echelon: Not guaranteed\n  since")
    [shorter] = re.findall("with +`--set (simulation.dt=[^`]*)` there is a guarantee", err)
    assert ech.guarantee(*ech.build(ech.load_scenario("planar-quadrotor", [shorter]))).promised
    assert echelon("run", "planar-quadrotor", *quick, "--out", "p", "--json")[2] == ""


def test_the_data_of_a_run_hold_the_whole_promise():
    model = ech.models.Pendulum()
    gain = ech.synthesize(model, PATH, ech.gains.Riccati())
    parts = parts_of(model, PATH, gain)
    result = ech.simulate(parts, settings(horizon=0.1))
    told, data = ech.summary(result)["guarantee"], ech.dataset(result)
    assert told.pop("covered") is None
    assert told == ech.guarantee(parts, settings(horizon=0.1)).as_mapping()
    # These lines are there only for laws that turn, graphs that switch, motors, networks, ...
    apart = {Hypothesis.HEADING_FRAME, Hypothesis.SWITCHING, Hypothesis.LIMITS, Hypothesis.SPEEDS}
    apart |= {Hypothesis.AGES, Hypothesis.HELD, Hypothesis.LEADER}
    apart |= {Hypothesis.MESSAGES, Hypothesis.OWN_STATE, Hypothesis.SEPARATION, Hypothesis.EVENTS}
    always = {h.value for h in Hypothesis if h not in apart}
    assert {each["name"] for each in told["conditions"]} == always
    for each in told["conditions"]:
        assert each["value"] is None or isinstance(each["value"], (int, float))
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


CARTS = ech.models.DoubleIntegrator()


def stopping(edges=((0, 1), (1, 2)), offset=1.0, model=CARTS, **more):
    graph = ech.Graph(edges)
    places = ech.Formation.from_offsets(model, graph, {1: (offset, 0.0), 2: (2.0, 0.0)})
    leader = ech.laws.StoppingLeader(reference=ech.references.Circle(rate=0.5))
    return ech.Parts(model, graph, places, ech.Laws(leader, ech.laws.StoppingPoint()), **more)


class OwnCart(ech.models.DoubleIntegrator):
    """A user's model."""


def test_a_guarantee_is_stored_for_its_parts_and_settings_alone(monkeypatch):
    stored = []
    monkeypatch.setattr(module, "load_or_compute", lambda _, *values: stored.append(values) or "")
    radio = ech.World(network=ech.Network(rate=25.0))
    for parts, chosen in (
        (stopping(), settings()),
        (stopping(), settings(dt=0.02)),
        (stopping(edges=((0, 1), (1, 2, 2.0))), settings()),
        (stopping(edges=((0, 1), (0, 2))), settings()),
        (stopping(offset=1.5), settings()),
        (stopping(initial={"position": 0.5}), settings()),
        (stopping(events=[ech.network.Cut((1, 2), 0.5, 0.2)]), settings()),
        (stopping(leadership=ech.Leadership((1,))), settings()),
        (stopping(world=radio), settings()),
        (stopping(model=OwnCart()), settings()),
        (stopping(), settings()),
    ):
        module.guarantee_data(parts, chosen)
    *keys, own, again = [digest(values) for values in stored]
    assert None not in keys and len({*keys}) == len(keys) and again == keys[0]
    # Nothing is stored of a user's model.
    assert own is None


def test_plans_are_promised_nothing():
    model, goals = ech.models.DoubleIntegrator(2), ech.Formation(np.zeros((4, 4)))
    parts = ech.Parts(model, PATH, goals, ech.optimal.Plans(ech.references.Circle()))
    assert in_words(ech.guarantee(parts, settings())) == (
        "Not guaranteed since no theorem covers `Plans` would help use laws that a theorem covers"
    )


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
    parts = parts_of(model, PATH, identity_gain(model))
    promise = ech.guarantee(parts, settings())
    assert promise.promised == promised != ("actuators" in in_words(promise))
    assert ech.guarantee(parts, settings(limits=False)).promised


def identity_gain(model, graph=PATH):
    return ech.synthesize(model, graph, ech.gains.FixedGain("identity", coupling=0.5))


def test_slopes_of_both_sides_that_contract_are_promised_without_a_linearization():
    grows = of_one_state(lambda x: -x + 3.0 * jnp.abs(x))
    promise = ech.guarantee(parts_of(grows, PATH, identity_gain(grows)), settings())
    assert not promise.promised
    assert "the rate of `x` bends or jumps with `x` at the trim" in in_words(promise)
    model = of_one_state(lambda x: -2.0 * x + jnp.maximum(x, 0.0))
    promise = ech.guarantee(parts_of(model, PATH, identity_gain(model)), settings())
    assert promise.promised and (promise.kind, promise.theorem) == (Kind.VERTICES, Theorem.T1)
    # The slower side, -1, and c times the smallest eigenvalue of the graph.
    assert promise.rate == pytest.approx(1.0 + 0.5 * PATH.spectrum().low, rel=1e-6)
    assert promise.domain == "x in [-0.001, 0.001]"
    # A hull of both sides is promised across the bend.
    gain = ech.synthesize(model, PATH, ech.gains.Contraction({"x": 2.0}, coupling=1.0))
    promise = ech.guarantee(parts_of(model, PATH, gain), settings())
    assert promise.promised and promise.kind is Kind.PROOF and promise.rate >= 0.99


def test_an_inner_loop_closes_around_the_slopes_of_both_sides():
    model = of_one_state(dragging, "xv")
    gain = ech.synthesize(model, PATH, ech.gains.InnerLoop())
    assert gain.inner is not None
    promise = ech.guarantee(parts_of(model, PATH, gain), settings())
    assert promise.promised and (promise.kind, promise.theorem) == (Kind.VERTICES, Theorem.T1)
    modes = np.linalg.eigvalsh(PATH.grounded_laplacian().toarray())
    assert 0.0 < promise.rate <= slowest_of_sides(gain, modes) + 1e-9


def slowest_of_sides(gain, modes):
    """How slowly modes decay where a mass has the drag of its slower side, 1/s."""
    B, inner = np.eye(2)[:, 1:], np.zeros((1, 2)) if gain.inner is None else gain.inner
    pull = gain.coupling * np.linalg.solve(gain.R, B.T @ gain.P)
    sides = [np.array([[0.0, 1.0], [0.0, -drag]]) for drag in (0.0, 0.5)]
    closed = [A - B @ (inner + mode * pull) for A in sides for mode in modes]
    return -max(np.linalg.eigvals(A).real.max() for A in closed)


class Bent(ech.ControlAffine):
    """Its drift and its input map bend at the trim."""

    state_names, input_names = ("x",), ("push",)

    def drift(self, x):
        return -2.0 * x + jnp.maximum(x, 0.0)

    def input_map(self, x):
        return (1.0 + 0.3 * jnp.abs(x))[:, None]


@pytest.mark.parametrize("feedforward", ["none", "relay", "relay-velocity"])
def test_a_leader_at_its_trim_has_no_velocity_that_a_bend_of_g_could_turn(feedforward):
    parts = parts_of(Bent(), PATH, identity_gain(Bent()), feedforward)
    promise = ech.guarantee(parts, settings())
    assert promise.promised and (promise.kind, promise.theorem) == (Kind.VERTICES, Theorem.T2)
    # g is 1 at the trim, and 1.0003 at the edge of what was looked at.
    assert promise.rate == pytest.approx(1.0 + 0.5 * PATH.spectrum().low, rel=1e-3)


def fence(x):
    return jnp.stack([x[1], -x[1] - x[0] - 2.0 * jnp.maximum(x[0] - 5.0, 0.0)])


@pytest.mark.parametrize(
    ("drift", "domain", "proved"),
    [
        (lambda x: jnp.stack([x[1], -x[1]]), {"v": 2.0}, True),
        (fence, {"x": 6.0, "v": 2.0}, False),
        (lambda x: jnp.stack([x[1], -x[1] - jnp.sin(x[1])]), {"v": 1.0}, True),
    ],
)
def test_offsets_are_proved_on_the_domain_or_said_to_be_tried(drift, domain, proved):
    model = of_one_state(drift, "xv")
    gain = ech.synthesize(model, PATH, ech.gains.RobustLQR(domain, exact=True))
    apart = ech.Formation(np.arange(4.0)[:, None] * [1.0, 0.0])
    promise = ech.guarantee(parts_of(model, PATH, gain).replace(formation=apart), settings())
    line = promise.hypotheses[Hypothesis.SYMMETRY]
    assert line.verdict is (Verdict.HOLDS if proved else Verdict.FAILS)
    assert line.kind is (Kind.PROOF if proved else Kind.SAMPLES)
    assert promise.promised == proved
    assert promise.kind is (Kind.PROOF if proved else Kind.LINEARIZATION)


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
    assert in_words(promise).startswith("Guaranteed (vertices of a hull, T1)")
    assert not {"slowest_mode", "edge"} & promise.as_mapping()["numbers"].keys()
    for text in (in_words(promise), ech.report(ech.simulate(parts, run))):
        assert not any(words in " ".join(text.split()) for words in NOTHING_LINEAR)
    for line in ech.check(parts, settings()).lines:
        # What a gain says of itself is compared, and promises nothing.
        told = line.statement is not Hypothesis.CLAIMS and line.kind is Kind.LINEARIZATION
        assert not told or line.verdict is not Verdict.HOLDS, line
    # Every side of the trim, held: the rate promised is below that of any of them.
    assert promise.rate <= slowest_of_sides(gain, [PATH.spectrum().low])
    rows = ech.design((parts, settings()), "riccati")
    (row,) = rows.designs
    assert row.stable and row.fastest is None and row.factors is None
    assert "slowest mode" not in rows.because


def test_a_step_too_long_for_one_side_of_a_bend_is_not_promised():
    # A stiff side, which the derivative that JAX takes at the trim does not show.
    model = of_one_state(lambda x: -x - 300.0 * jnp.maximum(x - 0.0, 0.0) ** 1)
    parts = parts_of(model, PATH, ech.synthesize(model, PATH, ech.gains.FixedGain("identity")))
    for dt, holds in ((0.005, True), (0.05, False)):
        promise = ech.guarantee(parts, settings(dt=dt))
        assert promise.promised is holds
        assert promise.hypotheses[Hypothesis.SAMPLING].fails is not holds


@final
@dataclasses.dataclass(frozen=True, eq=False, kw_only=True)
class RestPromise(Guarantee):
    """What is guaranteed of followers that rest: nothing grows."""

    ground = None
    rate = slowest = 0.0

    @classmethod
    def of(cls, prepared, settings, brief=False):
        leaders = leaders_of(prepared.parts, prepared.problem.states)
        case = GuaranteeInputs(prepared.parts, settings, loop_of(prepared.parts), leaders)
        own = (statement.holds(name, Kind.PROOF, "it rests") for name in REQUIRED)
        lines = {line.statement: line for line in (*agent_lines(case), *own)}
        return cls(loop=case.loop, hypotheses=lines, ignores=(), leader_mode=None)

    def longest_step(self, settings):
        return float("inf")

    def claim(self):
        return Claim(ClaimKind.BOUNDED, ("where they start",))

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
    assert found.as_mapping()["claim"] == "bounded"
    assert ech.check(parts, settings()).promise is found
    report = ech.report(ech.simulate(parts, settings(horizon=0.1)))
    assert "V never rises from where they start" in " ".join(report.split())
    seeds = [settings()._replace(seed=k) for k in range(2)]
    assert [type(each) for each in promises(parts, seeds)] == [RestPromise, RestPromise]
    other = parts.replace(drive=ech.Laws(TrimInput(), TrimInput()))
    assert not ech.guarantee(other, settings()).promised


@pytest.mark.parametrize("dt", [0.01, 0.001])
def test_no_remedy_asks_for_a_step_of_zero_or_less(dt):
    given = {
        "name": "cut",
        "model": {"name": "double-integrator", "parameters": {"dimension": 2}},
        "graph": {"name": "ring", "agents": 6},
        "reference": {"name": "circle", "radius": 3.0, "rate": 0.3},
        "events": [{"at": 5.0, "cut": [0, 1]}],
        "simulation": {"horizon": 15.0, "dt": dt},
    }
    promise = ech.guarantee(*ech.build(ech.scenario_from_mapping(given)))
    for line in promise.hypotheses.values():
        for number in re.findall(r"(?:below|than|to) (-?[\d.e+-]*\d|inf|nan)", line.remedy):
            assert 0.0 < float(number) < np.inf, line.remedy
    # Nothing grows on either graph, and the last one decides.
    assert promise.promised


class Reversed(ech.models.DoubleIntegrator):
    """Its difference of two states has the wrong sign, which no slope of f or g shows."""

    def difference(self, x, y):
        return y - x


def test_a_difference_that_is_not_x_minus_y_leaves_nothing_guaranteed():
    model = Reversed(dimension=1)
    gain = ech.synthesize(model, PATH, ech.gains.Riccati())
    parts = parts_of(model, PATH, gain, initial={"position": 0.1})
    result = ech.simulate(parts, settings())
    assert np.abs(result.errors[-1]).max() > 10.0 * np.abs(result.errors[0]).max()
    found = ech.guarantee(parts, settings())
    assert not found.promised and found.slowest > 1.0
