"""No sentence states more than its number: each is read back and compared with the exact one."""

import dataclasses
import decimal
import math
import re

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from in_words import in_words

import echelon as ech
from echelon.core.claim import Number, Rounding
from echelon.core.statement import Hypothesis, Topic
from echelon.core.words import Kind, Theorem, Verdict
from echelon.experiments.studies.basin import Radii
from echelon.guarantees.messages.late_messages import AgeLimits, LateMessages, LateRate
from echelon.guarantees.promises.region import CertifiedSet, set_line
from echelon.guarantees.stopping.motor_load import Alone, MotorLoad
from echelon.guarantees.stopping.separation import Separation
from echelon.guarantees.stopping.tube import Tube
from echelon.laws.law import TrimInput
from echelon.output.viewer.replay import guarantee_badge
from echelon.synthesis.certificates.domain import Domain

BELOW, ABOVE = -1, 1
"""What is stated may not be more than the number, or not less."""
SIZES = st.floats(1e-3, 1e4)


def assert_safe(text, number, side):
    """A text states a number from its safe side, and no less than its digits have to."""
    # Beyond twelve digits there is rounding of the computation.
    shown, exact = decimal.Decimal(text), decimal.Decimal(f"{number:.12g}")
    assert (shown - exact) * side >= 0
    assert abs(shown - exact) <= abs(exact) * decimal.Decimal("0.01")


def tube(rate=1.0, arrival=None, motors=None, network=None):
    return Tube(rate, (1.0,), 1.0, 1.0, arrival, ("any",), (), motors, network=network)


def late(steps=3, dt=1.0, **changes):
    """What T9 says of followers along one way, with messages lost."""
    ages = AgeLimits(5, steps, 7, 1, dt, 0.1)
    numbers = {"rate": 1.0, "ways": np.array([1, 3]), "rates": ()} | changes
    rest = {"weights": np.ones(2), "sums": np.ones(1), "spread": 2.0, "coupling": 1.0}
    return LateMessages(ages=ages, speed=1.0, **rest | numbers)


def both_ways(rate):
    return late(ways=None, rate=0.5 * rate, rates=(LateRate(rate, np.ones(2)),))


def apart(**changes):
    numbers = {"safety": ech.Safety(radii=(0.1, 0.1, 0.3)), "tube": tube(), "least": 1.0}
    rest = {"pair": (0, 1), "gap": np.ones((1, 3)), "scales": np.ones(3), "speeds": np.ones(3)}
    rest |= {"axes": ("x", "y"), "step": 0.01, "ideal": True, "kind": Kind.PROOF}
    return Separation(**rest | numbers | changes)


def data(numbers, what="converges", theorem="T5", **more):
    """A guarantee as its data."""
    stated = {"verdict": "guaranteed", "claim": what, "theorem": theorem, "kind": "proof"}
    lists = dict.fromkeys(("start", "graphs", "premises", "notes", "conditions", "ignores"), ())
    shown = {name: x.as_mapping() for name, x in numbers.items()}
    return stated | lists | {"numbers": shown} | more


def said(found):
    """What is said of a tube, or of distances."""
    claim, rate = found.claim(), getattr(found, "rate", None)
    numbers = {} if rate is None else {"rate": Number(rate, "1/s", Rounding.DOWN)}
    phrases = {name: getattr(claim, name) for name in ("start", "graphs", "premises", "notes")}
    stated = data(numbers | dict(claim.numbers), str(claim.what), str(found.theorem), **phrases)
    return in_words(stated)


def motors(least=0.01, largest=0.1, most=0.2, tilt=0.1, alone=None):
    return MotorLoad(least, largest, most, tilt, alone, {})


def loaded(**numbers):
    return said(tube(motors=motors(**numbers)))


def alone(**changes):
    one = Alone(0.1, 1.0, 1.0, 1.0, False)._replace(**changes)
    return said(tube(motors=motors(alone=one)))


