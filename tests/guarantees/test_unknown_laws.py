"""Laws of users' own: what they do is computed from them, and nothing of theorems is said."""

import jax.numpy as jnp
import numpy as np
import pytest

import echelon as ech
from echelon.core.words import Feedforward
from echelon.laws.law import Law
from echelon.laws.law_check import unknown_class
from echelon.synthesis.gains.gain import Gain

AGENT, GRAPH = ech.models.SingleIntegrator(), ech.Graph.path(4)
FORMATION = ech.Formation.line(AGENT, GRAPH)
GAIN = ech.synthesize(AGENT, GRAPH, ech.gains.Riccati())
SETTINGS = ech.Settings(horizon=2.0, dt=0.02)


class Push(ech.Law):
    """u = -weak K z; a negative number pushes agents apart, and the metric says nothing of it."""

    weak: float = 1.0
    gain: Gain | None = None

    def metric(self, model):
        return np.asarray(self.gain.P)

    def update(self, model, view, memory):
        K = self.gain.K(model) / self.gain.coupling
        return model.physical(-self.weak * (K @ view.disagreement)), memory


class Alone(ech.Law):
    """u = -x: it reads nothing of others."""

    def update(self, model, view, memory):
        return model.physical(-view.x), memory


class Told(ech.Law):
    """u = v_ff - z."""

    feedforward = Feedforward.RELAY

    def update(self, model, view, memory):
        return model.physical(view.feedforward - view.disagreement), memory


class Late(Alone):
    """It reads its neighbours after the step alone, into a memory."""

    def init(self):
        return jnp.zeros(2)

    def settle(self, model, view, desired, delivered, memory):
        return memory + view.disagreement


LAWS = {
    "pushes apart": Push(-2.0, GAIN),
    "comes together": Push(2.0, GAIN),
    "alone": Alone(),
    "told": Told(),
    "late": Late(),
}


NEIGHBOURS = "neighbours' states"
USED = {"alone": (), "told": (NEIGHBOURS, "the leader's input of the same step")}


def parts_of(law, leader=None):
    drive = ech.Laws(ech.laws.TrimInput() if leader is None else leader, law)
    return ech.Parts(AGENT, GRAPH, FORMATION, drive, initial={"position": 1.0})


HELD = {"comes together": True, "told": True, "pushes apart": False, "alone": False, "late": False}


@pytest.mark.parametrize("name", LAWS)
def test_what_is_said_of_a_law_of_ones_own_is_what_it_does(name):
    parts = parts_of(LAWS[name])
    found = ech.guarantee(parts, SETTINGS)
    told = found.as_mapping()
    assert found.promised is HELD[name] and (told["verdict"] == "guaranteed") is HELD[name]
    # No theorem and no metric of its own speaks of it.
    assert "edge" not in told["numbers"] and told["theorem"] is told["certified_set"] is None
    longer = SETTINGS._replace(horizon=20.0)
    result = ech.simulate(parts, longer)
    errors = np.abs(result.errors[[0, -1]]).max(axis=(1, 2))
    assert bool(errors[1] < 0.05 * errors[0]) is HELD[name]
    if HELD[name]:
        late = np.abs(result.errors[[-100, -1]]).max(axis=(1, 2))
        seen = np.log(late[0] / late[1]) / (99 * SETTINGS.dt)
        assert found.rate == pytest.approx(seen, rel=1e-3)
    report = str(ech.report(result))
    for text in ("Linearized", "does not act", "Cause"):
        assert text not in report
    assert ("nothing from others" in report) is (name == "alone")
    assert ech.summary(result)["guarantee"]["covered"] is None
    # What it uses of others is read off its trace.
    assert parts.information.follower == USED.get(name, (NEIGHBOURS,))


def test_a_leader_with_a_path_beside_an_unknown_law_has_a_reference():
    parts = parts_of(Alone(), ech.laws.Tracking(ech.references.Circle(rate=0.1)))
    lines = {line.name: line for line in ech.check(parts, SETTINGS).lines}
    assert lines["Assumption 4, leader tracks"].text == "at the trim"


class Elsewhere(ech.laws.StoppingLeader):
    """It is expected where it is not."""

    def expected(self, model, t, deviation, age, period):
        there = super().expected(model, t, deviation, age, period)
        return there._replace(signal=there.signal + 1.0)


class Driven(ech.laws.StoppingPoint):
    """Its input has the wrong sign."""

    def update(self, model, view, memory):
        u, memory = super().update(model, view, memory)
        return -u, memory


@pytest.mark.parametrize("network", [None, ech.Network(rate=50.0, loss=0.1)])
def test_what_is_proved_of_laws_is_not_of_their_subclasses(network):
    leader, follower = ech.laws.StoppingLeader(), ech.laws.StoppingPoint()
    known, own = [(follower, leader)], [(Driven(), leader), (follower, Elsewhere())]
    for laws, theorem in ((known, True), (own, False)):
        for pair in laws:
            parts = parts_of(*pair).replace(world=ech.World(network=network))
            found = ech.guarantee(parts, SETTINGS)
            assert (found.theorem is not None) is theorem
            assert found.promised or not theorem
    assert not ech.guarantee(parts_of(Driven(), leader), SETTINGS).claimed


CODE = sorted(
    name
    for base in (ech.laws.Consensus, Law)
    for name, value in vars(base).items()
    if not name.startswith("_") and (callable(value) or isinstance(value, property))
)


def test_a_subclass_that_replaces_a_method_is_unknown():
    for name in {*CODE}:

        def own(self, *arguments, name=name):
            return getattr(super(ech.laws.Consensus, self), name)(*arguments)

        value = property(own) if isinstance(getattr(Law, name, None), property) else own
        law = type("Own", (ech.laws.Consensus,), {name: value, "__module__": __name__})(GAIN)
        words = {"information", "warnings", "refusals"}
        assert unknown_class(law) == ("" if name in words else "Own"), name


class Renamed(ech.laws.Consensus):
    """Another name, and a number of its own."""

    extra: float = 1.0


class Still(ech.references.Hover):
    """A path of one's own."""

    def place(self, t):
        return super().place(t)


class Mixin:
    """A method that wins over that of a law which stands behind it."""

    def broadcast(self, model, x, v):
        return -v


class Mixed(Mixin, ech.laws.Consensus):
    """What it sends has the wrong sign."""


class Behind(ech.laws.Consensus, Mixin):
    """The bundled method wins."""


class Reversed(Gain):
    """A gain whose feedback has the wrong sign."""

    def feedback(self, *arguments):
        return -super().feedback(*arguments)


def test_code_counts_wherever_it_stands_and_numbers_do_not():
    own = Reversed(GAIN.P, GAIN.R, GAIN.coupling, GAIN.method, GAIN.certificate)
    hover = ech.references.Hover()
    for law, name in (
        (ech.laws.Consensus(GAIN), ""),
        (Renamed(GAIN), ""),
        (Behind(GAIN), ""),
        (Mixed(GAIN), "Mixed"),
        (ech.laws.Consensus(own), "Reversed"),
        (ech.laws.Tracking(hover, reaction=own), "Reversed"),
        (ech.laws.Tracking(Still()), ""),
        (ech.laws.TrimInput(), ""),
        (ech.laws.StoppingPoint(), ""),
    ):
        assert unknown_class(law) == name
