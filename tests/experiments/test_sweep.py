"""Sweeps: each run has the bits that it has alone, and interrupted sweeps lose nothing."""

import json
import os
import pickle
import shutil
import signal
from pathlib import Path

import distributed
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import xarray as xr
from hypothesis import given, settings
from hypothesis import strategies as st
from in_words import in_words
from processes import started, wait_for

import echelon as ech
from echelon.core.numerics import precision
from echelon.experiments.scenario.yaml import inline_yaml
from echelon.experiments.sweeps import workers as sweeps
from echelon.experiments.sweeps.plan import Axis, Sweep, axes_of, read_axes
from echelon.experiments.sweeps.sweep import _missing, compute
from echelon.experiments.sweeps.sweep_dataset import columns_of, dataset_of, share_bounds, succeeded
from echelon.experiments.sweeps.workers import SweepBatch
from echelon.guarantees.promises.promise import Guarantee, guarantee, promises
from echelon.guarantees.stopping.stopping_promise import StoppingPromise
from echelon.output.plots.study_figures import sweep_figures
from echelon.simulation.engine import batch, law_drive
from echelon.simulation.engine import batch as batches
from echelon.simulation.engine.batch import Batch
from echelon.simulation.engine.parts import initial_states

SHORT = ["simulation.horizon=0.5", "simulation.dt=0.01", "report.steady_window=0.1"]


def built(name, *changes):
    return ech.build(ech.load_scenario(name, changes))


def seeds(experiment, count, **changes):
    parts, chosen = experiment
    return [(parts, chosen._replace(seed=k, **changes)) for k in range(count)]


def check_same(one, other, tolerance=0.0):
    assert (one.outcome, one.message, one.engine) == (other.outcome, other.message, other.engine)
    assert one.warnings == other.warnings
    assert (one.reference is None) == (other.reference is None)
    for name in ("times", "states", "inputs", "reference"):
        a, b = (np.nan if x is None else x for x in (getattr(one, name), getattr(other, name)))
        np.testing.assert_allclose(a, b, rtol=0, atol=tolerance, err_msg=name)
    for name, a, b in zip(one.sums._fields, one.sums, other.sums, strict=True):
        size = np.abs(b).max(initial=1e-12)
        np.testing.assert_allclose(a, b, rtol=0, atol=tolerance * size, err_msg=name)


@pytest.mark.parametrize("name", ["van-der-pol", "unicycle"])
@pytest.mark.parametrize("precision", ["float64", "float32"])
def test_a_run_among_many_has_the_bits_that_it_has_alone(name, precision):
    experiment = built(name, "simulation.horizon=2", "report.steady_window=1")
    runs = seeds(experiment, 19, engine="native", precision=precision, store_every=20)
    for threads in (1, 3):
        found = list(Batch(threads).fly(runs))
        for k in (0, 7, 18):
            check_same(found[k], ech.simulate(*runs[k]))


def parted(graph, feedforward="relay", world=None, gains=()):
    """Yield parts of double integrators, one for each coupling and weight of its gain."""
    model = ech.models.DoubleIntegrator(dimension=2)
    formation = ech.Formation.line(model, graph, spacing=1.0)
    for coupling, weight in gains:
        method = ech.gains.Riccati(coupling=coupling, Q=[weight] * 4)
        follower = ech.laws.Consensus(ech.synthesize(model, graph, method), feedforward)
        laws, initial = ech.Laws(ech.laws.TrimInput(), follower), {"position": 1.0, "velocity": 0.3}
        yield ech.Parts(model, graph, formation, laws, initial, world=world or ech.World())


WIND = ech.World(disturbance=ech.Disturbance(rms={"velocity": 0.2}, hold=0.03))
WEIGHTED = ech.Graph.from_edges([(0, 1, 0.5), (1, 2, 3.0), (2, 3, 1.0), (0, 4, 2.0)], (0,), 5)
KINDS = {
    "gains of their own": (ech.Graph.ring(4), {}),
    "a parent's input, level by level": (ech.Graph.path(5), {"feedforward": "parent"}),
    "weights and wind": (WEIGHTED, {"world": WIND}),
    "several leaders": (ech.Graph.ring(6, leaders=(0, 3)), {}),
}
OWN = [(1.0 + 0.1 * k, 1.0 + 0.2 * (k % 3)) for k in range(9)]


