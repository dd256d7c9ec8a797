"""Exit codes of commands: one for each ending, with one sentence, never a bare traceback."""

import json
import re
import subprocess
import sys
from pathlib import Path

import jax
import numpy as np
import pytest
from processes import without_status

import echelon as ech
from echelon.apps.cli import app
from echelon.core.errors import Outcome

LEAVES = """
import sys
import jax.numpy as jnp
import echelon as ech
{top}
class Mine(ech.ControlAffine):
    state_names = ("x",)
    input_names = ("u",)
    def drift(self, x):
        {inside}
        return -x
    def input_map(self, x):
        return jnp.array([[1.0]])
"""
SCENARIO = """
name: mine
model: {python: "mine.py:Mine"}
graph: {name: path, agents: 3}
simulation: {horizon: 0.1, dt: 0.1}
"""


@pytest.fixture
def here(here):
    (here / "mine.yaml").write_text(SCENARIO)
    return here


def test_each_outcome_has_its_code():
    codes = {each.name: each.exit_code for each in Outcome}
    ended = {"COMPLETED": 0, "LEFT_CHART": 1, "DIVERGED": 3}
    assert codes == {**ended, "INTERRUPTED": 130, "STOPPED": 130}


def test_help_names_every_code(echelon):
    code, out, _ = echelon("--help")
    assert code == 0
    told = " ".join(out.split()).partition("Exit codes: ")[2]
    assert [int(x) for x in re.findall(r"\b(\d+)\b", told)] == [0, 1, 2, 3, 4, 5, 70, 130, 143, 141]


def test_a_users_file_that_leaves_is_bad_input(here, echelon):
    for command, where in (("run", "top"), ("check", "inside")):
        lines = {"top": "", "inside": "pass"} | {where: "sys.exit(0)"}
        (here / "mine.py").write_text(LEAVES.format(**lines))
        code, out, err = echelon(command, "mine.yaml")
        assert code == 2 and out == "" and err.count("\n") == 1 and err.startswith("echelon: ")
        assert "SystemExit" in err or "`sys.exit(0)`" in err
        assert not (here / "runs").exists()


def test_a_fault_of_echelons_own_is_no_verdict(here, echelon, monkeypatch):
    def fail(*_):
        raise ZeroDivisionError("nothing by nothing\nand more")

    monkeypatch.setattr("tempfile.tempdir", str(here))
    monkeypatch.setattr("echelon.experiments.scenario.build._graph", fail)
    code, out, err = echelon("check", "integrators")
    assert code == 70 and out == ""
    said = re.fullmatch(
        r"echelon: internal error of echelon \(your input may be correct\): "
        r"ZeroDivisionError: nothing by nothing\. Please report it with `(.*)`\.\n",
        err,
    )
    assert said is not None
    details = Path(said[1]).read_text()
    assert "check" in details.splitlines()[0] and "'jax'" in details
    assert "Traceback" in details and "in fail" in details


def test_details_that_no_disk_takes_are_shown(monkeypatch, capsys):
    def full(*_, **__):
        raise OSError("no room")

    monkeypatch.setattr(app.tempfile, "NamedTemporaryFile", full)
    assert "report it with the details above" in app.note_crash(ValueError("odd"))
    assert "ValueError: odd" in capsys.readouterr().err


def started(*arguments, **options):
    command = [sys.executable, "-m", "echelon", *arguments]
    return subprocess.Popen(command, text=True, **options)


def test_a_screen_that_takes_no_more_is_told():
    with (
        open("/dev/full", "w") as full,
        started("list", stdout=full, stderr=subprocess.PIPE) as process,
    ):
        assert process.communicate()[1].startswith("echelon: the output cannot be written: ")
    assert process.returncode == 2


def left_by_reader(here, *arguments):
    """The exit code of a command whose reader takes nothing, and what it says elsewhere."""
    with started(*arguments, cwd=here, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        process.stdout.close()
        said = process.stderr.read()
    return process.returncode, without_status(said)


def test_a_reader_that_has_left_is_no_fault(tmp_path):
    assert left_by_reader(tmp_path, "list") == (141, "")
    # What was found is told by the exit code, which needs no pipe.
    assert left_by_reader(tmp_path, "check", "integrators", "--set", "follower.law=passive")[0] == 1


@pytest.mark.slow
def test_a_run_is_written_whole_whoever_reads(tmp_path):
    """Both streams go to one pipe, as with `2>&1 | head -0`."""
    words = "run integrators --set simulation.horizon=0.1 --no-figures --out kept".split()
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT}
    with started(*words, cwd=tmp_path, **pipes) as process:
        process.stdout.close()
    assert process.returncode == 141
    summary = json.loads((tmp_path / "kept/summary.json").read_text())
    assert summary["outcome"]["name"] == "completed"
    assert not (tmp_path / "kept/chunks").exists()


def test_a_screen_that_was_never_there_is_no_fault():
    """As for a program that the system starts with its standard output closed."""
    close = "import os, sys; os.close(1); os.execv(sys.executable, [sys.executable, *sys.argv[1:]])"
    command = [sys.executable, "-c", close, "-m", "echelon", "list"]
    done = subprocess.run(command, stderr=subprocess.PIPE, text=True)
    assert (done.returncode, done.stderr) == (0, "")


def test_numbers_beyond_all_squares_say_nothing_on_the_screen(recwarn):
    agent, graph = ech.models.Linear([[50.0]], [[1.0]]), ech.Graph.path(3)
    places = ech.Formation.from_offsets(agent, graph, {})
    laws = ech.Laws(ech.laws.TrimInput(), ech.laws.TrimInput())
    parts = ech.Parts(agent, graph, places, laws, initial={"x1": 1.0})
    run = ech.simulate(parts, ech.Settings(horizon=8.0, dt=0.01))
    assert run.outcome is Outcome.COMPLETED and np.abs(run.states).max() > 1e160
    assert "grows" in ech.report(run)
    assert not [each for each in recwarn if each.category is RuntimeWarning]


MATRIX = np.array([[0.0, 1.0], [-1.0, -0.5]])


@jax.jit
def compiled_drift(x):
    return MATRIX @ x


class Constant(ech.ControlAffine):
    """Its matrix is of NumPy, and its drift compiled."""

    state_names = ("a", "b")
    input_names = ("u",)

    def drift(self, x):
        return compiled_drift(x)

    def input_map(self, x):
        return np.array([[0.0], [1.0]]) + 0.0 * x[:, None]


def test_numpy_constants_serve_in_any_precision():
    agent, graph = Constant(), ech.Graph.path(2)
    laws = ech.Laws(ech.laws.TrimInput(), ech.laws.TrimInput())
    places = ech.Formation.from_offsets(agent, graph, {})
    parts = ech.Parts(agent, graph, places, laws, initial={"a": 1.0})
    wide, narrow, again = (
        ech.simulate(parts, ech.Settings(horizon=1.0, dt=0.1, precision=p)).states[-1]
        for p in ("float64", "float32", "float64")
    )
    assert np.abs(wide - narrow).max() < 1e-5 and np.array_equal(wide, again)
