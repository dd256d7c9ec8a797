"""Compiled code kept between runs of the command line: where, and how to switch it off."""

import os
import subprocess
import sys
import warnings
from pathlib import Path

import pytest
from processes import without_status

from echelon.apps.cli import app
from echelon.apps.cli.cache import cache_folder, keep_compiled_code
from echelon.core import disk_cache


@pytest.fixture(autouse=True)
def filters():
    """The warnings' filters as they were, for what the command line sets holds for its process."""
    with warnings.catch_warnings():
        yield


def run(folder, where, **environment):
    """What a short command prints that runs in a process of its own."""
    clean = {k: v for k, v in os.environ.items() if not k.startswith(("JAX_", "ECHELON_"))}
    done = subprocess.run(
        [sys.executable, "-m", "echelon", "check", "integrators"],
        capture_output=True,
        text=True,
        cwd=folder,
        env=clean | environment | {"ECHELON_CACHE": str(where)},
        timeout=300,
    )
    assert done.returncode == 0
    return done.stdout, without_status(done.stderr)


@pytest.mark.slow
def test_a_second_run_uses_what_the_first_compiled_and_says_the_same(tmp_path):
    told = run(tmp_path, "c")
    entries = list((tmp_path / "c" / "compiled").glob("*-cache"))
    made = [entry for entry in entries if entry.name.endswith("-made-cache")]
    assert len(entries) > len(made) > 5 and told[1] == ""
    out, log = run(tmp_path, "c", JAX_LOGGING_LEVEL="DEBUG")
    hits = log.count("Persistent compilation cache hit")
    assert out == told[0] and hits >= len(entries) - len(made) and "CACHE MISS" not in log
    assert "Compiling _evaluate" not in log
    assert set((tmp_path / "c" / "compiled").glob("*-cache")) == set(entries)
    for entry in entries:
        entry.write_bytes(entry.read_bytes()[:20])  # as Ctrl-C or a full disk leaves it
    assert run(tmp_path, "c") == told


@pytest.mark.parametrize("where", ["off", ""])
def test_off_keeps_nothing(tmp_path, where):
    told = run(tmp_path, where, HOME=str(tmp_path), XDG_CACHE_HOME=str(tmp_path / "x"))
    assert told[1] == ""
    assert list(tmp_path.iterdir()) == []


def test_a_folder_that_cannot_be_made_does_no_harm(tmp_path):
    (tmp_path / "file").write_text("not a folder")
    assert run(tmp_path, tmp_path / "file" / "inside")[1] == ""
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_a_folder_without_leave_to_write_is_left_alone(tmp_path, monkeypatch):
    monkeypatch.setattr(os, "access", lambda path, mode: False)
    environment = {"ECHELON_CACHE": str(tmp_path)}
    keep_compiled_code(environment)
    assert environment == {"ECHELON_CACHE": str(tmp_path)}


@pytest.mark.parametrize(
    ("platform", "environment", "folder"),
    [
        ("linux", {}, ".cache/echelon"),
        ("linux", {"XDG_CACHE_HOME": "/xdg"}, "/xdg/echelon"),
        ("darwin", {}, "Library/Caches/echelon"),
        ("win32", {}, "AppData/Local/echelon"),
        ("win32", {"LOCALAPPDATA": "/local"}, "/local/echelon"),
        ("linux", {"ECHELON_CACHE": "~/mine", "XDG_CACHE_HOME": "/xdg"}, "mine"),
    ],
)
def test_the_folder_is_that_of_the_users_caches(
    tmp_path, monkeypatch, platform, environment, folder
):
    monkeypatch.setattr(sys, "platform", platform)
    monkeypatch.setenv("HOME", str(tmp_path))
    assert cache_folder(environment) == tmp_path / folder / "compiled"


def test_a_user_without_a_home_keeps_nothing(monkeypatch):
    def no_home(*_):
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.setattr(Path, "home", no_home)
    monkeypatch.setattr(Path, "expanduser", no_home)
    assert cache_folder({}) is None and cache_folder({"ECHELON_CACHE": "~/mine"}) is None


def test_what_the_user_told_jax_stands(tmp_path):
    environment = {"ECHELON_CACHE": str(tmp_path), "JAX_COMPILATION_CACHE_DIR": "theirs"}
    before = dict(environment)
    keep_compiled_code(environment)
    assert environment == before
    environment = {
        "ECHELON_CACHE": str(tmp_path),
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "3",
    }
    keep_compiled_code(environment)
    assert environment["JAX_COMPILATION_CACHE_DIR"] == str(tmp_path / "compiled")
    assert environment["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] == "3"


def test_the_folder_is_the_users_alone(tmp_path):
    keep_compiled_code({"ECHELON_CACHE": str(tmp_path / "c")})
    assert (tmp_path / "c" / "compiled").stat().st_mode & 0o777 == 0o700


def test_a_folder_that_others_can_change_is_left_alone(tmp_path):
    folder = tmp_path / "compiled"
    folder.mkdir()
    folder.chmod(0o770)
    environment = {"ECHELON_CACHE": str(tmp_path)}
    assert keep_compiled_code(environment) is None and len(environment) == 1
    folder.chmod(0o755)
    assert keep_compiled_code(environment).path == folder


def test_the_store_is_open_for_one_command_and_no_other_process(tmp_path, monkeypatch, echelon):
    monkeypatch.setenv("ECHELON_CACHE", str(tmp_path))
    monkeypatch.delenv("JAX_COMPILATION_CACHE_DIR")
    seen = []

    def command():
        seen.append(disk_cache.is_open())
        raise SystemExit

    monkeypatch.setattr(app, "app", command)
    echelon()
    assert seen == [True] and not disk_cache.is_open()
    assert str(tmp_path / "compiled") in os.environ["JAX_COMPILATION_CACHE_DIR"]
    assert not any("ECHELON" in name for name in os.environ if name != "ECHELON_CACHE")