@pytest.mark.parametrize("name", KINDS)
def test_numbers_of_a_formations_own_are_its_own(name):
    graph, more = KINDS[name]
    chosen = ech.Settings(horizon=0.5, dt=0.01, store_every=10, engine="native")
    every = enumerate(parted(graph, gains=OWN, **more))
    runs = [(parts, chosen._replace(seed=k)) for k, parts in every]
    found = list(Batch(1).fly(runs))
    assert len({r.states[-1].tobytes() for r in found}) == len(runs)
    for k in (0, 5):
        # Numbers that are rows are rounded where constants would be folded.
        check_same(found[k], ech.simulate(*runs[k]), 1e-13)


def test_runs_that_no_program_shares_are_flown_by_themselves():
    [short] = parted(ech.Graph.path(3), gains=[(1.0, 1.0)])
    [longer] = parted(ech.Graph.path(4), gains=[(1.0, 1.0)])
    chosen = ech.Settings(horizon=0.5, dt=0.01, store_every=10, engine="native")
    runs = [(short, chosen), (longer, chosen), (short, chosen._replace(horizon=0.2))]
    for one, run in zip(Batch(1).fly(runs), runs, strict=True):
        check_same(one, ech.simulate(*run))


class Cubic(ech.ControlAffine):
    """Escapes from beyond its start, at a time that the start decides."""

    state_names, input_names = ("x",), ("push",)

    def drift(self, x):
        return x**3

    def input_map(self, x):
        return jnp.ones((1, 1), x.dtype)


@pytest.mark.slow
def test_one_that_is_lost_is_told_as_alone_and_loses_no_other():
    drive = ech.Laws(ech.laws.TrimInput(), ech.laws.TrimInput())
    goals = ech.Formation(np.zeros((2, 1)))
    parts = ech.Parts(Cubic(), ech.Graph.path(2), goals, drive, initial={"x": 0.8})
    chosen = ech.Settings(horizon=2.0, dt=0.01, store_every=5, engine="native")
    runs = seeds((parts, chosen), 10)
    found = list(Batch(1).fly(runs))
    assert {r.outcome.name for r in found} == {"COMPLETED", "DIVERGED"}
    for one, run in zip(found, runs, strict=True):
        alone = ech.simulate(*run)
        assert (one.outcome, one.message) == (alone.outcome, alone.message)
        np.testing.assert_array_equal(one.states, alone.states)
        assert one.sums.steps.tolist() == alone.sums.steps.tolist()


def test_states_beyond_the_range_of_the_sines_go_on_by_jax():
    model, graph = ech.models.SingleIntegrator(dimension=1), ech.Graph.path(2)
    drive = ech.Laws(ech.laws.TrimInput(), ech.laws.Agreement())
    goals, chosen = ech.Formation(np.zeros((2, 1))), ech.Settings(0.1, 0.01, engine="native")
    starts = [np.array([[0.0], [far]]) for far in (1.0, 1e6, 2.0)]
    runs = [(ech.Parts(model, graph, goals, drive, initial=start), chosen) for start in starts]
    for one, run in zip(Batch(1).fly(runs), runs, strict=True):
        check_same(one, ech.simulate(*run))


@pytest.mark.parametrize("command", ["sweep", "compare", "run"])
def test_native_code_of_safety_is_refused_before_anything_is_made(echelon, here, command):
    over = ("--over", "seed=0..2") if command == "sweep" else ()
    changes = ("--set", "simulation.engine=native")
    code, out, err = echelon(command, "crossing", *over, *changes, "--out", "o")
    assert (code, out) == (2, "") and not (here / "o").exists()
    assert "no native code for agents that keep away" in err and "simulating" not in err


class Bends(ech.laws.Law):
    """Feeds back what it hears, and uses what has no native code."""

    gain: float = 1.0

    def update(self, model, view, memory):
        heard = jax.scipy.special.erfinv(jnp.tanh(view.disagreement))
        return -self.gain * heard, memory


GUSTS = ech.World(disturbance=ech.Disturbance(rms={"position": 0.3}, hold=0.05))


class Picky(ech.laws.Law):
    """Refuses starts that are far out."""

    most: float

    def update(self, model, view, memory):
        return -view.disagreement, memory

    def refusals(self, model, states):
        return [(k, "too far") for k in np.flatnonzero(np.abs(states).max(axis=1) > self.most)]


