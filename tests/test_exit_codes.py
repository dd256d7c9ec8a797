"""How a command ends: one exit code for each way, one sentence, and never a bare traceback."""

import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from runs import simulate

import echelon as ech
from echelon.cli import crash
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
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine.yaml").write_text(SCENARIO)
    return tmp_path


def test_each_outcome_has_its_code():
    codes = {each.name: each.exit_code for each in Outcome}
    ended = {"COMPLETED": 0, "LEFT_CHART": 1, "DIVERGED": 3}
    assert codes == {**ended, "INTERRUPTED": 130, "STOPPED": 130}


def test_help_names_every_code(echelon):
    code, out, _ = echelon("--help")
    assert code == 0
    told = " ".join(out.split()).partition("Exit codes: ")[2]
    assert [int(x) for x in re.findall(r"\b(\d+)\b", told)] == [0, 1, 2, 3, 4, 5, 70, 130, 143]


@pytest.mark.parametrize("where", ["top", "inside"])
@pytest.mark.parametrize("command", ["run", "check"])
def test_a_users_file_that_leaves_is_bad_input(here, echelon, where, command):
    lines = {"top": "", "inside": "pass"} | {where: "sys.exit(0)"}
    (here / "mine.py").write_text(LEAVES.format(**lines))
    code, out, err = echelon(command, "mine.yaml")
    assert code == 2 and out == "" and err.count("\n") == 1 and err.startswith("echelon: ")
    assert "SystemExit" in err or "`sys.exit(0)`" in err
    assert not (here / "runs").exists()


@pytest.mark.parametrize("command", ["check", "design", "run"])
def test_a_fault_of_echelons_own_is_no_verdict(here, echelon, monkeypatch, command):
    def fail(*_):
        raise ZeroDivisionError("nothing by nothing\nand more")

    monkeypatch.setattr("tempfile.tempdir", str(here))
    monkeypatch.setattr("echelon.scenario.build._graph", fail)
    code, out, err = echelon(command, "integrators")
    assert code == 70 and out == ""
    said = re.fullmatch(
        r"echelon: this is a fault of echelon's own, and what you gave need not be wrong: "
        r"ZeroDivisionError: nothing by nothing; the details are in `(.*)`\.\n",
        err,
    )
    assert said is not None
    details = Path(said[1]).read_text()
    assert command in details.splitlines()[0] and "'jax'" in details
    assert "Traceback" in details and "in fail" in details


def test_details_that_no_disk_takes_are_shown(monkeypatch, capsys):
    def full(*_, **__):
        raise OSError("no room")

    monkeypatch.setattr(crash.tempfile, "NamedTemporaryFile", full)
    assert "the details stand above" in crash.note_crash(ValueError("odd"))
    assert "ValueError: odd" in capsys.readouterr().err


def listed(**options):
    command = [sys.executable, "-m", "echelon", "list"]
    return subprocess.Popen(command, stderr=subprocess.PIPE, text=True, **options)


def test_a_screen_that_takes_no_more_is_told():
    with open("/dev/full", "w") as full, listed(stdout=full) as process:
        assert process.communicate()[1].startswith("echelon: nothing more can be written: ")
    assert process.returncode == 2


def test_a_reader_that_has_left_is_no_verdict():
    with listed(stdout=subprocess.PIPE) as process:
        process.stdout.close()
        assert process.stderr.read() == ""
    assert process.returncode == 141


def test_numbers_beyond_all_squares_say_nothing_on_the_screen(recwarn):
    agent, graph = ech.models.Linear([[50.0]], [[1.0]]), ech.Graph.path(3)
    run = simulate(
        agent,
        graph,
        ech.Formation.from_offsets(agent, graph, {}),
        leader=ech.laws.TrimInput(),
        follower=ech.laws.TrimInput(),
        initial={"x1": 1.0},
        horizon=8.0,
        dt=0.01,
    )
    assert run.outcome is Outcome.COMPLETED and np.abs(run.states).max() > 1e160
    assert "grows" in ech.report(run)
    assert not [each for each in recwarn if each.category is RuntimeWarning]


def test_numpy_constants_serve_in_any_precision():
    import jax

    matrix = np.array([[0.0, 1.0], [-1.0, -0.5]])

    @jax.jit
    def drift(x):
        return matrix @ x

    class Constant(ech.ControlAffine):
        state_names = ("a", "b")
        input_names = ("u",)

        def drift(self, x):
            return drift(x)

        def input_map(self, x):
            return np.array([[0.0], [1.0]]) + 0.0 * x[:, None]

    agent, graph = Constant(), ech.Graph.path(2)
    leaders = {"leader": ech.laws.TrimInput(), "follower": ech.laws.TrimInput()}
    formation = ech.Formation.from_offsets(agent, graph, {})
    wide, narrow, again = (
        simulate(
            agent, graph, formation, **leaders, initial={"a": 1.0}, horizon=1.0, dt=0.1, precision=p
        ).states[-1]
        for p in ("float64", "float32", "float64")
    )
    assert np.abs(wide - narrow).max() < 1e-5 and np.array_equal(wide, again)
