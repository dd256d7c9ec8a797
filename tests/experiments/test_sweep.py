"""Sweeps: each run has the bits that it has alone, and interrupted sweeps lose nothing."""

import contextlib
import json
import os
import signal
import types
from pathlib import Path

import distributed
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import xarray as xr
from hypothesis import given, settings
from hypothesis import strategies as st
from processes import started, wait_for
from typer.testing import CliRunner

import echelon as ech
from echelon.apps.cli.app import app
from echelon.experiments.scenario.yaml import inline_yaml
from echelon.experiments.sweeps import workers as sweeps
from echelon.experiments.sweeps.plan import Axis, Sweep, axes_of, read_axes
from echelon.experiments.sweeps.sweep import _missing, compute
from echelon.experiments.sweeps.sweep_dataset import columns_of, dataset_of, share_bounds, succeeded
from echelon.experiments.sweeps.workers import SweepBatch
from echelon.guarantees.promises.promise import guarantee, promises
from echelon.output.plots import study_figures as sweep_plots
from echelon.output.plots.study_figures import sweep_figures
from echelon.simulation.engine import batch, law_drive
from echelon.simulation.engine.batch import Batch

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


# ---- formations that are stepped together ----


@pytest.mark.parametrize("name", ["van-der-pol", "unicycle"])
@pytest.mark.parametrize("precision", ["float64", "float32"])
def test_a_run_among_many_has_the_bits_that_it_has_alone(name, precision):
    experiment = built(name, "simulation.horizon=2", "report.steady_window=1")
    runs = seeds(experiment, 19, engine="native", precision=precision, store_every=20)
    for threads in (1, 3):
        found = list(Batch(threads).fly(runs))
        for k in (0, 7, 18):
            check_same(found[k], ech.simulate(*runs[k]))


@pytest.mark.slow
@pytest.mark.parametrize(
    "name",
    [
        "paper",
        pytest.param("planar-quadrotor", marks=pytest.mark.study),
        "paper-literal",
        pytest.param("paper-line", marks=pytest.mark.study),
    ],
)
def test_every_run_among_many_has_the_bits_that_it_has_alone(name):
    runs = seeds(built(name), 20, engine="native", store_every=200)
    found = list(Batch().fly(runs))
    for k in (0, 19):
        check_same(found[k], ech.simulate(*runs[k]))


def parted(graph, model=None, leader=None, world=None, gains=(), **more):
    """Yield parts of a formation, one for each coupling and weight of its gain."""
    model = model or ech.models.DoubleIntegrator(dimension=2)
    formation = ech.Formation.line(model, graph, spacing=1.0)
    for coupling, weight in gains:
        n = len(model.state_names)
        gain = ech.synthesize(
            model, graph, ech.gains.Riccati(coupling=coupling, Q=(weight * np.ones(n)).tolist())
        )
        follower = ech.laws.Consensus(gain, feedforward=more.get("feedforward", "relay"))
        yield ech.Parts(
            model,
            graph,
            formation,
            ech.Laws(leader or ech.laws.TrimInput(), follower),
            initial={"position": 1.0, "velocity": 0.3},
            world=world or ech.World(),
        )


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
    runs = [
        (parts, chosen._replace(seed=k)) for k, parts in enumerate(parted(graph, gains=OWN, **more))
    ]
    found = list(Batch(1).fly(runs))
    assert len({r.states[-1].tobytes() for r in found}) == len(runs)
    for k in (0, 5):
        # Numbers that are rows are rounded where constants would be folded.
        check_same(found[k], ech.simulate(*runs[k]), 1e-13)


def test_runs_that_no_program_shares_are_flown_by_themselves():
    graph = ech.Graph.path(3)
    [short] = parted(graph, gains=[(1.0, 1.0)])
    [longer] = parted(ech.Graph.path(4), gains=[(1.0, 1.0)])
    chosen = ech.Settings(horizon=0.5, dt=0.01, store_every=10, engine="native")
    runs = [(short, chosen), (longer, chosen), (short, chosen._replace(horizon=0.2))]
    for one, (parts, each) in zip(Batch(1).fly(runs), runs, strict=True):
        check_same(one, ech.simulate(parts, each))


class Cubic(ech.ControlAffine):
    """Escapes from beyond its start, at a time that the start decides."""

    state_names, input_names = ("x",), ("push",)

    def drift(self, x):
        return x**3

    def input_map(self, x):
        return jnp.ones((1, 1), x.dtype)


