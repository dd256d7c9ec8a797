"""Sweeps that store states: those of each run by itself, also of killed and resumed sweeps."""

import signal

import numpy as np
import pytest
import xarray as xr
from processes import started, wait_for

import echelon as ech
from echelon.experiments.sweeps import workers
from echelon.experiments.sweeps.plan import Sweep, axes_of

SHORT = ["simulation.horizon=0.5", "simulation.dt=0.01", "report.steady_window=0.1"]
OVER = {"seed": range(3), "follower.gain.coupling": [0.5, 1.0]}


def oscillators(*changes):
    return ech.load_scenario("van-der-pol", [*SHORT, *changes])


def assert_states_of_single_runs(data, every):
    assert data.states.dims == ("seed", "follower.gain.coupling", "time", "agent", "state")
    assert data.inputs.dims[-1] == "input" and data.time.attrs["units"] == "s"
    for seed in (0, 2):
        for coupling in OVER["follower.gain.coupling"]:
            changes = [f"seed={seed}", f"follower.gain.coupling={coupling}"]
            run = ech.run(oscillators(f"simulation.store_every={every}", *changes))
            place = {"seed": seed, "follower.gain.coupling": coupling}
            np.testing.assert_allclose(data.time, run.times)
            for name in ("states", "inputs"):
                stored = data[name].sel(place)
                np.testing.assert_allclose(stored, getattr(run, name), rtol=1e-9, atol=1e-12)


def test_a_sweep_returns_the_states_of_its_runs():
    data = ech.sweep(oscillators(), OVER, keep_states=20)
    assert dict(data.sizes)["time"] == 4  # 0, 0.2, 0.4 and the end
    assert_states_of_single_runs(data, 20)
    numbers = ech.sweep(oscillators(), OVER)
    assert "states" not in numbers
    # Sums are made between stored frames, and so round in another way.
    xr.testing.assert_allclose(data[list(numbers)], numbers, rtol=1e-12)


def test_the_command_writes_them_into_a_file_that_is_read_lazily(echelon, here):
    arguments = ["sweep", "van-der-pol", "--over", "seed=0..2", "--over"]
    arguments += ["follower.gain.coupling=0.5,1.0", "--no-figures", "--out", "o"]
    for change in SHORT:
        arguments += ["--set", change]
    assert echelon(*arguments, "--keep-states", "20")[0] == 0
    assert sorted(path.name for path in (here / "o").iterdir()) == [
        "inputs", "scenario.yaml", "states.nc", "sweep.nc", "sweep.txt"
    ]  # fmt: skip
    with xr.open_dataset(here / "o" / "states.nc", engine="h5netcdf") as data:
        assert not data.states._in_memory
        assert data.states.encoding["chunksizes"] == (1, 1, 4, 6, 2)
        assert_states_of_single_runs(data, 20)
        assert set(data.coords) >= {"time", "state_unit", "input_unit"}


CALL = """
from echelon.experiments.sweeps import workers
workers._MOST = 8
from echelon.apps.cli.app import main
main()
"""


def test_a_killed_sweep_that_goes_on_has_the_states_of_one_that_was_not(here, echelon, monkeypatch):
    arguments = ["sweep", "integrators", "--over", "seed=0..31", "--keep-states", "25"]
    arguments += ["--set", "simulation.horizon=1", "--no-figures", "--out"]
    with started(CALL, *arguments, "o") as process:
        wait_for(process, lambda: len(list(here.glob("o/batches/*.npz"))) > 1)
        process.send_signal(signal.SIGKILL)
    assert process.wait() != 0 and not (here / "o" / "states.nc").exists()
    monkeypatch.setattr(workers, "_MOST", 8)
    assert echelon("sweep", "--resume", "o", "--no-figures")[0] == 0
    assert echelon(*arguments, "whole")[0] == 0
    assert (here / "o" / "states.nc").read_bytes() == (here / "whole" / "states.nc").read_bytes()


def test_a_run_that_ends_early_has_no_states_after_that(monkeypatch):
    scenario = {
        "name": "blowup",
        "model": {"name": "linear", "parameters": {"A": [[50.0]], "B": [[1.0]]}},
        "graph": {"name": "path", "agents": 3},
        "leader": {"law": "passive"},
        "follower": {"law": "consensus", "gain": {"method": "given", "P": "identity"}},
        "initial": {"spread": {"x1": 1.0}},
        "simulation": {"horizon": 40.0, "dt": 0.01},
    }
    data = ech.sweep(scenario, {"seed": range(2)}, keep_states=100)
    finite = np.isfinite(data.states.values).all(axis=(2, 3))
    assert finite[:, 0].all() and not finite[:, -1].any()
    assert (np.diff(finite.astype(int)) <= 0).all()


@pytest.mark.parametrize(
    ("over", "every", "sentence"),
    [
        ({"graph.agents": [5, 6]}, 5, "--over graph.agents: its values change the agents"),
        ({"simulation.horizon": [0.5, 1.0]}, 5, "--over simulation.horizon: its values change"),
        ({"seed": range(10**6)}, 1, "the sweep is too large"),
        ({"seed": [1]}, 0, "`keep_states` is 0"),
    ],
)
def test_what_cannot_be_stored_is_refused_before_anything_runs(over, every, sentence):
    with pytest.raises(ech.errors.ScenarioError, match=sentence):
        ech.sweep(oscillators(), over, keep_states=every)


def test_a_full_disk_is_refused_before_anything_runs(echelon, here, monkeypatch):
    import shutil

    monkeypatch.setattr(shutil, "disk_usage", lambda _: shutil._ntuple_diskusage(10, 10, 0))
    code, _, fault = echelon("sweep", "integrators", "--over", "seed=0..9", "--keep-states", "1")
    assert code == 2 and "store fewer, with a larger `--keep-states`" in fault
    assert not list((here / "runs").iterdir())


def test_a_plan_with_states_travels_without_its_parts():
    import pickle

    plan = Sweep(oscillators(), axes_of({"seed": range(2)}), 10)
    assert plan.frames is not None
    again = pickle.loads(pickle.dumps(plan))
    assert "first_built" not in vars(again) and again.frames == plan.frames
