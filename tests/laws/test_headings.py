"""Headings are compared on the circle: one heading written in two ways is one heading."""

import json
import math

import jax.numpy as jnp
import numpy as np
import pytest
from in_words import in_words
from model_family import MODELS
from plain_agents import PlainAgent, as_python, pilot_of

import echelon as ech
from echelon.agents.models.chains import angles_among
from echelon.agents.models.model import wrap_angles
from echelon.agents.network.inbox import LeaderPacket
from echelon.output.archive.flight_folder import python_law
from echelon.simulation.onboard.agent_functions import agent_functions
from echelon.synthesis.gains import FixedGain
from echelon.synthesis.gains.gain import synthesize
from echelon_flight import wire

TURN = 2.0 * math.pi
PATH = ech.Graph.path(3)
RADIO = ech.Network(rate=50.0, delay=0.02)


class Carrier(ech.ControlAffine):
    """A robot on wheels that move it in all directions, and that turns at a commanded rate."""

    state_names = output_names = flat_outputs = ("x", "y", "yaw")
    input_names = ("vx", "vy", "turn_rate")
    position = ("x", "y")
    flat_order = 1

    def drift(self, x):
        return jnp.zeros_like(x)

    def input_map(self, x):
        return jnp.eye(3, dtype=x.dtype)

    def flat(self, derivatives):
        return derivatives[0], derivatives[1]

    def difference(self, x, y):
        return wrap_angles(x - y, 2)


def stopping(model, graph=PATH, reference=None, network=None, law=None, **more):
    """Parts under stopping points, in a row."""
    followers = [k for k in range(graph.agents) if k not in graph.leaders]
    offsets = {k: [-0.6 * k] + [0.0] * (len(model.position) - 1) for k in followers}
    formation = ech.Formation.from_offsets(model, graph, offsets)
    drive = ech.Laws(ech.laws.StoppingLeader(reference=reference), law or ech.laws.StoppingPoint())
    return ech.Parts(model, graph, formation, drive, world=ech.World(network=network), **more)


def plain_law(parts, agent, dt=0.01):
    """The exported law of an agent in Python."""
    own = ech.Agent(parts, agent, dt).own_law
    return PlainAgent(own, as_python(agent_functions(own).values()))


def facing(model, yaw, place=0.0):
    """A state at rest at a place with a heading."""
    x = np.array(model.trim[0], float)
    x[model.state_names.index("x")] = place
    for name in ("yaw", "heading"):
        if name in model.state_names:
            x[model.state_names.index(name)] = yaw
    return x.tolist()


@pytest.mark.parametrize("name", MODELS)
def test_the_yaw_of_a_vehicle_is_the_only_angle_among_flat_outputs(name):
    model = MODELS[name]
    names = model.flat_outputs or model.output_names
    found = [names[k] for k in angles_among(model, tuple(names))]
    # The printed one takes x - y of all states, as the paper prints it.
    assert found == [n for n in names if n in ("yaw", "heading") and name != "printed"]


def under(law, model):
    """Parts of agents with a heading, whose gain weighs all states."""
    if law == "stopping-point":
        return stopping(model)
    weights = np.eye(len(model.state_names)) + 0.05
    gain = synthesize(model, PATH, FixedGain(P=weights, coupling=2.0))
    formation = ech.Formation.from_offsets(model, PATH, {})
    circle = ech.references.Circle(radius=3.0, rate=0.3)
    leader = ech.laws.Tracking(circle, gain=gain) if model.flat_outputs else ech.laws.TrimInput()
    return ech.Parts(model, PATH, formation, ech.Laws(leader, ech.laws.Consensus(gain)))


WITH_HEADING = [n for n, m in MODELS.items() if {"yaw", "heading"} & {*m.state_names}]
WITH_HEADING.remove("printed")


# The heading of a vehicle that has to move follows from its path, and is in no chain.
CHAINED = [name for name in WITH_HEADING if "yaw" in MODELS[name].state_names]
CASES = [(name, "consensus") for name in WITH_HEADING]
# Without a `to_flat` of their own their laws take long to trace.
SLOW = {"euler": pytest.mark.slow, "thrust": pytest.mark.slow, "attitude": pytest.mark.slow}
CASES += [pytest.param(name, "stopping-point", marks=SLOW.get(name, ())) for name in CHAINED]


