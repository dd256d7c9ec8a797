"""Limits of flat coordinates in theorem T5: lengths that must not be 0, models without limits."""

import json
from fractions import Fraction

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
from in_words import in_words

import echelon as ech
from echelon.agents.models.chains import chains_of
from echelon.agents.models.model import FlatBound, FlatChains, FlatCoordinates
from echelon.core.digits import at_most
from echelon.core.errors import EchelonError
from echelon.core.statement import Hypothesis
from echelon.core.words import Kind, Theorem
from echelon.guarantees.promises.promise import guarantee
from echelon.guarantees.stopping.borders import length_clearance_of
from echelon.guarantees.stopping.chain_response import Chain
from echelon.guarantees.stopping.flat_everywhere import bounds_of
from echelon.guarantees.verifier.verify import verify
from echelon.laws.stopping_point import StoppingLeader, StoppingPoint
from echelon.simulation.engine.prepare import prepare

CIRCLE = ech.references.Circle(radius=2.0, rate=0.7)
TREE = ech.Graph([(0, 1), (1, 2), (1, 3)])
UNICYCLE = ech.models.Unicycle()
START = np.array([2.0, 0.0, np.pi / 2])
"""On the circle at time 0, which is driven through at 1.4 m/s."""


def driven(headings=(0.0, 0.0, 0.0), away=0.0, reference=CIRCLE, leader=None, **law):
    """Unicycles whose headings (rad) are so far off, on goals beside each other and away (m)."""
    graph = ech.Graph([(0, k) if k == 1 else (1, k) for k in range(1, len(headings) + 1)])
    offsets = {k: (0.5 * k, -0.3 * k, 0.0) for k in range(1, len(headings) + 1)}
    formation = ech.Formation.from_offsets(UNICYCLE, graph, offsets)
    states = START + formation.offsets
    states[1:, 2] += headings
    states[1:, :2] += away
    drive = ech.Laws(StoppingLeader(reference=reference, **(leader or {})), StoppingPoint(**law))
    return ech.Parts(UNICYCLE, graph, formation, drive, initial=states)


def promised(parts, horizon=8.0):
    return guarantee(parts, ech.Settings(horizon=horizon, dt=0.01))


@pytest.mark.parametrize(("roots", "order"), [((4.0,), 0), ((2.0, 3.0), 1), ((2.0, 2.5, 3.0), 1)])
def test_a_vector_grows_no_longer_than_its_room(roots, order):
    draw, p = np.random.default_rng(0), len(roots)
    starts, speed = draw.uniform(-1.0, 1.0, (2, p)), 0.8
    exact = [list(map(Fraction, row)) for row in starts.tolist()]
    fall = float(
        length_clearance_of(Chain.of(roots), order, exact, Fraction("0.8"), Fraction(9)).fall
    )
    A = np.eye(p, k=1)
    A[-1] = -np.poly(-np.array(roots))[:0:-1]
    b, dt = np.eye(p)[-1] * A[-1, 0], 0.002
    flow = scipy.linalg.expm(np.block([[A, b[:, None]], [np.zeros((1, p + 1))]]) * dt)
    worst = 0.0
    for _ in range(40):
        # Pushes of the whole size that turn now and then, and some straight against the start.
        angles = np.repeat(draw.uniform(-np.pi, np.pi, 50), 30) * draw.integers(0, 2)
        x, w = starts.T.copy(), speed * np.stack([np.cos(angles), np.sin(angles)])
        for k in range(w.shape[1]):
            x = flow[:p, :p] @ x + np.outer(flow[:p, p], w[:, k])
            worst = max(worst, float(np.linalg.norm(x[order])))
    free = max(np.linalg.norm(scipy.linalg.expm(A * t) @ starts.T, axis=1)[order] for t in (0, 0.1))
    assert max(worst, free) <= fall <= 2.5 * worst


def test_of_one_root_the_longest_vector_is_the_longer_of_start_and_speed():
    for start, speed in ((1.0, 0.4), (0.3, 0.9)):
        exact = [[Fraction(start)], [Fraction(0)]]
        room = length_clearance_of(Chain.of((4.0,)), 0, exact, Fraction(speed), Fraction(2))
        assert max(start, speed) <= float(room.fall) <= 1.02 * max(start, speed)
        # Behind a leader at rest a start alone may be as long as what is allowed.
        alone = length_clearance_of(Chain.of((4.0,)), 0, (), Fraction(speed), Fraction(2))
        assert 1.98 <= float(alone.steepest) <= 2.0


