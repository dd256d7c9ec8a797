"""Comparisons of methods: equal conditions except for the law, and correct reports."""

import json
from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
import pytest

import echelon as ech
from echelon.experiments.results import run_numbers
from echelon.experiments.results.metrics import RunNumbers
from echelon.experiments.studies.compare import Comparison, ComparisonRow
from echelon.output.reports.comparison_report import comparison_mapping, comparison_report, verdict
from echelon.output.reports.glossary import glossary

LAWS = ("literal", "riccati-relay", "riccati", "inner-loop")
SHORT = ["simulation.horizon=1.0"]
LITERAL = "{gain: {method: given, P: identity}, feedforward: none, trim: false}"


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
    assert (planar.steady_window, planar.horizon) == (pytest.approx(0.2), 1.0)
    for width in (40, 60, 200):  # labels are whole however narrow the output is
        text = comparison_report(planar, width)
        assert all(f"\n {label} " in text or f"\n{label} " in text for label in LAWS)


@pytest.mark.parametrize(
    ("label", "changes"),
    [
        ("riccati-relay", ""),
        ("riccati", "follower.feedforward=none"),
        ("inner-loop", "follower.gain.method=inner-loop"),
        (
            "literal",
            "follower={gain: {method: given, P: identity}, feedforward: none, trim: false}",
        ),
    ],
)
def test_each_row_is_the_run_that_its_label_names(planar, label, changes):
    alone = ech.run(ech.load_scenario("planar-quadrotor", [*SHORT, *filter(None, [changes])]))
    # The same numbers but for the compiler's order of operations.
    np.testing.assert_allclose(flown(planar)[label].states, alone.states, rtol=1e-9, atol=1e-9)


def test_the_paragraph_names_the_row_with_the_least_number(planar):
    text = " ".join(verdict(planar))
    whole = {row.label: row.number("worst_rmse") for row in planar.rows}
    best = min(whole, key=whole.__getitem__)
    assert f"{best} has the smallest error over the whole run" in text
    assert "do not bring every follower within 1 cm" in text


def row_of(label, settles, effort, computing, unit="m"):
    """A method of one follower, with the numbers that the paragraph reads."""
    follower = run_numbers.FollowerMetrics(1, 0.1, 0.1, settles, effort, 0.0)
    leader = run_numbers.LeaderMetrics(None, None, {})
    numbers = run_numbers.Metrics((leader,), (follower,), (), None, 0.0, 1.0)
    run = SimpleNamespace(length_unit=unit)
    return ComparisonRow(label, RunNumbers(run, numbers, None, computing))


def said_of(*rows):
    return " ".join(verdict(Comparison("mine", rows, 5.0, 1.0, ())))


def test_what_is_said_of_those_that_settle_is_said_to_be_of_them():
    slow, a, b = (
        row_of("slow", None, 1.0, 1e-3),
        row_of("a", 2.0, 5.0, 2e-3),
        row_of("b", 3.0, 6.0, 9e-3),
    )
    text = said_of(slow, a, b)
    assert "Of those that settle, a has the smallest effort (5; next b, 6)." in text
    assert "Of those that settle, a takes the least computing time, b 4 times as much." in text
    text = said_of(a, b)
    assert "Of those" not in text and "a has the smallest effort (5; next b, 6)." in text
    # One that settles is the best of nothing.
    text = said_of(slow, a)
    assert "a settles (2 s)." in text and "Of those" not in text and "effort" not in text


@pytest.mark.parametrize(("unit", "within", "error"), [("m", "1 cm", "0.1 m"), ("", "0.01", "0.1")])
def test_errors_have_metres_where_there_is_a_position_alone(unit, within, error):
    a, b = row_of("a", 2.0, 5.0, 2e-3, unit), row_of("b", None, 6.0, 9e-3, unit)
    text = said_of(a, b)
    assert f"b does not bring every follower within {within}." in text
    assert f"a has the smallest error over the whole run ({error}; next b, 0.1)." in text
    assert said_of(a).startswith(f"a brings every follower within {within}.")


