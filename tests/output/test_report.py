"""The report: its table, and the sentences that say what happened and why."""

import re

import numpy as np
import pytest
from runs import made_up, simulate

import echelon as ech
from echelon.core.statement import Cause, Hypothesis, Statement
from echelon.core.words import Kind, Verdict
from echelon.output.reports.run_report import observations


def run(scenario, *changes):
    return ech.run(ech.load_scenario(scenario, list(changes)))


@pytest.fixture(scope="module")
def literal():
    law = "{law: consensus, gain: {method: given, P: identity}, feedforward: none, trim: false}"
    free = ["simulation.horizon=10", "simulation.limits=false", "report.steady_window=2"]
    return run("paper", *free, f"follower={law}")


@pytest.mark.slow
def test_the_table_stands_beside_the_papers(literal):
    text = ech.report(literal)
    for printed in ("0.186", "9.289e-17", "7.692e-17", "5.207e-17", "0.0302", "0.018"):
        assert printed in text
    assert "multiples of 2^-53" in text and "over all 2000 steps" in text
    assert text.count("follower ") >= 3 and "within 1 cm" in text
    # Of the 10 s nothing is said from a shorter run.
    text = ech.report(run("paper", "simulation.horizon=0.1", "report.steady_window=0.1"))
    assert "0.186" not in text and "which is of 10 s: the run ends at 0.1 s." in text


@pytest.mark.slow
def test_of_the_printed_example_as_a_whole_the_report_says_when_it_leaves_floats():
    text = " ".join(ech.report(run("paper-literal")).split())
    assert "The state of follower 1 stopped being finite by t = 0.6 s." in text
    assert (
        "Nothing is beside the paper's Table II, which is of 10 s: the run ends at 0.5 s." in text
    )


def test_the_literal_law_grows_and_no_cause_is_guessed(literal):
    text = " ".join(ech.report(literal).split())
    assert "The formation error grows: 1.16 m at the start, " in text
    assert "Not guaranteed since " in text and "the law leaves out the trim input" in text
    assert "Warning" not in text and "Cause" not in text


def test_a_broken_symmetry_warns_and_names_the_agent():
    model, graph = ech.models.Linear([[-1.0]], [[1.0]]), ech.Graph.path(2)
    gain = ech.synthesize(model, graph, ech.gains.FixedGain("identity"))
    laws = {"leader": ech.laws.TrimInput(), "follower": ech.laws.Consensus(gain, "none")}
    away = ech.Formation.from_offsets(model, graph, {1: [-1.0]})
    result = simulate(model, graph, away, **laws, horizon=20.0, dt=0.01)
    warning = "Warning: the offset of agent 1 is no symmetry of `Linear`: it changes the drift of "
    warning += "`x1` by up to 1, so the agents settle off their goals."
    assert warning in " ".join(ech.report(result).split())


@pytest.mark.parametrize("followers", [13, 14])
def test_of_many_followers_the_best_the_worst_and_one_in_the_middle_are_shown(followers):
    model, graph = ech.models.SingleIntegrator(1), ech.Graph.star(followers + 1)
    order = np.random.default_rng(0).permutation(followers) + 1
    errors = np.zeros((followers + 1, 1))
    errors[order, 0] = 0.01 * np.arange(1, followers + 1)
    states = np.broadcast_to(errors, (4, followers + 1, 1))
    text = " ".join(ech.report(made_up(states, model, graph, window=2.0)).split())
    middle = {order[(followers - 1) // 2], order[followers // 2]}
    assert f"best (follower {order[0]})" in text and f"worst (follower {order[-1]})" in text
    assert any(f"median (follower {k})" in text for k in middle)


def told(*changes, scenario="paper"):
    """What was observed of a short run."""
    quick = ["simulation.horizon=2", "report.steady_window=0.5"]
    result = run(scenario, *quick, *changes)
    found = ech.guarantee(result.parts, result.settings)
    return [*observations(result, ech.metrics(result), found)]


def test_a_horizon_shorter_than_the_slowest_mode_is_told():
    [text] = told(
        "graph={name: path, agents: 12}", "formation={name: line}", scenario="integrators"
    )
    assert text.startswith("The slowest mode takes ")
    assert text.endswith(" s from 1 m to 1 cm, and the horizon is 2 s.")
    # The angles of pendulums have no metres.
    starts = "initial.spread={angle: 0.1}", "leader.start_error={angle: 0.1}"
    [text] = told("model={name: pendulum}", *starts, scenario="van-der-pol")
    assert "s from 1 to 0.01, and the horizon is 2 s" in text


LATE = {
    "model": {"name": "double-integrator", "parameters": {"dimension": 2}},
    "graph": {"name": "path", "agents": 3},
    "reference": {"name": "circle", "radius": 2.0, "rate": 1.0},
    "simulation": {"horizon": 10.0, "dt": 0.01, "store_every": 10},
}


def test_the_steady_error_of_a_leader_that_measures_late_names_no_cause():
    # Only the late measurement holds it off: without, the error is below 1 cm.
    late = ech.run(ech.scenario_from_mapping({"name": "late", **LATE, "sensing": {"delay": 0.5}}))
    exact = ech.run(ech.scenario_from_mapping({"name": "exact", **LATE}))
    steady, least = (ech.metrics(each).leader.steady_rmse for each in (late, exact))
    assert steady > 0.05 > 0.01 > least
    text = " ".join(ech.report(late).split())
    assert f"The leader has a steady error of {steady:.3g} m from its reference." in text
    for guess in ("Cause", "integral action", "stronger", "plant's parameters"):
        assert guess not in text


def test_no_failing_line_and_no_cause_is_without_a_remedy():
    with pytest.raises(AssertionError, match="fails without a remedy"):
        Statement(Hypothesis.SAMPLING, Verdict.FAILS, Kind.PROOF)
    with pytest.raises(TypeError):
        Cause("it fails")


def test_an_increase_of_v_names_no_cause():
    wind = "disturbance={rms: {position: 0.01}}"
    for more in ([], ["simulation.dt=1.0", "simulation.horizon=20"]):
        result = ech.simulate(*ech.build(ech.load_scenario("integrators", [wind, *more])))
        text = " ".join(ech.report(result).split())
        assert re.search(r"V increased in \d+ of \d+ frames\.", text)


def cut_off(span):
    """Return what the report says of the links of carts whose last one is cut off for a time."""
    cart, graph = ech.models.DoubleIntegrator(), ech.Graph.path(4)
    places = ech.Formation.from_offsets(cart, graph, {k: [float(k), 0.0] for k in (1, 2, 3)})
    events = [ech.network.Cut((2, 3), at=0.5, duration=span)]
    gain = ech.synthesize(cart, graph, ech.gains.Riccati())
    laws = ech.Laws(ech.laws.TrimInput(), ech.laws.Consensus(gain))
    parts = ech.Parts(cart, graph, places, laws, {"position": 0.5}, events=events)
    result = ech.simulate(parts, ech.Settings(horizon=5.0, dt=0.01))
    return [line for line in ech.report(result).split("- ") if "received nothing" in line]


def test_an_agent_that_nobody_sent_anything_for_long_is_named_with_the_times():
    first = " ".join(cut_off(4.0)[0].split())
    assert first == (
        "Agent 3 received nothing from 0.5 s to 4.5 s, since no link led to it, and its error grew."
    )
    assert not cut_off(0.05)
