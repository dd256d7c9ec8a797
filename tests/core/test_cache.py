"""Results that are stored: found again by their inputs alone, in a folder of the user."""

import contextlib
import dataclasses
import inspect
import os
import subprocess
import sys
import threading
import time
import warnings
from concurrent.futures import ThreadPoolExecutor
from fractions import Fraction
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from processes import without_status

import echelon as ech
from echelon.agents.models import Pendulum, VanDerPol
from echelon.agents.models.linearization import AtTrim, at_trim
from echelon.agents.models.model import ControlAffine
from echelon.apps.cli import app
from echelon.core import cache, compiled
from echelon.core.cache import file_for, load_or_compute, private_folder, user_folder
from echelon.core.compiled import CompiledFunction
from echelon.core.numerics import precision
from echelon.core.words import Kind
from echelon.experiments.scenario.named_class import user_class
from echelon.simulation.native import kernel_cache, stepper


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A folder where all is kept, as the command line opens it, and nothing known before."""
    forget()
    # Other tests of this process may have loaded a user's file.
    monkeypatch.setattr(cache, "_closed", threading.Event())
    with cache.use_folder(private_folder(tmp_path / "compiled")):
        yield tmp_path / "compiled"
    forget()


def forget():
    """Let all be looked at again, as in another process."""
    cache.ground.cache_clear()
    cache.loaded_sources.cache_clear()


def again(*_, **__):
    raise AssertionError("it was made again")


class Own(VanDerPol):
    """A user's model."""


def test_what_is_found_depends_on_every_bit_and_class_and_nothing_is_kept_for_a_foreign_one(folder):
    values = 1, True, None, 0.0, -0.0, (1, (1,)), np.ones(2), np.ones(2, np.float32), VanDerPol()
    files = [file_for("what", value) for value in values]
    assert None not in files and len(set(files)) == len(values)
    assert file_for("what", VanDerPol(), np.ones(2)) == file_for("what", VanDerPol(), np.ones(2))
    assert file_for("another", 1) != file_for("what", 1)
    for value in (Own(), Own, lambda x: x, (1, {"a": [Own()]})):
        assert file_for("what", value) is None
        assert load_or_compute(lambda: 3, "what", value) == 3 and list(folder.iterdir()) == []


def test_what_comes_back_is_equal_and_its_arrays_are_read_only(folder, monkeypatch):
    value = {
        "array": np.arange(6.0).reshape(2, 3)[:, ::-1],
        "none": np.zeros((0, 3), np.int8),
        "scalar": np.float32(0.1),
        "plain": [Kind.PROOF, Fraction(-1, 3), 10**30, -0.0, b"1", {1: None}, (True,)],
    }
    model = Pendulum(damping=0.25)
    assert load_or_compute(lambda: value, "what", 1) is value
    back = load_or_compute(again, "what", 1)
    assert repr(back) == repr(value) and back["plain"][0] is Kind.PROOF
    assert [back[name].dtype for name in ("array", "none")] == [float, np.int8]
    assert not back["array"].flags.writeable and type(back["scalar"]) is np.float32
    first = load_or_compute(lambda: inspect.unwrap(at_trim)(model), "at_trim", model)
    found = load_or_compute(again, "at_trim", model)
    assert isinstance(found, AtTrim) and found.gap == first.gap
    load_or_compute(lambda: model, "model", 1)
    assert load_or_compute(again, "model", 1) == model
    np.testing.assert_array_equal(found[0], first[0])
    # What cannot be stored, as a function of one call, is computed each time.
    assert [load_or_compute(lambda: lambda: 1, "other", 1)() for _ in range(2)] == [1, 1]


