"""Interrupted runs: nothing computed is lost, nothing of the user's is overwritten, runs resume."""

import json
import os
import resource
import shutil
import signal
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from processes import started, wait_for
from runs import OWN_PENDULUM

import echelon as ech
from echelon.apps.cli.terminal import STOP
from echelon.core import files
from echelon.core.files import write_atomic
from echelon.experiments.results.labelled import read_labelled
from echelon.laws.law import Law
from echelon.output.archive.chunks import Chunks
from echelon.output.archive.study_folder import Flights
from echelon.simulation.engine import simulate as engine
from echelon.simulation.engine.chunk_grid import ChunkGrid
from echelon.simulation.engine.simulate import reassemble

SCENARIO = """
name: mine
# A comment of the user's.
model: {python: "models/swing.py:Pendulum"}
graph: {name: path, agents: 4, leaders: [0]}
leader: {law: passive}
initial: {spread: {angle: 0.5}}
disturbance: {rms: {rate: 0.1}, hold: 0.05}
simulation: {horizon: 1.0, dt: 0.01}
"""
LONG = ["--set", "simulation.horizon=1000", "--set", "simulation.store_every=250"]
# Whoever started the tests may have switched Ctrl-C off, as a script does for what it starts in the
# background, and a child inherits that. And a file for each chunk, not one every two seconds.
EAGER = """
import signal
signal.signal(signal.SIGINT, signal.default_int_handler)
import echelon.simulation.engine.simulate as engine
engine._SECONDS = 0.0
from echelon.apps.cli.app import main
main()
"""


@pytest.fixture
def here(here):
    (here / "models").mkdir()
    (here / "models" / "swing.py").write_text(OWN_PENDULUM)
    (here / "mine.yaml").write_text(SCENARIO)
    return here


def stored(folder):
    return read_labelled(folder / "run.nc").arrays()


def numbers(folder):
    told = json.loads((folder / "summary.json").read_text())
    return {key: value for key, value in told.items() if key != "wall_time_s"}


def assert_same(one, other):
    assert stored(one).keys() == stored(other).keys()
    for name, values in stored(one).items():
        np.testing.assert_array_equal(values, stored(other)[name], err_msg=name)
    assert numbers(one) == numbers(other)
    assert (one / "run.nc").read_bytes() == (other / "run.nc").read_bytes()


class Wandering(Law):
    def init(self):
        return jnp.zeros(()), jnp.zeros((), jnp.int32), jax.random.key(3)

    def update(self, model, view, memory):
        total, count, key = memory
        key, now = jax.random.split(key)
        z, push = view.disagreement, jax.random.normal(now, view.x.shape, view.x.dtype)
        return 0.1 * push - z - 0.01 * total, (total + z.sum(), count + 1, key)


def wandering(**settings):
    agent, graph = ech.models.SingleIntegrator(2), ech.Graph.path(3)
    parts = ech.Parts(
        agent,
        graph,
        ech.Formation.from_offsets(agent, graph, {}),
        ech.Laws(ech.laws.Tracking(ech.references.Circle((0.0, 0.0, 0.0))), Wandering()),
        initial={"position": 1.0},
        world=ech.World(disturbance=ech.Disturbance(rms={"position": 0.2}, hold=0.3)),
    )
    return parts, ech.Settings(**{"horizon": 50.0, "dt": 0.01} | settings)


