"""Parameters of users' classes are annotated fields; what else is assigned is told by its place."""

import dataclasses

import jax.numpy as jnp
import pytest

import echelon as ech


class Spring(ech.ControlAffine):
    """A spring whose stiffness its own `__init__` computes."""

    state_names = ("place", "speed")
    input_names = ("force",)
    k: float

    def __init__(self, root):
        self.k = root**2

    def drift(self, x):
        return jnp.stack([x[1], -self.k * x[0]])

    def input_map(self, x):
        return jnp.array([[0.0], [1.0]])


class Law(ech.Law):
    def __init__(self, **named):
        for name, value in named.items():
            setattr(self, name, value)

    def update(self, model, view, memory):
        return view.disagreement, memory


class Reference(ech.Reference):
    __init__ = Law.__init__

    def __call__(self, t):
        return jnp.zeros(4)


class Method(ech.Method):
    name = "mine"
    __init__ = Law.__init__

    def feedback(self, model, linear):
        raise NotImplementedError


class Model(Spring):
    __init__ = Law.__init__


def test_annotated_fields_may_be_set_by_an_own_init_and_not_changed_later():
    gain = ech.synthesize(Spring(1.5), ech.Graph.path(3), ech.gains.Riccati())
    assert gain.coupling > 0.0 and Spring(1.5).k == 2.25
    spring, circle = Spring(1.0), ech.references.Circle()
    for part, name in ((spring, "k"), (circle, "radius"), (ech.models.Pendulum(), "damping")):
        with pytest.raises(ech.EchelonError, match=f"`{name}` of a `.*` cannot be changed; make"):
            setattr(part, name, 3.0)


def test_what_is_no_field_is_told_by_its_file_and_line():
    line = Law.__init__.__code__.co_firstlineno + 2
    for cls in (Model, Law, Reference, Method):
        with pytest.raises(ech.EchelonError) as caught:
            cls(stiffness=2.0)
        assert str(caught.value) == (
            f"test_declared.py:{line}: parameters are annotated fields; declare "
            f"`stiffness: float` in `{cls.__name__}`."
        )
        assert isinstance(caught.value.__cause__, dataclasses.FrozenInstanceError)