def points_under(law, seeds, world=None, engine="auto"):
    """Runs of three points under a law, one for each seed."""
    model, graph = ech.models.SingleIntegrator(dimension=2), ech.Graph.path(3)
    laws, formation = ech.Laws(ech.laws.TrimInput(), law), ech.Formation.line(model, graph)
    initial, world = {"position": 1.0}, world or ech.World()
    parts = ech.Parts(model, graph, formation, laws, initial=initial, world=world)
    chosen = ech.Settings(horizon=0.5, dt=0.01, store_every=10, engine=engine)
    return [(parts, chosen._replace(seed=k)) for k in seeds]


@pytest.mark.parametrize(("gains", "world"), [((1.0, 0.5), GUSTS), ((1.0,), None)])
def test_runs_without_native_code_are_stepped_side_by_side_and_say_why(monkeypatch, gains, world):
    for room in (law_drive, batch):
        monkeypatch.setattr(room, "is_long", lambda *_: True)
    runs = [run for gain in gains for run in points_under(Bends(gain), (3, 4), world)]
    alone = [ech.simulate(*run) for run in runs]
    monkeypatch.setattr(batch, "simulate", None)
    for one, other in zip(Batch(1).fly(runs), alone, strict=True):
        check_same(one, other, 1e-13)
        [told] = one.warnings
        assert "no native code for `erf_inv` in" in told and "test_sweep.py, line" in told


def test_a_start_that_a_law_refuses_is_refused_among_many():
    runs = [points_under(Picky(most), range(12), engine="native") for most in (9.0, 2.6)]
    easy, strict = (list(Batch(1).fly(some)) for some in runs)
    told = {str(each) for each in strict if isinstance(each, ech.EchelonError)}
    assert told == {"agent 2 starts where its law has no meaning: too far."}
    assert any(isinstance(each, ech.Result) for each in strict)
    # Beside runs of a law that differs in its numbers it is the same.
    both = [type(each) for each in Batch(1).fly([*runs[0], *runs[1]])]
    assert both == [type(each) for each in [*easy, *strict]]


def test_runs_with_noise_and_runs_without_fly_in_one_sweep():
    scenario = ech.load_scenario("van-der-pol", [*SHORT, "simulation.engine=native"])
    noise = {f"disturbance.input_rms.{ech.models.VanDerPol.input_names[0]}": [0.0, 0.05]}
    found = ech.sweep(scenario, {**noise, "seed": range(2)})
    assert (found["outcome"] == 0).all()
    still, shaken = found["final_error"].values.reshape(2, -1)
    assert np.isfinite(shaken).any() and not np.array_equal(still, shaken, equal_nan=True)


@pytest.mark.slow
def test_of_starts_that_no_tube_covers_none_is_promised_among_many():
    far = ["initial.spread={velocity: 18.0}", "simulation.horizon=1", "report.steady_window=0.5"]
    parts, chosen = built("paper-global", *far)
    asked = [chosen._replace(seed=k) for k in (0, 1)]
    first, second = promises(parts, asked)
    for one, each in zip((first, second), asked, strict=True):
        assert in_words(one) == in_words(guarantee(parts, each))
    assert first.tube is not second.tube


def test_a_sweep_is_each_of_its_runs():
    scenario = ech.load_scenario("van-der-pol", SHORT)
    found = ech.sweep(scenario, {"seed": range(3), "follower.gain.coupling": [1.0, 2.0]})
    assert found["formation_rmse"].dims == ("seed", "follower.gain.coupling")
    # Of oscillators, whose states have no common unit.
    assert "units" not in found["rmse"].attrs and "error_unit" not in found
    assert found["promise_rate"].attrs["units"] == "1/s"
    for coupling in (1.0, 2.0):
        place = {"seed": 2, "follower.gain.coupling": coupling}
        run = ech.run(scenario.with_(*(f"{key}={value}" for key, value in place.items())))
        here, followers = found.sel(place), list(run.graph.followers)
        rmse = [f.rmse for f in ech.metrics(run).followers]
        np.testing.assert_allclose(here["rmse"].values[followers], rmse, rtol=1e-9)
        assert np.isnan(here["rmse"].values[0])
        last = np.linalg.norm(run.errors[-1], axis=1)
        np.testing.assert_allclose(here["final_error"].values[followers], last[followers])
        assert float(here["worst_final_error"]) == pytest.approx(last.max())
        assert int(here["outcome"]) == 0
        assert int(here["promised"]) == int(guarantee(run.parts, run.settings).promised)