@pytest.mark.slow
@pytest.mark.parametrize(
    "settings",
    [
        {"store_every": 7},
        pytest.param({"precision": "float32"}, marks=pytest.mark.slow),
    ],
    ids=["frames", "float32"],
)
def test_a_run_that_goes_on_ends_with_the_bits_of_one_that_never_ended(settings, monkeypatch):
    monkeypatch.setattr(engine, "_SECONDS", 0.0)
    parts, settings = wandering(**settings)
    whole = ech.simulate(parts, settings)
    kept = []

    def stop(run):
        if run.done > run.steps * (len(kept) % 7) / 9:
            raise KeyboardInterrupt

    for _ in range(20):
        result = ech.simulate(parts, settings, stop, kept.append, list(kept))
        opened = reassemble(parts, settings, kept)
        assert opened.outcome in (ech.Outcome.STOPPED, ech.Outcome.COMPLETED)
        np.testing.assert_array_equal(opened.states, result.states)
        np.testing.assert_array_equal(opened.states, whole.states[: len(opened.times)])
    result = ech.simulate(parts, settings, None, kept.append, list(kept))
    assert result.outcome is ech.Outcome.COMPLETED
    for name in ("times", "states", "inputs", "reference"):
        np.testing.assert_array_equal(getattr(result, name), getattr(whole, name))
    for one, other in zip(result.sums, whole.sums, strict=True):
        np.testing.assert_array_equal(one, other)


def test_the_grid_visits_each_step_once_and_stores_each_frame_once():
    grids = [(1, 1, 5), (10, 3, 1), (999, 7, 50), (1000, 300, 17), (20, 50, 6)]
    for steps, every, longest in grids:
        grid = ChunkGrid(ech.Settings(float(steps), 1.0, store_every=every), longest)
        assert grid.longest <= longest or grid.longest == 1
        first, frames = 0, []
        while len(frames) < grid.frames:
            counts = grid.counts(first)
            assert len(counts) == grid.pieces and counts.sum() <= grid.longest
            points = first + np.cumsum(counts) - counts
            frames += list(points[grid.stored(points)])
            first += int(counts.sum())
        assert first == steps and frames == sorted({*range(0, steps, every), steps})


@pytest.mark.slow
def test_a_killed_run_opens_as_stopped_and_goes_on_to_the_same_bits(here, echelon):
    with started(EAGER, "run", "mine.yaml", *LONG, "--no-figures", "--out", "o") as process:
        wait_for(process, lambda: len(list(here.glob("o/chunks/*.npz"))) > 3)
        process.kill()
    assert process.returncode == -signal.SIGKILL and not (here / "o" / "run.nc").exists()
    # What the scenario names is kept with it, and so may change or go.
    shutil.rmtree(here / "models")
    result = ech.load("o")
    assert result.outcome is ech.Outcome.STOPPED and 3 < len(result.times) < 401
    assert result.message.startswith("The run was ended from outside at t = ")
    assert result.sums.steps[0] > 750 and result.provenance["scenario"] == "mine"
    # Without figures, as it began.
    code, out, _ = echelon("run", "--resume", "o")
    assert code == 0 and "1000 s" in out and not (here / "o" / "chunks").exists()
    assert not (here / "o" / "figures").exists()
    # A run's folder is a scenario: it repeats the run to the bit.
    assert echelon("run", "o", "--no-figures", "--out", "again")[0] == 0
    assert_same(here / "o", here / "again")
    np.testing.assert_array_equal(result.states, stored(here / "o")["states"][: len(result.times)])
    code, out, _ = echelon("run", "--resume", "o")
    assert code == 0 and "is complete; nothing to do" in out


def test_interrupting_keeps_what_was_computed(here, echelon):
    with started(EAGER, "run", "mine.yaml", *LONG, "--no-figures", "--out", "o") as process:
        wait_for(process, lambda: list(here.glob("o/chunks/*.npz")))
        process.send_signal(signal.SIGINT)
        told = process.stderr.readline()
        while told and "stopping and saving results" not in told:
            told = process.stderr.readline()
        out, _ = process.communicate()
    assert process.returncode == 130 and "stopping and saving results" in told
    summary = json.loads((here / "o" / "summary.json").read_text())
    assert summary["outcome"]["name"] == "interrupted" and "was interrupted at t = " in out
    # The head of the table says what ran and not what was asked.
    assert "of 1000 s" in out.splitlines()[0]
    assert len(stored(here / "o")["states"]) > 1
    code, out, _ = echelon("run", "--resume", "o", "--no-figures", "--json")
    assert code == 0 and json.loads(out)["outcome"]["name"] == "completed"


