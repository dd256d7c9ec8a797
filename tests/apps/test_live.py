"""The live loop: it equals the loop of a run, its controls are scenario keys, the page shows it."""

import copy
import dataclasses
import itertools
import json
import threading
import urllib.error
import urllib.request

import numpy as np
import pytest
from browser import chromium, opened, until
from recordings import recorded

import echelon as ech
from echelon.agents.network.channel import NEVER
from echelon.apps.live import guarantee_status
from echelon.apps.live import server as served
from echelon.apps.live import swarm as looked
from echelon.apps.live.attendance import as_changes
from echelon.apps.live.guarantee_status import GuaranteeStatus, Promiser, badge_of, first_look
from echelon.apps.live.panel import Panel
from echelon.apps.live.server import live, live_page
from echelon.apps.live.session import Session
from echelon.apps.live.swarm import LiveLoop, Picture
from echelon.core.digits import at_least
from echelon.core.errors import SimulationError
from echelon.experiments.results.lyapunov import lyapunov
from echelon.experiments.scenario.build import build
from echelon.experiments.scenario.scenario import scenario_from_mapping
from echelon.experiments.scenario.yaml import dump_yaml, read_yaml
from echelon.output.viewer.replay import link_shades
from echelon.simulation.native import kernel_cache
from echelon.simulation.step import sequence

GIVEN = {
    "name": "own",
    "model": {"name": "double-integrator", "parameters": {"dimension": 2}},
    "graph": {"edges": [[0, 1], [1, 2], [1, 3], [0, 3]], "leaders": [0]},
    "formation": {"offsets": {1: [1, 0], 2: [1, 1], 3: [0, 1]}},
    "reference": {"name": "circle", "radius": 1.0, "rate": 0.5},
    "follower": {"law": "consensus", "gain": {"method": "riccati"}},
    "initial": {"spread": {"position": 0.5}},
    "simulation": {"horizon": 0.4, "dt": 0.01, "store_every": 4, "engine": "jax"},
}


def scenario(**changes):
    return scenario_from_mapping(copy.deepcopy(GIVEN) | changes)


@pytest.fixture(scope="module")
def panel():
    own = scenario()
    return Panel(own, build(own))


@pytest.fixture(scope="module")
def swarm(panel):
    return LiveLoop(*panel.experiment, panel.live)


@pytest.fixture(scope="module")
def native(panel):
    parts, settings = panel.experiment
    made = LiveLoop(parts, settings._replace(engine="native"), panel.live)
    assert (made.engine, LiveLoop(parts, settings, panel.live).engine) == ("native", "jax")
    return made


@pytest.fixture
def session(panel, swarm):
    swarm.apply(panel.start)
    swarm.restart()
    made = Session(panel.scenario, panel, swarm)
    yield made
    made.promiser.end()


def flown(swarm, pictures=10):
    swarm.restart()
    return np.stack([swarm.advance().states for _ in range(pictures)])


def test_a_live_loop_is_the_loop_of_a_run_and_tells_its_v(panel, swarm, native):
    whole = ech.run(panel.scenario)
    for each in (swarm, native):
        each.apply(panel.start)
        np.testing.assert_allclose(flown(each), whole.states[1:], atol=1e-12)
    assert swarm.advance(still=True).lyapunov == pytest.approx(lyapunov(whole).value[-1], rel=1e-9)


@pytest.mark.study
def test_a_law_that_remembers_and_signals_is_live_too():
    own = ech.load_scenario("paper-global", ["simulation.horizon=0.4", "simulation.engine=jax"])
    found = Panel(own, build(own))
    swarm, wanted = LiveLoop(*found.experiment, found.live), ech.run(own).states
    shown = flown(swarm, 10)
    # Pictures are 8 steps apart, stored frames 10.
    np.testing.assert_allclose(shown[4], wanted[4], atol=1e-9)
    np.testing.assert_allclose(shown[9], wanted[8], atol=1e-9)
    assert found.start.coupling == pytest.approx(ech.run(own).drive.follower.strength(0.005))


IMPERFECT = {
    "network": {"rate": 25.0, "delay": 0.01, "loss": 0.2, "forget": 0.3},
    "disturbance": {"rms": {"velocity": 0.3}, "time": 0.5},
    "actuator": {"lag": 0.05},
    "sensing": {"noise": {"position": 0.01}},
}


