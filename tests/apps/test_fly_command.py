"""`echelon fly` prepares a folder, and lets `echelon_flight` fly it in its place."""

import json
import os
import sys

import pytest

from echelon.apps.cli import fly_command

CARTS = """
name: carts
model: {name: double-integrator}
graph: {edges: [[0, 1]], leaders: [0]}
formation: {offsets: {1: [1, 0]}}
reference: {name: circle, rate: 0.5}
follower: {law: stopping-point}
network: {rate: 25}
simulation: {horizon: 1, dt: 0.02}
"""


class Replaced(Exception):
    """Raised where another program would take over."""


@pytest.fixture
def taken_over(monkeypatch):
    words = []

    def execv(program, given):
        words.extend([program, *given])
        raise Replaced

    monkeypatch.setattr(os, "execv", execv)
    return words


def test_a_folder_is_prepared_and_flown_by_another_program(echelon, here, taken_over):
    (here / "carts.yaml").write_text(CARTS)
    code, out, _ = echelon("fly", "carts.yaml", "--out", "flight")
    assert (code, out) == (0, "- Written to flight; `echelon fly flight --all` flies it.\n")
    facts = json.loads((here / "flight" / "flight.json").read_text("utf-8"))
    assert facts["agents"] == 2 and facts["horizon"] == 1.0
    assert not taken_over
    code, _, _ = echelon("fly", "flight", "--all", "--speed", "0.5")
    words = [sys.executable, "-m", "echelon_flight", "flight"]
    assert taken_over == [words[0], *words, "--link", "udp", "--speed", "0.5", "--all"]


REFUSED = {
    "": "give one of `--agent` with a number, `--agents`, `--all`, `--ground` and `--out`.",
    "--agent 0": "give `--key` with the key file, which all agents and the ground share.",
    "--ground --key none": "the key file `none` cannot be read",
    "--all --link radio://0": "`--link` is `radio://0`, and must begin with `udp`, `cflib`, `px4`",
}


def test_what_is_wrong_is_said_before_laws_are_written(echelon):
    """By echelon or by the package; an error of either is one sentence and its exit code."""
    for words, sentence in REFUSED.items():
        code, out, err = echelon("fly", "paper-radio", *words.split())
        assert (code, out) == (2, "") and err.startswith(f"echelon: {sentence}")
        assert err.count("\n") == 1


def test_another_version_of_the_package_is_named_once(echelon, here, monkeypatch):
    contained = fly_command.CONTAINED
    assert "installed beside" not in echelon("fly", "paper")[2]
    told = (
        "echelon: `echelon-flight` 9.9 is installed beside echelon, which contains "
        f"{contained}; uninstall it, then install echelon again.\n"
    )
    monkeypatch.setattr("importlib.metadata.version", lambda name: "9.9")
    assert echelon("fly", "paper")[2].startswith(told)
    monkeypatch.setattr("importlib.metadata.version", lambda name: contained)
    monkeypatch.setattr(fly_command, "__version__", "9.9")
    assert echelon("fly", "paper")[2].startswith(told)