def test_a_number_of_the_table_is_in_every_table_that_it_names(planar, monkeypatch):
    def largest(run):
        return float(np.abs(run.result.states).max())

    column = {"column": "largest\nstate", "shown": run_numbers.Appearance.COMPARISON}
    number = run_numbers.Quantity("largest state", "m", of=largest, **column)
    monkeypatch.setitem(run_numbers.RUN_NUMBERS, "largest_state", number)
    rows = comparison_mapping(planar)["methods"]
    for label, result in flown(planar).items():
        assert rows[label]["largest_state"] == np.abs(result.states).max()
    assert "largest" in comparison_report(planar)
    assert glossary({})["largest_state"] == "largest state, m"


@pytest.mark.parametrize(
    ("changes", "labels"),
    [
        ([], []),
        (["follower.gain={method: inner-loop, coupling: 5.0}"], ["inner-loop-relay"]),
        (["follower.feedforward=parent"], ["riccati-parent"]),
        (["follower.trim=false"], ["riccati-relay, own"]),
    ],
)
def test_the_scenario_s_own_law_is_always_a_row(changes, labels):
    short = ["simulation.horizon=0.02", "report.steady_window=0.01"]
    scenario = ech.load_scenario("planar-quadrotor", [*short, *changes])
    found = ech.compare(scenario, only=("riccati-relay", "inner-loop", "own"))
    assert [row.label for row in found.rows] == ["riccati-relay", "inner-loop", *labels]
    told = comparison_mapping(found)["methods"]
    for row in found.rows:
        result = row.flight.result
        assert (
            told[row.label]["guarantee"]
            == ech.guarantee(result.parts, result.settings).as_mapping()
        )


class Halved(ech.Law):
    """Half of the input of the consensus law, with its gain."""

    gain: ech.Gain | None = None

    def update(self, model, view, memory):
        u = -0.5 * jnp.asarray(self.gain.K(model)) @ view.disagreement
        return model.physical(u), memory


@pytest.mark.slow
def test_the_row_of_a_law_of_ones_own_has_the_name_of_its_class():
    given = {
        "name": "own",
        "model": {"name": "double-integrator"},
        "graph": {"name": "path", "agents": 3},
        "follower": {"law": {"python": f"{__file__}:Halved"}, "gain": {"method": "riccati"}},
        "simulation": {"horizon": 0.1, "dt": 0.01},
    }
    found = ech.compare(ech.scenario_from_mapping(given), only=("stopping-point", "own"))
    assert [row.label for row in found.rows] == ["stopping-point", "Halved"]
    assert "Halved" in comparison_mapping(found)["methods"]
    text = comparison_report(found, 100)
    assert "Halved" in text and "riccati" not in text


@pytest.mark.slow
def test_the_command_writes_numbers_text_runs_and_figures(echelon, here):
    call = ["compare", "planar-quadrotor", "--horizon", "0.5", "--out", "here", "--json"]
    code, out, _ = echelon(*call, "--method", "riccati", "--method", "riccati-relay")
    told = json.loads(out)
    assert code == 0 and told == json.loads((here / "here" / "comparison.json").read_text())
    assert list(told["methods"]) == ["riccati-relay", "riccati"] and told["horizon_s"] == 0.5
    assert (here / "here" / "comparison.txt").read_text().startswith("planar-quadrotor")
    runs, figures = ({x.name for x in (here / "here" / f).iterdir()} for f in ("runs", "figures"))
    assert runs == {"riccati-relay.nc", "riccati.nc"}
    names = ("formation_error", "tracking_error", "approach")
    assert figures == {f"{name}.{kind}" for name in names for kind in ("png", "pdf")}
    # Two scenarios get a folder each.
    call = ["compare", "integrators", "van-der-pol", "--horizon", "0.1", "--no-figures"]
    code, out, _ = echelon(*call, "--method", "riccati", "--out", "both")
    assert code == 0 and "costs" in out
    assert sorted(path.name for path in (here / "both").iterdir()) == ["integrators", "van-der-pol"]


def test_bad_input_is_one_sentence_and_leaves_nothing(echelon, here):
    for arguments, told in {
        ("paper", "--method", "riccati-realy"): "did you mean `riccati-relay`",
        ("paper", "--horizon", "0"): "simulation.horizon",
        ("paper", "paper"): "two scenarios have the name `paper`",
        ("papr",): "no such file exists",
    }.items():
        code, out, err = echelon("compare", *arguments)
        assert (code, out) == (2, "") and told in err and err.count("\n") == 1
        assert not list(here.iterdir())