@pytest.mark.slow
def test_radio_and_noise_are_knobs_in_gusts_and_with_motors_that_lag():
    own = scenario(**IMPERFECT)
    panel = Panel(own, build(own))
    swarm = LiveLoop(*panel.experiment, panel.live)
    assert {"delay", "loss", "outages", "noise"} <= {*panel.ranges}
    knobs = panel.start._replace(delay=0.06, loss=0.5, outages=0.2, noise=3.0)
    parts, settings = build(panel.scenario_at(knobs))
    run = ech.simulate(parts.replace(initial=swarm.states, start_error={}), settings)
    swarm.apply(knobs)
    np.testing.assert_allclose(flown(swarm), run.states[1:], atol=1e-11)
    # A link is as fresh as its oldest message, but for what arrives at the frame itself.
    traffic, heard = run.traffic, run.parts.receives
    fresh = link_shades(traffic.ages[-1], np.zeros(heard.shape), 0.3, heard)
    shades = swarm.advance(still=True).shades
    assert shades.shape == (4,) and (shades <= fresh + 1e-9).all() and shades.max() > 0.0


def shown(session, pictures=10):
    """The states after each of some pictures, in which what was asked happens."""
    return np.stack(
        [(session.settle(), session.swarm.advance())[1].states for _ in range(pictures)]
    )


@pytest.mark.slow
def test_who_is_lost_or_joins_live_does_so_as_in_a_run(session):
    before = shown(session, 3)
    session.ask({"name": "lose", "value": 3})
    lost = shown(session, 3)
    assert session.swarm.here.tolist() == [True, True, True, False]
    session.ask({"name": "join", "value": 3})
    joined = shown(session, 3)
    events = [{"at": 0.12, "lose": 3}, {"at": 0.24, "join": 3}]
    whole = ech.run(scenario(events=events))
    seen = np.concatenate([before, lost, joined])
    # The frame of a run at the time of an arrival is after it.
    seen[5, 3] = whole.states[6, 3]
    np.testing.assert_allclose(seen, whole.states[1:10], atol=1e-12)
    saved = read_yaml(session.ask({"name": "save"})["text"], "saved").data["live"]
    assert saved == events
    badge = badge_of(session.panel, session.knobs)
    assert badge["state"] == "lost" and "agent 3 joins at 0.24 s" in badge["whole"]
    session.ask({"name": "reset"})
    session.settle()
    assert session.swarm.here.all() and not session.knobs.events


@pytest.mark.slow
def test_a_reshape_live_is_that_of_a_run(session):
    """And a formation that moves in the scenario does so live."""
    before = shown(session, 2)
    session.ask({"name": "reshape", "value": "line"})
    fault = session.ask({"name": "reshape", "value": "star"})["fault"]
    assert fault.startswith("there is no shape `star` here")
    during = shown(session, 4)
    own = session.panel.scenario_at(session.knobs)
    assert own.formation.motion[0].at == pytest.approx(0.08)
    whole = ech.run(own.with_(simulation__horizon=0.24))
    np.testing.assert_allclose(np.concatenate([before, during]), whole.states[1:], atol=1e-12)
    live = LiveLoop(*build(own), Panel(own, build(own)).live)
    np.testing.assert_allclose(flown(live, 6), whole.states[1:], atol=1e-12)
    assert "lasts until 3.08 s" in session.ask({"name": "reshape", "value": "wedge"})["fault"]
    assert session.state()["moments"] == [(0.08, "the shape becomes line")]
    shown(session, 72)
    assert session.knobs.shape == "line" and session.knobs.reshaping is None
    picture = session.swarm.advance()
    np.testing.assert_array_equal(picture.offsets, session.panel.live.offsets(session.knobs))
    session.ask({"name": "reset"})
    session.settle()


def test_a_leader_that_has_lost_all_others_goes_on_alone(session):
    for agent in (3, 2, 1):
        session.ask({"name": "lose", "value": agent})
        session.settle()
    picture = session.swarm.advance()
    session.show(picture)
    assert picture.here.tolist() == [True, False, False, False]
    assert np.isnan(np.frombuffer(session.picture[16:], "<f4")[:2]).all()


def test_events_of_a_scenario_are_changes_of_a_live_loop():
    events = [
        {"at": 2.0, "cut": [0, 1], "for": 1.5},
        {"at": 3.0, "join": 2},
        {"at": 1.0, "lose": 1},
    ]
    assert sorted(as_changes(events), key=lambda change: change["at"]) == [
        {"at": 0.0, "lose": 2},
        {"at": 1.0, "lose": 1},
        {"at": 2.0, "cut": [0, 1]},
        {"at": 3.0, "join": 2},
        {"at": 3.5, "restore": [0, 1]},
    ]


