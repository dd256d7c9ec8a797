"""Claims where inputs have limits that nothing bounds: conditional, never guaranteed."""

import json

import numpy as np
import pytest
from in_words import in_words

import echelon as ech
from echelon.core.statement import Hypothesis
from echelon.core.words import GuaranteeVerdict
from echelon.output.viewer.replay import guarantee_badge

GRAPH = ech.Graph.path(3)
SETTINGS = ech.Settings(horizon=4.0, dt=0.01)
WHILE = "no input of any agent is at a limit"


class Cart(ech.models.DoubleIntegrator):
    """A double integrator whose inputs have limits."""

    most: float = 0.05

    @property
    def input_limits(self):
        m = len(self.input_names)
        return ech.models.Limits(np.eye(m), (-self.most,) * m, (self.most,) * m)


WIDE = {"position": 90.0, "velocity": 90.0}
DOUBLE = ech.models.DoubleIntegrator(dimension=2)


def parts_of(model, kind, spread=1.0, domain=WIDE, **more):
    """Parts under a law whose claim is that of a theorem."""
    formation = ech.Formation.line(model, GRAPH)
    if kind == "T5":
        circle = ech.references.Circle(radius=0.5, rate=0.2)
        laws = ech.Laws(ech.laws.StoppingLeader(reference=circle), ech.laws.StoppingPoint())
    else:
        gain = ech.synthesize(model, GRAPH, ech.gains.RobustLQR(domain=domain))
        laws = ech.Laws(ech.laws.TrimInput(), ech.laws.Consensus(gain, feedforward="relay"))
    return ech.Parts(model, GRAPH, formation, laws, initial={"position": spread}, **more)


@pytest.mark.slow
def test_a_limit_leaves_a_claim_to_the_run():
    kind = "T5"
    weak, strong = (Cart(dimension=2, most=most) for most in (0.05, 1e3))
    found = ech.guarantee(parts_of(weak, kind), SETTINGS)
    told = found.as_mapping()
    assert found.verdict is GuaranteeVerdict.CONDITIONAL and not found.promised and found.claimed
    assert str(found.theorem) == kind == told["theorem"]
    assert told["verdict"] == "conditional" and found.conditions == (WHILE,)
    assert in_words(found).startswith(f"Conditional (exact proof, T5) while {WHILE} ")
    assert found.hypotheses[Hypothesis.LIMITS].fails
    # The run that meets its limits, and misses, is not covered; the one that never does is.
    for model, covered in ((weak, False), (strong, True)):
        result = ech.simulate(parts_of(model, kind), SETTINGS)
        assert bool(result.saturated.max() == 0.0) is covered
        assert ech.summary(result)["guarantee"]["covered"] is covered
        what = "proof" if covered else "conditional claim"
        says = "covers this run" if covered else "does not cover this run: a limit acted"
        assert f"The {what} {says}" in " ".join(str(ech.report(result)).split())
    assert ech.guarantee(parts_of(strong, kind), SETTINGS).promised


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["T1", "T5"])
def test_a_claim_is_guaranteed_without_limits_of_the_model_and_of_every_plant(kind):
    free, (wide, weak) = DOUBLE, (Cart(dimension=2, most=most) for most in (np.inf, 0.05))
    for parts, settings in (
        (parts_of(free, kind), SETTINGS),
        (parts_of(weak, kind), SETTINGS._replace(limits=False)),
    ):
        found = ech.guarantee(parts, settings)
        assert found.verdict is GuaranteeVerdict.GUARANTEED and found.promised, in_words(found)
        assert in_words(found).startswith("Guaranteed (")
    for world in (ech.World(plant=weak), ech.World(plants={2: weak})):
        found = ech.guarantee(parts_of(wide, kind, world=world), SETTINGS)
        # T1 is about agents that move as the model says; near the goals no limit acts.
        near = kind == "T1" and found.promised and found.theorem is None
        assert near or found.verdict is GuaranteeVerdict.CONDITIONAL


def test_only_the_leader_at_its_limit_leaves_a_run_uncovered():
    model = Cart(dimension=2, most=0.5)
    parts = parts_of(model, "T5", spread=0.0)
    leader = ech.laws.StoppingLeader(reference=ech.references.Circle(radius=1.0, rate=1.0))
    parts = parts.replace(drive=ech.Laws(leader, parts.drive.follower))
    result = ech.simulate(parts, SETTINGS)
    assert result.saturated[0] > 0.0
    assert ech.summary(result)["guarantee"]["covered"] is False


@pytest.mark.slow
def test_the_badge_says_what_is_conditional_and_what_is_none():
    found = ech.guarantee(*ech.build(ech.load_scenario("crossing")))
    assert found.verdict is GuaranteeVerdict.CONDITIONAL and str(found.theorem) == "T10"
    badge = guarantee_badge(found.as_mapping())
    assert badge["state"] == "edge" and WHILE in badge["short"]
    found = ech.guarantee(*ech.build(ech.load_scenario("leader-lost")))
    assert found.verdict is GuaranteeVerdict.NONE and found.conditions == ()
    assert guarantee_badge(found.as_mapping())["short"] == "no guarantee"


