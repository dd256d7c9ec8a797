"""Comparisons over seeds: the same draws for all methods, and statistics that hold."""

import itertools
import json

import numpy as np
import pytest
import xarray as xr
from scipy.stats import binom

import echelon as ech
from echelon.experiments.results.metrics import RunNumbers
from echelon.experiments.studies.seed_comparison import (
    NUMBERS,
    MethodSeeds,
    SeedComparison,
    compare_seeds,
    median_interval,
    observed_quantiles,
)
from echelon.output.plots.study_figures import seed_figures
from echelon.output.reports.seed_report import seed_mapping, seed_report

NOISY = {
    "name": "noisy",
    "model": {"name": "double-integrator", "parameters": {"dimension": 2}},
    "graph": {"name": "path", "agents": 3},
    "formation": {"name": "line"},
    "follower": {"gain": {"method": "riccati"}},
    "initial": {"spread": {"position": 1.0}},
    "network": {"rate": 20.0, "delay": 0.02, "loss": 0.3},
    "simulation": {"horizon": 1.0, "dt": 0.02, "precision": "float64"},
}
OWN = f'{{python: "{__file__}:Pull", strength: {{}}}}'


class Pull(ech.Law):
    """Moves towards the neighbours, with a strength."""

    strength: float = 1.0

    def update(self, model, view, memory):
        z = view.disagreement
        return model.physical(-self.strength * (z[:2] + z[2:])), memory


@pytest.fixture(scope="module")
def noisy():
    laws = [OWN.format(1.0), OWN.format(2.0)]
    scenario = ech.scenario_from_mapping(NOISY)
    return compare_seeds(scenario, range(3, 9), only=["riccati", *laws, "own"])


def test_each_run_is_the_one_of_its_seed_alone(noisy):
    assert [row.label for row in noisy.rows] == [
        "riccati", "Pull(strength=1.0)", "Pull(strength=2.0)", "riccati-relay",
    ]  # fmt: skip
    for label, seed in (("riccati-relay", 3), ("Pull(strength=2.0)", 8)):
        changes = {"seed": seed}
        if "Pull" in label:
            law = {"python": f"{__file__}:Pull", "strength": 2.0}
            changes["follower"] = {"law": law}
        result = ech.run(ech.scenario_from_mapping(NOISY | changes))
        alone = RunNumbers(result, ech.metrics(result))
        (row,) = (row for row in noisy.rows if row.label == label)
        for name in NUMBERS:
            number = alone.number(name)
            found = row.numbers[name][noisy.seeds.index(seed)]
            np.testing.assert_allclose(found, np.nan if number is None else number, rtol=1e-9)


def made_up(**numbers):
    """Methods whose numbers are given, NaN of runs that diverged."""
    rows = []
    for label, values in numbers.items():
        values = np.array(values, float)
        outcomes = tuple("diverged" if np.isnan(x) else "completed" for x in values)
        rows.append(MethodSeeds(label, {name: values for name in NUMBERS}, outcomes))
    return SeedComparison("mine", (*range(len(values)),), (*rows,), 5.0, (), "m")


def test_runs_that_diverged_count_as_worse_and_are_counted():
    found = made_up(a=[1, 2, 3, np.nan, np.nan, 1, 1, 1], b=[2, 2, 1, 5, np.nan, 2, 2, 2])
    a, b = found.rows
    assert (a.ended, a.settled) == ({"completed": 6, "diverged": 2}, 6)
    assert a.quantiles("effort") == (1.0, 1.0, np.inf)
    by_name = {pair.number: pair for pair in found.differences()}
    effort = by_name["effort"]
    # -1, 0, 2, inf, -1, -1, -1: of the seed where neither has a number there is no difference.
    assert (effort.better, effort.seeds, effort.median) == ((4, 2), 8, -1.0)
    assert effort.interval == (-1.0, np.inf)
    # Larger distances are better.
    assert by_name["minimum_distance"].better == (1, 5)
    text = seed_report(found)
    assert "6 completed, 2 diverged" in text and "a less b" in text
    json.dumps(seed_mapping(found), allow_nan=False)
    assert {*seed_figures(found)} == {"quantiles", "differences"}
    # A method alone has no differences; one that could not run has a reason.
    alone = found._replace(rows=(a, MethodSeeds("c", reason="it does not apply.")))
    assert "paired" not in seed_report(alone) and "c: it does not apply." in seed_report(alone)
    assert seed_mapping(alone)["methods"]["c"] == {"reason": "it does not apply."}


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


def test_quantiles_are_numbers_of_runs():
    values = np.random.default_rng(0).permutation(200).astype(float)
    assert observed_quantiles(values, (0.05, 0.5, 0.95)) == (9.0, 99.0, 189.0)
    expected = np.quantile(values, (0.01, 0.3, 1.0), method="inverted_cdf")
    assert observed_quantiles(values, (0.01, 0.3, 1.0)) == (*expected,)


def test_the_command_writes_what_it_prints(echelon, here):
    (here / "noisy.yaml").write_text(json.dumps(NOISY), "utf-8")
    call = ["compare", "noisy.yaml", "--seeds", "0..5", "--horizon", "0.2", "--out", "o"]
    methods = ["--method", "riccati", "--method", "riccati-relay"]
    code, out, err = echelon(*call, *methods, "--json")
    assert code == 0, err
    told = json.loads(out)
    assert told == json.loads((here / "o" / "comparison.json").read_text("utf-8"))
    data = xr.open_dataset(here / "o" / "runs" / "seeds.nc", engine="h5netcdf")
    assert dict(data.sizes) == {"method": 2, "seed": 6} and told["seeds"] == [*range(6)]
    pairs = itertools.combinations(data["method"].values, 2)
    assert {(d["first"], d["second"]) for d in told["differences"]} == {*pairs}
    for label, row in told["methods"].items():
        median = float(np.sort(data["effort"].sel(method=label))[2])
        assert row["quantiles"]["effort"][1] == median and row["outcomes"] == {"completed": 6}
    names = {f"{name}.{kind}" for name in ("quantiles", "differences") for kind in ("png", "pdf")}
    assert {path.name for path in (here / "o" / "figures").iterdir()} == names
    for wrong, text in {
        "3..1": "a range must ascend",
        "a": "must be whole numbers from 0 on",
        "-1..1": "must be whole numbers from 0 on",
        "1,1": "must be one or more different whole numbers",
    }.items():
        code, _, err = echelon("compare", "noisy.yaml", f"--seeds={wrong}", *methods, "--out", "p")
        assert code == 2 and text in err and not (here / "p").exists()
    code, _, err = echelon("compare", "noisy.yaml", "--method", "{python: none.py:Law}")
    assert code == 2 and "--method {python: none.py:Law}" in err
