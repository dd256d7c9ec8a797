"""The report: its table, and the sentences that say what happened and why."""

import numpy as np
import pytest
from runs import made_up, simulate

import echelon as ech
from echelon.core.statement import Cause, Hypothesis, Statement
from echelon.core.words import Kind, Verdict
from echelon.output.reports.causes import causes


def run(scenario, *changes):
    return ech.run(ech.load_scenario(scenario, list(changes)))


@pytest.fixture(scope="module")
def literal():
    return run("paper-literal")


@pytest.mark.slow
def test_the_table_stands_beside_the_papers():
    text = ech.report(run("paper", "simulation.horizon=6", "report.steady_window=1"))
    for printed in ("0.186", "9.289e-17", "7.692e-17", "5.207e-17", "0.0302", "0.018"):
        assert printed in text
    assert "multiples of 2^-53" in text
    assert text.count("follower ") >= 3 and "within 1 cm" in text


def test_the_literal_law_names_its_cause(literal):
    text = " ".join(ech.report(literal).split())
    assert "The formation error grows: 1.16 m at the start, " in text
    assert (
        "Cause: no input feels 8 of 12 directions of disagreement, and along `x`, `y`, `z`, `yaw` "
        "it does not decay by itself; choose another P." in text
    )
    assert "Cause: the law leaves out the trim input; set `follower.trim: true`." in text
    assert "Warning" not in text and "Assumption 5 fails" in text


@pytest.mark.study
def test_the_lag_without_feed_forward_is_told():
    text = " ".join(
        ech.report(run("paper", "follower.feedforward=none", "simulation.horizon=20")).split()
    )
    assert "do not know the leader's motion and lag: 0.0" in text
    assert "`feedforward: relay` removes the lag" in text
    assert "Information used by each follower: neighbours' states." in text


def test_a_broken_symmetry_warns_and_names_the_agent():
    model, graph = ech.models.Linear([[-1.0]], [[1.0]]), ech.Graph.path(2)
    result = simulate(
        model,
        graph,
        ech.Formation.from_offsets(model, graph, {1: [-1.0]}),
        leader=ech.laws.TrimInput(),
        follower=ech.laws.Consensus(
            ech.synthesize(model, graph, ech.gains.FixedGain("identity")), "none"
        ),
        horizon=20.0,
        dt=0.01,
    )
    text = " ".join(ech.report(result).split())
    assert (
        "Warning: the offset of agent 1 is no symmetry of `Linear`: it changes the drift of `x1` "
        "by up to 1, so the agents settle off their goals." in text
    )


def test_the_unicycles_relay_is_told_to_the_reader():
    text = " ".join(ech.report(run("unicycle", "simulation.horizon=1")).split())
    assert "follower: neighbours' states; the leader's input of the same step." in text


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


# ---- every cause ends in what to do ----


def told(*changes, scenario="paper"):
    """The causes of a short run, each as text and remedy."""
    quick = ["simulation.horizon=2", "report.steady_window=0.5"]
    result = run(scenario, *quick, *changes)
    found = ech.promise(result.parts, result.settings)
    return {each.text: each.remedy for each in causes(result, ech.metrics(result), found)}


def test_a_horizon_shorter_than_the_slowest_mode_is_told():
    found = told("graph={name: path, agents: 12}", "formation={name: line}", scenario="integrators")
    [(text, remedy)] = found.items()
    assert "the slowest mode takes" in text and "the horizon is 2 s" in text
    assert "`simulation.horizon`" in remedy and "`echelon design`" in remedy
    # The angles of pendulums have no metres.
    starts = "initial.spread={angle: 0.1}", "leader.start_error={angle: 0.1}"
    [text] = told("model={name: pendulum}", *starts, scenario="van-der-pol")
    assert "s from 1 to 0.01, and the horizon is 2 s" in text


@pytest.mark.study
def test_a_leader_that_a_heavier_plant_holds_off_its_path_is_told():
    found = told("plant.scale.mass=1.1", "simulation.horizon=20", scenario="planar-quadrotor")
    [text] = [each for each in found if "the leader has a steady error" in each]
    assert "no law has integral action" in text and "`leader.gain`" in found[text]


def test_no_failing_line_and_no_cause_is_without_a_remedy():
    with pytest.raises(AssertionError, match="fails without a remedy"):
        Statement(Hypothesis.SAMPLING, Verdict.FAILS, Kind.PROOF)
    with pytest.raises(TypeError):
        Cause("it fails")


def test_wind_is_not_blamed_where_the_loop_grows_by_itself():
    wind = "disturbance={rms: {position: 0.01}}"
    told = [
        ech.report(ech.simulate(*ech.build(ech.load_scenario("integrators", [wind, *more]))))
        for more in ([], ["simulation.dt=1.0", "simulation.horizon=20"])
    ]
    assert "as expected under a disturbance" in told[0]
    assert "`dt` is too long for an input" in told[1] and "as expected" not in told[1]


def cut_off(span):
    """Return the causes in the report of carts in a line whose last one is cut off for a time."""
    cart, graph = ech.models.DoubleIntegrator(), ech.Graph.path(4)
    places = ech.Formation.from_offsets(cart, graph, {k: [float(k), 0.0] for k in (1, 2, 3)})
    events = [ech.network.Cut((2, 3), at=0.5, duration=span)]
    gain = ech.synthesize(cart, graph, ech.gains.Riccati())
    laws = ech.Laws(ech.laws.TrimInput(), ech.laws.Consensus(gain))
    parts = ech.Parts(cart, graph, places, laws, {"position": 0.5}, events=events)
    result = ech.simulate(parts, ech.Settings(horizon=5.0, dt=0.01))
    return [line for line in ech.report(result).split("- ") if line.startswith("Cause: ")]


def test_an_agent_that_nobody_sent_anything_is_named_with_the_times():
    first = " ".join(cut_off(4.0)[0].split())
    assert first == (
        "Cause: agent 3 received nothing from 0.5 s to 4.5 s, since no link led to it; give it "
        "another link at that time, or use the law `stopping-point`, under which an agent alone "
        "remains stable."
    )


def test_a_short_silence_without_harm_and_an_agent_that_is_heard_are_no_cause():
    assert not any("received nothing" in cause for cause in cut_off(0.05))


def test_a_mode_that_does_not_decay_is_a_cause_in_words():
    told = cut_off(4.0)
    assert any("not every mode decays, over " in " ".join(cause.split()) for cause in told)