def test_a_unicycle_is_promised_while_it_drives(tmp_path):
    found = promised(driven((0.9, -0.9, 0.2), away=8.0))
    assert found.promised and found.theorem is Theorem.T5 and found.kind is Kind.PROOF
    [border] = found.tube.borders
    # A chord of the leader's speed is 60 degrees; its path is enclosed a little below 1.4 m/s.
    assert 1.36 < border["path"] <= 1.4 and "a speed above 0" in in_words(found)
    chord = 2.0 * np.degrees(np.arcsin(found.tube.steepest / 2.8))
    assert 57.0 < chord < 60.0 and f"{at_most(chord)} deg to either side" in in_words(found)
    file, told = tmp_path / "summary.json", found.as_mapping()

    def verdict():
        file.write_text(json.dumps({"guarantee": told}))
        return verify(file).verdict

    assert verdict() == "incomplete"
    [border] = told["anywhere"]["borders"]
    for key, factor in (("left", 1.1), ("steepest", 1.1), ("speed", 1.8), ("starts", 2.0)):
        was = border[key]
        border[key] = (factor * np.array(was)).tolist()
        assert verdict() == "refused"
        border[key] = was


@pytest.mark.slow
def test_a_unicycle_that_might_stop_is_told_what_would_help():
    lower = "lower the `speed` of `x`, `y` below 0.9"
    for change, text in (
        ({"headings": (1.2, 0.0, 0.0)}, "is not proved to stay above 0"),
        ({"speed": 1.2}, lower),
    ):
        found = promised(driven(**change))
        assert not found.promised and text in in_words(found)
    # Where the path stands still it has no direction.
    with pytest.raises(EchelonError, match="`x'`, `y'` are 0 there, and allowed is a speed above"):
        prepare(driven(reference=ech.references.Hover()), ech.Settings(horizon=1.0, dt=0.01))


def led(place=(0.0, 0.0), turned=0.0, **leader):
    """Unicycles whose leader alone starts away from its place (m) and turned (rad)."""
    parts = driven(leader=leader, speed=0.4)
    states = np.array(parts.initial)
    states[0] += (*place, turned)
    return promised(parts.replace(initial=states))


@pytest.mark.slow
def test_of_a_leader_off_its_path_no_other_place_is_meant():
    # At most c |zeta - path| of its speed is used here, which grows from another place.
    found = led(place=(0.0, 0.02), speed=5.0)
    assert found.promised
    assert "from any position of the followers, with a speed above 0" in in_words(found)
    assert "and the leader as at these starts" in in_words(found)
    assert "any position," in in_words(led()) and "keeps to its path" in in_words(led())
    # One that is turned, with its stopping point on the path: y' / root away from where it is.
    turn, speed = 0.5, 1.4
    ways = np.array([[np.cos(a), np.sin(a)] for a in (np.pi / 2, np.pi / 2 + turn)])
    found = led(place=-speed * (ways[1] - ways[0]) / 4.0, turned=turn)
    assert found.promised and "keeps to its path" not in in_words(found)
    assert "and the leader as at these starts" in in_words(found)


@pytest.mark.slow
def test_unicycles_come_together_from_afar_and_never_stop():
    draw = np.random.default_rng(1)
    parts = driven(draw.uniform(-0.95, 0.95, 6))
    states = np.array(parts.initial)
    states[1:, :2] += draw.uniform(-10.0, 10.0, (6, 2))
    parts = parts.replace(initial=states)
    found = promised(parts, 40.0)
    result = ech.simulate(parts, ech.Settings(horizon=40.0, dt=0.01))
    assert found.promised and result.inputs[:, :, 0].min() >= found.tube.left
    off = np.linalg.norm(result.errors[:, 1:, :2], axis=2)
    assert off[-1].max() <= 1e-9
    outside = result.times[np.flatnonzero((off >= 0.01).any(axis=1))[-1]]
    assert outside <= found.tube.arrival <= 2.0 * outside


def name_of(value):
    return type(value).__name__


def knows_borders(model):
    return bounds_of(model, chains_of(model)).bounds is not None


class Swing(ech.ControlAffine):
    """A pendulum of which nothing is said but drift and input map."""

    state_names = ("angle", "rate")
    input_names = ("torque",)

    def drift(self, x):
        return jnp.stack([x[1], -9.81 * jnp.sin(x[0]) - 0.3 * x[1] * jnp.exp(x[0])])

    def input_map(self, x):
        return jnp.array([[0.0], [2.0]])


def own(name, base, **parts):
    """A class of somebody's own, which changes what is given."""
    return type(name, (base,), {"__module__": __name__, **parts})


def lost(self, x):
    return jnp.stack([jnp.zeros(1), jnp.cos(x[:1])])