def badge(rate, theorem="T1", slowest=None):
    slowest = -rate if slowest is None else slowest
    modes = Number(rate, "1/s", Rounding.DOWN), Number(slowest, "1/s", Rounding.UP), Number(2.0)
    names = "rate", "slowest_mode", "coupling"
    return guarantee_badge(data(dict(zip(names, modes, strict=True)), theorem=theorem))


def domain(bounds):
    model = ech.models.DoubleIntegrator(1)
    return Domain.about(model, bounds).in_words(model)


KINDS = {
    "rate of T5": (BELOW, r"rate (\S+) 1/s", lambda x: said(tube(x))),
    "arrival of T5": (ABOVE, r"after (\S+) s from", lambda x: said(tube(arrival=x))),
    "arrival of T9": (ABOVE, r"after (\S+) s from", lambda x: said(
        tube(arrival=x, network=late()))),
    "rate of T9": (BELOW, r"(\S+) 1/s while", lambda x: said(tube(network=both_ways(x)))),
    "age of T9": (BELOW, r"older than (\S+) ms", lambda x: said(tube(network=late(
        dt=x / 3e3, ways=None, rates=(LateRate(2.0, np.ones(2)),))))),
    "packets": (ABOVE, r"a packet after (\S+) s", lambda x: said(tube(network=late(dt=x / 3.0)))),
    "delay": (ABOVE, r"a delay of (\S+) s", lambda x: said(tube(network=late(dt=x / 6.0)))),
    "rate of T10": (BELOW, r"rate (\S+) 1/s", lambda x: said(apart(tube=tube(x)))),
    "radii": (BELOW, r"ellipsoids of (\S+) x", lambda x: said(apart(
        safety=ech.Safety(radii=(x, x, x))))),
    "distance": (BELOW, r"(\S+) m at the start", lambda x: apart(least=x).line.number_text),
    "kept": (BELOW, r"(\S+) m are kept", lambda x: apart(
        safety=ech.Safety(radii=(0.5 * x, 0.5 * x, x), margin=0.0)).line.text),
    "kept, claimed": (BELOW, r"(\S+) m are kept", lambda x: said(apart(
        safety=ech.Safety(radii=(0.5 * x, 0.5 * x, x), margin=0.0)))),
    "thrust, least": (BELOW, r"motors (\S+) N to", lambda x: loaded(least=x)),
    "thrust, largest": (ABOVE, r"to (\S+) N, of", lambda x: loaded(largest=x)),
    "tilt": (ABOVE, r"tilt (\S+) deg at", lambda x: loaded(tilt=math.radians(x))),
    "start, tilt": (BELOW, r"a tilt of (\S+) deg", lambda x: alone(tilt=math.radians(x))),
    "start, sideways": (BELOW, r"(\S+) m/s sideways", lambda x: alone(sideways=x)),
    "start, upward": (BELOW, r"or (\S+) m/s upward", lambda x: alone(upward=x)),
    "start, rate": (BELOW, r"(\S+) rad/s of roll", lambda x: alone(rate=x)),
    "set": (BELOW, r"radius (\S+)$", lambda x: set_line(
        None, CertifiedSet(x, Kind.PROOF, "")).number_text),
    "domain, upper end": (BELOW, r", (\S+)\]", lambda x: domain({"position": (-1.0, x)})),
    "domain, lower end": (BELOW, r"\[-(\S+),", lambda x: domain({"position": (-x, 1.0)})),
    "until an event": (BELOW, r"until (\S+) s", lambda x: in_words(data(
        {}, until={"at": x, "guarantee": data({})}))),
    "certified radius": (BELOW, r"certified (\S+);", lambda x: Radii(
        ("x", "y"), x, 1.0, 2.0, 1.0).sentence()),
    "observed radius": (BELOW, r"observed (\S+),", lambda x: Radii(
        ("x", "y"), 1.0, x, 2.0 * x, 1.0).sentence()),
    "badge": (BELOW, r": (\S+) 1/s", lambda x: badge(x)["short"]),
    "badge, by linearization": (BELOW, r"rate +(\S+) 1/s", lambda x: badge(x, None)["whole"]),
    "badge, slowest": (BELOW, r"decays\s+at (\S+)\s+1/s", lambda x: badge(
        0.5 * x, None, -x)["whole"]),
}  # fmt: skip


