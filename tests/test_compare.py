"""The comparison of methods: alike in all but the law, and told truly."""

import json
import os
import subprocess
import sys

import numpy as np
import pytest

import echelon as ech
from echelon.cli.app import app
from echelon.reports.comparison import comparison_report, verdict
from echelon.studies.compare import LABELS, Comparison

LAWS = ("literal", "riccati-relay", "riccati", "inner-loop")
SHORT = ["simulation.horizon=1.0"]


@pytest.fixture(scope="module")
def planar() -> Comparison:
    return ech.compare(ech.load_scenario("planar-quadrotor", SHORT), only=LAWS)


def flown(comparison):
    return {row.label: row.flight.result for row in comparison.rows if row.flight is not None}


def test_all_start_alike_and_have_the_same_limits(planar):
    runs = list(flown(planar).values())
    assert len(runs) == len(LAWS)
    for run in runs[1:]:
        np.testing.assert_array_equal(run.states[0], runs[0].states[0])
        assert run.settings == runs[0].settings


@pytest.mark.parametrize(
    ("label", "changes"),
    [
        ("riccati-relay", []),
        ("riccati", ["follower.feedforward=none"]),
        ("inner-loop", ["follower.gain.method=inner-loop"]),
        (
            "literal",
            [
                "follower.gain={method: given, P: identity}",
                "follower.feedforward=none",
                "follower.trim=false",
            ],
        ),
    ],
)
def test_each_row_is_the_run_that_its_label_names(planar, label, changes):
    alone = ech.run(ech.load_scenario("planar-quadrotor", [*SHORT, *changes]))
    # The same numbers but for the compiler's order of operations.
    np.testing.assert_allclose(flown(planar)[label].states, alone.states, rtol=1e-9, atol=1e-9)


def test_the_steady_window_is_shorter_than_the_run(planar):
    assert planar.steady_window == pytest.approx(0.2)
    assert planar.horizon == 1.0


def test_the_paragraph_names_the_row_with_the_least_number(planar):
    text = " ".join(verdict(planar))
    whole = {row.label: row.whole for row in planar.rows}
    best = min(whole, key=whole.__getitem__)
    assert f"{best} has the smallest error over the whole run" in text
    assert "do not bring every follower within 1 cm" in text


def test_a_law_of_ones_own_flies_beside_the_methods():
    given = {
        "name": "pendulums",
        "model": {"name": "pendulum"},
        "graph": {"name": "path", "agents": 3},
        "follower": {
            "gain": {"method": "monotone", "domain": {"angle": 0.5}},
            "feedforward": "relay",
        },
        "initial": {"spread": {"angle": 0.2}},
        "simulation": {"horizon": 0.5, "dt": 0.01},
    }
    found = ech.compare(ech.scenario_from_mapping(given))
    assert [row.label for row in found.rows] == [*LABELS, "monotone-relay"]
    reasons = {row.label: row.reason for row in found.rows if row.flight is None}
    assert "inner-loop" in reasons
    assert all(reason.endswith(".") for reason in reasons.values())


def test_labels_are_whole_however_narrow_the_output_is(planar):
    for width in (40, 60, 200):
        text = comparison_report(planar, width)
        for label in LAWS:
            assert f"\n {label} " in text or f"\n{label} " in text


def test_the_command_writes_numbers_text_runs_and_figures(tmp_path, capsys):
    out = tmp_path / "here"
    arguments = ["compare", "planar-quadrotor", "--horizon", "0.5", "--out", str(out), "--json"]
    for label in ("riccati", "riccati-relay"):
        arguments += ["--method", label]
    app(arguments, standalone_mode=False)
    told = json.loads(capsys.readouterr().out)
    assert told == json.loads((out / "comparison.json").read_text())
    assert list(told["methods"]) == ["riccati-relay", "riccati"]
    assert told["horizon_s"] == 0.5
    assert (out / "comparison.txt").read_text().startswith("planar-quadrotor")
    assert {path.name for path in (out / "runs").iterdir()} == {"riccati-relay.nc", "riccati.nc"}
    names = ("formation_error", "tracking_error", "approach")
    assert {path.name for path in (out / "figures").iterdir()} == {
        f"{name}.{kind}" for name in names for kind in ("png", "pdf")
    }


def test_two_scenarios_get_a_folder_each(tmp_path, capsys):
    out = tmp_path / "both"
    arguments = ["compare", "integrators", "van-der-pol", "--horizon", "0.1", "--no-figures"]
    app([*arguments, "--method", "riccati", "--out", str(out)], standalone_mode=False)
    assert sorted(path.name for path in out.iterdir()) == ["integrators", "van-der-pol"]
    assert "what it takes" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (["compare", "paper", "--method", "riccati-realy"], "did you mean `riccati-relay`"),
        (["compare", "paper", "--horizon", "0"], "simulation.horizon"),
        (["compare", "paper", "paper"], "two scenarios have the name `paper`"),
        (["compare", "papr"], "no such file exists"),
    ],
)
def test_bad_input_is_one_sentence_and_leaves_nothing(tmp_path, arguments, told):
    environment = {**os.environ, "JAX_PLATFORMS": "cpu"}
    done = subprocess.run(
        [sys.executable, "-m", "echelon", *arguments],
        capture_output=True,
        text=True,
        cwd=tmp_path,
        env=environment,
    )
    assert done.returncode == 2
    assert told in done.stderr
    assert "Traceback" not in done.stderr
    assert not list(tmp_path.iterdir())
