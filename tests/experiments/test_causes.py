"""Causes of poor runs: the rules by which one is stated, and causes that were planted."""

import dataclasses
import itertools

import jax.numpy as jnp
import numpy as np
import pytest
from runs import made_up

import echelon as ech
from echelon.agents.references import Circle, Waypoints
from echelon.agents.references.slowed_path import SlowedPath
from echelon.core.numerics import precision
from echelon.experiments.results.role_outcome import (
    Grade,
    RoleOutcome,
    RunOutcome,
    grade_of,
    run_outcome,
)
from echelon.experiments.scenario.build import build
from echelon.experiments.scenario.scenario import scenario_from_mapping
from echelon.experiments.studies import causes as study_of
from echelon.experiments.studies.causes import Effect, causes, effect_of, moved_starts
from echelon.experiments.studies.scenario_changes import (
    candidate_changes,
    other_seed,
    shorter_step,
    without_sections,
)
from echelon.output.reports.causes_report import causes_report
from echelon.simulation.engine.parts import initial_states
from echelon.simulation.engine.prepare import prepare

BASE = {
    "name": "planted",
    "model": {"name": "double-integrator", "parameters": {"dimension": 2}},
    "graph": {"name": "path", "agents": 3},
    "formation": {"name": "line"},
    "reference": {"name": "circle", "radius": 2.0, "rate": 0.5},
    "simulation": {"horizon": 2.0, "dt": 0.05},
}
"""Of a step so long that a run takes 40 of them; its leader starts on its path."""
ARRIVED, BOUNDED = RoleOutcome(Grade.ARRIVED, 0.001), RoleOutcome(Grade.BOUNDED, 0.6)
LOST = RoleOutcome(Grade.LOST, None)


def scenario(**keys):
    return scenario_from_mapping({k: x for k, x in {**BASE, **keys}.items() if x is not None})


# ---- the class of an outcome --------------------------------------------------------------------


@pytest.mark.parametrize(
    ("numbers", "grade"),
    [
        # steady, end, start, extent
        ((0.009, 0.009, 1.0, 2.0), Grade.ARRIVED),
        ((0.009, 0.011, 1.0, 2.0), Grade.BOUNDED),
        ((0.05, 0.05, 0.0, 2.0), Grade.BOUNDED),
        ((0.05, 4.1, 0.0, 2.0), Grade.LOST),
        ((1.0, 3.0, 2.0, 0.0), Grade.BOUNDED),
        ((1.0, np.nan, 2.0, 0.0), Grade.LOST),
    ],
)
def test_the_class_follows_from_four_numbers(numbers, grade):
    assert grade_of(*numbers) is grade


def test_of_a_run_that_diverged_no_number_counts():
    model = ech.models.SingleIntegrator(dimension=1)
    graph = ech.Graph.path(2)
    states = np.zeros((6, 2, 1))
    states[:, 1, 0] = [1.0, 0.5, 0.1, 0.001, 0.001, 0.001]
    assert run_outcome(made_up(states, model, graph)).followers.grade is Grade.ARRIVED
    diverged = made_up(states, model, graph, outcome=ech.Outcome.DIVERGED)
    assert run_outcome(diverged) == RunOutcome(None, LOST)


# ---- what counts --------------------------------------------------------------------------------


def bounded(error):
    return RoleOutcome(Grade.BOUNDED, error)


@pytest.mark.parametrize(
    ("after", "spread", "effect"),
    [
        (ARRIVED, [BOUNDED], Effect.EXPLAINS),
        (BOUNDED, [LOST], Effect.EXPLAINS),
        (LOST, [BOUNDED], Effect.WORSENS),
        (bounded(0.19), [bounded(0.6)], Effect.EXPLAINS),
        (bounded(0.21), [bounded(0.6)], Effect.NONE),
        (bounded(1.8), [bounded(0.6)], Effect.WORSENS),
        # At the edge of a class nothing happens.
        (RoleOutcome(Grade.ARRIVED, 0.0099), [bounded(0.0101)], Effect.NONE),
        # Of those that are lost, no error counts.
        (RoleOutcome(Grade.LOST, 1.0), [RoleOutcome(Grade.LOST, 1e9)], Effect.NONE),
        # Other seeds do as much.
        (ARRIVED, [BOUNDED, ARRIVED], Effect.NONE),
        (bounded(0.1), [bounded(0.6), bounded(0.2)], Effect.NONE),
        (None, [BOUNDED], Effect.NONE),
        (ARRIVED, [None], Effect.NONE),
    ],
)
def test_a_change_counts_beyond_a_class_or_a_factor_of_three_and_beyond_the_spread(
    after, spread, effect
):
    assert effect_of(after, spread) is effect


