"""Agents that are lost or join, links that are cut, and backup leaders that take the lead."""

import dataclasses

import h5py
import jax
import numpy as np
import pytest
from in_words import in_words

import echelon as ech
from echelon.core.errors import EchelonError
from echelon.guarantees.promises.hypotheses import events_in_words
from echelon.output.reports.guarantee_text import through_event
from echelon.simulation.engine.prepare import prepare
from echelon.simulation.step.assembly import assemble
from echelon.simulation.step.sequence import begin, step

Cut, Join, Lose = ech.network.Cut, ech.network.Join, ech.network.Lose
CART = ech.models.DoubleIntegrator()
RING = ech.Graph([(0, 1), (1, 2), (2, 3), (3, 0), (1, 3)])
TREE = ech.Graph([(0, 1), (1, 2), (1, 3)])
CIRCLE = ech.references.Circle(radius=2.0, rate=0.7)
STOPPING = ech.Laws(ech.laws.StoppingLeader(reference=CIRCLE), ech.laws.StoppingPoint())
PLACES = {1: [1.0, 0.0], 2: [2.0, 0.0], 3: [0.0, 1.0]}
SETTINGS = ech.Settings(horizon=6.0, dt=0.02, seed=3)
RADIO = ech.Network(rate=25.0, delay=0.02, loss=0.2)


def _parts(graph=RING, drive=STOPPING, network=None, **more):
    formation = ech.Formation.from_offsets(CART, graph, PLACES)
    world = ech.World(network=network)
    return ech.Parts(CART, graph, formation, drive, {"position": 0.5}, world=world, **more)


@pytest.fixture(scope="module")
def lost():
    return ech.simulate(_parts(events=[Lose(3, 2.0), Join(2, 3.0)]), SETTINGS)


@pytest.mark.slow
def test_a_cut_link_is_a_graph_that_switches():
    """To the bit, in both ways of stating it; native code steps it too."""
    edges = RING.edges.tolist()
    rest = [edge for edge in edges if edge != [1, 2]]
    turns = ech.Graph.switching([(0.0, edges), (2.0, rest), (4.0, edges)])
    drive = ech.Laws(STOPPING.leader, ech.laws.StoppingPoint(coupling=4.0))
    stated, cut = (
        ech.simulate(parts, SETTINGS._replace(engine="native"))
        for parts in (_parts(turns, drive), _parts(drive=drive, events=[Cut((1, 2), 2.0, 2.0)]))
    )
    assert np.array_equal(stated.states, cut.states)
    assert cut.engine == "native" and cut.presence is None


def test_an_agent_and_its_numbers_are_there_until_it_is_lost_and_from_when_it_joins(lost):
    steps = np.rint(lost.times / 0.02).astype(int)
    assert np.array_equal(lost.presence[:, 3], steps < 100)
    assert np.array_equal(lost.presence[:, 2], steps >= 150)
    # It stays where it is, without inputs.
    assert np.ptp(lost.states[steps >= 100, 3], axis=0).max() == 0.0
    assert np.ptp(lost.states[steps <= 150, 2], axis=0).max() == 0.0
    assert not lost.inputs[~lost.presence].any()
    assert not lost.errors[~lost.presence].any()
    numbers = {row.agent: row for row in ech.metrics(lost).followers}
    frames = lost.presence[:-1]
    for agent in (1, 2, 3):
        own = lost.formation_errors[:-1, agent][frames[:, agent]]
        assert numbers[agent].rmse == pytest.approx(np.sqrt(np.mean(own**2)), rel=1e-9)
    assert numbers[3].steady_rmse is None


def test_those_who_remain_fly_as_in_a_graph_without_the_others(lost):
    """Agents 0 and 1 alone between the two events, from the states at the first of them."""
    edges = RING.edges.tolist()
    fewer = [[edge for edge in edges if not absent & {*edge}] for absent in ({2}, {2, 3})]
    graph = ech.Graph.switching([(0.0, fewer[0]), (2.0, fewer[1]), (3.0, edges)])
    other = ech.simulate(_parts(graph), SETTINGS)
    before = lost.times < 3.0 - 1e-9
    gap = np.abs(other.states - lost.states)[before][:, [0, 1]]
    assert gap.max() < 1e-12


