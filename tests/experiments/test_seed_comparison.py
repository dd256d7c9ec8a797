"""Comparisons over seeds: the same draws for all methods, and statistics that hold."""

import csv
import itertools
import json
import signal

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import binom

import echelon as ech
from echelon.apps.cli.terminal import STOP
from echelon.experiments.studies import seed_comparison
from echelon.experiments.studies.seed_comparison import (
    LEVELS,
    NUMBERS,
    MethodSeeds,
    SeedComparison,
    SeedStore,
    compare_seeds,
    median_interval,
    quantiles,
)
from echelon.output.archive.chunks import Chunks
from echelon.output.archive.study_folder import SeedBatches
from echelon.output.plots.study_figures import seed_figures
from echelon.output.reports.comparison_report import comparison_mapping, comparison_report

NOISY = {
    "name": "noisy",
    "model": {"name": "double-integrator", "parameters": {"dimension": 2}},
    "graph": {"name": "path", "agents": 3},
    "formation": {"name": "line"},
    "follower": {"gain": {"method": "riccati"}},
    "initial": {"spread": {"position": 1.0}},
    "network": {"rate": 25.0, "delay": 0.02, "loss": 0.3, "prediction": "packet"},
    "simulation": {"horizon": 0.6, "dt": 0.02, "precision": "float64"},
}
PULL = f"{__file__}:Pull"
STRONG = f"{{python: {json.dumps(PULL)}, strength: 2.0}}"
AVERAGED = {"formation_rmse": "rmse", "formation_steady_rmse": "steady_rmse", "effort": "effort"}
LABELS = ["riccati", "Pull", "Pull(strength: 2.0)", "riccati-relay"]


class Pull(ech.Law):
    """Moves towards the neighbours, with a strength."""

    strength: float = 1.0

    def update(self, model, view, memory):
        z = view.disagreement
        return model.physical(-self.strength * (z[:2] + z[2:])), memory


class Blow(ech.Law):
    """Diverges behind a leader that starts far away."""

    def update(self, model, view, memory):
        z = view.disagreement[:2]
        return model.physical(z * jnp.where(z @ z > 1.2, 1e300, -1.0)), memory


@pytest.fixture(scope="module")
def noisy():
    scenario = ech.scenario_from_mapping(NOISY)
    return compare_seeds(scenario, range(3, 9), only=["riccati", PULL, STRONG, "own"])


def test_each_run_is_the_one_of_its_seed_alone(noisy, echelon, here):
    assert [row.label for row in noisy.rows] == LABELS
    mine = {"law": {"python": PULL, "strength": 2.0}}
    for label, follower, seed in zip(LABELS[2:], (mine, NOISY["follower"]), (3, 8), strict=True):
        changed = json.dumps(NOISY | {"seed": seed, "follower": follower})
        (here / "one.yaml").write_text(changed, "utf-8")
        call = ("run", "one.yaml", "--out", "o", "--force", "--no-figures", "--json")
        code, out, err = echelon(*call)
        assert code == 0, err
        told = json.loads(out)
        (row,) = (row for row in noisy.rows if row.label == label)
        numbers = {name: row.numbers[name][noisy.seeds.index(seed)] for name in NUMBERS}
        assert numbers["minimum_distance"] == pytest.approx(told["minimum_distance"], 1e-12)
        for name, key in AVERAGED.items():
            each = [follower[key] for follower in told["followers"]]
            assert numbers[name] == pytest.approx(np.sqrt(np.mean(np.square(each))), 1e-12)


def test_a_difference_is_antisymmetric_and_zero_to_itself(noisy):
    turned = noisy._replace(rows=noisy.rows[::-1])
    back = {(d.number, d.second, d.first): d for d in turned.differences()}
    for pair in noisy.differences():
        other = back[pair.number, pair.first, pair.second]
        assert pair.median == -other.median and pair.better == other.better[::-1]
        assert pair.interval == tuple(-end for end in other.interval[::-1])
    row = noisy.rows[0]
    for pair in noisy._replace(rows=[row, row]).differences():
        assert (pair.median, pair.interval, pair.better) == (0.0, (0.0, 0.0), (0, 0))