# ---- the search, on made-up outcomes ------------------------------------------------------------


def searched(monkeypatch, outcomes, seconds=60.0, clock=None, **keys):
    """Return a study whose runs have made-up outcomes of followers, by the changed keys."""

    def outcome(search, keys, placebo=None):
        search._check_time()
        text = " ".join(keys)
        found = [x for name, x in outcomes.items() if all(y in text for y in name.split("+"))]
        made = max(found, key=lambda x: -x.grade, default=BOUNDED) if keys else BOUNDED
        return RunOutcome(None, made)

    if clock is not None:
        monkeypatch.setattr(study_of.time, "monotonic", lambda: next(clock))
    monkeypatch.setattr(study_of._Search, "_outcome", outcome)
    monkeypatch.setattr(study_of, "run_outcome", lambda result: RunOutcome(None, BOUNDED))
    loaded = scenario(**keys)
    return causes(loaded, seconds, not_simulated(loaded))


def not_simulated(loaded):
    """Return a result with the parts of a scenario, whose agents stand still."""
    parts, settings = build(loaded)
    parts = prepare(parts, settings).parts
    result = made_up(np.zeros((2, 3, 4)), parts.model, ech.Graph.path(3))
    return dataclasses.replace(result, parts=parts, settings=settings)


WORLD = {"sensing": {"delay": 0.1}, "actuator": {"lag": 0.1}}


def test_a_part_that_can_be_left_out_is_the_cause_and_a_smaller_gain_helps_too(monkeypatch):
    found = searched(monkeypatch, {"sensing=null": ARRIVED, "follower.gain": ARRIVED}, **WORLD)
    assert [trial.words for trial in found.causes("followers")] == ["exact sensors"]
    text = causes_report(found)
    instead = "followers' error 0.001 m instead of 0.6 m"
    assert f"- Would not have happened with exact sensors: {instead}." in text
    assert f"- Helps too: half the followers' gain; {instead}." in text
    assert "exact sensors (`--set sensing=null`)" in text
    assert found.as_mapping()["causes"] == {"followers": ["exact sensors"]}


def test_where_no_single_change_helps_a_pair_may(monkeypatch):
    found = searched(monkeypatch, {"sensing=null+actuator": ARRIVED}, **WORLD)
    assert [x.words for x in found.causes("followers")] == ["exact sensors and no actuator lag"]
    none = searched(monkeypatch, {}, **WORLD)
    assert none.causes("followers") == []
    assert "- No single cause found for the followers; tried: exact sensors," in causes_report(none)
    pairs = [trial.changes for trial in none.trials if len(trial.changes) == 2]
    assert pairs and all(one.family != other.family for one, other in pairs)


def test_a_pair_with_a_change_that_explains_alone_explains_no_more(monkeypatch):
    # Leaders are explained by exact sensors, followers by nothing but the pair.
    def outcome(search, keys, placebo=None):
        text = " ".join(keys)
        leader = ARRIVED if "sensing=null" in text else BOUNDED
        return RunOutcome(leader, ARRIVED if leader is ARRIVED and "actuator" in text else BOUNDED)

    monkeypatch.setattr(study_of._Search, "_outcome", outcome)
    monkeypatch.setattr(study_of, "run_outcome", lambda result: RunOutcome(BOUNDED, BOUNDED))
    found = causes(scenario(**WORLD), 60.0, not_simulated(scenario(**WORLD)))
    pair = ["exact sensors and no actuator lag"]
    assert named(found) == {"leader": ["exact sensors"], "followers": pair}


def test_what_makes_it_worse_is_told_and_no_remedy(monkeypatch):
    found = searched(monkeypatch, {"sensing=null": LOST}, **WORLD)
    text = causes_report(found)
    assert "- Worse with exact sensors: followers lost instead of 0.6 m." in text
    assert "Remedies" not in text


def test_what_explains_alone_is_no_remedy(monkeypatch):
    found = searched(monkeypatch, {"plant=": ARRIVED}, plant={"parameters": {"drag": 0.5}})
    assert [trial.words for trial in found.causes("followers")] == ["agents equal to the model"]
    assert not any(trial.remedy for trial in found.trials)


def test_a_slower_path_counts_only_beyond_a_longer_horizon(monkeypatch):
    both = searched(monkeypatch, {"horizon": ARRIVED})
    assert [trial.words for trial in both.causes("followers")] == ["twice the horizon"]
    slower = searched(monkeypatch, {"slowdown": ARRIVED})
    assert [trial.words for trial in slower.causes("followers")] == ["a path of half the speed"]