def under(most, call, *arguments):
    """Call what may not let a file grow beyond some bytes, as on a disk that has no more room."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (most, before[1]))
    try:
        return call(*arguments)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


FRAMES = ["--set", "simulation.horizon=10", "--no-figures"]


def run_on_a_full_disk(echelon, monkeypatch, seconds):
    """Fly with room for small files alone, stretches written after so many seconds."""
    write = files._write
    with monkeypatch.context() as patch:
        patch.setattr(engine, "_SECONDS", seconds)
        patch.setattr(files, "_write", lambda *file: under(30_000, write, *file))
        code, out, err = echelon("run", "mine.yaml", *FRAMES, "--out", "o")
    assert code == 2 and "follower 3" in out
    return err


def test_a_full_disk_shows_the_report_and_keeps_what_was_written(here, echelon, monkeypatch):
    assert run_on_a_full_disk(echelon, monkeypatch, 0.0).endswith(
        "echelon: `o` cannot be written: File too large; partial results are saved, and "
        "`echelon run --resume o` continues.\n"
    )
    assert not list(here.rglob("*.part")) and not (here / "o" / "run.nc").exists()
    assert echelon("run", "--resume", "o", "--no-figures")[0] == 0
    assert echelon("run", "mine.yaml", *FRAMES, "--out", "whole")[0] == 0
    assert_same(here / "o", here / "whole")


def test_where_nothing_could_be_kept_nothing_is_said_to_be(here, echelon, monkeypatch):
    # The whole run is one stretch, which is larger than a file may be.
    told = run_on_a_full_disk(echelon, monkeypatch, np.inf)
    assert told.endswith("File too large; no results could be saved.\n")
    assert not (here / "o").exists()


def test_a_file_that_cannot_be_written_is_what_it_was(here):
    (here / "gain.json").write_text("precious")
    with pytest.raises(OSError):
        under(1000, write_atomic, here / "gain.json", "x" * 2000)
    assert (here / "gain.json").read_text() == "precious"
    assert not list(here.glob("*.part")) and not list(here.glob(".*"))
    write_atomic(here / "gain.json", "x" * 2000)
    assert len((here / "gain.json").read_text()) == 2000


def test_a_link_and_a_device_are_written_through(here):
    (here / "target").write_text("old")
    (here / "link").symlink_to("target")
    write_atomic(here / "link", "new")
    assert (here / "link").is_symlink() and (here / "target").read_text() == "new"
    with pytest.raises(OSError):
        write_atomic(Path("/dev/full"), "anything")


@pytest.mark.slow
def test_of_two_runs_into_one_folder_one_is_refused(here, echelon):
    with started(EAGER, "run", "mine.yaml", *LONG, "--no-figures", "--out", "o") as process:
        wait_for(process, lambda: list(here.glob("o/chunks/*.npz")))
        for more in ([], ["--force"]):
            code, _, err = echelon("run", "mine.yaml", *FRAMES, "--out", "o", *more)
            assert code == 2 and ("is writing into" if more else "is not empty") in err
        code, _, err = echelon("run", "--resume", "o")
        assert code == 2 and "another run is writing into the folder `o`" in err
        assert process.poll() is None


@pytest.mark.slow
def test_force_takes_nothing_that_echelon_did_not_write(here, echelon):
    (here / "figures").mkdir()
    (here / "figures" / "thesis.pdf").write_text("years of work")
    code, _, err = echelon("run", "mine.yaml", *FRAMES, "--out", ".", "--force")
    assert code == 2 and "holds `figures`, which echelon did not write" in err
    assert (here / "figures" / "thesis.pdf").read_text() == "years of work"
    assert echelon("run", "mine.yaml", "--no-figures")[0] == 0
    shutil.rmtree(here / "figures")
    for _ in range(2):
        assert echelon("run", "mine.yaml", *FRAMES, "--out", ".", "--force")[0] == 0
        assert list((here / "runs").iterdir()) and (here / "mine.yaml").exists()


def test_a_changed_scenario_does_not_go_on(here, echelon):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Chunks, "remove", lambda self: None)
        assert echelon("run", "mine.yaml", "--no-figures", "--out", "o")[0] == 0
    swing = here / "o" / "inputs" / "swing.py"
    swing.write_text(OWN_PENDULUM.replace("9.81", "1.62"))
    code, _, err = echelon("run", "--resume", "o")
    assert code == 2 and "was changed since the run began" in err
    swing.write_text(OWN_PENDULUM)
    begun = here / "o" / "chunks" / "begun.json"
    before = begun.read_text()
    told = json.loads(before)
    told["versions"]["jax"] = "0.1.0"
    begun.write_text(json.dumps(told))
    code, _, err = echelon("run", "--resume", "o")
    assert code == 2 and "began with jax `0.1.0`, and" in err
    begun.write_text(before)
    assert echelon("run", "--resume", "o", "--no-figures")[0] == 0
    for name in ("nowhere", "models"):
        code, _, err = echelon("run", "--resume", name)
        assert code == 2 and f"`{name}` holds no unfinished run" in err


def test_a_refused_start_leaves_no_folder_and_says_where(here, echelon):
    bad = ["--set", "initial={states: {1: [0, 0, 0]}}"]
    code, out, err = echelon("run", "mine.yaml", *bad, "--out", "o")
    assert code == 2 and out == "" and not (here / "o").exists()
    assert err.startswith("echelon: --set initial={states: {1: [0, 0, 0]}}: ")
    assert "the initial state of agent 1 has shape (3,)" in err
    code, _, err = echelon("run", "mine.yaml", *bad)
    assert code == 2 and not (here / "runs").exists()


@pytest.mark.slow
def test_design_overwrites_nothing(here, echelon):
    before = (here / "mine.yaml").read_text()
    design = ["design", "mine.yaml", "--method", "riccati"]
    for more in ([], ["--force"]):
        code, _, err = echelon(*design, "--out", "mine.yaml", *more)
        assert code == 2 and "is an input of this command" in err
    assert (here / "mine.yaml").read_text() == before
    assert echelon(*design, "--out", "gain.json")[0] == 0
    code, _, err = echelon(*design, "--out", "gain.json")
    assert code == 2 and "the file `gain.json` exists; choose another, or `--force`" in err
    assert echelon(*design, "--out", "gain.json", "--force")[0] == 0
    # And a run keeps the gain that it was flown with.
    gain = ["--set", "follower.gain={file: gain.json}"]
    assert echelon("run", "mine.yaml", *FRAMES, *gain, "--out", "o")[0] == 0
    os.remove("gain.json")
    assert echelon("run", "o", "--no-figures", "--out", "again")[0] == 0
    assert_same(here / "o", here / "again")


def test_a_comparison_that_is_interrupted_keeps_what_was_flown(here, echelon, monkeypatch):
    kept = Flights.write

    def write(self, row):
        kept(self, row)
        # Each row is on disk as soon as it is there.
        assert (here / "o" / "runs" / "literal.nc").exists()
        if STOP.number is None:
            os.kill(os.getpid(), signal.SIGTERM)
        while STOP.number is None:
            time.sleep(0.001)

    monkeypatch.setattr(Flights, "write", write)
    several = ["--method", "literal", "--method", "riccati", "--horizon", "0.1", "--no-figures"]
    before = signal.signal(signal.SIGTERM, signal.SIG_DFL)
    try:
        code, out, err = echelon("compare", "integrators", *several, "--out", "o")
    finally:
        signal.signal(signal.SIGTERM, before)
    assert code == 143 and "stopping and saving results" in err
    assert "it was not run because of an interruption" in out
    assert [path.name for path in (here / "o" / "runs").iterdir()] == ["literal.nc"]
    assert (here / "o" / "comparison.json").exists()