def made_up(**numbers):
    """Methods whose numbers are given, NaN of runs that diverged."""
    rows = []
    for label, values in numbers.items():
        values = np.array(values, float)
        outcomes = ["diverged" if np.isnan(x) else "completed" for x in values]
        rows.append(MethodSeeds(label, outcomes, dict.fromkeys(NUMBERS, values), "", "m"))
    return SeedComparison("mine", range(len(values)), rows, 5.0, ())


def test_runs_that_diverged_count_as_worse_and_are_counted():
    found = made_up(a=[1, 2, 3, np.nan, np.nan, 1, 1, 1], b=[2, 2, 1, 5, np.nan, 2, 2, 2])
    a, b = found.rows
    assert (a.ended, a.settled) == ({"completed": 6, "diverged": 2}, 6)
    assert a.quantiles("effort") == [1.0, 1.5, np.inf]
    assert a.quantiles("minimum_distance")[0] == -np.inf
    by_name = {pair.number: pair for pair in found.differences()}
    effort = by_name["effort"]
    # -1, 0, 2, inf, -1, -1, -1: of the seed where neither has a number there is no difference.
    assert (effort.better, effort.median, effort.interval) == ((4, 2), -1.0, (-1.0, np.inf))
    # Larger distances are better.
    assert by_name["minimum_distance"].better == (1, 5)
    text = comparison_report(found)
    assert "6 completed, 2 diverged" in text and "a minus b" in text
    json.dumps(comparison_mapping(found), allow_nan=False)
    assert {*seed_figures(found)} == {"quantiles", "differences"}


def test_methods_without_all_runs_are_named_with_the_reason():
    (a,) = made_up(a=[1, 2, 3]).rows
    some = MethodSeeds("b", a.outcomes[:1], {name: a.numbers[name][:1] for name in NUMBERS}, "x")
    rows = [a, MethodSeeds("c", reason="it does not apply."), some]
    found = made_up(a=[1, 2, 3])._replace(rows=rows)
    text = comparison_report(found)
    assert "minus" not in text and "c: it does not apply." in text
    assert "b: interrupted after 1 of 3 runs" in text
    assert comparison_mapping(found)["methods"]["c"]["reason"] == "it does not apply."
    assert seed_figures(found._replace(rows=rows[1:])) == {}
    comparison_report(found._replace(rows=rows[1:]))


def test_a_law_that_diverges_on_some_seeds_is_an_outcome():
    scenario = {key: value for key, value in NOISY.items() if key != "network"}
    found = compare_seeds(scenario, range(6), only=["riccati", f"{__file__}:Blow"])
    fine, blown = found.rows
    assert fine.ended == {"completed": 6} and {*blown.ended} == {"completed", "diverged"}
    lost = np.array(blown.outcomes) == "diverged"
    for name in NUMBERS:
        assert np.isnan(blown.numbers[name][lost]).all()
    assert np.isfinite(blown.numbers["effort"][~lost]).all()


def test_equal_seeds_are_said_to_be_equal(noisy):
    text = "All seeds give the same numbers"
    calm = {key: value for key, value in NOISY.items() if key not in ("network", "initial")}
    found = compare_seeds(calm, range(2), only=["riccati", "riccati-relay"])
    assert {pair.median for pair in found.differences()} == {0.0}
    assert text in comparison_report(found) and text not in comparison_report(noisy)
    # Where every run diverged there are no numbers to compare.
    assert text not in comparison_report(made_up(a=[np.nan, np.nan], b=[np.nan, np.nan]))