@pytest.mark.slow
def test_the_summary_states_each_event_and_what_followed(lost):
    summary = ech.summary(lost)
    assert [event["text"] for event in summary["events"]] == ["agent 3 is lost", "agent 2 joins"]
    # What is guaranteed holds until the first event that nothing covers.
    assert [x["guarantee"]["verdict"] for x in summary["events"]] == ["guaranteed", "none"]
    first, second = summary["event_outcomes"]
    late = lost.formation_errors[lost.times >= 3.0 - 1e-9]
    assert second["peak"] == pytest.approx(late.max())
    assert second["restored"] is None or second["restored"] > 3.0
    assert first["until"] == pytest.approx(2.98)
    assert "Agent 2 joins at 3 s" in ech.report(lost)
    events = [Lose(agent, 0.1 + 0.1 * agent) for agent in (1, 2, 3)]
    run = ech.simulate(_parts(events=events), SETTINGS._replace(horizon=1.0))
    assert "No follower is there at the end." in ech.report(run)


@pytest.mark.slow
def test_an_agent_that_returns_begins_anew():
    once = ech.simulate(_parts(events=[Lose(2, 2.0), Join(2, 3.0)]), SETTINGS)
    at = int(round(3.0 / 0.02))
    assert np.array_equal(once.states[at, 2], once.states[0, 2])
    assert once.presence[:, 2].sum() == len(once.times) - 50
    assert once.formation_errors[-1].max() < 0.02


def test_an_agent_that_returns_measures_where_it_returns_and_not_where_it_was_lost():
    parts = _parts(events=[Lose(2, 0.2), Join(2, 0.4)])
    parts = parts.replace(world=ech.World(sensing=ech.Sensing(delay=0.1)))
    prepared = prepare(parts, SETTINGS._replace(engine="jax"))
    drive = prepared.parts.drive
    with jax.enable_x64(True):
        loop = assemble(prepared.problem, drive.leader, drive.follower)
        first = now = begin(loop, prepared.problem.states)
        forward = jax.jit(lambda now: step(loop, now))
        for _ in range(15):
            now = forward(now)
        lost_at, held = np.asarray(now.states[2]), np.asarray(now.memory.sensing[0][2])
        for _ in range(6):
            now = forward(now)
    # While it is absent it measures nothing; then it begins with its start, for all of the delay.
    assert np.ptp(held, axis=0).max() > 0.0 and not np.array_equal(lost_at, first.states[2])
    assert np.array_equal(now.memory.sensing[0][2], np.repeat(first.states[2][None], 5, axis=0))


def of_states(graph, leader=None):
    gain = ech.synthesize(CART, graph, ech.gains.Riccati())
    return ech.Laws(leader or ech.laws.Tracking(CIRCLE), ech.laws.Consensus(gain, "relay"))


@pytest.mark.slow
@pytest.mark.parametrize(
    "network", [None, pytest.param(RADIO, marks=pytest.mark.slow)], ids=["ideal", "radio"]
)
def test_a_backup_leader_leads_along_the_path(network):
    backups = {"events": [Lose(0, 3.0)], "leadership": ech.Leadership((1, 2), timeout=0.3)}
    run = ech.simulate(_parts(network=network, **backups), SETTINGS)
    assert run.formation_errors[run.times > 3.0].max() < 1e-3
    # The backup leader is where the leader's path and its own offset put it.
    gap = run.states[-1, 1] - run.reference[-1] - run.offsets[1]
    assert np.abs(gap).max() < 5e-3
    assert (run.nearest_then[run.times >= 3.0] == 1).all()
    agent, off = ech.summary(run)["event_outcomes"][0]["leader"]
    assert agent == 1 and off < 0.3
    if network is None:
        run = ech.simulate(_parts(drive=of_states(RING), **backups), SETTINGS)
        assert run.formation_errors[-1].max() < 0.05