@pytest.mark.parametrize("kind", KINDS)
@settings(max_examples=40, deadline=None)
@given(SIZES)
def test_a_sentence_states_no_more_than_its_number(kind, x):
    side, pattern, text = KINDS[kind]
    [shown] = re.findall(pattern, text(x))
    assert_safe(shown, x, side)


@settings(max_examples=100, deadline=None)
@given(SIZES, st.floats(1.0, 1.001))
def test_a_thrust_that_suffices_is_not_stated_above_the_limit(x, more):
    text = loaded(largest=x, most=more * x)
    [(largest, most)] = re.findall(r"to (\S+) N, of (\S+) N", text)
    assert float(largest) <= float(most)


@settings(max_examples=40, deadline=None)
@given(st.floats(1e-3, 1e3), st.floats(1e-3, 1e3))
def test_the_sentence_of_a_region_states_no_more(robust, rate, radius):
    region = dataclasses.replace(robust.region, rate=rate)
    certified = CertifiedSet(radius, region.kind, "")
    text = in_words(dataclasses.replace(robust, region=region, certified=certified))
    assert_safe(re.findall(r"rate (\S+) 1/s", text)[0], rate, BELOW)
    assert_safe(re.findall(r"<= (\S+)\^2", text)[0], radius, BELOW)


@pytest.fixture(scope="module")
def robust():
    """A guarantee of a pendulum on a domain."""
    model, graph = ech.models.Pendulum(), ech.Graph.path(4)
    gain = ech.synthesize(model, graph, ech.gains.RobustLQR({"angle": 0.5}))
    laws = ech.Laws(TrimInput(), ech.laws.Consensus(gain))
    parts = ech.Parts(model, graph, ech.Formation(np.zeros((4, 2))), laws)
    found = ech.guarantee(parts, ech.Settings(horizon=2.0, dt=0.01))
    assert found.theorem is Theorem.T1
    return found


LINES = {
    Hypothesis.DISAGREEMENT_DECAY: (ABOVE, r"(\S+) 1/s", 1.0),
    Hypothesis.ALONG_PATH: (ABOVE, r"(\S+) 1/s", 1.0),
    Hypothesis.SWITCHING: (BELOW, r"(\S+) 1/s", 1.0),
    Hypothesis.REGION: (BELOW, r"(\S+) 1/s", 1.0),
    Hypothesis.SET: (BELOW, r"(?:radius )?(\S+)(?: off)?$", 1.0),
    Hypothesis.STARTS: (BELOW, r"(\S+) left$", 1.0),
    Hypothesis.SEPARATION: (BELOW, r"(\S+) m at", 1.0),
    Hypothesis.LIMITS: (BELOW, r"(\S+) \.\.", 1.0),
    Hypothesis.MESSAGES: (ABOVE, r"(\S+) ms", 1e3),
    Hypothesis.OWN_STATE: (BELOW, r"(\S+) ms", 1e3),
    Topic.LEADER_TRACKING: (ABOVE, r"(\S+) 1/s", 1.0),
    Topic.GAIN: (ABOVE, r"^(\S+) to", 1.0),
    Topic.DELAY: (BELOW, r"(\S+) ms", 1e3),
    Topic.SCALING: (ABOVE, r"(\S+) 1/s", 1.0),
    Topic.POSITIVE: (BELOW, r"(\S+)", 1.0),
    Topic.STRING: (ABOVE, r", (\S+) over", 1.0),
}
"""On which side the number of a line that holds is stated, where, and its factor."""