@pytest.mark.parametrize(("name", "law"), CASES)
def test_one_heading_written_in_several_ways_gives_one_input(name, law):
    """The law of an agent, as exported in Python; of unicycles no chain has the heading."""
    model = MODELS[name]
    plain, inputs = plain_law(under(law, model), 1), []
    other = plain.speak(0.0, facing(model, 3.1))
    other = [0.0 if math.isnan(number) else number for number in other]
    plain.rows = dict.fromkeys(plain.rows, other)
    for turns in (0, 1, -1, 5):
        plain.memory = None
        inputs.append(plain.step(0.0, facing(model, 3.0 + turns * TURN))[0])
    assert np.abs(np.array(inputs[0]) - model.trim[1]).max() > 0.0
    np.testing.assert_allclose(inputs, [inputs[0]] * 4, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("name", [pytest.param(n, marks=SLOW.get(n, ())) for n in CHAINED])
def test_a_measured_heading_that_passes_pi_does_not_change_the_command(name):
    """Against the same measurements with the heading counted on; in the memory too."""
    plain, flights = plain_law(stopping(MODELS[name]), 1), []
    for measured in (lambda yaw: yaw, lambda yaw: math.remainder(yaw, TURN)):
        plain.memory, rows = plain.law["begin"](facing(MODELS[name], 3.0)), []
        for k, yaw in enumerate(np.linspace(3.0, 9.6, 40)):
            x = facing(MODELS[name], measured(yaw))
            said = [number - 0.1 for number in plain.speak(0.01 * k, x)[:4]]
            plain.rows = dict.fromkeys(plain.rows, [*said, *[0.0] * 4])
            u, message, _ = plain.step(0.01 * k, x)
            rows.append([*u, *plain.memory, *message[:4]])
        flights.append(rows)
    assert flights[0][-1][-1] == pytest.approx(9.6)
    np.testing.assert_allclose(flights[1], flights[0], rtol=1e-9, atol=1e-9)


def test_an_agent_by_itself_takes_one_heading_in_two_ways_for_one():
    agents = [ech.Agent(stopping(Carrier()), 1, 0.02) for _ in range(2)]
    for k, heading in enumerate(np.linspace(2.5, 4.5, 9)):
        x = facing(Carrier(), heading), facing(Carrier(), math.remainder(heading, TURN))
        (u, sent), (other, also) = (a.step(0.02 * k, s) for a, s in zip(agents, x, strict=True))
        np.testing.assert_allclose(other, u, atol=1e-12)
        np.testing.assert_allclose(also.signal.values, sent.signal.values, atol=1e-12)


SETTINGS = ech.Settings(horizon=12.0, dt=0.02)
ENGINES = ["jax", "native"]


@pytest.mark.slow
@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("edges", ["ring", "row"])
def test_headings_all_round_the_circle_agree_whatever_the_graph(edges, engine):
    """In a ring neighbours an eighth of a turn apart would rest so by differences on the circle."""
    pairs = [(k, (k + 1) % 8) for k in range(8 if edges == "ring" else 7)]
    graph = ech.Graph(pairs)
    starts = [[-0.6 * k, 0.0, math.remainder(k * TURN / 8.0, TURN)] for k in range(8)]
    parts = stopping(Carrier(), graph, initial=np.array(starts))
    result = ech.simulate(parts, SETTINGS._replace(engine=engine, horizon=40.0))
    heading = np.asarray(result.states)[..., 2]
    np.testing.assert_allclose(heading[-1], 0.0, atol=1e-3)
    assert np.abs(heading).max() <= math.pi * (1 + 1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("model", [Carrier(), MODELS["crazyflie"]], ids=["carrier", "crazyflie"])
def test_an_agent_turns_the_shorter_way(model, engine):
    """From -3.1 rad behind a leader at 3.1: by 0.083 rad, and not by 6.2."""
    hover = ech.references.Hover(position=(0.0, 0.0, 0.0), yaw=3.1)
    starts = np.array([facing(model, yaw, -0.6 * k) for k, yaw in enumerate((3.1, -3.1, 3.1))])
    parts = stopping(model, reference=hover, initial=starts)
    result = ech.simulate(parts, SETTINGS._replace(engine=engine, dt=0.01, horizon=4.0))
    yaw = np.asarray(result.states)[:, 1, model.state_names.index("yaw")]
    assert yaw[-1] == pytest.approx(3.1 - TURN, abs=1e-3)
    assert np.ptp(yaw) == pytest.approx(TURN - 6.2, abs=1e-3)


SPINNING = ech.references.Hover(position=(0.0, 0.0, 0.0), yaw_rate=1.0)


@pytest.mark.slow
@pytest.mark.parametrize("network", [None, RADIO], ids=["ideal", "radio"])
def test_who_joins_a_formation_that_has_turned_does_not_make_up_for_it(network):
    joins = 12.56
    events = [ech.network.Join(2, joins)]
    parts = stopping(Carrier(), reference=SPINNING, network=network, events=events)
    parts = parts.replace(initial={2: [-1.2, 0.0, 0.0]})
    settings = SETTINGS._replace(horizon=14.0)
    result, other = (ech.simulate(parts, settings._replace(engine=e)) for e in ("jax", "native"))
    np.testing.assert_allclose(other.states, result.states, rtol=1e-13, atol=1e-12)
    assert other.engine == "native"
    times, yaw = np.asarray(result.times), np.asarray(result.states)[:, 2, 2]
    after = times >= joins + 0.5
    # It turns with the leader from 0 rad on, which is where the leader is at 12.566 s.
    np.testing.assert_allclose(yaw[after], times[after] - 2.0 * TURN, atol=0.02)
    assert np.abs(yaw).max() < 2.0


@pytest.mark.parametrize("by", ["agent", "agent over a radio", "pilot"])
def test_a_process_that_begins_late_does_not_make_up_for_turns(by):
    """Its commanded rate is that of the leader, 1 rad/s."""
    network = None if by == "agent" else RADIO
    parts, t = stopping(Carrier(), reference=SPINNING, network=network), 12.56
    agent = ech.Agent(parts, 1, 0.02)
    own, x = agent.own_law, facing(Carrier(), t - 2.0 * TURN, -0.6)
    names, heading = own.signal_names, [0.0, 0.0, t]
    packet = LeaderPacket(0, t - 0.02, (0.0, 0.0, 0.0))
    if by == "pilot":
        pilot = pilot_of(agent)
        for k in own.neighbours:
            row = t - 0.02, float(k), 0.0, 0.0, 0.0, float(packet.leader), packet.time
            pilot.box.receive(wire.Message(k, (*row, *packet.content)), t)
        u = pilot.tick(t, x).u
    else:
        if network is not None:  # which has no message before it
            agent.step(t - 0.02, facing(Carrier(), t - 0.02 - 2.0 * TURN, -0.6))
        for k in own.neighbours:
            sent = names, heading if network is None else [0.0] * 3
            late = () if network is None else (t - 0.02, k, packet)
            feed = (own.forward_names, [0.0, 0.0, 1.0]) if network is None and k == 0 else None
            agent.receive(ech.Message(k, sent, feed, *late))
        u = agent.step(t, x)[0]
    np.testing.assert_allclose(u, [0.0, 0.0, 1.0], atol=1e-6)


def test_what_is_guaranteed_of_a_start_is_that_of_its_nearest_turn():
    settings = SETTINGS._replace(dt=0.01)
    sentences = set()
    for yaw in (-3.1, -3.1 + TURN, -3.1 - 2 * TURN):
        starts = np.array([facing(Carrier(), y, -0.6 * k) for k, y in enumerate((3.1, yaw, 3.1))])
        hover = ech.references.Hover(position=(0.0, 0.0, 0.0), yaw=3.1)
        parts = stopping(Carrier(), reference=hover, initial=starts)
        sentences.add(in_words(ech.guarantee(parts, settings)))
    [sentence] = sentences
    assert "after 0 s" in sentence or "1 cm" in sentence


def test_a_follower_that_is_fed_with_the_leaders_input_turns_as_fast():
    model = MODELS["point"]
    leader, follower = (plain_law(under("consensus", model), k) for k in (0, 1))
    x = [3.0 + 0.1, 0.3, 1.57]
    u, message, _ = leader.step(0.0, x)
    message = message[3:]
    sent = [*leader.law["normalized"](u), message[-1]]
    np.testing.assert_allclose(sent, message, rtol=1e-12)
    follower.rows[0] = [math.nan] * 3 + sent
    again = follower.step(0.0, x)[0]
    np.testing.assert_allclose(again, u, rtol=1e-12)
    assert abs(u[1]) > 0.01 and u[1] != pytest.approx(message[1], rel=0.5)


@pytest.mark.parametrize("name", ["point", "crazyflie", "attitude"])
def test_inputs_are_the_trim_and_the_scale_times_normalized_ones(name):
    model = MODELS[name]
    law = plain_law(under("consensus", model), 1).law
    v = [0.3, -0.2, 0.5, 0.1][: len(model.input_names)]
    expected = np.array(model.trim[1]) + np.array(model.input_scale) @ v
    np.testing.assert_allclose(law["physical"](v), expected, rtol=1e-12)
    np.testing.assert_allclose(law["normalized"](expected.tolist()), v, rtol=1e-9, atol=1e-12)


def test_law_json_names_no_message_as_an_input():
    model, settings = MODELS["point"], ech.Settings(horizon=1.0, dt=0.01)
    stated = ech.guarantee(under("consensus", model), settings).as_mapping()
    files = python_law(under("consensus", model), settings, 1, "", stated)
    facts = json.loads(files["law.json"])
    assert facts["feed_forward"] == ["normalized speed", "normalized turn_rate", "heading"]
    assert "no physical inputs u" in facts["feed_forward_meaning"]
    np.testing.assert_allclose(facts["scale"], model.input_scale)
    assert "u = u* + S v, where u* is (0, 0) and S has the rows (1, 0; 0, " in files["law.py"]