def test_nonsense_is_refused_in_a_sentence_and_a_knob_is_clamped(session):
    for name, agent, sentence in (
        (
            "lose",
            0,
            "agent 0 is lost, and nobody leads afterwards; name `backups` in `leadership`.",
        ),
        ("join", 2, "agent 2 cannot join, since it is there."),
        ("lose", 99, "`lose` got `99`, and must be the number of an agent."),
    ):
        assert session.ask({"name": name, "value": agent}) == {"fault": sentence}
    assert session.ask({"name": "size", "value": 1e9}) == {"size": 3.0}
    said = json.loads(session.messages[-1][4:])["note"]
    assert said == "`size` got 1e+09, must be from 0.3 to 3, and is now 3."
    assert session.ask({"name": "wind", "value": -1e300}) == {"wind": -3.0}
    for name, value, sentence in (
        ("colour", 1.0, "there is no control `colour`; this scenario has `coupling`"),
        ("turn", "a lot", "`turn` got `a lot`, and must be a number."),
        ("turn", float("nan"), "`turn` got `nan`, and must be a number."),
        ("turn", True, "`turn` got `True`, and must be a number."),
        ("kick", 9, "`kick` got `9`, and must be the number of an agent."),
        ("cut", (0, 2), "`[0, 2]` is no link of the graph."),
        ("cut", 7, "`7` is no link of the graph."),
    ):
        with pytest.raises(SimulationError) as fault:
            session.ask({"name": name, "value": value})
        assert str(fault.value).startswith(sentence)


KNOBS = {
    "loop": {
        **{"coupling": 3.0, "weight": 4.0, "feedforward": 0.0},
        **{"wind": 1.5, "cut": frozenset({3})},
    },
    "places": {"size": 2.0, "turn": 30.0, "shape": "wedge"},
    "method": {"method": "inner-loop", "coupling": 1.0},
}


@pytest.mark.parametrize("name", KNOBS)
def test_knobs_do_what_their_keys_in_the_scenario_do(panel, swarm, native, name):
    """The scenario that `scenario_at` returns is run by the engine from the live loop's start."""
    plain = panel.scenario_at(panel.start)
    for knob, value in KNOBS[name].items():
        assert panel.scenario_at(panel.start._replace(**{knob: value})) != plain
    knobs = panel.start._replace(**KNOBS[name])
    parts, settings = build(panel.scenario_at(knobs))
    wanted = ech.simulate(parts.replace(initial=swarm.states, start_error={}), settings)
    for each in (swarm, native):
        each.apply(knobs)
        np.testing.assert_allclose(flown(each), wanted.states[1:], atol=1e-11)
    V = swarm.advance(still=True).lyapunov
    assert V == pytest.approx(lyapunov(wanted).value[-1], rel=1e-9)


def test_no_knob_compiles_anything_again(panel, swarm, native, monkeypatch):
    for each in (swarm, native):
        each.apply(panel.start)
        each.advance()
        traced = []
        monkeypatch.setattr(sequence, "control", lambda *_: traced.append(1))
        monkeypatch.setattr(kernel_cache, "program", lambda *_: traced.append(1))
        for change in [item for changes in KNOBS.values() for item in changes.items()]:
            each.apply(panel.start._replace(**dict([change])))
            each.advance()
        each.kick(1, np.ones(4))
        each.advance(still=True)
        assert traced == []


def test_another_law_takes_over_where_the_agents_are_and_is_the_loop_of_a_run(session, swarm):
    swarm.advance()
    places = np.asarray(swarm.now.states)
    session.ask({"name": "size", "value": 2.0})
    session.ask({"name": "law", "value": "passive"})
    session.settle()
    assert session.swarm is not swarm and session.knobs == session.panel.start._replace(size=2.0)
    np.testing.assert_array_equal(session.swarm.now.states, places)
    assert session.swarm.steps == swarm.steps and "coupling" not in session.panel.ranges
    assert first_look(session.panel, session.knobs)["state"] == "pending"
    assert badge_of(session.panel, session.knobs)["end"] is None
    session.ask({"name": "reset"})
    session.settle()
    parts, settings = build(session.panel.scenario_at(session.knobs))
    wanted = ech.simulate(parts.replace(initial=swarm.states, start_error={}), settings)
    np.testing.assert_allclose(shown(session), wanted.states[1:], atol=1e-11)
    assert session.events[0] == {"at": 0.0, "law": "passive", "size": 2.0}
    told = session.ask({"name": "law", "value": "agreement"})
    assert told["fault"].startswith("follower: the law `agreement` is made for `SingleIntegrator`")
    assert "there is no law `best` here" in session.ask({"name": "law", "value": "best"})["fault"]


SWITCHING = {
    "edges": [[0, 1], [1, 2], [1, 3], [0, 3]],
    "schedule": [{"at": 0.09, "edges": [[0, 3], [2, 3], [1, 2]]}],
    "period": 0.15,
}