def test_other_sources_settings_and_versions_find_nothing(folder, monkeypatch):
    before = file_for("what", 1)
    for change in (
        lambda at: at.setattr(cache, "sources", lambda: b"other"),
        lambda at: at.setattr(cache, "processor", lambda: "other"),
        lambda at: at.setenv("XLA_FLAGS", "--xla_cpu_enable_fast_math=true"),
        lambda at: at.setattr(np, "__version__", "0"),
        lambda at: at.setattr(sys, "version", "0"),
    ):
        with monkeypatch.context() as at:
            change(at)
            forget()
            assert file_for("what", 1) not in (None, before)
    forget()
    files = [file_for("what", 1)]
    assert files == [before]
    for name in ("float32", "float64"):
        with precision(name):
            files.append(file_for("what", 1))
            with jax.default_matmul_precision("bfloat16"):
                files.append(file_for("what", 1))
    assert None not in files and len(set(files[1:])) == 4


@pytest.fixture
def home(folder, tmp_path, monkeypatch):
    """Sources that were there before the process began."""
    home = tmp_path / "home"
    (home / "core").mkdir(parents=True)
    for name in ("core/cache.py", "late.py"):
        (home / name).write_text("old")
    monkeypatch.setattr(cache, "__file__", str(home / "core" / "cache.py"))
    monkeypatch.setattr(cache, "BEGAN", (home / "late.py").stat().st_ctime + 0.01)
    time.sleep(0.03)
    forget()
    return home


def test_sources_are_told_by_all_that_stands_in_them(home, monkeypatch):
    monkeypatch.setattr(cache, "BEGAN", float("inf"))
    found = []
    for name, text in (("core/cache", ""), ("a", "1"), ("a", "2"), ("b", "2"), ("core/a", "")):
        (home / f"{name}.py").write_text(text)
        found.append(cache.sources())
    assert None not in found and len(set(found)) == 5


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
def test_nothing_is_kept_where_a_source_changed_since_the_process_began(home, folder, change):
    # What was loaded after the change is no part of what was told before it.
    def compute():
        change(home)
        return 3

    assert load_or_compute(compute, "what", 1) == 3 and list(folder.iterdir()) == []
    forget()
    assert (file_for("what", 1) is None) == (change is taken_back)
    (home / "core" / "cache.py").unlink()
    forget()
    # Nor where Python runs compiled files only.
    assert file_for("what", 1) is None


def test_nothing_is_kept_once_a_users_file_is_loaded_nor_by_the_library(folder, tmp_path):
    text = "from echelon.agents.models import VanDerPol\nclass Mine(VanDerPol):\n    pass\n"
    (tmp_path / "mine.py").write_text(text)
    with cache.use_folder(None):
        assert file_for("what", 1) is None and not cache.is_open()
    assert file_for("what", 1) is not None
    user_class(tmp_path, "mine.py:Mine", ControlAffine)
    assert file_for("what", 1) is None and not cache.is_open()


def test_a_file_is_written_completely_or_not_at_all(folder, monkeypatch):
    def killed(part, _):
        begun.append(Path(part).name)
        raise KeyboardInterrupt

    def full(*_):
        raise OSError(28, "No space left on device")

    begun = []
    for fault in (killed, killed):
        with monkeypatch.context() as at, pytest.raises(KeyboardInterrupt):
            at.setattr(os, "replace", fault)
            load_or_compute(lambda: 1, "what", 1)
    # Each by a name of its own, since two threads may write one file.
    assert len(set(begun)) == 2 and all(name.endswith("-cache") for name in begun)
    with monkeypatch.context() as at:
        at.setattr(os, "replace", full)
        assert load_or_compute(lambda: 1, "what", 1) == 1
    assert list(folder.iterdir()) == []
    assert load_or_compute(lambda: 1, "what", 1) == load_or_compute(again, "what", 1) == 1
    assert [file.stat().st_mode & 0o777 for file in (folder, *folder.iterdir())] == [0o700, 0o600]


def test_the_oldest_files_go_first_and_no_others(tmp_path):
    for age, name in enumerate(["new-cache", "old-cache", "oldest-cache", "not-ours"]):
        (tmp_path / name).write_bytes(bytes(10))
        os.utime(tmp_path / name, (1000 - age, 1000 - age))
    cache.remove_oldest(tmp_path, 25)
    assert {*os.listdir(tmp_path)} == {"new-cache", "old-cache", "not-ours"}