def test_after_its_seconds_it_tells_what_was_not_tried(monkeypatch):
    # One second at each look; six placebos and one change are done by then.
    found = searched(monkeypatch, {}, 7.0, itertools.count(), **WORLD)
    assert [trial.words for trial in found.trials] == ["exact sensors"]
    assert ("no actuator lag", "7 s were over") in found.untried
    assert "- Not tried, since 7 s were over: no actuator lag," in causes_report(found)


def test_of_a_run_that_arrived_nothing_is_looked_for():
    found = causes(scenario(), 0.0, not_simulated(scenario()))
    assert found.poor == () and found.trials == ()
    assert causes_report(found).endswith("- Everybody arrived, so there is no cause to look for.")


# ---- common random numbers ----------------------------------------------------------------------


def test_a_shorter_step_keeps_the_wind_and_all_that_is_rounded_to_steps():
    # 0.47 s are 9.4 steps, which are held for 9.
    loaded = scenario(
        disturbance={"rms": {"velocity": 1.0}, "input_rms": {"ax": 1.0}, "hold": 0.47},
        sensing={"delay": 0.12},
        network={"rate": 10.0},
    )
    halved = loaded.with_(*shorter_step(loaded))
    (parts, settings), (other, finer) = build(loaded), build(halved)
    winds = [
        x.world.disturbance.prepared(x.model, s.dt, s.seed)
        for x, s in ((parts, settings), (other, finer))
    ]
    for step in (0, 8, 9, 20):
        for half in (0, 1):
            same = winds[0].on_state(step, 1), winds[1].on_state(2 * step + half, 1)
            np.testing.assert_array_equal(*same)
            same = winds[0].on_input(step, 1), winds[1].on_input(2 * step + half, 1)
            np.testing.assert_array_equal(*same)
    channels = [
        x.world.network.prepared(s.dt, s.horizon, 0) for x, s in ((parts, settings), (other, finer))
    ]
    assert 2 * channels[0].delay == channels[1].delay and 2 * channels[0].every == channels[1].every
    assert other.world.sensing.delay == pytest.approx(2 * 0.05)


@pytest.mark.parametrize(
    ("keys", "reason"),
    [
        ({"sensing": {"noise": {"position": 0.1}}}, "its measurements would have another noise"),
        (
            {"disturbance": {"rms": {"velocity": 1.0}, "time": 1.0}},
            "its gusts would take another course",
        ),
        ({"network": {"rate": 10.0, "jitter": 0.1}}, "its messages would have other delays"),
        ({"parts": [{"python": "own.py:Own"}]}, "its own parts may count in steps"),
    ],
)
def test_a_shorter_step_is_not_tried_where_draws_would_shift(keys, reason):
    assert shorter_step(scenario(**keys)) == reason


def test_parts_of_your_own_are_left_out_as_a_change():
    own = scenario(parts=[{"python": "own.py:Own"}])
    changes = candidate_changes(own, ech.simulate(*build(scenario())))
    assert ("parts=null",) in [change.keys for change in changes]


def test_another_seed_is_one_of_all_sections():
    loaded = scenario(
        seed=3, disturbance={"rms": {"velocity": 1.0}, "seed": 4}, sensing={"delay": 0.1}
    )
    assert other_seed(loaded, 5) == ("seed=1008", "disturbance.seed=1009")


def test_a_key_does_not_restore_the_section_that_another_change_leaves_out():
    keys = ("simulation.dt=0.1", "sensing.delay=0.5", "sensing=null", "sensing.seed=3", "seed=4")
    assert without_sections(keys) == ("simulation.dt=0.1", "sensing=null", "seed=4")
    assert without_sections(("seed=4", "network.seed=4")) == ("seed=4", "network.seed=4")


def test_starts_are_moved_by_a_billionth_those_of_leaders_with_an_error_too():
    parts = build(scenario(leader={"start_error": {"position": 1.0}})).parts
    before, after = initial_states(parts, 0), initial_states(moved_starts(parts, 0, 1, False), 0)
    assert 0.0 < np.abs(after - before).max() <= 1.0001e-9
    assert (after != before).all()
    single = initial_states(moved_starts(parts, 0, 1, True), 0).astype(np.float32)
    assert (single != before.astype(np.float32)).any()