def test_an_interruption_keeps_the_runs_before_it():
    def progress(label, done, methods):
        if done > 1.4:
            raise KeyboardInterrupt

    found = compare_seeds(NOISY, range(2), None, ["riccati", PULL, "own"], progress)
    first, second, third = found.rows
    assert first.ended == {"completed": 2} and not third.outcomes
    assert second.ended == {"completed": 1} and found.compared == [first]
    whole = compare_seeds(NOISY, range(2), only=["riccati"])
    for name in NUMBERS:
        np.testing.assert_array_equal(first.numbers[name], whole.rows[0].numbers[name])


def test_the_interval_contains_the_median_as_often_as_it_says():
    for n in (5, 6, 9, 50, 200):
        interval = median_interval(np.arange(n, dtype=float))
        # Without an interval even the extremes are too often on one side.
        if interval is None:
            assert 2 * 0.5**n > 0.05
            continue
        low, high = interval
        assert low + high == n - 1
        # Fewer than `low + 1` of n below the median, or above it: exactly, and no narrower one.
        assert 2 * binom.cdf(low, n, 0.5) <= 0.05 < 2 * binom.cdf(low + 1, n, 0.5)
    assert 0.9 < np.mean([_hit(seed) for seed in range(400)])


def _hit(seed):
    low, high = median_interval(np.random.default_rng(seed).exponential(size=30))
    return low <= np.log(2.0) <= high


def test_quantiles_are_those_of_numpy_and_order_infinite_values():
    values = np.random.default_rng(0).exponential(size=200)
    assert quantiles(values, LEVELS) == np.quantile(values, LEVELS).tolist()
    values[:15], values[-5:] = np.inf, -np.inf
    levels = np.linspace(0.0, 1.0, 21)
    low, high = (np.quantile(values, levels, method=m) for m in ("lower", "higher"))
    found = np.array(quantiles(values, levels))
    # Where both neighbours are finite the quantile lies between them; otherwise it is infinite.
    assert (np.isfinite(found) | (found == low) | (found == high)).all()
    inside = np.isfinite(low) & np.isfinite(high)
    assert ((low <= found) & (found <= high))[inside].all() and inside.sum() > 15
    assert np.isnan(quantiles(np.array([]), LEVELS)).all()


def test_the_command_writes_what_it_prints(echelon, here):
    (here / "noisy.yaml").write_text(json.dumps(NOISY), "utf-8")
    call = ["compare", "noisy.yaml", "--seeds", "0..5", "--horizon", "0.2", "--out", "o"]
    methods = ["--method", "riccati", "--method", "riccati-relay"]
    code, out, err = echelon(*call, *methods, "--json")
    assert code == 0, err
    told = json.loads(out)
    assert told == json.loads((here / "o" / "comparison.json").read_text("utf-8"))
    with (here / "o" / "runs" / "seeds.csv").open() as file:
        rows = [*csv.DictReader(file)]
    assert [(row["method"], int(row["seed"])) for row in rows] == [
        *itertools.product(told["methods"], told["seeds"])
    ]
    for label, row in told["methods"].items():
        effort = [float(each["effort"]) for each in rows if each["method"] == label]
        np.testing.assert_allclose(row["quantiles"]["effort"], np.quantile(effort, LEVELS), 1e-12)
        assert row["outcomes"] == {"completed": 6}
    names = {f"{name}.{kind}" for name in ("quantiles", "differences") for kind in ("png", "pdf")}
    assert {path.name for path in (here / "o" / "figures").iterdir()} == names