def test_one_that_is_lost_is_told_as_alone_and_loses_no_other():
    drive = ech.Laws(ech.laws.TrimInput(), ech.laws.TrimInput())
    parts = ech.Parts(
        Cubic(), ech.Graph.path(2), ech.Formation(np.zeros((2, 1))), drive, initial={"x": 0.8}
    )
    chosen = ech.Settings(horizon=2.0, dt=0.01, store_every=5, engine="native")
    runs = [(parts, chosen._replace(seed=k)) for k in range(10)]
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
    starts = [np.array([[0.0], [far]]) for far in (1.0, 1e6, 2.0)]
    runs = [
        (
            ech.Parts(model, graph, ech.Formation(np.zeros((2, 1))), drive, initial=start),
            ech.Settings(horizon=0.1, dt=0.01, engine="native"),
        )
        for start in starts
    ]
    for one, run in zip(Batch(1).fly(runs), runs, strict=True):
        check_same(one, ech.simulate(*run))


# ---- what has no native code ----


@pytest.mark.parametrize("command", [["sweep", "--over", "seed=0..2"], ["compare"], ["run"]])
def test_native_code_over_a_network_is_refused_before_anything_is_made(echelon, here, command):
    name, *more = command
    native = [
        "--set",
        "simulation.engine=native",
        "--set",
        "network={rate: 50, prediction: packet}",
    ]
    code, out, err = echelon(name, "integrators", *more, *native, "--out", "o")
    assert (code, out) == (2, "") and not (here / "o").exists()
    assert "no native code for a network that is not ideal" in err and "simulating" not in err


class Bends(ech.laws.Law):
    """Feeds back what it hears, and uses what has no native code."""

    gain: float = 1.0

    def update(self, model, view, memory):
        heard = jax.scipy.special.erfinv(jnp.tanh(view.disagreement))
        return -self.gain * heard, memory


WIND = ech.World(disturbance=ech.Disturbance(rms={"position": 0.3}, hold=0.05))


@pytest.mark.parametrize(("gains", "world"), [((1.0, 0.5), WIND), ((1.0,), ech.World())])
def test_runs_without_native_code_are_stepped_side_by_side_and_say_why(monkeypatch, gains, world):
    for room in (law_drive, batch):
        monkeypatch.setattr(room, "is_long", lambda *_: True)
    model, graph = ech.models.SingleIntegrator(dimension=2), ech.Graph.path(3)
    chosen, runs = ech.Settings(horizon=0.5, dt=0.01, store_every=10), []
    for gain in gains:
        drive = ech.Laws(ech.laws.TrimInput(), Bends(gain))
        formation = ech.Formation.line(model, graph)
        parts = ech.Parts(model, graph, formation, drive, initial={"position": 1.0}, world=world)
        runs += [(parts, chosen._replace(seed=k)) for k in (3, 4)]
    alone = [ech.simulate(*run) for run in runs]
    monkeypatch.setattr(batch, "simulate", None)
    for one, other in zip(Batch(1).fly(runs), alone, strict=True):
        check_same(one, other, 1e-13)
        [told] = one.warnings
        assert "no native code for `erf_inv` in" in told and "test_sweep.py, line" in told


def test_a_start_that_a_law_refuses_is_refused_among_many():
    class Picky(ech.laws.Law):
        most: float

        def update(self, model, view, memory):
            return -view.disagreement, memory

        def refusals(self, model, states):
            return [(k, "too far") for k in np.flatnonzero(np.abs(states).max(axis=1) > self.most)]

    model, graph = ech.models.SingleIntegrator(dimension=2), ech.Graph.path(3)
    formation, runs = ech.Formation.line(model, graph), []
    chosen = ech.Settings(horizon=0.5, dt=0.01, store_every=10, engine="native")
    for most in (9.0, 2.6):
        drive = ech.Laws(ech.laws.TrimInput(), Picky(most))
        parts = ech.Parts(model, graph, formation, drive, initial={"position": 1.0})
        runs.append([(parts, chosen._replace(seed=k)) for k in range(12)])
    easy, strict = (list(Batch(1).fly(some)) for some in runs)
    told = {str(each) for each in strict if isinstance(each, ech.EchelonError)}
    assert told == {"agent 2 starts where its law has no meaning: too far."}
    assert any(isinstance(each, ech.Result) for each in strict)
    # Beside runs of a law that differs in its numbers it is the same.
    both = [type(each) for each in Batch(1).fly([*runs[0], *runs[1]])]
    assert both == [type(each) for each in [*easy, *strict]]


