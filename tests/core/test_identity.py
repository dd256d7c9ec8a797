"""What identifies a value: each kind of leaf changes the digest, and equal bits do not."""

import dataclasses
import functools
import types
from decimal import Decimal
from fractions import Fraction
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import echelon as ech
from echelon.agents.models import Pendulum, VanDerPol
from echelon.agents.models.linearization import linearize
from echelon.core.cache import BoundedCache, memoize
from echelon.core.compiled import cached_jit
from echelon.core.identity import digest, foreign_key, process_key
from echelon.core.words import Feedforward, Kind


class Scaled(VanDerPol):
    """A user's model, with a field that JAX does not trace."""

    factors: Any = eqx.field(static=True, default=1.0)


def test_an_array_that_is_modified_in_place_and_a_zero_of_another_sign_are_other_values():
    # The larger one is hashed where it is.
    for size in (3, 5000):
        array = np.arange(float(size))
        before = digest([array]), process_key([array])
        assert before == (digest([array.copy()]), process_key([array.copy()]))
        array[-1] = np.nextafter(array[-1], np.inf)
        assert digest([array]) != before[0] and process_key([array]) != before[1]
    for wrap in (float, np.float64, np.asarray, jnp.asarray, lambda x: [1, (x,)]):
        zero, minus, nan = (digest(wrap(x)) for x in (0.0, -0.0, float("nan")))
        assert None not in (zero, minus, nan) and len({zero, minus, nan}) == 3
        assert digest(wrap(float("nan"))) == nan
        assert process_key(wrap(-0.0)) != process_key(wrap(0.0))


def test_types_shapes_frames_fields_and_members_count():
    array, pendulum = np.array([1.0, 2.0]), Pendulum()
    values = [array, array.astype(np.float32), array[None], array.astype(int), array[::-1]]
    values += [jnp.asarray(array), [1.0, 2.0], (1.0, 2.0), 1, 1.0, True, "1", b"1", Fraction(1, 3)]
    values += [Fraction(1), (1, (1,)), ((1,), 1), (1, 1), ("11",), ("1", "1"), {}, (), None]
    values += [{"a": 1}, {"b": 1}, {"a": 1, "b": 2}, {"b": 2, "a": 1}, VanDerPol(), VanDerPol]
    values += [pendulum, dataclasses.replace(pendulum, damping=0.2), jax.random.key(1)]
    values += [jax.random.key(2), Feedforward.NONE, Feedforward.RELAY, Kind.PROOF, "none"]
    found = [digest(value) for value in values]
    assert len({*found}) == len(values) and found.count(None) == 0
    assert digest(Pendulum()) == digest(pendulum)
    assert digest(jax.random.key(1)) == digest(jax.random.key(1))
    assert process_key(Fraction(1)) == process_key(Fraction(2, 2)) != process_key(1)
    # A view and its copy have the same numbers, whatever lies between them in memory.
    wide = np.arange(6.0)
    assert digest(wide[::2]) == digest(wide[::2].copy())


@pytest.mark.filterwarnings("ignore:A JAX array is being set as static")
def test_a_static_field_counts_and_may_hold_an_array():
    numbers = np.ones(2)
    keys = [process_key(Scaled(factors=x)) for x in (1.0, 2.0, numbers, "one")]
    assert None not in keys and len(set(keys)) == 4
    numbers[0] = 3.0
    assert process_key(Scaled(factors=numbers)) not in keys


def test_what_is_not_echelon_s_own_has_no_digest_but_a_key_in_this_process():
    values = Scaled(), Scaled, lambda x: x, Decimal(1), [1, {"a": (Scaled(),)}], frozenset([1])
    for value in values:
        assert digest(value) is None
        assert process_key(value) is not None and process_key(value) == process_key(value)
    for value in ({1}, np.array([object()]), (1, [np.array([object()])])):
        assert digest(value) is None and process_key(value) is None
    # What is traced is not identified, a class that is defined anew is another one, and code that
    # belongs to no module is foreign.
    keys, names = [], {}
    jax.make_jaxpr(lambda x: keys.append((digest([x]), process_key([x]))))(1.0)
    assert keys == [(None, None)]
    one, other = (type("Own", (VanDerPol,), {}) for _ in range(2))
    assert process_key(one()) == process_key(one()) != process_key(other())
    exec("def cost(sums):\n    return 2 * sums", names)
    assert names["cost"].__module__ is None and foreign_key(names["cost"])