@pytest.fixture
def base(tmp_path):
    """A folder under folders that others may enter, so that modes below it count."""
    assert sys.platform != "win32", "these are rules of POSIX"
    for folder in (tmp_path, *tmp_path.parents):
        if folder.stat().st_uid == os.geteuid() and folder != folder.parent:
            with contextlib.suppress(OSError):
                folder.chmod(folder.stat().st_mode | 0o055)
    return tmp_path


def test_a_folder_is_refused_that_others_may_change(base, monkeypatch):
    for mode in (0o770, 0o702, 0o777, 0o1777):
        (base / f"{mode}").mkdir()
        (base / f"{mode}").chmod(mode)
        with pytest.raises(PermissionError):
            private_folder(base / f"{mode}")
    (base / "above" / "inner").mkdir(parents=True)
    for mode, private in ((0o770, False), (0o772, False), (0o1777, True)):
        (base / "above").chmod(mode)
        with contextlib.nullcontext() if private else pytest.raises(PermissionError):
            private_folder(base / "above" / "inner" / "compiled")
    (base / "above").chmod(0o777)
    # Below a folder that nobody else can enter, modes do not count.
    base.chmod(0o700)
    private_folder(base / "above" / "inner" / "compiled")
    base.chmod(0o755)
    (base / "own").mkdir()
    with monkeypatch.context() as at, pytest.raises(PermissionError):
        at.setattr(os, "geteuid", lambda: os.getuid() + 1)
        private_folder(base / "own")
    assert private_folder(base / "own") == base / "own"
    assert private_folder(base / "a" / "b").stat().st_mode & 0o777 == 0o700
    assert (base / "a").stat().st_mode & 0o777 == 0o700


def test_links_are_followed_on_the_way_and_never_at_the_end(base):
    (base / "real").mkdir(mode=0o755)
    (base / "link").symlink_to("real")
    assert private_folder(base / "link" / "compiled") == base / "real" / "compiled"
    (base / "compiled").symlink_to(base / "real" / "compiled")
    (base / "loop").symlink_to("loop")
    for path in (base / "compiled", base / "loop" / "compiled"):
        with pytest.raises(OSError):
            private_folder(path)
    (base / "real").chmod(0o777)
    with pytest.raises(PermissionError):
        private_folder(base / "link" / "compiled")


def test_the_folder_is_that_of_the_users_caches(tmp_path, monkeypatch):
    cases = [
        ("linux", {}, ".cache/echelon"),
        ("linux", {"XDG_CACHE_HOME": "/xdg"}, "/xdg/echelon"),
        ("darwin", {}, "Library/Caches/echelon"),
        ("win32", {}, "AppData/Local/echelon"),
        ("win32", {"LOCALAPPDATA": "/local"}, "/local/echelon"),
        ("linux", {"ECHELON_CACHE": "~/mine", "XDG_CACHE_HOME": "/xdg"}, "mine"),
    ]
    monkeypatch.setenv("HOME", str(tmp_path))
    for platform, environment, folder in cases:
        monkeypatch.setattr(sys, "platform", platform)
        assert user_folder(environment) == tmp_path / folder / "compiled"
    assert user_folder({"ECHELON_CACHE": "off"}) is user_folder({"ECHELON_CACHE": ""}) is None

    def no_home(*_):
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.setattr(Path, "home", no_home)
    monkeypatch.setattr(Path, "expanduser", no_home)
    assert user_folder({}) is None and user_folder({"ECHELON_CACHE": "~/mine"}) is None