# ---- what is promised ----


@pytest.mark.slow
@pytest.mark.parametrize(
    "changes", [pytest.param([], marks=pytest.mark.study), ["simulation.dt=0.4"]]
)
def test_promises_of_many_seeds_are_those_of_each(changes):
    experiment = built("van-der-pol", "simulation.horizon=4", "report.steady_window=1", *changes)
    parts, chosen = experiment
    asked = [chosen._replace(seed=k) for k in range(3)]
    for one, each in zip(promises(parts, asked), asked, strict=True):
        assert one.as_mapping() == guarantee(parts, each).as_mapping()


def test_runs_with_noise_and_runs_without_fly_in_one_sweep():
    scenario = ech.load_scenario("van-der-pol", [*SHORT, "simulation.engine=native"])
    noise = {f"disturbance.input_rms.{ech.models.VanDerPol.input_names[0]}": [0.0, 0.05]}
    found = ech.sweep(scenario, {**noise, "seed": range(2)})
    assert (found["outcome"] == 0).all()
    still, shaken = found["final_error"].values.reshape(2, -1)
    assert np.isfinite(shaken).any() and not np.array_equal(still, shaken, equal_nan=True)


def test_of_starts_that_no_tube_covers_none_is_promised_among_many():
    far = ["initial.spread={velocity: 18.0}", "simulation.horizon=1", "report.steady_window=0.5"]
    parts, chosen = built("paper-global", *far)
    asked = [chosen._replace(seed=k) for k in (0, 1)]
    first, second = promises(parts, asked)
    assert [first.promised, second.promised] == [guarantee(parts, s).promised for s in asked]
    assert first.tube is not second.tube


# ---- the dataset ----


def test_a_sweep_is_each_of_its_runs():
    scenario = ech.load_scenario("van-der-pol", SHORT)
    found = ech.sweep(scenario, {"seed": range(3), "follower.gain.coupling": [1.0, 2.0]})
    assert found["formation_rmse"].dims == ("seed", "follower.gain.coupling")
    # Of oscillators, whose states have no common unit.
    assert "units" not in found["rmse"].attrs and "error_unit" not in found
    assert found["promise_rate"].attrs["units"] == "1/s"
    for seed in (2,):
        for coupling in (1.0, 2.0):
            changes = [*SHORT, f"seed={seed}", f"follower.gain.coupling={coupling}"]
            run = ech.run(ech.load_scenario("van-der-pol", changes))
            here = found.sel({"seed": seed, "follower.gain.coupling": coupling})
            told = ech.metrics(run)
            followers = list(run.graph.followers)
            np.testing.assert_allclose(
                here["rmse"].values[followers], [f.rmse for f in told.followers], rtol=1e-9
            )
            assert np.isnan(here["rmse"].values[0])
            last = np.linalg.norm(run.errors[-1], axis=1)
            np.testing.assert_allclose(here["final_error"].values[followers], last[followers])
            assert float(here["worst_final_error"]) == pytest.approx(last.max())
            assert int(here["outcome"]) == 0 and int(here["promised"]) == int(
                guarantee(run.parts, run.settings).promised
            )


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


def test_what_cannot_be_made_is_refused_and_the_others_run():
    scenario = ech.load_scenario("van-der-pol", SHORT)
    found = ech.sweep(scenario, {"initial.states.1": [[0.0, 0.0], [1.0]]})
    assert found["outcome"].values.tolist() == [0, -1]
    assert "agent 1 has shape (1,)" in str(found["message"].values[1])


def test_agents_may_differ_in_number():
    scenario = ech.load_scenario("van-der-pol", SHORT)
    found = ech.sweep(scenario, {"graph.agents": [4, 6], "seed": [5]})
    assert found.sizes["agent"] == 6
    assert np.isnan(found["rmse"].values[0, 0, 4:]).all()
    assert np.isfinite(found["rmse"].values[1, 0, 1:]).all()


# ---- which runs there are ----


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


@pytest.mark.parametrize(
    "text, values",
    [
        ("seed=0..4", [0, 1, 2, 3, 4]),
        ("a.b=1,2.5,4", [1, 2.5, 4]),
        ("a.b=[1, 2],[3, 4]", [[1, 2], [3, 4]]),
        ("graph.name=ring,path", ["ring", "path"]),
        ("seed=7,10..12", [7, 10, 11, 12]),
    ],
)
def test_values_are_read_and_written_as_on_the_command_line(text, values):
    [axis] = read_axes([text])
    assert list(axis.values) == values
    assert [list(a.values) for a in read_axes([axis.text])] == [values]


