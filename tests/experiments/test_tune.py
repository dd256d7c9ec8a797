"""Tuned weights: gradients of the cost, lower costs, and refused input."""

import json

import numpy as np
import pytest
import scipy.linalg
import yaml
from typer.testing import CliRunner

import echelon as ech
from echelon.apps.cli.app import app
from echelon.experiments.studies.tune import _Search, cost_named, through_riccati

CARTS = {
    "name": "carts",
    "model": {"name": "double-integrator", "parameters": {"dimension": 1}},
    "graph": {"name": "path", "agents": 3},
    "formation": {"offsets": {1: [1.0], 2: [2.0]}},
    "leader": {"law": "passive"},
    "follower": {
        "law": "consensus",
        "gain": {"method": "riccati", "Q": [1.0, 0.0], "R": [1.0]},
    },
    "initial": {"spread": {"position": 0.5}},
    "simulation": {"horizon": 2.0, "dt": 0.05},
}
GIVEN = {"law": "consensus", "gain": {"method": "given", "P": "identity"}}
BOTH = ("follower.gain.Q", "follower.gain.R")


def carts(**gain):
    follower = CARTS["follower"] | {"gain": CARTS["follower"]["gain"] | gain}
    return ech.scenario_from_mapping(CARTS | {"follower": follower})


@pytest.mark.parametrize("seed", range(3))
def test_slopes_through_the_riccati_equation_are_those_of_differences(seed):
    rng = np.random.default_rng(seed)
    A, B, slope = rng.normal(size=(4, 4)), rng.normal(size=(4, 2)), rng.normal(size=(4, 4))
    Q, R, slope = np.diag(rng.uniform(0.5, 2, 4)), np.diag(rng.uniform(0.5, 2, 2)), slope + slope.T

    def solved(Q, R):
        return scipy.linalg.solve_continuous_are(A, B, Q, R)

    by_Q, by_R = through_riccati(A, B, solved(Q, R), R, slope)
    dQ, dR = (np.diag(rng.normal(size=k)) for k in (4, 2))
    h = 1e-5
    seen = ((solved(Q + h * dQ, R) - solved(Q - h * dQ, R)) * slope).sum() / (2 * h)
    assert (by_Q * dQ).sum() == pytest.approx(seen, rel=1e-6)
    seen = ((solved(Q, R + h * dR) - solved(Q, R - h * dR)) * slope).sum() / (2 * h)
    assert (by_R * dR).sum() == pytest.approx(seen, rel=1e-6)


def test_the_slopes_of_a_search_are_those_of_differences_and_a_weight_of_zero_stays():
    search = _Search(carts(), (*BOTH, "follower.gain.coupling"), cost_named("formation"), None)
    assert len(search.start) == 3 and search.start == pytest.approx(np.log([1.0, 1.0, 2.618]), 1e-3)
    value, slopes = search.evaluate(search.start)
    assert search.trials[0].values["follower.gain.Q"][1] == 0.0
    for k, slope in enumerate(slopes):
        h = 1e-4 * np.eye(3)[k]
        ends = [search.evaluate(search.start + sign * h)[0] for sign in (1.0, -1.0)]
        assert slope == pytest.approx((ends[0] - ends[1]) / 2e-4, rel=1e-5)
    assert value == pytest.approx(np.log(search.trials[0].cost))


def test_tuning_lowers_the_cost_that_a_run_then_has(tmp_path):
    out, scenario = tmp_path / "gain.json", tmp_path / "carts.yaml"
    scenario.write_text(yaml.safe_dump(CARTS))
    command = ["tune", str(scenario), "--cost", "formation+0.01*effort", "--rounds", "5", "--json"]
    done = CliRunner().invoke(app, [*command, "--out", str(out)])
    assert done.exit_code == 0, done.output
    told = json.loads(done.output)
    assert told["after"]["cost"] < 0.9 * told["before"]["cost"] and len(told["costs"]) > 1
    assert told["after"]["promise"]["promised"]
    # Flown again from the file, by the engine that knows no slopes.
    flown = ech.load_scenario(scenario, [f"follower.gain={{file: {out}}}"])
    sums = ech.simulate(*ech.build(flown)).sums
    cost = (sums.errors[0].sum() + 0.01 * sums.effort.sum()) / sums.steps[0]
    assert cost == pytest.approx(told["after"]["cost"], rel=1e-9)
    # What is there is not replaced.
    again = CliRunner().invoke(app, [*command, "--out", str(out)])
    assert isinstance(again.exception, ech.errors.OutputError)


REFUSED = {
    "another parameter": (
        lambda: ech.tune(carts(), ["follower.gain.r"]),
        r"`params` names `follower.gain.r`, allowed are .* \(did you mean `follower.gain.R`\?\)",
    ),
    "no parameter": (lambda: ech.tune(carts(), []), "`params` is empty"),
    "another method": (
        lambda: ech.tune(ech.scenario_from_mapping(CARTS | {"follower": GIVEN})),
        "the followers have the method `given`, but only weights of `riccati` under the law ",
    ),
    "a full weight": (
        lambda: ech.tune(carts(Q=[[1.0, 0.1], [0.1, 1.0]])),
        "`follower.gain.Q` has off-diagonal entries",
    ),
    "a run that diverges": (
        lambda: ech.tune(
            ech.scenario_from_mapping(CARTS | {"simulation": {"horizon": 4000.0, "dt": 2.0}})
        ),
        "the run diverges with the scenario's own weights",
    ),
    "another cost": (lambda: cost_named("formatio"), "`cost` names `formatio`, .* \\(did you mean"),
    "no number": (lambda: cost_named("x*effort"), "`cost` has the weight `x` for `effort`"),
    "a negative weight": (
        lambda: cost_named("-1*effort"),
        "`cost` has the weight `-1` for `effort`",
    ),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_cannot_be_tuned_is_refused_in_a_sentence(name):
    ask, told = REFUSED[name]
    with pytest.raises(ech.EchelonError, match=told) as refused:
        ask()
    assert str(refused.value).endswith(".")