def test_what_the_user_set_for_jax_is_kept_and_a_folder_of_others_left_alone(tmp_path):
    with warnings.catch_warnings():
        environment = {"ECHELON_CACHE": str(tmp_path), "JAX_COMPILATION_CACHE_DIR": "theirs"}
        before = dict(environment)
        assert cache.open_user_folder(environment) is None and environment == before
        least = "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"
        environment = {"ECHELON_CACHE": str(tmp_path), least: "3"}
        assert cache.open_user_folder(environment) == tmp_path / "compiled"
        assert environment["JAX_COMPILATION_CACHE_DIR"] == str(tmp_path / "compiled")
        assert environment[least] == "3"
        (tmp_path / "file").write_text("not a folder")
        for place in (tmp_path / "file", Path("/proc")):
            environment = {"ECHELON_CACHE": str(place)}
            assert cache.open_user_folder(environment) is None and len(environment) == 1


def test_the_cache_is_open_for_one_command_and_no_other_process(tmp_path, monkeypatch, echelon):
    monkeypatch.setattr(cache, "_closed", threading.Event())
    monkeypatch.setenv("ECHELON_CACHE", str(tmp_path))
    monkeypatch.delenv("JAX_COMPILATION_CACHE_DIR")
    seen = []

    def command():
        seen.append(cache.is_open())
        raise SystemExit

    monkeypatch.setattr(app, "app", command)
    echelon()
    assert seen == [True] and not cache.is_open()
    assert str(tmp_path / "compiled") in os.environ["JAX_COMPILATION_CACHE_DIR"]
    assert not any("ECHELON" in name for name in os.environ if name != "ECHELON_CACHE")


@pytest.mark.slow
def test_a_second_run_uses_what_the_first_compiled_and_says_the_same(tmp_path):
    def run(**environment):
        clean = {k: v for k, v in os.environ.items() if not k.startswith(("JAX_", "ECHELON_"))}
        done = subprocess.run(
            [sys.executable, "-m", "echelon", "check", "integrators"],
            **{"capture_output": True, "text": True, "cwd": tmp_path, "timeout": 300},
            env=clean | {"ECHELON_CACHE": "c"} | environment,
        )
        assert done.returncode == 0
        return done.stdout, without_status(done.stderr)

    first = run()
    entries = {*(tmp_path / "c" / "compiled").glob("*-cache")}
    made = {entry for entry in entries if entry.name.endswith("-made-cache")}
    assert len(entries) > len(made) > 5 and first[1] == ""
    out, log = run(JAX_LOGGING_LEVEL="DEBUG")
    assert "Persistent compilation cache hit" in log and "CACHE MISS" not in log
    assert out == first[0]
    assert "Compiling _evaluate" not in log
    assert {*(tmp_path / "c" / "compiled").glob("*-cache")} == entries
    for entry in entries:
        entry.write_bytes(entry.read_bytes()[:20])  # as Ctrl-C or a full disk leaves it
    assert run() == first
    assert run(ECHELON_CACHE="off", HOME=str(tmp_path / "none")) == first
    assert [path.name for path in tmp_path.iterdir()] == ["c"]


def sensitivity(model, x, scale):
    """A function that echelon might have."""
    return {"slope": jax.jacfwd(model.drift)(x) * scale, "name": type(model).__name__}


@pytest.fixture
def slope(folder, monkeypatch):
    """It, as if it were echelon's."""
    monkeypatch.setattr(sensitivity, "__module__", "echelon.agents.models.linearization")
    return lambda: CompiledFunction(sensitivity)


@pytest.mark.parametrize("name", ["float64", "float32"])
def test_another_process_finds_a_program_and_its_bits(slope, monkeypatch, name):
    x = np.array([0.3, -0.2])
    with precision(name):
        plain = eqx.filter_jit(sensitivity)(VanDerPol(), x, 2.0)
        first = slope()(VanDerPol(), x, 2.0)
        monkeypatch.setattr(compiled, "compile_call", again)
        other = slope()(VanDerPol(), x + 1.0, 2.0)
        found = slope()(VanDerPol(), jnp.asarray(x), 2.0)
        with pytest.raises(AssertionError, match="made again"):
            slope()(VanDerPol(), x, 3.0)
    for each in (first, found):
        assert each["name"] == "VanDerPol" and each["slope"].dtype == name
        np.testing.assert_array_equal(each["slope"], plain["slope"])
    assert (np.asarray(other["slope"]) != np.asarray(plain["slope"])).any()


