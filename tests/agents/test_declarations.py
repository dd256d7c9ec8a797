"""Which declarations of a class apply to its agents: none whose motion a subclass changes."""

import jax.numpy as jnp
import numpy as np
import pytest

import echelon as ech
from echelon.agents.models.chains import DECLARED, chains_of, declared_of, to_flat
from echelon.agents.models.declarations import undeclared
from echelon.agents.models.model import FlatChains, Limits
from echelon.core.numerics import precision

Quadrotor = ech.models.Quadrotor
CHAINS = ("flat_chains", "flat_bounds", "to_flat")


class Dragged(Quadrotor):
    """A quadrotor with drag, which declares its chains again but not how it maps to them."""

    drag: float = 3.0

    flat_chains, flat_bounds = FlatChains((4, 4, 4, 2), (2, 0, 0, 0)), Quadrotor.flat_bounds

    def drift(self, x):
        return super().drift(x).at[3:6].add(-self.drag * x[3:6])


class Heavier(Quadrotor):
    """A quadrotor of other parameters, units and weights, with a method of its own."""

    mass: float = 0.04
    weights = ((2.0,) * 12, (1.0,) * 4)
    state_units = ("",) * 12

    def ratio(self):
        return 4.0 * self.motor_thrust / (self.mass * self.gravity)


class Windy(ech.ControlAffine):
    """A boat that asks a method for its drag."""

    state_names, input_names = ("x", "v"), ("u",)
    strength = 0.3
    flat_chains, flat_bounds = FlatChains((2,), (0,)), ()

    def drag(self, v):
        return self.strength * v

    def drift(self, x):
        return jnp.stack([x[1], -self.drag(x[1])])

    def input_map(self, x):
        return jnp.array([[0.0], [1.0]])


def subclass(base, **changes):
    """A subclass with these attributes in its body."""
    for value in changes.values():
        if callable(value):
            value.__module__, value.__qualname__ = __name__, "Changed.changed"
    return type(base)("Changed", (base,), {"__module__": __name__, **changes})()


@pytest.mark.parametrize(
    ("model", "expected"),
    [
        (Quadrotor(), CHAINS),
        (Heavier(), CHAINS),
        (subclass(Heavier, gravity=1.6), CHAINS),
        (Dragged(), ("flat_chains", "flat_bounds")),
        (subclass(Dragged), ("flat_chains", "flat_bounds")),
        (subclass(Quadrotor, input_map=lambda self, x: 2.0 * x), ()),
        (subclass(Quadrotor, output=lambda self, x: x[:4]), ()),
        (subclass(Quadrotor, output_names=("y", "x", "z", "yaw")), ()),
        (subclass(Quadrotor, trim=((0.0,) * 12, (1.0, 0.0, 0.0, 0.0))), ()),
        (subclass(Quadrotor, input_scale=((1.0,) * 4,) * 4), ()),
        (subclass(Quadrotor, velocity=lambda self, x, u: x), ()),
        (subclass(Quadrotor, limit=lambda self, u: 0.5 * u), CHAINS),
        (subclass(Quadrotor, flat_chains=FlatChains((4, 4, 4, 2), (1, 0, 0, 0))), CHAINS[:1]),
        (Windy(), CHAINS[:2]),
        (subclass(Windy, strength=0.5), CHAINS[:2]),
        (subclass(Windy, drag=lambda self, v: v**3), ()),
        (subclass(ech.models.Unicycle), ("flat_chains", "flat_bounds", "initial_integrators")),
        (subclass(ech.models.DoubleIntegrator, drag=1.0), ("flat_chains", "flat_bounds")),
    ],
)
def test_a_declaration_applies_to_the_motion_that_it_was_made_for(model, expected):
    assert declared_of(model) == expected


@pytest.mark.parametrize(
    ("model", "known"),
    [
        (Quadrotor(), True),
        (Heavier(), True),
        (Dragged(), False),
        (subclass(Quadrotor, limit=lambda self, u: 0.5 * u), False),
        (subclass(Quadrotor, input_limits=Limits(((1.0,) * 4,), (0.0,), (0.1,))), False),
        (subclass(Dragged, airframe=Quadrotor().airframe), True),
        (ech.models.PlanarQuadrotor(), False),
    ],
)
def test_an_airframe_is_declared_of_motion_and_limits_together(model, known):
    assert undeclared(model, "airframe") == (() if known else ("airframe",))


def test_what_is_set_from_outside_is_below_every_declaration(monkeypatch):
    own = Quadrotor()
    object.__setattr__(own, "drift", lambda x: 0.0 * x)
    assert declared_of(own) == ()
    monkeypatch.setattr(Quadrotor, "drift", lambda self, x: 0.0 * x)
    assert declared_of(Quadrotor()) == declared_of(Heavier()) == ()
    monkeypatch.undo()
    assert declared_of(Quadrotor()) == CHAINS


@pytest.mark.parametrize(
    "name", [f"{kind}Integrator" for kind in ("Single", "Double")] + ["Unicycle", "Pendulum"]
    + ["VanDerPol", "Quadrotor", "PlanarQuadrotor", "QuadrotorEuler", "QuadrotorThrust"]
    + ["CrazyflieAttitude"]
)  # fmt: skip
def test_every_bundled_model_declares_at_the_class_that_moves(name):
    kind, interface = getattr(ech.models, name), ech.ControlAffine
    stated = {each for each in DECLARED if getattr(kind, each) is not getattr(interface, each)}
    assert stated == {*declared_of(kind())} and stated


@pytest.mark.slow
def test_an_inherited_map_to_flat_coordinates_is_not_that_of_another_motion():
    model = Dragged()
    with precision("float64"):
        x = jnp.asarray(np.random.default_rng(0).uniform(-0.5, 0.5, 12))
        e, chains = jnp.array([0.3, -0.2]), chains_of(model)
        values = to_flat(model, chains, x, e).values
        motion = model.velocity(x, model.physical(chains.acting_input(e, jnp.zeros(4))))
    # The second derivative of the place is what the velocity changes by.
    assert np.allclose(values[1, :3], motion[:3]) and np.allclose(values[2, :3], motion[3:6])
