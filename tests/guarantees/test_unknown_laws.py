"""Laws of users' own: echelon does not know them, and every reader of a guarantee says so."""

import json

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
UNKNOWN = "echelon does not know this law; no guarantee is computed"


class Push(ech.Law):
    """u = -weak K z; a negative number pushes agents apart, and the metric says nothing of it."""

    weak: float = 1.0
    gain: Gain | None = None

    def metric(self, model):
        return np.asarray(self.gain.P)

    def update(self, model, view, memory):
        K = self.gain.K(model) / self.gain.coupling
        return model.physical(-self.weak * (K @ view.disagreement)), memory


class Slow(ech.Law):
    """u = -z - rate * integral of z: unstable where the rate is negative."""

    rate: float = 0.5

    def metric(self, model):
        return np.eye(len(model.state_names))

    def init(self):
        return jnp.zeros(()), jnp.zeros(2)

    def update(self, model, view, memory):
        then, area = memory
        area = area + (view.t - then) * view.disagreement
        return model.physical(-view.disagreement - self.rate * area), (view.t, area)


class Alone(ech.Law):
    """u = -x: it reads nothing of others."""

    def update(self, model, view, memory):
        return model.physical(-view.x), memory


class Told(ech.Law):
    """u = v_ff - z."""

    feedforward = Feedforward.RELAY

    def update(self, model, view, memory):
        return model.physical(view.feedforward - view.disagreement), memory


LAWS = {
    "pushes apart": Push(-2.0, GAIN),
    "comes together": Push(2.0, GAIN),
    "wrong integral": Slow(-0.5),
    "alone": Alone(),
    "told": Told(),
}


def parts_of(law, leader=None):
    drive = ech.Laws(ech.laws.TrimInput() if leader is None else leader, law)
    return ech.Parts(AGENT, GRAPH, FORMATION, drive, initial={"position": 1.0})


@pytest.mark.parametrize("name", LAWS)
def test_nothing_is_said_of_a_law_that_echelon_does_not_know(name):
    parts = parts_of(LAWS[name])
    found = ech.guarantee(parts, SETTINGS)
    told = found.as_mapping()
    assert UNKNOWN in found.sentence() and str(found.verdict) == told["verdict"] == "none"
    assert not found.promised and not found.claimed
    numbers = ("rate", "slowest_mode", "coupling", "edge", "theorem", "certified_set")
    assert all(told[key] is None for key in numbers)
    result = ech.simulate(parts, SETTINGS)
    report = str(ech.report(result))
    for text in ("Linearized", "slowest mode", "does not act", "stable", "Cause"):
        assert text not in report
    assert ("nothing from others" in report) is (name == "alone")
    assert ech.summary(result)["covered"] is None
    assert "pole_real" not in ech.dataset(result)
    lines = {line.name: line for line in ech.check(parts, SETTINGS).lines}
    assert {x.name for x in lines.values() if x.fails} <= {
        *("disagreement decays", "Lemma 3, sum over edges"),
    }


@pytest.mark.parametrize(
    ("name", "information"),
    [
        ("pushes apart", ("neighbours' states",)),
        ("wrong integral", ("neighbours' states",)),
        ("alone", ()),
        ("told", ("neighbours' states", "the leader's input of the same step")),
    ],
)
def test_what_a_law_uses_of_others_is_read_off_its_trace(name, information):
    assert parts_of(LAWS[name]).information.follower == information


class Late(Alone):
    """It reads its neighbours after the step alone, into a memory."""

    def init(self):
        return jnp.zeros(2)

    def settle(self, model, view, desired, delivered, memory):
        return memory + view.disagreement


def test_what_a_law_reads_after_a_step_is_information_too():
    assert parts_of(Late()).information.follower == ("neighbours' states",)


def test_a_leader_with_a_path_beside_an_unknown_law_has_a_reference():
    parts = parts_of(Alone(), ech.laws.Tracking(ech.references.Circle(rate=0.1)))
    lines = {line.name: line for line in ech.check(parts, SETTINGS).lines}
    assert lines["Assumption 4, leader tracks"].text == "no mode of the leader is known"