def test_what_is_damaged_is_made_again(slope, folder):
    x = np.array([0.3, -0.2])
    first = slope()(VanDerPol(), x, 2.0)["slope"]
    [entry] = folder.iterdir()
    whole = entry.read_bytes()
    for damage in (whole[:40], b"", whole[:-1] + bytes([whole[-1] ^ 1])):
        entry.write_bytes(damage)
        np.testing.assert_array_equal(slope()(VanDerPol(), x, 2.0)["slope"], first)
        assert entry.read_bytes() != damage


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
    for _ in range(2):
        assert CompiledFunction(solved)(np.eye(2)).shape == (2,)
    # What is stored says so, and each later process traces it once.
    assert len(traced) == 4 and len(list(folder.iterdir())) == 1


def test_what_another_thread_compiles_leaves_the_settings_of_jax(slope):
    option = "jax_persistent_cache_min_compile_time_secs"
    before = jax.config.values[option]
    scales = np.linspace(1.0, 2.0, 6).tolist()
    with ThreadPoolExecutor(3) as pool:
        list(pool.map(lambda scale: slope()(VanDerPol(), np.ones(2), scale), scales))
    assert jax.config.values[option] == before


class Still(eqx.Module):
    """An array that is no part of what is traced, and known by who it is alone."""

    kept: Any = eqx.field(static=True)


@dataclasses.dataclass(frozen=True, eq=False)
class Box:
    values: Any


def scaled(still, x):
    return x * still.kept.values


def zeros(n):
    return jnp.zeros(()) + n.sum()


def test_a_program_is_that_of_what_is_set_and_of_arrays_that_are_not_traced(folder, monkeypatch):
    for thing in (Still, Box, scaled, zeros):
        monkeypatch.setattr(thing, "__module__", "echelon.agents.models")
        monkeypatch.setattr("echelon.agents.models." + thing.__name__, thing, raising=False)
    made, n = CompiledFunction(zeros), np.arange(3, dtype=np.int32)
    for name in ("float32", "float64", "float32"):
        with precision(name):
            assert made(n).dtype == name
    made = CompiledFunction(scaled)
    for numbers in (np.array([1.0, 2.0]), np.array([3.0, 4.0])):
        with precision("float64"):
            np.testing.assert_array_equal(made(Still(Box(numbers)), np.ones(2)), numbers)


def test_the_text_of_a_kernel_is_found_by_what_runs_and_never_of_somebody_s_own_class(
    folder, monkeypatch
):
    def flown(model, speed=1.0):
        graph = ech.Graph.path(3)
        laws = ech.laws.StoppingLeader(speed=speed), ech.laws.StoppingPoint(speed=speed)
        offsets = ech.Formation.from_offsets(model, graph, {})
        parts = ech.Parts(model, graph, offsets, ech.Laws(*laws))
        parts = parts.replace(initial={model.state_names[0]: 1.0})
        monkeypatch.setattr(kernel_cache, "KERNELS", kernel_cache.Kernels())
        monkeypatch.setattr(stepper, "KERNELS", kernel_cache.KERNELS)
        chosen = ech.Settings(horizon=1.0, dt=0.01, engine="native", steady_window=None)
        return ech.simulate(parts, chosen).states

    first, other, own = flown(Pendulum()), flown(Pendulum(), 0.1), flown(OwnPendulum())
    assert (first != other).any() and (own == first).all()
    with monkeypatch.context() as patch:
        patch.setattr(kernel_cache, "plan_of", again)
        np.testing.assert_array_equal(flown(Pendulum()), first)
        np.testing.assert_array_equal(flown(Pendulum(), 0.1), other)
        with pytest.raises(AssertionError, match="made again"):
            flown(OwnPendulum())


class OwnPendulum(Pendulum):
    """A user's model."""