@pytest.mark.slow
def test_a_backup_leader_leads_at_its_place_in_a_formation_that_turns():
    """Its place, and those of all others, are those of each time and not of the start."""
    parts = _parts(events=[Lose(0, 3.0)], leadership=ech.Leadership((1, 2), timeout=0.3))
    turning = parts.formation.moving(CART, RING, [ech.network.Rotate(0.8)])
    run = ech.simulate(parts.replace(formation=turning), SETTINGS)
    place = [np.cos(0.8 * 6.0), np.sin(0.8 * 6.0)]
    assert run.states[-1, 1, :2] - run.reference[-1, :2] == pytest.approx(place, abs=5e-3)
    [event] = ech.summary(run)["event_outcomes"]
    assert event["restored"] == pytest.approx(3.0) and event["peak"] < 1e-3
    agent, off = event["leader"]
    assert agent == 1 and off < 0.3


def test_losses_and_cuts_that_are_covered_are_guaranteed_and_others_until_a_leader_is_lost():
    parts = _parts(events=[Lose(3, 2.0), Cut((1, 2), 3.0, 1.0)])
    guarantee = ech.guarantee(parts, SETTINGS)
    assert guarantee.promised and guarantee.rate is not None
    stated = events_in_words(parts, guarantee)
    assert [event["guarantee"]["kind"] for event in stated] == ["proof", "proof"]
    parts = _parts(events=[Cut((1, 2), 1.0, 0.5), Lose(0, 3.01)], leadership=ech.Leadership((1,)))
    guarantee = ech.guarantee(parts, SETTINGS)
    without = ech.guarantee(
        parts.replace(events=[Cut((1, 2), 1.0, 0.5)]), SETTINGS._replace(horizon=3.0)
    )
    assert in_words(guarantee.prefix.promise) == in_words(without)
    assert "until 3.01 s: guaranteed (exact proof, T5)" in in_words(guarantee)
    assert guarantee.as_mapping()["until"]["guarantee"]["verdict"] == "guaranteed"
    # At its first step nothing comes before it.
    at_once = _parts(events=[Lose(0, 0.01)], leadership=ech.Leadership((1,)))
    assert ech.guarantee(at_once, SETTINGS).prefix is None


@pytest.mark.parametrize(
    ("world", "ignored"),
    [
        (ech.World(network=RADIO), "messages are late or lost"),
        (ech.World(actuator=ech.Actuator(lag=0.03)), "the actuators lag or have levels"),
        (
            ech.World(sensing=ech.Sensing(noise={"position": 0.001})),
            "agents measure their states late or with noise",
        ),
    ],
    ids=["radio", "lag", "noise"],
)
def test_an_event_is_not_covered_by_a_guarantee_that_ignores_how_messages_and_agents_are(
    world, ignored
):
    """As before the event: what the guarantee of the run leaves out, that of an event does too."""
    parts = _parts(events=[Lose(3, 2.0), Cut((1, 2), 3.0, 1.0)]).replace(world=world)
    guarantee = ech.guarantee(parts, SETTINGS)
    assert ignored in in_words(guarantee)
    for event in events_in_words(parts, guarantee):
        stated = event["guarantee"]
        assert stated["verdict"] == "none" and stated["kind"] is None
        whom = "it" if event["what"] == "cut" else "all others"
        assert through_event(stated).startswith(f"The guarantee would cover {whom}")
        assert through_event(stated).endswith(f", but ignores that {ignored}.")


@pytest.mark.parametrize(
    ("event", "later"),
    [
        (Lose(3, 2.01), Lose(3, 2.02)),
        (Cut((1, 2), 2.01), Cut((1, 2), 2.02)),
        (Cut((1, 2), 2.01, 1.003), Cut((1, 2), 2.02, 1.0)),
    ],
    ids=str,
)
def test_an_event_between_two_steps_is_guaranteed_as_at_the_later_one(event, later):
    between, on = (ech.guarantee(_parts(events=[each]), SETTINGS) for each in (event, later))
    assert on.promised and in_words(between) == in_words(on)
    assert between.rate == on.rate


def test_who_is_there_in_steps_is_who_is_there_in_a_run():
    parts, dt = _parts(events=[Lose(3, 1.013), Join(3, 2.0), Lose(2, 3.009)]), SETTINGS.dt
    stepped = parts.graph.in_steps(dt)
    assert stepped.schedule.starts == pytest.approx([0.0, 1.02, 2.0, 3.02])
    times = dt * np.arange(300)
    rows = [graph.schedule.present[graph.schedule.rows(times)] for graph in (parts.graph, stepped)]
    assert np.array_equal(*rows)
    # Put into parts again, it is the same graph: no event is added to it twice.
    assert parts.replace(graph=stepped).graph is stepped


