"""What a stranger's code reads counts: nothing is remembered once it changed."""

import types

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import echelon as ech
from echelon.agents.models.linearization import linearize
from echelon.core.compiled import cached_jit
from echelon.core.identity import process_key

SPEED = 1.0
MATRIX = np.array([[-1.0, 0.0], [0.0, -1.0]])
TABLE = {"damping": [0.5]}
OTHER = types.ModuleType("someone_s_numbers")
OTHER.pull = 2.0


def pull():
    return OTHER.pull


class Reader(ech.ControlAffine):
    state_names, input_names = ("a", "b"), ("u",)
    share = 1.0

    def drift(self, x):
        return SPEED * self.share * (MATRIX @ x) - TABLE["damping"][0] * x - pull() * x

    def input_map(self, x):
        return jnp.array([[0.0], [1.0]])


def closed_over(slope):
    class Closed(ech.ControlAffine):
        state_names, input_names = ("a", "b"), ("u",)

        def drift(self, x):
            return slope[0] * x

        def input_map(self, x):
            return jnp.array([[0.0], [1.0]])

    return Closed()


@cached_jit
def at_one(model):
    return model.drift(jnp.ones(2))


def changes():
    """Ways to change what `Reader` reads."""
    return {
        "a number of its module": lambda set_: set_(globals(), "SPEED", 3.0),
        "an entry of an array": lambda set_: MATRIX.__setitem__((0, 0), -5.0),
        "another array": lambda set_: set_(globals(), "MATRIX", -7.0 * np.eye(2)),
        "an entry of a table": lambda set_: set_(TABLE, "damping", [9.0]),
        "a number of another module": lambda set_: set_(OTHER.__dict__, "pull", 6.0),
        "an attribute of the class": lambda set_: setattr(Reader, "share", 4.0),
    }


@pytest.mark.parametrize("what", changes())
def test_what_a_class_reads_is_part_of_what_is_remembered(what, monkeypatch):
    before_share, before_matrix = Reader.share, MATRIX.copy()
    model, again = Reader(), Reader()
    linear, ones, key = linearize(model), np.asarray(at_one(model)), process_key(model)
    assert linearize(again) is linear and process_key(again) == key
    changes()[what](monkeypatch.setitem)
    try:
        assert process_key(model) != key
        changed = np.asarray(at_one(model))
        A = linearize(model).A
        assert not np.array_equal(ones, changed)
        np.testing.assert_allclose(A @ np.ones(2), changed, rtol=1e-6)
    finally:
        Reader.share = before_share
        before_matrix.setflags(write=True)
        if what == "an entry of an array":
            MATRIX[:] = before_matrix


def test_what_a_function_closes_over_counts():
    slope = [-1.0]
    model = closed_over(slope)
    assert linearize(model).A[0, 0] == -1.0
    slope[0] = -2.0
    assert linearize(model).A[0, 0] == -2.0


def test_a_proof_is_not_that_of_numbers_that_changed(monkeypatch):
    graph, settings = ech.Graph.path(3), ech.Settings(1.0, 0.01)

    def parts():
        model = Reader()
        gain = ech.synthesize(model, graph, ech.gains.Contraction({}, rate=0.1))
        drive = ech.Laws(ech.laws.TrimInput(), ech.laws.Consensus(gain))
        return ech.Parts(model, graph, ech.Formation(np.zeros((3, 2))), drive)

    first = parts()
    slow = ech.promise(first, settings).rate
    assert ech.promise(first, settings) is ech.promise(first, settings)
    monkeypatch.setitem(globals(), "SPEED", 3.0)
    assert ech.promise(first, settings).rate > slow + 0.5
    assert ech.promise(parts(), settings).rate > slow + 0.5


class Caller:
    """An object that JAX takes as one constant."""

    def __init__(self, slope):
        self.slope = slope

    def __call__(self, x):
        return self.slope * SPEED * x


@cached_jit
def called(function):
    return function(jnp.ones(2))


def test_an_object_that_is_called_counts_with_what_it_holds_and_reads(monkeypatch):
    function = Caller(2.0)
    assert called(function)[0] == called(jax.tree_util.Partial(function))[0] == 2.0
    monkeypatch.setitem(globals(), "SPEED", 3.0)
    assert called(function)[0] == 6.0
    function.slope = 5.0
    assert called(function)[0] == 15.0
