"""What is kept between processes: found by all that it was made from, and by nothing else."""

import dataclasses
import inspect
import sys
from fractions import Fraction

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from echelon.core import kept, program, store
from echelon.core.kept import stored
from echelon.core.numerics import precision
from echelon.core.program import Program
from echelon.models import Pendulum, VanDerPol
from echelon.models.linearization import AtTrim, at_trim
from echelon.models.model import ControlAffine
from echelon.scenario.own import own_class


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    """A folder where all is kept, as the command line names it, and nothing known before."""
    monkeypatch.setenv(store.FOLDER, str(tmp_path))
    store._ground.cache_clear()
    yield tmp_path
    store._ground.cache_clear()


class Own(VanDerPol):
    """A user's model."""


def place(*values):
    return store.place_of("what", *values)


def sensitivity(model, x, scale):
    """A function that echelon might have."""
    return {"slope": jax.jacfwd(model.drift)(x) * scale, "name": type(model).__name__}


@pytest.fixture
def slope(monkeypatch):
    """It, as if it were echelon's."""
    monkeypatch.setattr(sensitivity, "__module__", "echelon.models.linearization")
    return lambda: Program(sensitivity)


def refused(*_):
    raise AssertionError("it was made again")


@pytest.mark.parametrize("name", ["float64", "float32"])
def test_another_process_finds_a_program_and_its_bits(slope, monkeypatch, name):
    x = np.array([0.3, -0.2])
    with precision(name):
        plain = eqx.filter_jit(sensitivity)(VanDerPol(), x, 2.0)
        first = slope()(VanDerPol(), x, 2.0)
        monkeypatch.setattr(program, "_compile", refused)
        again = slope()(VanDerPol(), x + 1.0, 2.0), slope()(VanDerPol(), jnp.asarray(x), 2.0)
    for found in (first, again[1]):
        assert found["name"] == "VanDerPol" and found["slope"].dtype == name
        np.testing.assert_array_equal(found["slope"], plain["slope"])
    assert (np.asarray(again[0]["slope"]) != np.asarray(plain["slope"])).any()
    with pytest.raises(AssertionError, match="made again"), precision(name):
        slope()(VanDerPol(), x, 3.0)


def test_what_is_damaged_is_made_again(slope, folder):
    x = np.array([0.3, -0.2])
    told = slope()(VanDerPol(), x, 2.0)["slope"]
    [entry] = folder.iterdir()
    whole = entry.read_bytes()
    for damage in (whole[:40], b"", whole[:-1] + bytes([whole[-1] ^ 1])):
        entry.write_bytes(damage)
        np.testing.assert_array_equal(slope()(VanDerPol(), x, 2.0)["slope"], told)
        assert store.read(entry) is not None


def test_a_program_within_a_trace_is_a_part_of_it(slope, folder):
    def through(x):
        return slope()(VanDerPol(), x, 2.0)["slope"].sum()

    assert jax.grad(through)(jnp.array([0.3, -0.2])).shape == (2,)
    assert list(folder.iterdir()) == []


def test_code_that_calls_other_code_is_not_kept(folder, monkeypatch):
    def solved(a):
        return jnp.linalg.lstsq(a, a[0])[0]

    monkeypatch.setattr(solved, "__module__", "echelon.models.linearization")
    assert Program(solved)(np.eye(2)).shape == (2,)
    assert list(folder.iterdir()) == []


def test_what_is_found_depends_on_every_bit_and_class():
    array = np.array([1.0, 2.0])
    values = [1, 1.0, True, "1", b"1", None, np.float64(1.0), np.float32(1.0), 0.0, -0.0]
    values += [(1,), [1], (1, 1), ((1,), 1), (1, (1,)), {"a": 1}, {"b": 1}]
    values += [array, array.astype(np.float32), array[None], array.astype(int), array[::-1]]
    values += [VanDerPol(), Pendulum(), VanDerPol, dataclasses.replace(Pendulum(), damping=0.2)]
    places = [place(value) for value in values]
    assert None not in places and len(set(places)) == len(values)
    assert place(VanDerPol(), array.copy()) == place(VanDerPol(), array)
    assert store.place_of("another", 1) != place(1)


@pytest.mark.parametrize(
    "value",
    [Own(), Own, lambda x: x, Fraction(1, 3), np.array([object()]), (1, {"a": [Own()]}), refused],
)
def test_nothing_is_kept_for_a_strangers_class(value, folder):
    assert place(value) is None
    assert stored(lambda: 3, "what", value) == 3 and list(folder.iterdir()) == []


def test_other_sources_settings_and_versions_find_nothing(monkeypatch):
    before = place(1)
    for change in (
        lambda at: at.setattr(store, "_sources", lambda: b"other"),
        lambda at: at.setattr(store, "_processor", lambda: "other"),
        lambda at: at.setenv("XLA_FLAGS", "--xla_cpu_enable_fast_math=true"),
        lambda at: at.setattr(np, "__version__", "0"),
        lambda at: at.setattr(sys, "version", "0"),
    ):
        with monkeypatch.context() as at:
            change(at)
            store._ground.cache_clear()
            assert place(1) not in (None, before)
    store._ground.cache_clear()
    assert place(1) == before


def test_sources_are_told_by_all_that_stands_in_them(tmp_path, monkeypatch):
    home = tmp_path / "home"
    (home / "core").mkdir(parents=True)
    monkeypatch.setattr(store, "__file__", str(home / "core" / "store.py"))
    monkeypatch.setattr(store, "_BEGAN", float("inf"))
    told = []
    for name, text in (("a", "1"), ("a", "2"), ("b", "2"), ("core/a", "")):
        (home / f"{name}.py").write_text(text)
        told.append(store._sources())
    assert None not in told and len(set(told)) == 4


def test_nothing_is_kept_where_a_source_changed_since_the_process_began(monkeypatch):
    monkeypatch.setattr(store, "_BEGAN", 0.0)
    assert place(1) is None


def test_nothing_is_kept_once_a_users_file_is_loaded(tmp_path, monkeypatch):
    closed = store.threading.Event()
    monkeypatch.setattr(store, "_closed", closed)
    (tmp_path / "mine.py").write_text(
        "from echelon.models import VanDerPol\nclass Mine(VanDerPol):\n    pass\n"
    )
    assert place(1) is not None
    own_class(tmp_path, "mine.py:Mine", ControlAffine)
    assert place(1) is None and not store.is_open()


def test_the_library_keeps_nothing(monkeypatch):
    monkeypatch.delenv(store.FOLDER)
    assert place(1) is None


def test_what_comes_back_is_equal_and_read_only(monkeypatch):
    model = Pendulum()
    inspect.unwrap(at_trim)(model)  # what it rests on is compiled
    first = stored(lambda: inspect.unwrap(at_trim)(model), "at_trim", model)
    again = stored(refused, "at_trim", model)
    assert isinstance(again, AtTrim) and again.gap == first.gap
    for a, b in zip(first[:-1], again[:-1], strict=True):
        np.testing.assert_array_equal(a, b)
        assert not b.flags.writeable or not b.size
    assert kept.kept(lambda value: value)(model) is model