# A force that is infinite somewhere, an input that is lost somewhere, a rate that is not linear.
Spring = own("Spring", Swing, drift=lambda _, x: jnp.stack([x[1], -x[0] / (1.0 + x[0])]))
Tilted = own("Tilted", Swing, input_map=lost)
Bent = own("Bent", Swing, drift=lambda _, x: jnp.stack([x[1] + 0.1 * x[1] ** 3, -x[0]]))


@pytest.mark.parametrize(
    ("model", "everywhere"),
    [
        (Swing(), True),
        (Spring(), False),
        (Tilted(), False),
        (Bent(), False),
        (ech.models.Linear([[0.0, 1.0], [2.0, -0.3]], [[0.0], [1.0]]), True),
        (ech.models.Linear([[0, 1, 0], [0, 0, 1], [1, 2, 3]], [[0.0], [0.0], [1.0]]), True),
    ],
    ids=name_of,
)
def test_a_model_that_does_not_say_has_no_border_where_its_coordinates_are_linear(
    model, everywhere
):
    assert knows_borders(model) == everywhere


def swings(model):
    drive = ech.Laws(StoppingLeader(), StoppingPoint())
    return ech.Parts(model, TREE, ech.Formation(np.zeros((4, 2))), drive, initial={"angle": 3.0})


@pytest.mark.slow
def test_what_is_proved_of_a_model_of_ones_own_is_promised_and_flown():
    found = promised(swings(Swing()))
    assert found.promised and found.kind is Kind.PROOF
    assert "any state of any agent" in in_words(found)
    result = ech.simulate(swings(Swing()), ech.Settings(horizon=8.0, dt=0.01))
    assert np.abs(result.errors[-1]).max() <= 1e-9
    # One that ends somewhere unknown is promised nothing.
    found = promised(swings(Tilted()))
    assert not found.promised
    assert "does not state where its flat coordinates end" in in_words(found)


STATED = {"flat_chains": FlatChains((2,), (0,)), "flat_bounds": ()}


def bounded(*bounds):
    """A pendulum that states these bounds."""
    return own("Bounded", Swing, **STATED | {"flat_bounds": bounds})()


class Mixed(ech.ControlAffine):
    """An output that is pushed, and one that is commanded."""

    state_names, input_names = ("x", "v", "y"), ("push", "speed")
    flat_outputs, flat_chains = ("x", "y"), FlatChains((2, 1), (0, 0))
    flat_bounds = (FlatBound(("x", "y"), 1, 0.0, "moving"),)

    def drift(self, x):
        return jnp.stack([x[1], 0.0 * x[0], 0.0 * x[0]])

    def input_map(self, x):
        return jnp.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])


OUTPUTS = "must name different outputs of the chains, `angle`"
ANGLE = ("angle",)


def test_a_bound_of_which_nothing_is_proved_is_refused():
    for bound, text in (
        (ANGLE, "must be a tuple of `FlatBound`"),
        (FlatBound("angle", 1, -1.0, "slow"), OUTPUTS),
        (FlatBound((), 1, -1.0, "slow"), OUTPUTS),
        (FlatBound(("q",), 1, -1.0, "slow"), OUTPUTS),
        (FlatBound(("angle", "angle"), 1, 0.0, "slow"), OUTPUTS),
        (FlatBound(ANGLE, 0, -1.0, "slow"), "order 0 of `angle`, and allowed is 1"),
        (FlatBound(ANGLE, 2, -1.0, "slow"), "order 2 of `angle`, and allowed is 1"),
        (FlatBound(ANGLE, 1.0, -1.0, "slow"), "order 1.0 of `angle`, and allowed is 1"),
        (FlatBound(ANGLE, 1, float("nan"), "slow"), "above nan, which must be a finite"),
    ):
        with pytest.raises(EchelonError, match=text):
            StoppingPoint().prepared(bounded(bound), TREE)
    with pytest.raises(EchelonError, match="chains of 2 and 1 integrators, which must be equal"):
        StoppingPoint().prepared(Mixed(), TREE)


SLOW = FlatBound(("angle",), 1, -1.0, "a rate above -1")


def test_starts_beyond_a_bound_that_no_integrator_decides_are_refused():
    parts = swings(bounded(SLOW))
    for rate, refused in ((-0.9, False), (-1.1, True)):
        law = StoppingPoint().prepared(parts.model, TREE)
        found = list(law.refusals(parts.model, np.array([[0.3, rate], [0.3, 2.0]])))
        assert [k for k, _ in found] == [0] * refused
    assert found[0][1] == "`angle'` is -1.1 there, allowed is a rate above -1"


@pytest.mark.slow
def test_a_bound_that_no_integrator_decides_is_promised_and_flown():
    parts = swings(bounded(SLOW)).replace(initial={"angle": 1.0})
    found = promised(parts)
    assert found.promised and 0.0 < found.tube.left < 1.0
    result = ech.simulate(parts, ech.Settings(horizon=4.0, dt=0.01))
    assert result.states[:, :, 1].min() >= found.tube.left - 1.0