@pytest.mark.parametrize("network", [None, "network={rate: 50, delay: 0.02}"])
def test_of_a_leader_that_is_lost_no_loop_without_it_is_judged(network):
    settings = [
        "leadership={backups: [1]}",
        "events=[{at: 12, lose: 0}]",
        *[network] * bool(network),
    ]
    if network:
        settings[0] = "leadership={backups: [1], timeout: 0.3}"
    found = ech.guarantee(*ech.build(ech.load_scenario("planar-quadrotor", settings)))
    # The loop of followers without anybody to follow is not what runs: the backup leads.
    assert not found.promised and found.reasons
    assert all("backup" in reason for reason in found.reasons)


WEAK = "plant={agents: {2: {parameters: {motor_thrust: 0.06}}}}"


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (WEAK, "cannot hold the trim"),
        # A Crazyflie of 28 g hovers at 0.028 * 9.81 / 4 = 0.0687 N a motor.
        ("actuator={minimum: 0.07}", "more than the trim needs"),
        ("actuator={minimum: 0.03}", ""),
    ],
)
def test_motors_that_cannot_give_what_the_trim_needs_leave_nothing_guaranteed(change, said):
    found = ech.guarantee(*ech.build(ech.load_scenario("paper", [change])))
    assert found.promised is (said == "") and said in in_words(found)
    assert ("more than the trim" in in_words(found)) == ("0.07" in change)


def test_a_run_from_outside_the_set_that_stays_in_the_domain_is_covered_whatever_is_stored():
    pendulum, goals = ech.models.Pendulum(), np.zeros((3, 2))
    gain = ech.synthesize(pendulum, GRAPH, ech.gains.RobustLQR(domain={"angle": 1.0}))
    laws = ech.Laws(ech.laws.TrimInput(), ech.laws.Consensus(gain, feedforward="relay"))
    parts = ech.Parts(pendulum, GRAPH, ech.Formation(goals), laws)
    starts = np.array([[0.0, 0.0], [0.9, 0.0], [0.9, 0.0]])
    parts, short = parts.replace(initial=starts), SETTINGS._replace(horizon=0.05)
    # It ends before the certified set is reached.
    assert ech.guarantee(parts, short).hypotheses[Hypothesis.STARTS].fails
    for every in (1, 5):
        result = ech.simulate(parts, short._replace(store_every=every))
        assert ech.summary(result)["guarantee"]["covered"] is True


SCENARIO = f"""
name: carts
model: {{python: "{__file__}:Cart", parameters: {{dimension: 2}}}}
graph: {{name: path, agents: 3}}
formation: {{name: line}}
reference: {{name: circle, radius: 0.5, rate: 0.2}}
follower: {{law: stopping-point}}
initial: {{spread: {{position: 1.0}}}}
simulation: {{horizon: 2.0, dt: 0.01}}
"""


@pytest.mark.slow
def test_check_run_sweep_verify_and_json_agree(echelon, tmp_path):
    (tmp_path / "carts.yaml").write_text(SCENARIO)
    code, out, _ = echelon("check", "carts.yaml")
    assert code == 1 and f"while {WHILE}" in " ".join(out.split())
    code, out, _ = echelon("check", "carts.yaml", "--json")
    assert code == 1 and json.loads(out)["guarantee"]["verdict"] == "conditional"
    code, out, _ = echelon("run", "carts.yaml", "--no-figures", "--out", "o")
    assert code == 0 and "does not cover this run" in " ".join(out.split())
    told = json.loads((tmp_path / "o" / "summary.json").read_text())
    assert told["guarantee"]["verdict"] == "conditional" and told["guarantee"]["covered"] is False
    assert echelon("verify", "o", "--scenario", "o")[0] == 0
    told["guarantee"]["verdict"] = "guaranteed"
    (tmp_path / "o" / "summary.json").write_text(json.dumps(told))
    assert echelon("verify", "o", "--scenario", "o")[0] == 1
    over = ("--over", "model.parameters.most=0.05,1000")
    _, out, _ = echelon("sweep", "carts.yaml", *over, "--out", "s")
    said = " ".join(out.split())
    # A limit of 1000 is shown to suffice, and one of 0.05 is not.
    assert "With a guarantee: 1 of 2." in said
    assert "while no input is at a limit: 1; covered in every step: 0." in said


def test_no_edge_of_the_coupling_is_told_where_messages_are_late():
    gain = ech.synthesize(DOUBLE, GRAPH, ech.gains.Riccati())
    laws = ech.Laws(ech.laws.TrimInput(), ech.laws.Consensus(gain))
    formation = ech.Formation.line(DOUBLE, GRAPH)
    for network in (None, ech.Network(rate=20.0, delay=0.05, prediction="packet")):
        parts = ech.Parts(DOUBLE, GRAPH, formation, laws, world=ech.World(network=network))
        found = ech.guarantee(parts, SETTINGS)
        told = f"{found.hypotheses[Hypothesis.COUPLING].explanation} {in_words(found)}"
        assert ("edge" in found.as_mapping()["numbers"]) is (network is None)
        assert ("every mode decays" in told or "suffices" in told) is (network is None)