@pytest.mark.slow
def test_formations_and_schedules_in_a_sweep_are_those_of_single_runs_by_jax():
    turns = [{"at": 0.3, "edges": [[0, 2], [2, 3], [3, 1]]}]
    ring = {"edges": [[0, 1], [1, 2], [2, 3]], "schedule": turns, "period": 0.7}
    base = ["simulation.horizon=2", "report.steady_window=1", f"graph={inline_yaml(ring)}"]
    over = {
        "graph.schedule": [
            turns,
            [{"at": 0.2, "edges": [[0, 3], [1, 3]]}, {"at": 0.5, "edges": [[0, 1], [1, 2]]}],
        ],
        "formation.offsets": [{1: [1, 0, 0], 2: [1, 0.8, 0]}, {3: [0, 0, 2]}],
        "seed": [3, 4, 5],
    }
    found = ech.sweep(ech.load_scenario("integrators", [*base, "simulation.engine=native"]), over)
    assert (found["engine"] == "native").all() and (found["outcome"] == 0).all()
    errors = found["final_error"].values
    assert len(np.unique(errors[..., 1:].sum(axis=-1))) == 12
    for place in ((0, 0, 1), (0, 1, 2), (1, 0, 0), (1, 1, 2)):
        pairs = zip(over.items(), place, strict=True)
        changes = [f"{key}={inline_yaml(values[k])}" for (key, values), k in pairs]
        run = ech.run(ech.load_scenario("integrators", [*base, "simulation.engine=jax", *changes]))
        alone = np.linalg.norm(run.errors[-1], axis=-1)
        np.testing.assert_allclose(errors[place][1:], alone[1:], rtol=1e-11)


def test_agents_may_differ_in_number_and_what_cannot_be_made_is_refused():
    scenario = ech.load_scenario("van-der-pol", SHORT)
    found = ech.sweep(scenario, {"initial.states.1": [[0.0, 0.0], [1.0]]})
    assert found["outcome"].values.tolist() == [0, -1]
    assert "agent 1 has shape (1,)" in str(found["message"].values[1])
    found = ech.sweep(scenario, {"graph.agents": [4, 6], "seed": [5]})
    assert found.sizes["agent"] == 6
    assert np.isnan(found["rmse"].values[0, 0, 4:]).all()
    assert np.isfinite(found["rmse"].values[1, 0, 1:]).all()


