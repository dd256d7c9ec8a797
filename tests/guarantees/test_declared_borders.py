"""What a user's class declares of its coordinates and motors is compared with its equations."""

import jax.numpy as jnp
import numpy as np
import pytest
from in_words import in_words

import echelon as ech
from echelon.agents.models.chains import chains_of
from echelon.agents.models.model import FlatBound, FlatChains
from echelon.core.statement import Hypothesis
from echelon.core.words import Kind, Theorem, Verdict
from echelon.guarantees.stopping.flat_everywhere import airframe_fault, border_fault, bounds_of
from echelon.guarantees.stopping.stopping_promise import StoppingPromise

Quadrotor, Planar, Unicycle = (
    getattr(ech.models, name) for name in ("Quadrotor", "PlanarQuadrotor", "Unicycle")
)
GRAPH = ech.Graph([(0, 1), (1, 2)])


class Cart(ech.ControlAffine):
    """A cart whose motor is weaker the faster it goes, and turns about at 1 m/s."""

    fading: float = 1.0
    state_names, input_names, position = ("x", "v"), ("u",), ("x",)
    flat_chains, flat_bounds = FlatChains((2,), (0,)), ()

    def drift(self, x):
        return jnp.stack([x[1], -(x[1] ** 3)])

    def input_map(self, x):
        return jnp.stack([0.0 * x[1], 1.0 - self.fading * x[1]])[:, None]


def own(name, base, **parts):
    """A class of somebody's own, which changes what is given, and restates its chains."""
    stated = {"flat_chains": base.flat_chains, "flat_bounds": base.flat_bounds}
    return type(name, (base,), {"__module__": __name__, **stated, **parts})


class Slower(Cart):
    """The same where it is slower than 1 m/s to the left."""

    flat_chains, output_names = Cart.flat_chains, ("back", "v")
    flat_bounds = (FlatBound(("back",), 1, -1.0, "a speed below 1 m/s"),)

    def output(self, x):
        return x.at[0].multiply(-1.0)


class Early(Cart):
    """An input that reaches the first derivative too."""

    flat_chains, flat_bounds = Cart.flat_chains, ()

    def input_map(self, x):
        return jnp.array([[1e-3], [1.0]])


def backwards(name, bound):
    """A cart with another bound on its speed to the left."""
    return own(name, Slower, flat_bounds=(FlatBound(("back",), 1, bound, "a speed"),))


Faster, Nowhere = backwards("Faster", -2.0), backwards("Nowhere", 1e9)


# An input that reaches the first derivative too.


def promised(model, **initial):
    drive = ech.Laws(ech.laws.StoppingLeader(), ech.laws.StoppingPoint())
    goals = ech.Formation(np.zeros((3, len(model.state_names))))
    parts = ech.Parts(model, GRAPH, goals, drive, initial=initial or {"x": 0.3})
    return ech.guarantee(parts, ech.Settings(horizon=10.0, dt=0.01))


EFFECT = "leave out where its inputs lose their effect"


@pytest.mark.parametrize(
    ("model", "fault"),
    [
        (Slower(), ""),
        (own("Restated", Planar)(), ""),
        (own("Restated", Unicycle)(), ""),
        (Cart(), f"`flat_bounds` of `Cart` {EFFECT}"),
        (Faster(), f"`flat_bounds` of `Faster` {EFFECT}"),
        (Early(0.0), "the inputs of `Early` reach derivatives below those that its `flat_chains`"),
        (Nowhere(), "no sample of the states of `Nowhere` is within its `flat_bounds`"),
    ],
)
def test_what_fits_the_equations_is_a_guarantee_of_samples_and_else_none(model, fault):
    found = bounds_of(model, chains_of(model))
    assert (found.bounds is None) == bool(fault) and fault in found.fault
    if not fault:
        assert found.kind is Kind.SAMPLES and not found.fault
    # Bounds that nothing needs leave a proof a proof.
    bounds = (FlatBound(("angle",), 1, -9.0, "a rate above -9"),)
    model = own("Bounded", ech.models.Pendulum, flat_bounds=bounds)()
    assert bounds_of(model, chains_of(model)).kind is Kind.PROOF


@pytest.mark.slow
def test_a_guarantee_says_that_it_rests_on_what_a_class_states():
    found = promised(Slower())
    assert found.promised and found.theorem is Theorem.T5 and found.kind is Kind.SAMPLES
    assert in_words(found).startswith("Seen at samples, which is no proof: ")
    for line in (found.hypotheses[name] for name in (Hypothesis.SET, Hypothesis.STARTS)):
        assert line.kind is Kind.SAMPLES
        assert "if its borders are those that `Slower` states" in line.text
    without = promised(Faster())
    assert not without.promised and "leave out where its inputs" in without.reasons[0]


def body(**changes):
    """A quadrotor that declares its airframe again, with changes."""
    airframe = Quadrotor().airframe._replace(**changes)
    return type("Body", (Quadrotor,), {"__module__": __name__, "airframe": airframe})()


class Dragged(Quadrotor):
    """A quadrotor with drag that calls itself a rigid body without."""

    drag: float = 0.1
    flat_chains = Quadrotor.flat_chains
    airframe = Quadrotor().airframe

    def drift(self, x):
        return super().drift(x).at[3:6].add(-self.drag * x[3:6])


MASS, ARM = Quadrotor().airframe.mass, Quadrotor().airframe.arm


@pytest.mark.parametrize(
    ("model", "fault"),
    [
        (body(), ""),
        (body(mass=1.1 * MASS), "is not of its motion: at a sample a motor's thrust is"),
        (body(arm=0.9 * ARM), "is not of its motion"),
        (body(gravity=9.0), "is not of its motion"),
        (body(motor_thrust=1.0), "has motors of 0 to 1 N, `input_limits` have others"),
        pytest.param(Dragged(), "is not of its motion", marks=pytest.mark.slow),
    ],
)
def test_an_airframe_has_the_motors_that_the_equations_ask_for(model, fault):
    found = airframe_fault(model, chains_of(model), model.airframe)
    assert found == "" if not fault else fault in found


@pytest.mark.slow
@pytest.mark.parametrize(("model", "known"), [(body(), True), (body(mass=0.9 * MASS), False)])
def test_motors_are_guaranteed_of_an_airframe_that_fits_alone(model, known):
    roots, speeds = (2.0, 2.5, 3.0), (1.0, 1.0, 0.5, 0.3)
    leader = ech.laws.StoppingLeader(reference=ech.references.Hover(), roots=roots, speed=0.5)
    drive = ech.Laws(leader, ech.laws.StoppingPoint(roots=roots, speed=speeds))
    goals = ech.Formation(np.zeros((3, 12)))
    parts = ech.Parts(model, GRAPH, goals, drive, initial={"x": 0.1})
    found = ech.guarantee(parts, ech.Settings(horizon=10.0, dt=0.005))
    line = found.hypotheses[Hypothesis.LIMITS]
    assert isinstance(found, StoppingPromise) and found.tube is not None
    assert (line.verdict is Verdict.HOLDS) == known == (found.tube.motor_load is not None)
    # The borders are echelon's own, and were not in question.
    assert found.kind is (Kind.SAMPLES if known else Kind.PROOF)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["Quadrotor", "QuadrotorEuler", "QuadrotorThrust"])
def test_the_borders_of_bundled_quadrotors_fit_their_equations(name):
    model = getattr(ech.models, name)()
    assert border_fault(model, chains_of(model)) == ""