@pytest.mark.slow
def test_a_graph_that_switches_is_live_by_its_schedule(monkeypatch):
    own = scenario(graph=SWITCHING)
    panel = Panel(own, build(own))
    # Few periods are foreseen at a time, so that the loop must look ahead again.
    monkeypatch.setattr(looked, "_AHEAD", 0.2)
    swarm = LiveLoop(*panel.experiment, panel.live)
    assert len(swarm.loop.graph.switches.steps) == 10 and panel.live.loop(panel.start) is None
    for knobs in (panel.start, panel.start._replace(cut=frozenset({2}))):
        parts, settings = build(panel.scenario_at(knobs))
        settings = settings._replace(horizon=1.2)
        wanted = ech.simulate(parts.replace(initial=swarm.states, start_error={}), settings)
        swarm.apply(knobs)
        np.testing.assert_allclose(flown(swarm, 30), wanted.states[1:], atol=1e-11)


MUTE = """
import dataclasses
import echelon as ech


class Silence(ech.Channel):
    def post(self, posts, step, content, sends, receivers, senders):
        return super().post(posts, step, content, sends & False, receivers, senders)


@dataclasses.dataclass(frozen=True)
class Mute(ech.WorldPart):
    def member(self, loop):
        return loop.with_medium(Silence(**vars(loop.network.medium)))
"""


LOUD = """
import dataclasses
import numpy as np
import echelon as ech


@dataclasses.dataclass(frozen=True)
class Mute(ech.WorldPart):
    def member(self, loop):
        none = dataclasses.replace(loop.network.medium, loss=np.asarray(1.0))
        return loop.with_medium(none)
"""


@pytest.mark.slow
@pytest.mark.parametrize("code", [MUTE, LOUD], ids=["another medium", "a number of it"])
def test_a_medium_of_your_own_stays_after_a_change_of_the_network(tmp_path, code):
    (tmp_path / "mute.py").write_text(code)
    more = {"network": {"rate": 50, "messages": "state"}, "parts": [{"python": "mute.py:Mute"}]}
    own = scenario_from_mapping(copy.deepcopy(GIVEN) | more, tmp_path)
    panel = Panel(own, build(own))
    swarm = LiveLoop(*panel.experiment, panel.live)
    swarm.apply(panel.start._replace(loss=0.2))
    swarm.advance()
    assert (np.asarray(swarm.now.memory.network[1].stamp) == NEVER).all()


@pytest.mark.parametrize("changes", [{"actuator": {"lag": 0.1}}, {"sensing": {"delay": 0.1}}])
def test_no_first_look_is_at_agents_that_theorems_are_not_about(changes):
    own = scenario(**changes)
    panel = Panel(own, build(own))
    assert panel.live.loop(panel.start) is None
    assert first_look(panel, panel.start)["short"] == "guarantee \u2026"


def test_an_event_of_your_own_does_not_happen_live():
    with pytest.raises(SimulationError, match="the event `far.py:Far` cannot happen live"):
        as_changes([{"at": 1.0, "python": "far.py:Far"}])


def test_a_loop_goes_on_from_the_last_state_of_a_run(swarm):
    whole = ech.run(scenario(simulation=GIVEN["simulation"] | {"horizon": 0.8}))
    names = whole.model.state_names
    parts = (whole.states[:11], whole.inputs[:11], whole.times[:11], whole.offsets)
    first = recorded(*parts, names=names, position=(0, 1))
    session, _ = live(scenario(), first)
    assert session.swarm.advance(still=True).time == pytest.approx(0.4)
    shown = [session.swarm.advance() for _ in range(10)]
    np.testing.assert_allclose([each.states for each in shown], whole.states[11:], atol=1e-11)
    desired = whole.reference[11:] + whole.offsets[0]
    np.testing.assert_allclose([each.reference for each in shown], desired, atol=1e-12)
    away = np.linalg.norm(whole.states[-1, 0, :2] - desired[-1, :2])
    assert session.swarm.off_reference(shown[-1]) == pytest.approx(away, rel=1e-9)
    session.ask({"name": "reset"})
    session.settle()
    assert session.swarm.steps == 40
    assert session.ask({"name": "save"})["fault"].startswith("A scenario begins at 0 s")
    session.promiser.end()
    other = dataclasses.replace(first, states=whole.states[:11, :3])
    with pytest.raises(SimulationError, match="the run has 3 agents, and its scenario 4 agents of"):
        served._continue(swarm, other)