class Lost(ech.models.Pendulum):
    """A pendulum whose torque is lost where it hangs level, which inherits a word."""

    def input_map(self, x):
        return super().input_map(x) * jnp.cos(x[0])


class Quickened(ech.models.Unicycle):
    """A unicycle that is quicker elsewhere, which inherits the bound of its speed."""

    def input_map(self, x):
        return super().input_map(x) * (1.0 + x[0] ** 2)


class Damped(ech.models.Pendulum):
    """A pendulum of another friction: what it inherits is proved of it again."""

    def drift(self, x):
        return super().drift(x) - jnp.stack([0.0 * x[0], x[1] ** 3])


OWN = (Lost(), Quickened(), Damped(), own("Stated", Lost, **STATED)())
OWN += (own("Renamed", ech.models.Unicycle, input_names=("v", "w"))(),)
BUNDLED = ("Unicycle", "Pendulum", "VanDerPol", "SingleIntegrator", "DoubleIntegrator", "Quadrotor")
BUNDLED += ("PlanarQuadrotor", "QuadrotorEuler", "QuadrotorThrust")


@pytest.mark.parametrize(
    "model", [*OWN, *(getattr(ech.models, name)() for name in BUNDLED)], ids=name_of
)
def test_a_word_on_borders_is_of_the_motion_that_it_was_given_with(model):
    assert knows_borders(model) != isinstance(model, Lost | Quickened)


class Sailing(ech.ControlAffine):
    """A boat whose sail answers to where it is: x' = v - sin x."""

    state_names, input_names = ("x", "v"), ("u",)
    flat_chains, flat_bounds = FlatChains((2,), (0,)), ()

    def drift(self, x):
        return jnp.stack([x[1] - jnp.sin(x[0]), jnp.zeros_like(x[0])])

    def input_map(self, x):
        return jnp.array([[0.0], [1.0]])


Located = own("Located", Sailing, position=("x",), **STATED)


class Hundredth(ech.models.DoubleIntegrator):
    """A double integrator whose outputs are in hundreds of metres."""

    flat_chains, flat_bounds = FlatChains((2, 2), (0, 0)), ()

    def output(self, x):
        return x[:2] / 100.0


def afloat(model, x=0.0):
    drive = ech.Laws(ech.laws.StoppingLeader(), ech.laws.StoppingPoint())
    goals = np.zeros((4, len(model.state_names)))
    goals[:, 0] = np.arange(4.0) * x
    initial = {model.state_names[0]: 1.0}
    return ech.Parts(model, TREE, ech.Formation(goals), drive, initial=initial)


@pytest.mark.slow
def test_offsets_of_outputs_that_other_states_answer_to_are_not_kept():
    # At rest v = sin x, so that boats at other places have other v for ever.
    parts = afloat(Sailing(), x=1.0)
    result = ech.simulate(parts, ech.Settings(horizon=6.0, dt=0.01))
    errors = np.abs(result.states[-1] - parts.formation.offsets)
    assert errors[:, 0].max() <= 1e-6 and errors[:, 1].max() > 0.5
    assert "differ in other states" in promised(parts).hypotheses[Hypothesis.SYMMETRY].text
    assert not promised(parts).promised and promised(afloat(Sailing())).promised
    assert promised(afloat(Located(), x=1.0)).promised


@pytest.mark.slow
def test_a_time_within_1_cm_is_of_positions_that_are_outputs_in_metres():
    assert promised(afloat(Located())).tube.arrival is not None
    found = promised(afloat(Hundredth(2)))
    assert found.promised and found.tube.arrival is None
    assert not promised(afloat(Hundredth(2), x=1.0)).promised


class Mapped(Swing):
    """A mass that states its flat coordinates itself."""

    drag: float = 0.0
    flat_chains, flat_bounds = FlatChains((2,), (0,)), ()

    def drift(self, x):
        return jnp.stack([x[1], -self.drag * x[1]])

    def to_flat(self, x, e):
        return FlatCoordinates(x[:, None], lambda tops: tops / 2.0)


Adrift = own("Adrift", Sailing, state_names=("x", "v", "w"), **STATED)


def test_declared_coordinates_hold_all_states_and_change_as_the_equations_say():
    assert StoppingPoint().prepared(Mapped(), TREE).ready.chains.degrees == (2,)
    for model, text in (
        (Mapped(0.5), "`to_flat` of `Mapped` is not of its motion"),
        (Adrift(), "2 integrators in all, and must be 1 chains, .* with 3"),
    ):
        with pytest.raises(EchelonError, match=text):
            StoppingPoint().prepared(model, TREE)