def test_a_leader_that_echelon_does_not_know_leaves_nothing_guaranteed():
    class Away(ech.laws.TrimInput):
        """A leader that drives away."""

        def update(self, model, view, memory):
            return model.physical(jnp.ones(2)), memory

    law = ech.laws.Consensus(GAIN, feedforward="none")
    assert ech.guarantee(parts_of(law), SETTINGS).promised
    found = ech.guarantee(parts_of(law, Away()), SETTINGS)
    assert UNKNOWN in found.sentence() and not found.promised


# ---- what is known -------------------------------------------------------------------------------

CODE = sorted(
    name
    for base in (ech.laws.Consensus, Law)
    for name, value in vars(base).items()
    if not name.startswith("_") and (callable(value) or isinstance(value, property))
)


@pytest.mark.parametrize("name", sorted({*CODE}))
def test_a_subclass_that_replaces_a_method_is_unknown(name):
    def own(self, *arguments):
        return getattr(super(ech.laws.Consensus, self), name)(*arguments)

    value = property(own) if isinstance(getattr(Law, name, None), property) else own
    law = type("Own", (ech.laws.Consensus,), {name: value, "__module__": __name__})(GAIN)
    words = {"information", "warnings", "refusals"}
    assert unknown_class(law) == ("" if name in words else "Own")


class Renamed(ech.laws.Consensus):
    """Another name, and a number of its own."""

    extra: float = 1.0


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
    names = [
        (ech.laws.Consensus(GAIN), ""),
        (Renamed(GAIN), ""),
        (Behind(GAIN), ""),
        (Mixed(GAIN), "Mixed"),
        (ech.laws.Consensus(own), "Reversed"),
        (ech.laws.Tracking(ech.references.Hover(), reaction=own), "Reversed"),
    ]
    assert [unknown_class(law) for law, _ in names] == [name for _, name in names]
    assert all(not unknown_class(law) for law in (ech.laws.TrimInput(), ech.laws.StoppingPoint()))


def test_a_reference_of_ones_own_is_no_unknown_law():
    class Still(ech.references.Hover):
        """A path of one's own."""

        def place(self, t):
            return super().place(t)

    assert not unknown_class(ech.laws.Tracking(Still()))


# ---- every reader --------------------------------------------------------------------------------

FILE = """
import numpy as np
import echelon as ech

class Anti(ech.Law):
    weak: float = 1.0
    gain: ech.Gain | None = None
    def metric(self, model):
        return np.asarray(self.gain.P)
    def update(self, model, view, memory):
        K = self.gain.K(model) / self.gain.coupling
        return model.physical(-self.weak * (K @ view.disagreement)), memory
"""
SCENARIO = """
name: anti
model: {name: pendulum}
graph: {name: path, agents: 4}
follower: {law: {python: "anti.py:Anti", weak: -2.0}, gain: {method: riccati}}
initial: {spread: {angle: 0.05}}
simulation: {horizon: 2.0, dt: 0.01}
"""


@pytest.mark.slow
def test_check_run_sweep_verify_and_page_agree(echelon, tmp_path):
    (tmp_path / "anti.py").write_text(FILE)
    (tmp_path / "anti.yaml").write_text(SCENARIO)
    code, out, _ = echelon("check", "anti.yaml")
    assert code == 1 and UNKNOWN in " ".join(out.split())
    code, out, _ = echelon("check", "anti.yaml", "--json")
    assert code == 1 and json.loads(out)["promise"]["verdict"] == "none"
    code, out, _ = echelon("run", "anti.yaml", "--no-figures", "--out", "o")
    assert code == 0 and UNKNOWN in " ".join(out.split()) and "Linearized" not in out
    told = json.loads((tmp_path / "o" / "summary.json").read_text())
    assert told["promise"]["verdict"] == "none" and UNKNOWN in told["promise"]["sentence"]
    code, out, _ = echelon("verify", "o", "--scenario", "o")
    assert code in (0, 5), out
    _, out, _ = echelon("sweep", "anti.yaml", "--over", "seed=0..1", "--out", "s")
    assert "With a guarantee: 0 of 2." in out