def test_who_was_closest_is_kept_until_a_reset(session, swarm):
    places = []
    for _ in range(5):
        picture = swarm.advance()
        session.show(picture)
        places.append(picture.states[:, :2])
    pairs = list(itertools.combinations(range(4), 2))
    apart = np.array([[np.linalg.norm(p[i] - p[j]) for i, j in pairs] for p in places])
    frame, pair = np.unravel_index(apart.argmin(), apart.shape)
    assert session.closest.agents == pairs[pair]
    numbers = session.closest.distance, session.closest.time
    assert numbers == pytest.approx((apart.min(), 0.04 * (frame + 1)), rel=1e-12)
    near, active = np.frombuffer(session.picture[16:], "<f4")[8:10]
    assert near == pytest.approx(apart[-1].min(), rel=1e-6) and active == 0.0
    session.ask({"name": "reset"})
    session.settle()
    assert session.closest.time == 0.0


def test_a_page_that_comes_before_the_first_picture_is_sent_none(session):
    sent = []

    def send(block):
        sent.append(block)
        session.ended = True

    session.watch(send)
    assert sent and all(len(block) > 4 for block in sent)


def test_another_method_brings_its_gain_and_its_coupling(session):
    session.ask({"name": "method", "value": "inner-loop"})
    session.settle()
    found = build(scenario(follower={"gain": {"method": "inner-loop"}})).parts.drive.gain
    own = session.swarm.loop.laws.follower.gain
    np.testing.assert_array_equal(own.P, found.P)
    np.testing.assert_array_equal(own.inner, found.inner)
    assert session.knobs.coupling == pytest.approx(found.coupling, abs=1e-9)
    with pytest.raises(SimulationError, match="no method `best` here"):
        session.ask({"name": "method", "value": "best"})
    session.ask({"name": "method", "value": "scenario"})
    session.settle()
    assert session.knobs == session.panel.start


def test_the_error_is_the_distance_from_the_goal_of_the_turned_formation(panel, swarm):
    knobs = panel.start._replace(size=2.0, turn=90.0)
    swarm.apply(knobs)
    swarm.restart()
    picture = swarm.advance()
    # Twice as large and a quarter to the left: (1, 0) goes to (0, 2), (1, 1) to (-2, 2).
    goal = picture.states[0, :2] + np.array([-2.0, 2.0])
    away = np.linalg.norm(picture.states[2, :2] - goal)
    assert picture.errors[2] == pytest.approx(away, rel=1e-12)


def test_a_kick_moves_one_agent_and_all_ways_in_turn(session):
    before = session.swarm.advance(still=True).states
    first, second = (session.ask({"name": "kick", "value": 2}) for _ in range(2))
    session.settle()
    moved = session.swarm.advance(still=True).states - before
    np.testing.assert_allclose(moved[2], np.array(first["kick"][2]) + second["kick"][2])
    assert not np.delete(moved, 2, axis=0).any()
    assert np.hypot(*first["kick"][2][2:]) == pytest.approx(2.0, rel=1e-5)
    third = session.ask({"name": "kick", "value": 2})
    assert third["kick"] != first["kick"]


def test_what_was_done_is_saved_and_repeats_to_the_bit(session, swarm):
    done = {
        2: [("coupling", 2.5), ("cut", [3, 0])],
        4: [("kick", 1), ("wind", 0.7)],
        6: [("restore", [0, 3]), ("size", 1.5), ("turn", -20.0), ("feedforward", 0)],
        7: [("law", "passive"), ("shape", "line")],
        8: [("law", "consensus"), ("kick", 3)],
    }
    rows = []
    for k in range(9):
        for name, value in done.get(k, ()):
            session.ask({"name": name, "value": value})
        rows.append(shown(session, 1)[0])
    text = session.ask({"name": "save"})["text"]
    again = scenario_from_mapping(read_yaml(text, "saved").data)
    ats = [0.08, 0.08, 0.16, 0.16, 0.24, 0.24, 0.24, 0.24, 0.28, 0.28, 0.32, 0.32]
    assert [event.at for event in again.live] == ats
    panel = Panel(again, build(again))
    other = Session(again, panel, LiveLoop(*panel.experiment, panel.live))
    np.testing.assert_array_equal(shown(other, 9), rows)
    other.promiser.end()
    # And what it saves is the same again.
    assert other.ask({"name": "save"})["text"] == text


def test_a_run_refuses_what_was_done_live(echelon, here):
    (here / "live.yaml").write_text(dump_yaml(GIVEN | {"live": [{"at": 1.0, "coupling": 2.0}]}))
    code, _, fault = echelon("run", "live.yaml", "--out", "out")
    assert code == 2 and "live: got 1 events, which only `echelon live` repeats" in fault
    assert not (here / "out").exists()


def test_reset_begins_again_with_the_knobs_as_they_are(session, swarm):
    session.ask({"name": "coupling", "value": 3.0})
    session.settle()
    swarm.advance()
    session.ask({"name": "kick", "value": 1})
    session.ask({"name": "reset"})
    session.settle()
    assert swarm.steps == 0 and session.knobs.coupling == 3.0
    assert session.events == [{"at": 0.0, "coupling": 3.0}]