def test_a_class_that_only_claims_to_be_echelon_s_own_is_foreign(monkeypatch):
    monkeypatch.setattr(Scaled, "__module__", "echelon.agents.models")
    assert digest(Scaled()) is None
    monkeypatch.setattr("echelon.agents.models.Scaled", Scaled, raising=False)
    assert digest(Scaled()) is not None


def test_parts_of_a_run_are_identified_by_every_bit():
    parts, settings = ech.build(ech.load_scenario("integrators"))
    first = digest((parts.model, parts.drive, parts.world, settings))
    again, _ = ech.build(ech.load_scenario("integrators"))
    assert first is not None
    assert first == digest((again.model, again.drive, again.world, settings))
    assert first != digest((parts.model, parts.drive, parts.world, settings._replace(seed=7)))


def test_a_memoized_function_computes_anew_for_other_bits_alone():
    calls = []

    @memoize
    def first_entry(array, model=None):
        calls.append(array[0])
        return None if array[0] < 0.0 else float(array[0])

    array = np.array([1.0, 2.0])
    assert first_entry(array) == first_entry(array.copy()) == 1.0 and len(calls) == 1
    array[0] = -0.0
    assert first_entry(array) == 0.0 and len(calls) == 2
    # None is a result too, and a user's class is known as long as the process lasts.
    array[0] = -1.0
    for _ in range(2):
        assert first_entry(array) is None and first_entry(array, model=Scaled()) is None
    assert len(calls) == 4
    unhashable = functools.partial(first_entry, array, model={1})
    assert unhashable() is unhashable() is None and len(calls) == 6


def test_a_cache_drops_what_was_not_used_for_longest_and_has_room_for_a_size():
    cache = BoundedCache(2)
    assert [cache.get_or_make(key, lambda key=key: key) for key in "abac"] == list("abac")
    assert len(cache) == 2 and cache.pop("b") is None and cache.pop("a") == "a"
    assert cache.get_or_make(None, lambda: "new") == "new" and len(cache) == 1
    cache = BoundedCache(9, len, 10)
    for text in ("four", "fives", "six"):
        cache.put(text, text)
    assert cache.total() == 8 and cache.pop("four") is None
    cache.put("long", "longer than all")
    assert len(cache) == 0 == cache.total()


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


@cached_jit
def at_one(model):
    return model.drift(jnp.ones(2))


def test_what_a_class_reads_is_part_of_what_is_remembered(monkeypatch):
    changes = {
        "a number of its module": lambda: monkeypatch.setitem(globals(), "SPEED", 3.0),
        "an entry of an array": lambda: MATRIX.__setitem__((0, 0), -5.0),
        "another array": lambda: monkeypatch.setitem(globals(), "MATRIX", -7.0 * np.eye(2)),
        "an entry of a table": lambda: monkeypatch.setitem(TABLE, "damping", [9.0]),
        "a number of another module": lambda: monkeypatch.setitem(OTHER.__dict__, "pull", 6.0),
        "an attribute of the class": lambda: monkeypatch.setattr(Reader, "share", 4.0),
    }
    before, faults = MATRIX.copy(), []
    for what, change in changes.items():
        model, again = Reader(), Reader()
        linear, ones, key = linearize(model), np.asarray(at_one(model)), process_key(model)
        assert linearize(again) is linear and process_key(again) == key
        change()
        changed = np.asarray(at_one(model))
        close = np.allclose(linearize(model).A @ np.ones(2), changed, rtol=1e-6)
        if process_key(model) == key or np.array_equal(ones, changed) or not close:
            faults.append(what)
        monkeypatch.undo()
        MATRIX[:] = before
    assert faults == []


def test_what_a_function_closes_over_counts():
    slope = [-1.0]

    def closed(x):
        return slope[0] * x

    assert called(closed)[0] == -1.0
    slope[0] = -2.0
    assert called(closed)[0] == -2.0


def test_a_proof_is_not_that_of_numbers_that_changed(monkeypatch):
    graph, settings = ech.Graph.path(3), ech.Settings(1.0, 0.01)

    def parts():
        model = Reader()
        gain = ech.synthesize(model, graph, ech.gains.Contraction({}, rate=0.1))
        drive = ech.Laws(ech.laws.TrimInput(), ech.laws.Consensus(gain))
        return ech.Parts(model, graph, ech.Formation(np.zeros((3, 2))), drive)

    first = parts()
    slow = ech.guarantee(first, settings).rate
    assert ech.guarantee(first, settings) is ech.guarantee(first, settings)
    monkeypatch.setitem(globals(), "SPEED", 3.0)
    assert ech.guarantee(first, settings).rate > slow + 0.5
    assert ech.guarantee(parts(), settings).rate > slow + 0.5


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