@pytest.mark.parametrize(
    ("network", "events"),
    [(None, [Join(2, 3.0)]), (None, [Lose(0, 3.0)]), (RADIO, [])],
    ids=["one that joins", "a leader that is lost", "backup leaders over a radio, at any time"],
)
def test_what_is_not_covered_is_not_guaranteed(network, events):
    parts = _parts(network=network, events=events, leadership=ech.Leadership((1,)))
    assert not ech.guarantee(parts, SETTINGS).promised


@pytest.mark.slow
def test_who_hears_nearer_neighbours_alone_may_be_left_behind_by_an_event():
    """Agent 2 of a ring of five hears agent 1 alone, which is lost, or hears the leader no more."""
    ring, ward = ech.Graph.ring(5), ech.laws.StoppingPoint(hears="leaderward")
    drive = ech.Laws(STOPPING.leader, ward)
    for event in (Lose(1, 0.2), Cut((0, 1), 0.2)):
        guarantee = ech.guarantee(_parts(ring, drive, events=[event]), SETTINGS)
        assert not guarantee.promised and guarantee.rate is None
        assert "no path to the leader along neighbours that are nearer" in in_words(guarantee)
        # Truly: whoever hears nobody stays off.
        run = ech.simulate(_parts(ring, drive, events=[event]), SETTINGS)
        assert run.formation_errors[-1].max() > 0.1
        assert ech.guarantee(_parts(ring, events=[event]), SETTINGS).promised


@pytest.mark.slow
def test_a_link_that_no_step_has_makes_nobody_nearer():
    """For 3 ms agent 3 is the leader's neighbour, and so hears nobody who is not."""
    line = [(0, 1), (1, 2), (2, 3)]
    turns = [(0.0, line), (1.011, [*line, (0, 3)]), (1.014, line)]
    graph, ward = ech.Graph.switching(turns, period=2.0), ech.laws.StoppingPoint(hears="leaderward")
    parts = _parts(graph, ech.Laws(STOPPING.leader, ward))
    assert not ech.guarantee(parts, SETTINGS).promised
    assert ech.simulate(parts, SETTINGS).formation_errors[-1, 3] > 0.1


def test_what_is_guaranteed_until_an_event_is_of_links_that_come_back():
    """The link is cut when the leader is lost: without the loss it would be restored."""
    line = ech.Graph.path(4)
    cut, backups = Cut((0, 1), 1.0, 3.0), ech.Leadership((1,))
    guarantee = ech.guarantee(
        _parts(line, events=[cut, Lose(0, 2.0)], leadership=backups), SETTINGS
    )
    until = guarantee.prefix.promise
    assert until.rate == ech.guarantee(_parts(line, events=[cut]), SETTINGS).rate > 1.0
    # Between two steps as well, where somebody is away for good.
    later = [Cut((0, 1), 1.003, 3.0), Join(3, 2.0)]
    assert ech.guarantee(_parts(line, events=later), SETTINGS).prefix.promise.rate > 1.0
    # Where somebody is away, or comes back, whose messages others need, nothing is.
    for graph, events in ((line, [Join(2, 2.0)]), (TREE, [Lose(1, 2.0), Join(1, 3.0)])):
        away = ech.guarantee(_parts(graph, events=events), SETTINGS)
        assert not away.promised and away.prefix is None


def test_who_hears_no_leader_for_some_time_under_a_law_of_states_is_warned_of():
    states, late = of_states(TREE), [Join(1, 3.0)]
    (text,) = prepare(_parts(TREE, states, events=late), SETTINGS).warnings
    assert text.startswith("agents 2, 3 have no path to a leader from 0 to 3 s, in which the law ")
    assert "`Consensus`" in text and text.endswith("add links, or use `stopping-point`.")
    assert prepare(_parts(RING, states, events=late), SETTINGS).warnings == ()
    assert prepare(_parts(TREE, events=late), SETTINGS).warnings == ()