@pytest.mark.parametrize(
    ("option", "value", "text"),
    [
        ("--seeds", "3..1", "a range must ascend"),
        ("--seeds", "a", "allowed are whole numbers from 0 on"),
        ("--seeds", "-1..1", "allowed are whole numbers from 0 on"),
        ("--seeds", "1,1", "got `1` twice"),
        ("--seeds", "", "got no values"),
        ("--method", "{python: none.py:Law}", "--method {python: none.py:Law}"),
        ("--method", "none.py:Law", "none.py` does not exist"),
        ("--method", "{", "is not YAML"),
    ],
)
def test_bad_input_is_one_sentence_and_leaves_no_folder(echelon, here, option, value, text):
    (here / "noisy.yaml").write_text(json.dumps(NOISY), "utf-8")
    code, out, err = echelon("compare", "noisy.yaml", f"{option}={value}", "--out", "p")
    assert code == 2 and text in err and not out and len(err.strip().splitlines()) == 1
    assert not (here / "p").exists()


COMPARED = ("--seeds", "0..8", "--horizon", "0.2", "--no-figures", "--method", "riccati")
COMPARED += ("--method", "riccati-relay", "--method", "own", "--method")


STILL = """import echelon as ech

class Still(ech.Law):
    def update(self, model, view, memory):
        return 0.0 * model.physical(view.disagreement[:2]), memory
"""


@pytest.fixture
def own_law(here):
    """A scenario of which three runs fit in a batch, and a law in a file beside it."""
    (here / "noisy.yaml").write_text(json.dumps(NOISY), "utf-8")
    (here / "still.py").write_text(STILL, "utf-8")
    return "still.py:Still"


def files_of(folder):
    names = ("comparison.json", "comparison.txt", "runs/seeds.csv")
    return {name: (folder / name).read_bytes() for name in names}


@pytest.mark.parametrize("batches", [0, 1, 4, 7])
def test_an_interrupted_comparison_continues_with_the_same_output(
    echelon, here, own_law, monkeypatch, batches
):
    monkeypatch.setattr(seed_comparison, "batch_size", lambda *_: 4)
    call = ("compare", "noisy.yaml", *COMPARED, own_law, "--out")
    assert echelon(*call, "whole")[0] == 0
    fly, flown = seed_comparison.Batch.fly, []

    def stopped(self, runs, report):
        flown.append(len(runs))
        if len(flown) == batches + 1:
            STOP.number = signal.SIGINT
        return fly(self, runs, report)

    monkeypatch.setattr(seed_comparison.Batch, "fly", stopped)
    code, said, _ = echelon(*call, "part")
    assert code == 130 and files_of(here / "part") != files_of(here / "whole")
    assert ("`echelon compare --resume part` continues" in said) == (batches > 0)
    flown[:] = [0] * 100
    assert echelon("compare", "--resume", "part", "--no-figures")[0] == 0
    # Batches of 4, 4 and 1 runs for each of the three methods that differ, none of them again.
    assert len(flown) - 100 == 9 - batches
    assert files_of(here / "part") == files_of(here / "whole")
    code, said, _ = echelon("compare", "--resume", "part")
    assert code == 0 and not said.count("quantiles")


def test_a_comparison_with_other_inputs_does_not_continue(echelon, here, own_law, monkeypatch):
    monkeypatch.setattr(SeedBatches, "store", property(lambda self: SeedStore()))
    monkeypatch.setattr(Chunks, "remove", lambda self: None)
    assert echelon("compare", "noisy.yaml", *COMPARED, own_law, "--out", "o")[0] == 0
    assert echelon("compare", "--resume", "o", "--seeds", "1..2")[2] == (
        "echelon: `--resume` takes its inputs from the folder; give no others.\n"
    )
    assert "no scenario was given; give one, or `--resume` with" in echelon("compare")[2]
    (here / "still.py").write_text("", "utf-8")
    code, _, fault = echelon("compare", "--resume", "o")
    assert code == 2 and "`still.py` is not the file with which the comparison in `o/runs`" in fault
    (here / "o" / "runs" / "scenario.yaml").write_text("{}", "utf-8")
    code, _, fault = echelon("compare", "--resume", "o")
    assert code == 2 and "the scenario in `o/runs` was changed" in fault
    code, _, fault = echelon("compare", "--resume", "none")
    assert code == 2 and "holds no unfinished run" in fault