# ---- a slower path ------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "path", [Circle(radius=2.0), Waypoints([0.0, 1.0, 3.0], [[0, 0, 1], [1, 2, 1], [3, 1, 2]])]
)
def test_a_slowed_path_has_the_same_points_later_and_its_derivatives(path):
    with precision("float64"):
        slow, names = SlowedPath(path, 2.0), ("x", "y")
        rows = np.asarray(slow.derivatives(jnp.asarray(1.4), 3, names))
        own = np.asarray(path.derivatives(jnp.asarray(0.7), 3, names))
        np.testing.assert_allclose(rows, own / 2.0 ** np.arange(4)[:, None], atol=1e-12)
        ends = [end for end, _ in slow.parts(6.0)]
        assert ends == [2.0 * end for end, _ in path.parts(3.0)]
        for _, piece in slow.parts(6.0)[:1]:
            there = piece(jnp.asarray(0.5)), path(jnp.asarray(0.25))
            np.testing.assert_allclose(*there, atol=1e-12)


def test_the_key_slows_a_path_down_but_none_of_states():
    loaded = scenario(reference={"name": "circle", "rate": 0.5, "slowdown": 2.0})
    assert build(loaded).parts.drive.leader.reference.factor == 2.0
    with pytest.raises(ech.core.errors.ReferenceError, match="it is no path in space"):
        SlowedPath(object(), 2.0)


# ---- planted causes -----------------------------------------------------------------------------

LONG = {"simulation": {"horizon": 15.0, "dt": 0.02, "store_every": 10}}


def named(found):
    return {role: [trial.words for trial in found.causes(role)] for role in found.poor}


@pytest.mark.slow
def test_late_sensors_are_the_cause_of_both_errors():
    # From exact starts nothing but rounding would grow.
    starts = {"spread": {"position": 0.3}}
    found = causes(scenario(**LONG, initial=starts, sensing={"delay": 0.5}), 600.0)
    assert named(found) == {"leader": ["exact sensors"], "followers": ["exact sensors"]}


@pytest.mark.slow
def test_wind_is_the_cause_and_no_remedy():
    found = causes(scenario(**LONG, disturbance={"constant": {"vx": 0.5}}), 600.0)
    assert found.poor and set(map(tuple, named(found).values())) == {("no disturbance",)}
    wind = next(trial for trial in found.trials if trial.words == "no disturbance")
    assert not wind.remedy


@pytest.mark.slow
def test_a_stiff_model_needs_substeps():
    A = [[0, 1, 0], [0, -20, 400], [0, -50, -5000]]
    model = {"A": A, "B": [[0], [0], [100]], "names": ["angle", "rate", "current"]}
    found = causes(
        scenario_from_mapping(
            {
                "name": "stiff",
                "model": {"name": "linear", "parameters": model},
                "graph": {"name": "path", "agents": 3},
                "initial": {"spread": {"angle": 1.0}},
                "simulation": {"horizon": 12.0, "dt": 0.01, "store_every": 10},
            }
        ),
        600.0,
    )
    # 5000 1/s times 0.01 s over 2.785, the limit of the method, are 18 substeps.
    assert named(found) == {"followers": ["32 substeps"]}


@pytest.mark.slow
def test_single_precision_far_away_is_a_cause():
    path = {"name": "circle", "center": [5e6, 0.0, 0.0], "radius": 2.0, "rate": 0.5}
    single = {"simulation": {**LONG["simulation"], "precision": "float32"}}
    found = causes(scenario(**single, reference=path), 600.0)
    assert set(map(tuple, named(found).values())) == {("float64",)}


@pytest.mark.slow
def test_a_formation_without_the_leaders_input_lags_and_its_leader_does_not():
    found = causes(scenario(**LONG, follower={"feedforward": "none"}), 600.0)
    assert named(found) == {"followers": ["the leader's input relayed"]}


@pytest.mark.slow
def test_late_sensors_and_slow_actuators_are_a_pair_where_neither_alone_is_the_cause():
    # By the characteristic equation s^2 (1 + 4 s) + 6.85 (1.732 s + 1) exp(-0.5 s) = 0 errors grow
    # at 0.64 1/s; at 0.15 1/s with the lag alone, at 2.1 1/s with the delay alone.
    found = causes(
        scenario(
            simulation={"horizon": 60.0, "dt": 0.05, "store_every": 20},
            initial={"spread": {"position": 0.3}},
            sensing={"delay": 0.5},
            actuator={"lag": 4.0},
        ),
        600.0,
    )
    pair = "exact sensors and no actuator lag"
    assert [trial.words for trial in found.causes("followers")] == [pair]