def test_the_promise_holds_stands_on_its_edge_or_is_lost_with_its_number(panel):
    strong = badge_of(panel, panel.start)
    assert strong["state"] == "holds" and strong["short"].startswith("guaranteed: ")
    edge = strong["edge"]
    # Up to the end of the slider errors decay in held steps too.
    assert strong["end"] is None
    near = badge_of(panel, panel.start._replace(coupling=1.05 * edge))
    assert near["state"] == "edge" and near["short"].endswith(", near its edge")
    parted = badge_of(panel, panel.start._replace(cut=frozenset({0, 3})))
    assert parted["state"] == "lost" and "disconnected" in parted["causes"][0]


LOOKS = [{"coupling": 0.3}, pytest.param({"cut": frozenset({3})}, marks=pytest.mark.slow)]


@pytest.mark.parametrize("change", LOOKS)
def test_the_first_look_is_the_loop_that_the_promise_then_judges(panel, change):
    knobs = panel.start._replace(**change)
    parts, settings = build(panel.scenario_at(knobs))
    found, seen = ech.guarantee(parts, settings).loop, panel.live.loop(knobs)
    assert seen.slowest == pytest.approx(found.slowest, rel=1e-9)
    assert seen.radius(settings) == pytest.approx(found.radius(settings), rel=1e-9)
    rate = -np.log(found.radius(settings)) / settings.dt
    look = first_look(panel, knobs)
    assert look["state"] == "pending" and look["short"].startswith(
        f"slowest mode {at_least(-rate)} 1/s"
    )


def test_a_gain_too_large_for_the_step_is_told_at_once_and_while_a_promise_is_computed(
    panel, monkeypatch
):
    """In continuous time every mode decays; errors grow because inputs are held."""
    fast = panel.start._replace(coupling=40.0)
    assert panel.live.loop(fast).slowest < 0.0
    radius = radius_of(panel, fast)
    short = f"no guarantee: errors grow {radius:.3g}-fold in each step of 10 ms"
    # A guarantee of an earlier position, which is still being computed, is not shown any more.
    began, ended, told = threading.Event(), threading.Event(), []

    def slow(_, knobs):
        if knobs.coupling == 1.0:
            raise ZeroDivisionError
        if knobs != fast:
            began.set()
            ended.wait(10.0)
        return {"state": "holds", "short": str(knobs.coupling)}

    monkeypatch.setattr(guarantee_status, "badge_of", slow)
    answers = Promiser(told.append)
    answers.ask(panel, panel.start)
    assert began.wait(10.0)
    answers.ask(panel, fast)
    until(lambda: told[-1]["short"] == short)
    assert told[-1]["state"] == "lost"
    ended.set()
    until(lambda: told[-1]["short"] == str(fast.coupling))
    # An error of echelon's own is said, and the next guarantee is computed.
    answers.ask(panel, fast._replace(coupling=1.0))
    until(lambda: told[-1]["short"] == "guarantee not computed")
    answers.ask(panel, fast)
    until(lambda: told[-1]["short"] == str(fast.coupling))
    answers.end()
    assert str(panel.start.coupling) not in [each["short"] for each in told]
    monkeypatch.undo()
    assert badge_of(panel, fast)["short"] == short


def test_the_slider_marks_from_where_on_errors_grow_in_held_steps(panel):
    cheap = panel.start._replace(weight=0.02)
    end = guarantee_status._end(panel, cheap, 0.5 * cheap.coupling)
    radii = [radius_of(panel, cheap._replace(coupling=c)) for c in (0.99 * end, 1.01 * end)]
    assert radii[0] < 1.0 < radii[1]


def radius_of(panel, knobs):
    """Spectral radius of steps of 10 ms of x'' = u, the gain's input held, by series; an axis."""
    gain, dt = panel.live.gain(knobs), panel.experiment.settings.dt
    L = panel.experiment.parts.graph.laplacian().toarray()[1:, 1:]
    K = knobs.coupling * (np.linalg.inv(gain.R) @ gain.P[2:])
    eye, none = np.eye(2), np.zeros((2, 2))
    free = np.block([[eye, dt * eye], [none, eye]])
    held = np.vstack([0.5 * dt**2 * eye, dt * eye]) @ K
    return max(np.abs(np.linalg.eigvals(free - x * held)).max() for x in np.linalg.eigvalsh(L))


def test_a_growing_mode_is_told_at_once(panel):
    oscillator = scenario(
        model={"name": "van-der-pol"},
        formation={},
        reference=None,
        follower={"law": "consensus"},
        initial={"spread": {"position": 0.1}},
    )
    own = Panel(oscillator, build(oscillator))
    weak = own.start._replace(coupling=0.02 * own.start.coupling)
    look, found = first_look(own, weak), badge_of(own, weak)
    assert look["state"] == found["state"] == "lost"
    assert look["short"] == found["short"] and "a mode grows at " in look["short"]
    assert any("is below the edge" in cause for cause in found["causes"])