@given(st.integers(1, 5), st.integers(1, 4), st.integers(1, 3), st.sampled_from([0, 1, 2]))
@settings(max_examples=20)
def test_every_combination_is_a_run_once_with_the_seeds_fastest(seeds, a, b, where):
    axes = [Axis("x", range(a)), Axis("y", range(b))]
    axes.insert(where, Axis("seed", range(10, 10 + seeds)))
    plan = object.__new__(Sweep)
    plan.axes = tuple(axes)
    runs = [plan.run(k) for k in range(plan.count)]
    assert len({run.place for run in runs}) == plan.count == seeds * a * b
    assert [run.seed for run in runs] == [*range(10, 10 + seeds)] * (a * b)
    assert [run.case for run in runs] == [k // seeds for k in range(plan.count)]


@given(st.integers(1, 9), st.integers(1, 9), st.integers(1, 9), st.sets(st.integers(0, 59)))
def test_what_is_missing_is_computed_once_in_the_batches_of_a_whole_sweep(cases, seeds, size, done):
    runs = cases * seeds
    whole = list(_missing(runs, [], size, seeds))
    assert max(count for _, count in whole) <= size
    for first, count in whole:
        # Neighbours share a case, or each case is whole.
        alike = first // seeds == (first + count - 1) // seeds
        assert alike or first % seeds == count % seeds == 0
    before = [
        SweepBatch(first, {"outcome": np.zeros(count)})
        for k, (first, count) in enumerate(whole)
        if k in done
    ]
    left = list(_missing(runs, before, size, seeds))
    assert sorted([*left, *((b.first, b.runs) for b in before)]) == whole
    assert sum(count for _, count in whole) == runs


def test_values_are_read_and_written_as_on_the_command_line():
    for text, values in {
        "seed=0..4": [0, 1, 2, 3, 4],
        "a.b=1,2.5,4": [1, 2.5, 4],
        "a.b=[1, 2],[3, 4]": [[1, 2], [3, 4]],
        "graph.name=ring,path": ["ring", "path"],
        "seed=7,10..12": [7, 10, 11, 12],
    }.items():
        [axis] = read_axes([text])
        assert list(axis.values) == values
        assert [list(a.values) for a in read_axes([axis.text])] == [values]


FAULTS = {
    "seed": "got no `key=values`, give them as in `seed=0..9`.",
    "seed=": "got no values, allowed are one or more.",
    "seed=1,1": "got `1` twice, give each value once.",
    "seed=0..999999999999": "1e+12 runs are asked for, and 10000000 fit.",
    "follower.gain.couplng=1": "got an unknown key",
    "follower.gain.coupling=1,-2": "got `-2`",
    "seed=0.5": "got `0.5`",
}


def test_bad_axes_are_one_sentence_before_anything_runs(echelon, here):
    for text, fault in FAULTS.items():
        code, _, said = echelon("sweep", "van-der-pol", "--over", text, "--out", "o")
        assert code == 2 and said.startswith("echelon: --over ") and fault in said, said
        assert said.count("\n") == 1 and not (here / "o").exists()


def test_too_many_runs_of_several_axes_and_of_many_agents_are_refused():
    many = {"seed": range(10**6)}
    for changes, over, said in (
        ([], {**many, "simulation.horizon": range(1, 100)}, "^the sweep is too large: .* are"),
        (["graph.agents=2000"], many, "need .* of memory, and .* fit: .* runs"),
        ([], {"initial": [{}], "initial.spread": [{}]}, "is inside `initial`, which varies too"),
    ):
        with pytest.raises(ech.errors.ScenarioError, match=said):
            ech.sweep(ech.load_scenario("van-der-pol", changes), over)


def test_the_interval_of_a_share_is_wilsons():
    # Computed apart: the roots of (p - s)^2 = z^2 p (1 - p) / n.
    for count, total in ((0, 10), (3, 10), (10, 10), (700, 1000)):
        share, z = count / total, 1.96
        roots = np.roots([1 + z * z / total, -2 * share - z * z / total, share * share])
        np.testing.assert_allclose(share_bounds(count, total), sorted(roots.real), atol=1e-9)


def test_figures_show_the_shares_that_the_batches_hold():
    over = {"follower.gain.coupling": [1.0, 2.0, 64.0], "simulation.dt": [0.01, 0.02]}
    plan = Sweep(ech.load_scenario("van-der-pol", SHORT), axes_of({**over, "seed": [1, 2]}))
    rows = [
        {
            "outcome": 0,
            "worst_settling_time": 3.0 if plan.run(k).place[0] else np.nan,
            "formation_rmse": 0.1 * (k + 1),
            "saturated": np.zeros(4),
            "error_unit": "m" if k else "",
        }
        for k in range(12)
    ]
    batches = [SweepBatch(0, columns_of(rows[:5])), SweepBatch(5, columns_of(rows[5:]))]
    data = dataset_of(plan, batches)
    assert succeeded(data).sum("seed").values.tolist() == [[0, 0], [2, 2], [2, 2]]
    assert data["formation_rmse"].values.ravel().tolist() == [row["formation_rmse"] for row in rows]
    found = sweep_figures(data)
    assert sorted(found) == ["errors", "region", "success"]
    texts = [ax.get_xlabel() for ax in found["errors"].axes]
    assert texts == ["formation RMSE (m)", "worst final error (m)", "settling time (s)"]
    ax = found["region"].axes[0]
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("coupling strength", "length of a step (s)")
    assert (ax.get_xscale(), ax.get_yscale()) == ("log", "linear")
    assert sorted(text.get_text() for text in ax.texts) == ["0/2"] * 2 + ["2/2"] * 4
    assert ax.collections[0].get_array().tolist() == [[0.0, 1.0, 1.0], [0.0, 1.0, 1.0]]
    # Cells end half way between values on their axis.
    ends = ax.collections[0].get_coordinates()
    np.testing.assert_allclose(ends[0, :, 0], [0.5**0.5, 2**0.5, 128**0.5, 64 * 32**0.5])
    np.testing.assert_allclose(ends[:, 0, 1], [0.005, 0.015, 0.025])
    assert found["success"].axes[0].get_lines()[0].get_ydata().tolist() == [0.0, 1.0, 1.0]


# Whoever started the tests may have switched Ctrl-C off, and a child inherits that. Batches are
# small, so that there are some before the end.
SMALL = """
import signal, sys
signal.signal(signal.SIGINT, signal.default_int_handler)
import echelon.simulation.engine.batch as batches
batches._AGENT_STEPS = 1
from echelon.apps.cli.app import main
main()
"""
SWEEP = ["sweep", "van-der-pol", "--set", "simulation.horizon=20", "--over", "seed=0..95"]
SWEEP += ["--over", "follower.gain.coupling=2,3", "--no-figures", "--threads", "1"]


def arrays(folder):
    with xr.open_dataset(folder / "sweep.nc", engine="h5netcdf") as data:
        return {name: np.asarray(data[name].values) for name in data}


def files(folder):
    return list((folder / "batches").glob("*.npz"))


@pytest.mark.slow
def test_ctrl_c_ends_a_sweep_soon_and_keeps_what_is_done(here):
    with started(SMALL, *SWEEP, "--out", here / "cut", "--json") as process:
        wait_for(process, lambda: len(files(here / "cut")) >= 1)
        process.send_signal(signal.SIGINT)
        out, _ = process.communicate(timeout=60)
        assert process.returncode == 130
    told = json.loads(out)
    done = 192 - told["outcomes"]["missing"]
    assert sum(told["outcomes"].values()) == told["runs"] == 192 and 0 < done < 192
    assert int((arrays(here / "cut")["outcome"] >= 0).sum()) == done


# In the middle of an instruction of Python that takes a minute, as a compilation does.
BUSY = """
import hashlib, signal
signal.signal(signal.SIGINT, signal.default_int_handler)

def busy(*_):
    open("busy", "w").close()
    hashlib.pbkdf2_hmac("sha256", b"", b"", 10**8)

import echelon.experiments.scenario.scenario as x; x.load_scenario = busy
from echelon.apps.cli.app import main
main()
"""


def test_ctrl_c_waits_for_no_compilation_where_there_is_nothing_to_save(here):
    with started(BUSY, *SWEEP, "--out", "o") as process:
        wait_for(process, lambda: (here / "busy").exists())
        process.send_signal(signal.SIGINT)
        assert "Traceback" not in process.communicate(timeout=20)[1]
    # Shells report this as 130.
    assert process.returncode == -signal.SIGINT and not (here / "o").exists()


def test_a_sweep_that_is_stopped_before_its_first_batch_leaves_no_folder(echelon, monkeypatch):
    def stop(*_):
        os.kill(os.getpid(), signal.SIGTERM)
        raise KeyboardInterrupt

    monkeypatch.setattr("echelon.experiments.sweeps.workers.Workers.batch", stop)
    code, out, err = echelon(*SWEEP, "--out", "o")
    assert code == 143 and out == "" and err.endswith("there were no results to save.\n")
    assert not Path("o").exists()


def test_a_sweep_writes_its_folder_and_is_complete(echelon, here):
    call = ["sweep", "van-der-pol", "--over", "seed=0..2", "--out", "o"]
    call += [word for change in SHORT for word in ("--set", change)]
    assert echelon(*call)[0] == 0
    names = {"scenario.yaml", "inputs", "sweep.nc", "sweep.txt", "figures"}
    assert {path.name for path in (here / "o").iterdir()} == names
    told = (here / "o" / "sweep.txt").read_text()
    assert "3 runs: 3 completed." in told and "Settled to 0.01:" in told and " m;" not in told
    code, out, err = echelon("sweep", "--resume", "o")
    assert code == 0 and "nothing to do" in out + err
    assert "is not empty" in echelon(*call)[2]


OVER = {"seed": range(3), "follower.gain.coupling": [0.5, 1.0]}


def oscillators(*changes):
    return ech.load_scenario("van-der-pol", [*SHORT, *changes])


def assert_states_of_single_runs(data):
    assert data.states.dims == ("seed", "follower.gain.coupling", "time", "agent", "state")
    assert data.inputs.dims[-1] == "input" and data.time.attrs["units"] == "s"
    for seed, coupling in ((0, 0.5), (2, 1.0)):
        place = {"seed": seed, "follower.gain.coupling": coupling}
        changes = (f"{key}={value}" for key, value in place.items())
        run = ech.run(oscillators("simulation.store_every=20", *changes))
        np.testing.assert_allclose(data.time, run.times)
        for name in ("states", "inputs"):
            stored = data[name].sel(place)
            np.testing.assert_allclose(stored, getattr(run, name), rtol=1e-9, atol=1e-12)


def test_a_sweep_returns_the_states_of_its_runs():
    data = ech.sweep(oscillators(), OVER, keep_states=20)
    assert dict(data.sizes)["time"] == 4  # 0, 0.2, 0.4 and the end
    assert_states_of_single_runs(data)
    numbers = ech.sweep(oscillators(), OVER)
    assert "states" not in numbers
    # Sums are made between stored frames, and so round in another way.
    xr.testing.assert_allclose(data[list(numbers)], numbers, rtol=1e-12)


def test_the_command_writes_them_into_a_file_that_is_read_lazily(echelon, here):
    call = ["sweep", "van-der-pol", "--over", "seed=0..2", "--over"]
    call += ["follower.gain.coupling=0.5,1.0", "--no-figures", "--out", "o"]
    call += [word for change in SHORT for word in ("--set", change)]
    assert echelon(*call, "--keep-states", "20")[0] == 0
    names = {"inputs", "scenario.yaml", "states.nc", "sweep.nc", "sweep.txt"}
    assert {path.name for path in (here / "o").iterdir()} == names
    with xr.open_dataset(here / "o" / "states.nc", engine="h5netcdf") as data:
        assert not data.states._in_memory
        assert data.states.encoding["chunksizes"] == (1, 1, 4, 6, 2)
        assert_states_of_single_runs(data)
        assert set(data.coords) >= {"time", "state_unit", "input_unit"}


def test_a_killed_sweep_goes_on_with_the_same_bits_and_computes_nothing_again(
    here, echelon, monkeypatch
):
    call = ["sweep", "integrators", "--over", "seed=0..31", "--keep-states", "25"]
    call += ["--set", "simulation.horizon=1", "--no-figures", "--out"]
    with started(SMALL.replace("_AGENT_STEPS = 1", "_MOST = 8"), *call, "o") as process:
        wait_for(process, lambda: len(files(here / "o")) > 1)
        process.send_signal(signal.SIGKILL)
    kept, honest, computed = len(files(here / "o")), sweeps.Workers.batch, []
    assert process.wait() != 0 and not (here / "o" / "states.nc").exists()

    def batch(self, first, count, progress):
        computed.append(count)
        return honest(self, first, count, progress)

    monkeypatch.setattr(batches, "_MOST", 8)
    monkeypatch.setattr(sweeps.Workers, "batch", batch)
    assert echelon("sweep", "--resume", "o", "--no-figures")[0] == 0
    assert computed == [8] * (4 - kept) and not (here / "o" / "batches").exists()
    assert echelon(*call, "whole")[0] == 0
    assert (here / "o" / "states.nc").read_bytes() == (here / "whole" / "states.nc").read_bytes()
    whole, cut = arrays(here / "whole"), arrays(here / "o")
    assert whole.keys() == cut.keys()
    for name, values in whole.items():
        np.testing.assert_array_equal(values, cut[name], err_msg=name)


def test_a_run_that_ends_early_has_no_states_after_that():
    scenario = {
        "name": "blowup",
        "model": {"name": "linear", "parameters": {"A": [[50.0]], "B": [[1.0]]}},
        "graph": {"name": "path", "agents": 3},
        "follower": {"gain": {"method": "given", "P": "identity"}},
        "initial": {"spread": {"x1": 1.0}},
        "simulation": {"horizon": 40.0, "dt": 0.01},
    }
    data = ech.sweep(scenario, {"seed": range(2)}, keep_states=100)
    finite = np.isfinite(data.states.values).all(axis=(2, 3))
    assert finite[:, 0].all() and not finite[:, -1].any()
    assert (np.diff(finite.astype(int)) <= 0).all()


def test_what_cannot_be_stored_is_refused_before_anything_runs(echelon, here, monkeypatch):
    for over, every, sentence in (
        ({"graph.agents": [5, 6]}, 5, "--over graph.agents: its values change the agents"),
        ({"simulation.horizon": [0.5, 1.0]}, 5, "--over simulation.horizon: its values change"),
        ({"seed": range(10**6)}, 1, "the sweep is too large"),
        ({"seed": [1]}, 0, "`keep_states` is 0"),
    ):
        with pytest.raises(ech.errors.ScenarioError, match=sentence):
            ech.sweep(oscillators(), over, keep_states=every)
    monkeypatch.setattr(shutil, "disk_usage", lambda _: shutil._ntuple_diskusage(10, 10, 0))
    code, _, fault = echelon("sweep", "integrators", "--over", "seed=0..9", "--keep-states", "1")
    assert code == 2 and "store fewer, with a larger `--keep-states`" in fault
    assert not list((here / "runs").iterdir())


def test_a_plan_with_states_travels_without_its_parts():
    plan = Sweep(oscillators(), axes_of({"seed": range(2)}), 10)
    assert plan.frames is not None
    again = pickle.loads(pickle.dumps(plan))
    assert "first_built" not in vars(again) and again.frames == plan.frames


@pytest.mark.slow
def test_a_cluster_gives_the_same_numbers_though_a_worker_is_killed(monkeypatch):
    scenario = ech.load_scenario("van-der-pol", SHORT)
    plan = Sweep(scenario, axes_of({"seed": range(80), "follower.gain.coupling": [1.0, 2.0]}))
    alone, shared = list[SweepBatch](), list[SweepBatch]()
    sweeps_of = {"n_workers": 2, "threads_per_worker": 1, "processes": True}
    with distributed.LocalCluster(**sweeps_of, dashboard_address=None) as cluster:
        workers = [nanny.pid for nanny in cluster.workers.values()]
        monkeypatch.setattr(batches, "_AGENT_STEPS", 1)
        compute(plan, alone.append)

        def keep(batch):
            if not shared:
                os.kill(workers[0], signal.SIGKILL)
            shared.append(batch)

        compute(plan, keep, cluster=cluster.scheduler_address)
    assert sum(batch.runs for batch in shared) == plan.count and len(shared) > 4
    one, two = dataset_of(plan, alone), dataset_of(plan, shared)
    for name in one:
        np.testing.assert_array_equal(one[name].values, two[name].values, err_msg=name)


def test_a_cluster_that_does_not_answer_is_one_sentence():
    plan = Sweep(ech.load_scenario("van-der-pol", SHORT), axes_of({"seed": [1]}))
    with pytest.raises(ech.errors.OutputError, match="^the cluster at `nowhere:1` does not answer"):
        compute(plan, print, cluster="nowhere:1")


def test_numbers_of_numpy_are_numbers():
    over = {"seed": np.arange(2), "follower.gain.coupling": np.linspace(3.0, 5.0, 3)}
    assert axes_of(over) == axes_of({"seed": [0, 1], "follower.gain.coupling": [3.0, 4.0, 5.0]})
    assert axes_of({"seed": [np.int32(4), np.uint8(5)]})[0].text == "seed=4, 5"
    vectors = {"graph.leaders": [np.array([0]), (np.int64(0), 1)], "model.x": [np.float32(0.5)]}
    assert [axis.values for axis in axes_of(vectors)] == [([0], [0, 1]), (0.5,)]


@pytest.mark.parametrize(
    ("name", "sets"),
    [
        pytest.param("paper-radio", (), marks=pytest.mark.slow),
        ("paper-global", ("initial={spread: {attitude: 0.02, velocity: 0.2, rate: 0.1}}",)),
        ("integrators", ("initial={spread: {position: 1.0}}",)),
    ],
)
def test_what_is_kept_for_other_seeds_is_what_each_would_compute(name, sets, monkeypatch):
    parts, chosen = built(name, *sets)
    asked = [chosen._replace(seed=seed) for seed in range(4)]

    def told():
        return [each.as_mapping() for each in promises(parts.replace(), asked, brief=True)]

    kept = told()
    monkeypatch.setattr(StoppingPromise, "again", Guarantee.again)
    assert kept == told()


def test_starts_are_the_same_whatever_their_caller_computes_in():
    parts, _ = built("paper-radio")
    with precision("float32"):
        single = initial_states(parts, 3)
    with precision("float64"):
        double = initial_states(parts, 3)
    np.testing.assert_array_equal(single, double)