PARENTS = ("follower.feedforward=parent", "graph={edges: [[0, 1], [1, 2], [2, 3]]}")
QUICK = ("integrators", "van-der-pol", "unicycle")
SLOW = ("crossing", "leader-lost", "paper-radio", "paper-windy")


@pytest.mark.parametrize("name", [*QUICK, *(pytest.param(x, marks=pytest.mark.slow) for x in SLOW)])
def test_no_line_of_a_check_states_more_than_its_number(name):
    seen, changes = 0, PARENTS if name == "paper-windy" else ()
    for line in ech.check(*ech.build(ech.load_scenario(name, changes))).lines:
        side, pattern, scale = LINES.get(line.statement, (0, "", 1.0))
        found = re.findall(pattern, line.number_text) if side else ()
        if line.verdict is Verdict.HOLDS and found and math.isfinite(line.number):
            assert_safe(found[0], scale * line.number, side)
            seen += 1
    assert seen


def line_of(model, graph, laws, **more):
    """Agents a metre apart along x, under laws."""
    offsets = {k: [k, 0.0] for k in range(1, graph.agents)}
    formation = ech.Formation.from_offsets(model, graph, offsets)
    return ech.Parts(model, graph, formation, laws, {"position": 0.5}, **more)


@pytest.mark.slow
def test_a_guarantee_in_single_precision_says_that_it_ignores_its_rounding():
    """At 300 km numbers are 3 cm apart, and followers stay farther off than the guarantee says."""
    circle = ech.references.Circle(center=(3e5, 0.0, 0.0))
    laws = ech.Laws(ech.laws.StoppingLeader(reference=circle), ech.laws.StoppingPoint())
    parts = line_of(ech.models.DoubleIntegrator(2), ech.Graph.path(3), laws)
    ignored = "ignores numbers have single precision"
    for precision, left_out in (("float64", False), ("float32", True)):
        chosen = ech.Settings(horizon=6.0, dt=0.01, precision=precision)
        found, result = ech.guarantee(parts, chosen), ech.simulate(parts, chosen)
        assert found.promised and (ignored in in_words(found)) is left_out
        late = result.times >= found.tube.arrival
        assert (result.formation_errors[late].max() > 0.02) == left_out


METRES = re.compile(r"\b(m|cm|mm|m/s|m/s\^2)\b(?! 2 c)")


@pytest.mark.slow
@pytest.mark.parametrize(("x", "y", "unit"), [("ft", "ft", "ft"), ("m", "cm", "1")])
def test_nothing_is_stated_in_metres_of_positions_in_other_units(x, y, unit):
    """Nor in the unit of one coordinate where the others have another one."""
    units = {"__module__": __name__, "state_units": (x, y, f"{x}/s", f"{y}/s")}
    model = type("Scaled", (ech.models.DoubleIntegrator,), units)()
    graph = ech.Graph([(0, 1), (1, 2), (2, 3)], leaders=(0, 3))
    circle, chosen = ech.references.Circle(center=(0.0, 0.0, 0.0)), ech.Settings(1.0, 0.01)
    leader = ech.laws.StoppingLeader(reference=circle)
    radio = ech.Network(delay=0.2, messages="state")
    gain = ech.synthesize(model, graph, ech.gains.Riccati())
    for laws, more in (
        (ech.Laws(leader, ech.laws.StoppingPoint()), {"world": ech.World(network=radio)}),
        (ech.Laws(TrimInput(), ech.laws.Consensus(gain)), {"start_error": {"position": 0.1}}),
    ):
        parts = line_of(model, graph, laws, **more)
        checked = ech.check(parts, chosen)
        told = [in_words(checked.promise), ech.report(ech.simulate(parts, chosen))]
        told += [f"{line.number_text} {line.explanation}" for line in checked.lines]
        assert [text for text in told if METRES.search(text)] == []
        assert "world" not in more or f" {unit}/s" in " ".join(told)