HELD = {"state": "holds", "short": "promised", "whole": "Promised.", "rate": 1.0, "causes": []}


def badges_of(errors, model=ech.models.DoubleIntegrator(), pitch=None, begins=None, apart=None):
    """What the badge tells over time (s) of errors, one a second, of a leader and a follower."""
    told, names = [], model.state_names
    status = GuaranteeStatus(model, ech.Graph.path(2), told.append)
    kept = None if apart is None else 0.3
    status.update(HELD | {"beyond": ["the guarantee does not cover this run: far"], "apart": kept})
    for second, error in enumerate(errors):
        if second == begins:
            status.begin()
        states = np.zeros((2, len(names)))
        if pitch is not None:
            states[1, names.index("pitch")] = pitch[second]
        size, none = np.array([0.0, error]), np.zeros(2, bool)
        rows = float(second), states, states, size, states, None, np.nan, none
        status.look(Picture(*rows, apart=np.inf if apart is None else apart[second]))
    return told


def states_of(badges):
    return [each["state"] for each in badges]


def test_the_badge_is_green_only_where_what_is_promised_reaches():
    grown = badges_of([1.0, 1.5, 1.0, 2.9, 3.1, 4.0, 3.0, 2.1, 2.0, 1.0])
    assert states_of(grown) == ["holds", "lost", "holds"]
    assert "does not cover this run" in grown[1]["causes"][0]
    errors, pitch = [2.0, 8.0, 8.0, 5.0, 4.0], [0.0, 1.6, 0.0, 0.0, 0.0]
    out = badges_of(errors, ech.models.Quadrotor(), pitch)
    assert states_of(out) == ["holds", "lost", "holds"]
    assert "Agent 1 left the domain of its equations at t = 1.00 s: `pitch`" in out[1]["causes"][1]


def test_a_first_swing_and_errors_of_no_size_take_no_promise_back():
    for errors in ([0.0, 0.5, 1.0, 1.9, 1.0], [1e-9, 1e-9, 1e-9, 1e-3, 9e-3]):
        assert len(badges_of(errors)) == 1
    # What is done has a swing of its own, and errors without equal are doubted until they halve.
    assert len(badges_of([0.5, 1e-9, 1e-9, 1e-9, 0.5, 0.9], begins=4)) == 1
    fallen = badges_of([0.5, 0.1, 0.1, 1.1, 9.0, 9.5, 4.7, 2.0], begins=4)
    assert states_of(fallen) == ["holds", "lost", "edge", "holds"]


def test_the_badge_of_distances_is_green_while_hulls_are_apart_whatever_the_errors():
    told = badges_of([1.0, 9.0, 9.0, 9.0, 1.0], begins=1, apart=[0.4, 0.3, 0.28, 0.1, 0.3])
    assert states_of(told) == ["holds", "lost", "holds"]
    assert told[1]["causes"] == [
        "The hulls of two agents are 0.28 m apart, scaled, as after a kick; from 0.3 m on it is "
        "guaranteed again that agents stay apart."
    ]


@pytest.fixture(scope="module")
def page():
    # A quick loop, since it is watched in real time.
    follower = {"law": "consensus", "gain": {"method": "riccati", "R": [0.02, 0.02]}}
    session, html = live(scenario(follower=follower))
    session.start()
    with live_page(session, html).serving(0) as address:
        yield session, address
    session.end()


def post(address, told, **headers):
    data = told if isinstance(told, bytes) else json.dumps(told).encode()
    request = urllib.request.Request(address + "knob", data, headers)
    try:
        with urllib.request.urlopen(request, timeout=10) as answer:
            return answer.status, json.loads(answer.read())
    except urllib.error.HTTPError as error:
        return error.code, error.read()


def test_pages_of_others_may_neither_turn_a_knob_nor_read_the_stream(page):
    session, address = page
    knob = {"name": "wind", "value": 1.0}
    for headers in ({"Origin": "http://example.org"}, {"Host": "example.org"}, {"Origin": "null"}):
        assert post(address, knob, **headers)[0] == 403
        request = urllib.request.Request(address + "stream", headers=headers)
        with pytest.raises(urllib.error.HTTPError, match="403"):
            urllib.request.urlopen(request, timeout=10)
    assert session.knobs.wind == 0.0
    assert post(address, knob, Origin=address[:-1]) == (200, {"wind": 1.0})
    assert post(address, {"name": "wind", "value": 0.0})[0] == 200


