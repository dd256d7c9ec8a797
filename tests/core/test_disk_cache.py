"""Results stored between processes: found again by their inputs, and by nothing else."""

import dataclasses
import inspect
import os
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from decimal import Decimal
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from echelon.agents.models import Pendulum, VanDerPol
from echelon.agents.models.linearization import AtTrim, at_trim
from echelon.agents.models.model import ControlAffine
from echelon.core import compiled, disk_cache, memoize
from echelon.core.compiled import CompiledFunction
from echelon.core.memoize import load_or_compute
from echelon.core.numerics import precision
from echelon.core.private_folder import PrivateFolder
from echelon.experiments.scenario.named_class import user_class


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    """A folder where all is kept, as the command line opens it, and nothing known before."""
    forget()
    # Other tests of this process may have loaded a user's file.
    monkeypatch.setattr(disk_cache, "_closed", threading.Event())
    with disk_cache.use_folder(PrivateFolder(tmp_path)):
        yield tmp_path
    forget()


def forget():
    """Let all be looked at again, as in another process."""
    disk_cache._ground.cache_clear()
    disk_cache._loaded.cache_clear()


class Own(VanDerPol):
    """A user's model."""


def place(*values):
    return disk_cache.file_for("what", *values)


def stored(entry):
    return disk_cache.read(disk_cache.CacheFile(PrivateFolder(entry.parent), entry.name))


def sensitivity(model, x, scale):
    """A function that echelon might have."""
    return {"slope": jax.jacfwd(model.drift)(x) * scale, "name": type(model).__name__}


@pytest.fixture
def slope(monkeypatch):
    """It, as if it were echelon's."""
    monkeypatch.setattr(sensitivity, "__module__", "echelon.agents.models.linearization")
    return lambda: CompiledFunction(sensitivity)


def refused(*_):
    raise AssertionError("it was made again")


@pytest.mark.parametrize("name", ["float64", "float32"])
def test_another_process_finds_a_program_and_its_bits(slope, monkeypatch, name):
    x = np.array([0.3, -0.2])
    with precision(name):
        plain = eqx.filter_jit(sensitivity)(VanDerPol(), x, 2.0)
        first = slope()(VanDerPol(), x, 2.0)
        monkeypatch.setattr(compiled, "_compile", refused)
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
        assert stored(entry) is not None


def test_a_program_within_a_trace_is_a_part_of_it(slope, folder):
    def through(x):
        return slope()(VanDerPol(), x, 2.0)["slope"].sum()

    assert jax.grad(through)(jnp.array([0.3, -0.2])).shape == (2,)
    assert list(folder.iterdir()) == []


def test_code_that_calls_other_code_is_left_to_jax(folder, monkeypatch):
    traced = []

    def solved(a):
        traced.append(a)
        return jnp.linalg.lstsq(a, a[0])[0]

    monkeypatch.setattr(solved, "__module__", "echelon.agents.models.linearization")
    # JAX compiles what it traces itself, under a name that it finds again.
    assert CompiledFunction(solved)(np.eye(2)).shape == (2,) and len(traced) == 2
    assert [stored(entry) for entry in folder.iterdir()] == [b""]
    for _ in range(2):
        assert CompiledFunction(solved)(np.eye(2)).shape == (2,)
    # Nor is it traced to know of it once that is kept.
    assert len(traced) == 2


def test_what_another_thread_compiles_leaves_the_settings_of_jax(slope):
    before = jax.config.values[compiled._LEAST]
    scales = np.linspace(1.0, 2.0, 6).tolist()
    with ThreadPoolExecutor(3) as pool:
        list(pool.map(lambda scale: slope()(VanDerPol(), np.ones(2), scale), scales))
    assert jax.config.values[compiled._LEAST] == before