@pytest.mark.parametrize(
    ("graph", "events", "words"),
    [
        (RING, [Lose(7, 2.0)], "agents are numbered from 0 to 3"),
        (RING, [Lose(3, 9.0)], "the run ends at 6 s"),
        (RING, [Lose(3, -1.0)], "times must be positive"),
        (RING, [Lose(3, 2.0), Lose(3, 3.0)], "absent already"),
        (RING, [Join(3, 2.0), Join(3, 3.0)], "present already"),
        (RING, [Lose(0, 2.0)], "nobody leads afterwards"),
        (RING, [Join(0, 2.0)], "nobody leads before"),
        (RING, [Cut((0, 2), 2.0)], "no such link"),
        (TREE, [Lose(1, 2.0)], "agents 2, 3 have no path"),
        (TREE, [Cut((0, 1), 2.0, 1.0), Cut((1, 3), 3.0)], "agent 3 has no path"),
    ],
)
def test_events_that_cannot_be_are_refused_in_a_sentence(graph, events, words):
    with pytest.raises(EchelonError, match=words):
        ech.simulate(_parts(graph, events=events), SETTINGS)


def test_backup_leaders_that_cannot_be_are_refused():
    passive = of_states(RING, ech.laws.TrimInput())
    for backups, timeout, more, words in (
        ((9,), 0.3, {}, "no agent"),
        ((0,), 0.3, {}, "leader itself"),
        ((1, 1), 0.3, {}, "twice"),
        ((), 0.3, {}, "empty"),
        ((1,), 0.05, {"network": RADIO}, "at least two periods of the network"),
        ((1,), 0.3, {"drive": passive}, "no plan"),
    ):
        with pytest.raises(EchelonError, match=words):
            leadership = ech.Leadership(backups, timeout=timeout)
            ech.simulate(_parts(leadership=leadership, **more), SETTINGS)


@pytest.mark.slow
def test_a_run_with_events_is_stored_and_verified(tmp_path):
    scenario = ech.load_scenario("paper-global").with_(simulation__horizon=2.0)
    data = {
        **scenario.data,
        "events": [{"at": 1.0, "lose": 3}, {"at": 1.2, "cut": [1, 2], "for": 0.3}],
    }
    run = ech.run(ech.scenario_from_mapping(data))
    folder = ech.save_run(run, tmp_path / "run", figures=False)
    assert ech.verify(folder).verdict == "verified"
    stored = ech.load(folder)
    assert np.array_equal(stored.presence, run.presence)
    assert ech.summary(stored)["event_outcomes"] == ech.summary(run)["event_outcomes"]
    # Who is there, and where places are, follows from the scenario.
    with h5py.File(folder / "run.nc", "r+") as file:
        file["presence"][-1, 3] = 1
    assert ech.verify(folder).verdict == "refused"


@pytest.mark.slow
@pytest.mark.parametrize("prediction", ["preview", "packet"])
def test_single_agents_hand_the_lead_over_as_in_a_run(prediction):
    """Each with a queue of its own; the leader stops at 1 s, and a backup leader of it at 2 s."""
    dt, radio = 0.02, dataclasses.replace(RADIO, loss=0.0, prediction=prediction)
    events = [Lose(0, 1.0), Lose(1, 2.0)]
    parts = _parts(network=radio, events=events, leadership=ech.Leadership((1, 2), timeout=0.2))
    run = ech.simulate(parts, ech.Settings(horizon=3.0, dt=dt, seed=3))
    agents = [ech.Agent(parts, k, dt=dt) for k in range(4)]
    states, under_way, leads = run.states[0].copy(), [], []
    for k in range(150):
        now = k * dt
        for receiver, message in [x for x in under_way if x[1].time < now - 1e-9]:
            agents[receiver].receive(message)
        under_way = [x for x in under_way if x[1].time >= now - 1e-9]
        inputs = np.zeros((4, 2))
        for agent in agents:
            if run.presence[k, agent.number]:
                inputs[agent.number], message = agent.step(now, states[agent.number])
                if message is not None and k % 2 == 0:
                    near = [x for x in agents if agent.number in x.neighbours]
                    under_way += [(x.number, message) for x in near if run.presence[k, x.number]]
        assert inputs == pytest.approx(run.inputs[k], abs=1e-9)
        states = run.states[k + 1]
        leads.append([agent.leads for agent in agents])
    assert np.array(leads)[-1].tolist() == [True, True, True, False]