def test_a_question_that_is_none_is_answered_and_nothing_ends(page):
    for told in (b"{", b"[1]", b"x" * 200_000, b"null", {"name": None}):
        assert post(page[1], told)[0] == 400
        assert post(page[1], {"name": "pause", "value": False})[0] == 200


@pytest.fixture(scope="module")
def browser():
    with chromium() as found:
        yield found


def test_a_cut_link_disappears_the_error_reacts_and_the_page_says_why(browser, page):
    _, address = page
    with opened(browser, address) as shown:
        until(lambda: shown.evaluate("echelon.pictures") > 20)
        until(lambda: shown.evaluate("echelon.promise && echelon.promise.state") == "holds")
        until(lambda: shown.evaluate("echelon.numbers.worst") < 0.05)
        # With both links to the leader gone nobody hears it.
        click_link(shown, 0, 1)
        until(lambda: [0, 1] not in shown.evaluate("echelon.links"))
        shown.evaluate("echelon.ask('cut', [0, 3])")
        until(lambda: shown.evaluate("echelon.promise.state") == "lost")
        until(lambda: "disconnected" in shown.locator(".notes").inner_text())
        shown.evaluate("echelon.ask('kick', 1)")
        until(lambda: shown.evaluate("echelon.numbers.worst") > 0.3)
        for pair in ([0, 1], [0, 3]):
            shown.evaluate("(pair) => echelon.ask('restore', pair)", pair)
        until(lambda: len(shown.evaluate("echelon.links")) == 4)
        until(lambda: shown.evaluate("echelon.numbers.worst") < 0.05)


def click_link(shown, i, j):
    shown.evaluate("echelon.ask('pause', true)")
    until(lambda: shown.evaluate("echelon.live.paused"))
    ends = np.array([shown.evaluate(f"echelon.whereOnScreen({k})") for k in (i, j)])
    box = shown.locator("#scene").bounding_box()
    shown.mouse.click(box["x"] + ends[:, 0].mean(), box["y"] + ends[:, 1].mean())
    shown.evaluate("echelon.ask('pause', false)")


def test_a_slider_turns_its_knob_and_the_page_shows_places_that_are_the_loops(browser, page):
    session, address = page
    with opened(browser, address, 420, 800) as shown:
        until(lambda: shown.evaluate("echelon.pictures") > 3)
        assert shown.evaluate("document.documentElement.scrollWidth") <= 420
        shown.get_by_role("slider", name="formation size").fill("900")
        until(lambda: session.knobs.size > 2.0)
        shown.evaluate("echelon.ask('pause', true)")
        until(lambda: shown.evaluate("echelon.live.paused"))
        time = shown.evaluate("echelon.time")
        until(lambda: shown.evaluate("echelon.time") == time and session.paused)
        states = session.swarm.advance(still=True).states
        for agent in range(4):
            place = shown.evaluate(f"echelon.position({agent})")
            assert place[:2] == pytest.approx(states[agent, :2], abs=1e-5)
        shown.evaluate("echelon.ask('pause', false)")
        shown.evaluate("echelon.ask('size', 1.0)")
        until(lambda: session.knobs.size == 1.0)


def test_a_page_that_is_closed_ends_nothing_and_nobody_watching_stops_the_clock(browser, page):
    session, address = page
    with opened(browser, address) as shown:
        until(lambda: shown.evaluate("echelon.pictures") > 3)
    until(lambda: session.watchers == 0)
    steps = session.swarm.steps
    threading.Event().wait(0.3)
    assert session.swarm.steps <= steps + 2 * session.swarm.count
    with opened(browser, address) as shown:
        until(lambda: shown.evaluate("echelon.pictures") > 3)


def test_what_a_scenario_cannot_do_live_is_told_before_it_begins(panel, swarm):
    for event, sentence in (
        ({"cut": [0, 2]}, "`[0, 2]` is no link of the graph."),
        ({"law": "best"}, "there is no law `best` here; there are `consensus`"),
        ({"shape": "star"}, "there is no shape `star` here; there are"),
        ({"law": "passive", "coupling": 2.0}, "there is no control `coupling`"),
        ({"kick": {4: [1.0, 0, 0, 0]}}, "`kick` got agent 4 with 4 numbers"),
    ):
        with pytest.raises(SimulationError) as fault:
            Session(scenario(live=[{"at": 1.0, **event}]), panel, swarm)
        assert str(fault.value).startswith(f"`live` at 1 s: {sentence}")


def test_what_is_too_large_to_be_live_is_refused_with_what_would_be(monkeypatch):
    monkeypatch.setattr(served, "_SLOWEST", 0.0)
    with pytest.raises(SimulationError, match="4 agents are too many to be live here: 0.04 s take"):
        live(scenario())