def test_a_program_is_compiled_for_what_is_set(monkeypatch):
    def zeros(n):
        return jnp.zeros(()) + n.sum()

    monkeypatch.setattr(zeros, "__module__", "echelon.agents.models.linearization")
    made, n = CompiledFunction(zeros), np.arange(3, dtype=np.int32)
    for name in ("float32", "float64", "float32"):
        with precision(name):
            assert made(n).dtype == name


def test_what_is_found_depends_on_every_bit_and_class():
    array = np.array([1.0, 2.0])
    values = [1, 1.0, True, "1", b"1", None, np.float64(1.0), np.float32(1.0), 0.0, -0.0]
    values += [(1,), [1], (1, 1), ((1,), 1), (1, (1,)), {"a": 1}, {"b": 1}]
    values += [array, array.astype(np.float32), array[None], array.astype(int), array[::-1]]
    values += [VanDerPol(), Pendulum(), VanDerPol, dataclasses.replace(Pendulum(), damping=0.2)]
    places = [place(value) for value in values]
    assert None not in places and len(set(places)) == len(values)
    assert place(VanDerPol(), array.copy()) == place(VanDerPol(), array)
    assert disk_cache.file_for("another", 1) != place(1)


@pytest.mark.parametrize(
    "value",
    [Own(), Own, lambda x: x, Decimal(1), np.array([object()]), (1, {"a": [Own()]}), refused],
)
def test_nothing_is_kept_for_a_strangers_class(value, folder):
    assert place(value) is None
    assert load_or_compute(lambda: 3, "what", value) == 3 and list(folder.iterdir()) == []


def test_other_sources_settings_and_versions_find_nothing(monkeypatch):
    before = place(1)
    for change in (
        lambda at: at.setattr(disk_cache, "_sources", lambda: b"other"),
        lambda at: at.setattr(disk_cache, "_processor", lambda: "other"),
        lambda at: at.setenv("XLA_FLAGS", "--xla_cpu_enable_fast_math=true"),
        lambda at: at.setattr(np, "__version__", "0"),
        lambda at: at.setattr(sys, "version", "0"),
    ):
        with monkeypatch.context() as at:
            change(at)
            forget()
            assert place(1) not in (None, before)
    forget()
    assert place(1) == before


def test_what_is_set_counts_when_it_is_set_and_where():
    places = [place(1)]
    for name in ("float32", "float64"):
        with precision(name):
            places.append(place(1))
            with jax.default_matmul_precision("bfloat16"):
                places.append(place(1))
    assert None not in places and len(set(places[1:])) == 4 and place(1) == places[0]


def test_sources_are_told_by_all_that_stands_in_them(tmp_path, monkeypatch):
    home = tmp_path / "home"
    (home / "core").mkdir(parents=True)
    monkeypatch.setattr(disk_cache, "__file__", str(home / "core" / "disk_cache.py"))
    monkeypatch.setattr(disk_cache, "_BEGAN", float("inf"))
    told = []
    for name, text in (("core/disk_cache", ""), ("a", "1"), ("a", "2"), ("b", "2"), ("core/a", "")):
        (home / f"{name}.py").write_text(text)
        told.append(disk_cache._sources())
    assert None not in told and len(set(told)) == 5


def test_nothing_is_kept_where_a_source_changed_since_the_process_began(folder, monkeypatch):
    before = place(1)
    monkeypatch.setattr(disk_cache, "_BEGAN", 0.0)
    # What was loaded after the change is no part of what was told before it.
    assert load_or_compute(lambda: 3, "what", 1) == 3 and place(1) == before
    assert list(folder.iterdir()) == []
    forget()
    assert place(1) is None


@pytest.fixture
def home(tmp_path, monkeypatch):
    """Sources that were there before the process began."""
    home = tmp_path / "home"
    (home / "core").mkdir(parents=True)
    for name in ("core/disk_cache.py", "late.py"):
        (home / name).write_text("old")
    monkeypatch.setattr(disk_cache, "__file__", str(home / "core" / "disk_cache.py"))
    monkeypatch.setattr(disk_cache, "_BEGAN", (home / "late.py").stat().st_ctime + 0.01)
    time.sleep(0.03)
    forget()
    return home