FAULTS = {
    "seed": "got no `key=values`, give them as in `seed=0..9`.",
    "seed=": "got no values, allowed are one or more.",
    "seed=9..0": "got `9..0`, a range must ascend.",
    "seed=1,1": "got `1` twice, give each value once.",
    "seed=0..999999999999": "1e+12 runs are asked for, and 10000000 fit.",
    "follower.gain.couplng=1": "got an unknown key",
    "follower.gain.coupling=1,-2": "got `-2`",
    "seed=0.5": "got `0.5`",
}


@pytest.mark.parametrize("text", FAULTS)
def test_bad_axes_are_one_sentence_before_anything_runs(text, here):
    done = CliRunner().invoke(app, ["sweep", "van-der-pol", "--over", text, "--out", "o"])
    assert done.exit_code == 2 or done.exception is not None
    said = str(done.exception)
    assert said.startswith("--over ") and FAULTS[text] in said, said
    assert not (here / "o").exists()


def test_too_many_runs_of_several_axes_and_of_many_agents_are_refused():
    scenario = ech.load_scenario("van-der-pol")
    with pytest.raises(
        ech.errors.ScenarioError, match="^the sweep is too large: .* runs are asked"
    ):
        ech.sweep(
            scenario, {"seed": range(10**6), "simulation.horizon": [1.0 + k for k in range(99)]}
        )
    big = ech.load_scenario("van-der-pol", ["graph.agents=2000"])
    with pytest.raises(ech.errors.ScenarioError, match="need .* of memory, and .* fit: .* runs"):
        ech.sweep(big, {"seed": range(10**6)})
    with pytest.raises(
        ech.errors.ScenarioError, match="this key is inside `initial`, which varies too"
    ):
        axes_of({"initial": [{}], "initial.spread": [{}]})


def test_the_interval_of_a_share_is_wilsons():
    # Computed apart: the roots of (p - s)^2 = z^2 p (1 - p) / n.
    for count, total in ((0, 10), (3, 10), (10, 10), (700, 1000)):
        share, z = count / total, 1.96
        roots = np.roots([1 + z * z / total, -2 * share - z * z / total, share * share])
        np.testing.assert_allclose(share_bounds(count, total), sorted(roots.real), atol=1e-9)


def test_figures_show_the_shares_that_the_batches_hold():
    scenario = ech.load_scenario("van-der-pol", SHORT)
    over = {"follower.gain.coupling": [1.0, 2.0, 64.0], "simulation.dt": [0.01, 0.02]}
    over["seed"] = [1, 2]
    plan = Sweep(scenario, axes_of(over))
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
    data = dataset_of(
        plan, [SweepBatch(0, columns_of(rows[:5])), SweepBatch(5, columns_of(rows[5:]))]
    )
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
    shown = ax.collections[0].get_array()
    assert shown.tolist() == [[0.0, 1.0, 1.0], [0.0, 1.0, 1.0]]
    [left, _] = found["success"].axes
    assert left.get_lines()[0].get_ydata().tolist() == [0.0, 1.0, 1.0]


@pytest.mark.parametrize(
    ("values", "scale", "ends"),
    [
        ([1.0, 2.0, 4.0, 8.0], "log", [0.5**0.5, 2**0.5, 8**0.5, 32**0.5, 128**0.5]),
        ([1.0, 2.0, 3.0], "linear", [0.5, 1.5, 2.5, 3.5]),
        ([0.0, 10.0, 100.0], "linear", [-5.0, 5.0, 55.0, 145.0]),
        ([1.0, 100.0], "log", [0.1, 10.0, 1000.0]),
    ],
)
def test_cells_of_a_map_end_half_way_between_values_on_their_axis(values, scale, ends):
    assert sweep_plots._is_geometric(np.array(values)) == (scale == "log")
    np.testing.assert_allclose(sweep_plots._cell_ends(np.array(values)), ends)


# ---- nothing is lost ----

# Whoever started the tests may have switched Ctrl-C off, and a child inherits that. Batches are
# small, so that there are some before the end.
SMALL = """
import signal, sys
signal.signal(signal.SIGINT, signal.default_int_handler)
import echelon.experiments.sweeps.workers as sweeps
sweeps._AGENT_STEPS = 1
from echelon.apps.cli.app import main
main()
"""
SWEEP = ["sweep", "van-der-pol", "--set", "simulation.horizon=20", "--over", "seed=0..95"]
SWEEP += ["--over", "follower.gain.coupling=2,3", "--no-figures", "--threads", "1"]


