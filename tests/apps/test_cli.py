"""The command line: what a user types, sees, and finds in the output folder."""

import json
import time

import numpy as np
import pytest
import xarray as xr
from runs import OWN_PENDULUM

import echelon as ech

QUICK = ["--set", "simulation.horizon=0.5", "--no-figures"]
FILE = """
class Wrong(Pendulum):
    def drift(self, x):
        return x[:1]

class NotAModel:
    pass
"""
SCENARIO = """
name: mine
model: {python: "pendulum.py:Pendulum", parameters: {damping: 0.5}}
graph: {name: path, agents: 4, leaders: [0]}
leader: {law: passive}
initial: {spread: {angle: 0.5}}
simulation: {horizon: 1.0, dt: 0.01}
"""


@pytest.fixture
def here(here):
    (here / "pendulum.py").write_text(OWN_PENDULUM + FILE)
    (here / "mine.yaml").write_text(SCENARIO)
    return here


def test_run_writes_what_it_says(here, echelon):
    code, out, err = echelon("run", "paper", *QUICK, "--out", "o")
    assert (code, err) == (0, "")
    assert "paper, 0.5 s, seed 0" in out and "Written to o" in out
    names = {"summary.json", "run.nc", "scenario.yaml", "report.txt", "gain.json"}
    assert {path.name for path in (here / "o").iterdir()} == names
    again = ech.load_scenario(here / "o" / "scenario.yaml")
    assert again.simulation.horizon == 0.5
    told = json.loads((here / "o" / "summary.json").read_text(), parse_constant=pytest.fail)
    promised = (
        "scenario outcome agents unit horizon_s dt_s seed leader followers edges gain lambda_min "
        "lambda_max minimum_distance saturation_fraction wall_time_s versions"
    )
    assert set(promised.split()) <= set(told)
    assert told["outcome"]["name"] == "completed" and told["unit"] == "m"
    assert {"rmse", "steady_rmse", "rmse_by_output"} <= set(told["leader"])
    assert list(told["leader"]["rmse_by_output"]) == ["x", "y", "z", "yaw"]
    assert [each["agent"] for each in told["followers"]] == [1, 2, 3]
    assert {"rmse", "steady_rmse", "settling_time_s"} <= set(told["followers"][0])
    assert told["edges"][0]["edge"] == [0, 1]
    assert np.array(told["gain"]["P"]).shape == (12, 12)
    assert told["lambda_min"] == pytest.approx(2 - np.sqrt(3), abs=1e-12)
    with xr.open_dataset(here / "o" / "run.nc", engine="h5netcdf") as data:
        assert dict(data.sizes) == {"time": 101, "agent": 4, "state": 12}
        assert data.time.attrs["units"] == "s"
        assert str(data.state_unit.sel(state="vx").values) == "m/s"
        assert {"lyapunov", "lyapunov_rate", "reference", "error"} <= set(data)
        assert data.attrs["scenario"] == "paper" and "version_jax" in data.attrs
        assert data.states.dtype == np.float64
    (here / "o" / "gain.json").unlink()
    code, _, err = echelon("verify", "o")
    assert code == 2 and "`o` has lost its `gain.json`" in err


def test_a_users_own_agent_runs_as_from_python(here, echelon):
    code, out, err = echelon("run", "mine.yaml", "--no-figures", "--out", "o", "--json")
    assert (code, err) == (0, "")
    told = json.loads(out)
    assert told == json.loads((here / "o" / "summary.json").read_text())
    assert told["unit"] == "state" and told["leader"]["rmse"] is None
    assert told["minimum_distance"] is None
    agent = ech.models.Pendulum(damping=0.5)
    graph = ech.Graph.path(4)
    gain = ech.synthesize(agent, graph, ech.gains.Riccati())
    laws = ech.Laws(ech.laws.TrimInput(), ech.laws.Consensus(gain, feedforward="relay"))
    places = ech.Formation.from_offsets(agent, graph, {})
    parts = ech.Parts(agent, graph, places, laws, initial={"angle": 0.5})
    result = ech.simulate(parts, ech.Settings(horizon=1.0, dt=0.01))
    expected = [each.rmse for each in ech.metrics(result).followers]
    assert [each["rmse"] for each in told["followers"]] == pytest.approx(expected, rel=1e-12)


def test_faults_that_only_building_finds_name_file_and_line(here, echelon):
    changes = {
        ("pendulum.py:Pendulum", "pendulum.py:Pendulun"): "did you mean `Pendulum`?",
        ("pendulum.py:Pendulum", "pendulum.py:NotAModel"): "is not a `ControlAffine` class",
        ("pendulum.py:Pendulum", "missing.py:Pendulum"): "does not exist",
        ("pendulum.py:Pendulum", "pendulum.py:Wrong"): "has shape (1,), and must have shape (2,)",
        ("damping: 0.5", "dampin: 0.5"): "did you mean `damping`?",
        ("angle: 0.5", "angel: 0.5"): "did you mean `angle`?",
        ("agents: 4", "agents: 1"): "needs at least 2 agents",
        ("name: path, agents: 4", "edges: [[0, 1], [2, 3]]"): (
            "graph: the graph is disconnected: agents 2, 3 have no path to a leader (leader 0)."
        ),
        ("name: path, agents: 4", "edges: [[0, 1]], agents: 3"): (
            "graph: the graph is disconnected: agent 2 has no path to a leader (leader 0)."
        ),
    }
    faults = []
    for (old, new), sentence in changes.items():
        (here / "mine.yaml").write_text(SCENARIO.replace(old, new))
        code, out, err = echelon("run", "mine.yaml", "--out", "o")
        place = f"echelon: mine.yaml:{1 + SCENARIO[: SCENARIO.index(old)].count(chr(10))}: "
        if (code, out) != (2, "") or not err.startswith(place) or sentence not in err:
            faults.append((new, code, err))
    assert faults == [] and not (here / "o").exists()