def taken_back(home):
    """A source that had another text for a while, and has its date again."""
    before = (home / "late.py").stat().st_mtime
    for text in ("new", "old"):
        (home / "late.py").write_text(text)
    os.utime(home / "late.py", (before, before))


def replaced(home):
    """Another version in the folder's place, all of it with old dates."""
    os.rename(home / "late.py", home.parent / "late.py")


@pytest.mark.parametrize("change", [taken_back, replaced])
def test_a_source_that_changes_before_it_is_loaded_keeps_nothing(home, change):
    file = place(1)
    assert file is not None
    disk_cache.write_if_unchanged(file, b"true")
    change(home)
    disk_cache.write_if_unchanged(file, b"false")
    assert disk_cache.read(file) == b"true"


def test_nothing_is_kept_where_python_runs_no_sources(home):
    (home / "core" / "disk_cache.py").unlink()
    assert place(1) is None


def test_what_a_killed_process_leaves_goes_with_the_oldest(folder, monkeypatch):
    def killed(beside, _, **folders):
        begun.append(beside)
        raise KeyboardInterrupt

    begun, file = [], place(1)
    with monkeypatch.context() as at:
        at.setattr(os, "replace", killed)
        for _ in range(2):
            with pytest.raises(KeyboardInterrupt):
                disk_cache.write_if_unchanged(file, b"made")
    # Each by a name of its own, since two threads may write one file.
    assert len(set(begun)) == 2 and all(name.endswith("-cache") for name in begun)
    assert list(folder.iterdir()) == []


class Still(eqx.Module):
    """An array that is no part of what is traced, and known by who it is alone."""

    kept: Any = eqx.field(static=True)


@dataclasses.dataclass(frozen=True, eq=False)
class Box:
    values: Any


def scaled(still, x):
    return x * still.kept.values


def test_arrays_that_are_not_traced_are_known_by_their_numbers(monkeypatch):
    for thing in (Still, Box, scaled):
        monkeypatch.setattr(thing, "__module__", "echelon.agents.models")
        monkeypatch.setattr("echelon.agents.models." + thing.__name__, thing, raising=False)
    x = np.ones(2)
    for numbers in (np.array([1.0, 2.0]), np.array([3.0, 4.0])):
        with precision("float64"):
            got = CompiledFunction(scaled)(Still(Box(numbers)), x)
        np.testing.assert_array_equal(got, numbers)


def test_nothing_is_kept_once_a_users_file_is_loaded(tmp_path, monkeypatch):
    closed = disk_cache.threading.Event()
    monkeypatch.setattr(disk_cache, "_closed", closed)
    (tmp_path / "mine.py").write_text(
        "from echelon.agents.models import VanDerPol\nclass Mine(VanDerPol):\n    pass\n"
    )
    assert place(1) is not None
    user_class(tmp_path, "mine.py:Mine", ControlAffine)
    assert place(1) is None and not disk_cache.is_open()


def test_the_library_keeps_nothing(folder):
    with disk_cache.use_folder(None):
        assert place(1) is None and not disk_cache.is_open()
    assert place(1) is not None


def test_what_comes_back_is_equal_and_read_only(monkeypatch):
    model = Pendulum()
    inspect.unwrap(at_trim)(model)  # what it rests on is compiled
    first = load_or_compute(lambda: inspect.unwrap(at_trim)(model), "at_trim", model)
    again = load_or_compute(refused, "at_trim", model)
    assert isinstance(again, AtTrim) and again.gap == first.gap
    for a, b in zip(first[:-1], again[:-1], strict=True):
        np.testing.assert_array_equal(a, b)
        assert not b.flags.writeable or not b.size
    assert memoize.memoize(lambda value: value)(model) is model