def arrays(folder):
    with xr.open_dataset(folder / "sweep.nc", engine="h5netcdf") as data:
        return {name: np.asarray(data[name].values) for name in data}


def files(folder):
    return {f.name: f.stat().st_mtime_ns for f in (folder / "batches").glob("*.npz")}


@pytest.mark.slow
def test_a_sweep_that_is_killed_goes_on_and_computes_nothing_again(here):
    with started(SMALL, *SWEEP, "--out", here / "whole") as process:
        assert process.wait(300) == 0, process.communicate()
    with started(SMALL, *SWEEP, "--out", here / "cut") as process:
        wait_for(process, lambda: len(files(here / "cut")) >= 2)
        process.send_signal(signal.SIGKILL)
        process.wait(10)
    kept = files(here / "cut")
    assert kept and not (here / "cut" / "sweep.nc").exists()
    with started(SMALL, "sweep", "--resume", here / "cut", "--no-figures") as process:
        wait_for(process, lambda: len(files(here / "cut")) > len(kept) or process.poll() == 0)
        now = files(here / "cut")
        assert all(now.get(name, stamp) == stamp for name, stamp in kept.items())
        assert process.wait(300) == 0, process.communicate()
    whole, cut = arrays(here / "whole"), arrays(here / "cut")
    assert whole.keys() == cut.keys()
    for name, values in whole.items():
        np.testing.assert_array_equal(values, cut[name], err_msg=name)
    assert not (here / "cut" / "batches").exists()


@pytest.mark.slow
def test_ctrl_c_ends_a_sweep_soon_and_keeps_what_is_done(here):
    with started(SMALL, *SWEEP, "--out", here / "cut", "--json") as process:
        wait_for(process, lambda: len(files(here / "cut")) >= 1)
        process.send_signal(signal.SIGINT)
        out, _ = process.communicate(timeout=60)
        assert process.returncode == 130
    told = json.loads(out)
    assert told["outcomes"]["missing"] > 0
    assert sum(told["outcomes"].values()) == told["runs"] == 192
    done = 192 - told["outcomes"]["missing"]
    assert done and int((arrays(here / "cut")["outcome"] >= 0).sum()) == done


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


def test_a_sweep_writes_its_folder_and_is_complete(here):
    call = ["sweep", "van-der-pol", "--over", "seed=0..2", "--out", "o"]
    for change in SHORT:
        call += ["--set", change]
    done = CliRunner().invoke(app, call)
    assert done.exit_code == 0, done.output
    names = {"scenario.yaml", "inputs", "sweep.nc", "sweep.txt", "figures"}
    assert {path.name for path in (here / "o").iterdir()} == names
    told = (here / "o" / "sweep.txt").read_text()
    assert "3 runs: 3 completed." in told and "Settled to 0.01:" in told and " m;" not in told
    again = CliRunner().invoke(app, ["sweep", "--resume", "o"])
    assert again.exit_code == 0 and "nothing to do" in again.output
    over = CliRunner().invoke(app, call)
    assert "is not empty" in str(over.exception)


# ---- on a cluster ----


@pytest.mark.slow
def test_a_cluster_gives_the_same_numbers_though_a_worker_is_killed():
    scenario = ech.load_scenario("van-der-pol", SHORT)
    plan = Sweep(scenario, axes_of({"seed": range(80), "follower.gain.coupling": [1.0, 2.0]}))
    alone, shared = list[SweepBatch](), list[SweepBatch]()
    sweeps_of = {"n_workers": 2, "threads_per_worker": 1, "processes": True}
    with distributed.LocalCluster(**sweeps_of, dashboard_address=None) as cluster:
        workers = [nanny.pid for nanny in cluster.workers.values()]
        with smaller_batches():
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


def smaller_batches():
    patch = pytest.MonkeyPatch()
    patch.setattr(sweeps, "_AGENT_STEPS", 1)
    return contextlib.closing(types.SimpleNamespace(close=patch.undo))


def test_a_cluster_that_does_not_answer_is_one_sentence():
    plan = Sweep(ech.load_scenario("van-der-pol", SHORT), axes_of({"seed": [1]}))
    with pytest.raises(
        ech.errors.OutputError, match=r"^the cluster at `nowhere:1` does not answer"
    ):
        compute(plan, print, cluster="nowhere:1")