def test_a_file_that_does_not_import_is_told(here, echelon):
    (here / "pendulum.py").write_text("import nothing_of_that_name\n")
    code, _, err = echelon("run", "mine.yaml")
    assert code == 2
    assert "does not import: ModuleNotFoundError: No module named 'nothing_of_that_name'." in err
    assert not (here / "runs").exists()


def test_several_faults_of_parts_come_at_once(here, echelon):
    (here / "mine.yaml").write_text(
        SCENARIO.replace("angle: 0.5", "angel: 0.5")
        + "formation: {offsets: {2: [1, 2, 3]}}\nfollower: {gain: {method: given, P: [1, -1]}}\n"
    )
    code, _, err = echelon("run", "mine.yaml")
    assert code == 2 and len(err.splitlines()) == 3
    assert "the offset of agent 2 has 3 numbers, and must have 2 (all states)." in err
    assert "`P` is not positive definite: its smallest eigenvalue is -1." in err


def test_a_folder_that_holds_something_is_kept(here, echelon):
    (here / "o").mkdir()
    (here / "o" / "thesis.txt").write_text("years of work")
    run = "run", "mine.yaml", "--out", "o", "--no-figures"
    code, _, err = echelon(*run)
    assert code == 2
    assert err.startswith("echelon: the folder `o` is not empty (it holds `thesis.txt`)")
    for _ in range(2):
        assert echelon(*run, "--force")[0] == 0 and (here / "o" / "summary.json").exists()
        assert (here / "o" / "thesis.txt").read_text() == "years of work"


def test_a_folder_that_cannot_be_written_is_told_before_the_run(here, echelon):
    (here / "file").write_text("")
    for out in ("file", "file/inside"):
        code, _, err = echelon("run", "mine.yaml", "--out", out)
        assert code == 2 and err.count("\n") == 1 and "`file" in err


def test_two_runs_of_one_second_do_not_collide(here, echelon, monkeypatch):
    monkeypatch.setattr(time, "strftime", lambda form: "20260101-000000")
    for _ in range(2):
        assert echelon("run", "mine.yaml", "--no-figures")[0] == 0
    names = sorted(path.name for path in (here / "runs").iterdir())
    assert names == ["mine-20260101-000000", "mine-20260101-000000-2"]


@pytest.mark.slow
def test_a_diverging_run_is_a_result(here, echelon):
    (here / "mine.yaml").write_text(
        "name: blowup\n"
        "model: {name: linear, parameters: {A: [[50.0]], B: [[1.0]]}}\n"
        "graph: {name: path, agents: 3}\n"
        "leader: {law: passive}\n"
        "follower: {law: consensus, gain: {method: given, P: identity}}\n"
        "initial: {spread: {x1: 1.0}}\n"
        "simulation: {horizon: 100.0, dt: 0.01, store_every: 10}\n"
    )
    code, out, _ = echelon("run", "mine.yaml", "--out", "o")
    assert code == 3 and "stopped being finite by t = " in out
    told = json.loads((here / "o" / "summary.json").read_text(), parse_constant=pytest.fail)
    assert told["outcome"]["name"] == "diverged" and "follower" in told["outcome"]["message"]
    assert told["followers"][0]["rmse"] is None and told["followers"][0]["steady_rmse"] is None
    with xr.open_dataset(here / "o" / "run.nc", engine="h5netcdf") as data:
        assert len(data.time) > 10 and bool(np.isfinite(data.states).all())


@pytest.mark.slow
def test_after_a_poor_run_its_outcome_and_the_command_that_looks_for_the_cause_are_told(
    here, echelon
):
    short = ["--set", "simulation.horizon=1", "--no-figures", "--out", "o"]
    code, out, _ = echelon("run", "mine.yaml", *short)
    last = out.splitlines()[-1]
    assert code == 0 and last.startswith("- Outcome: followers bounded, error ")
    assert last.endswith("`echelon causes o` looks for the cause.")
    # No time for any change: that is told, and no cause.
    code, out, _ = echelon("causes", "o", "--seconds", "0")
    lines = out.splitlines()
    assert code == 0 and lines[1] == "- No single cause found for the followers; tried: nothing."
    assert lines[2] == "- Not tried, since 0 s were over: changes."
    more = ["--force", "--json", "--causes", "--seconds", "0"]
    code, out, _ = echelon("run", "mine.yaml", *short, *more)
    assert json.loads(out)["causes"]["outcome"]["followers"]["class"] == "bounded"


def test_list_has_every_family_for_programs(echelon):
    code, out, _ = echelon("list", "--json")
    assert code == 0 and set(json.loads(out)) >= {"scenarios", "models", "follower laws"}
