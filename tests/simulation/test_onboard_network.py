"""Exported laws over networks that are late: with the rules of docs/onboard.md they are `Agent`."""

import dataclasses
import math

import numpy as np
import pytest

import echelon as ech
from echelon.agents.network.inbox import Packet
from echelon.output.archive.law_folder import network_facts
from echelon.simulation.onboard.law_functions import law_functions
from echelon.simulation.onboard.python_text import python_text

FAR = 2**30
CARTS = ech.models.DoubleIntegrator()
TREE = ech.Graph([(0, 1), (1, 2), (1, 3)])


def parts_of(law, **network):
    offsets = {1: (1.0, 0.0), 2: (1.0, 0.8), 3: (1.0, -0.8)}
    circle = ech.references.Circle(rate=0.5)
    if law == "consensus":
        gain = ech.synthesize(CARTS, TREE, ech.gains.Riccati())
        drive = ech.Laws(ech.laws.Tracking(circle), ech.laws.Consensus(gain))
    else:
        leader = ech.laws.StoppingLeader(reference=circle)
        drive = ech.Laws(leader, ech.laws.StoppingPoint())
    places = ech.Formation.from_offsets(CARTS, TREE, offsets)
    world = ech.World(network=ech.Network(rate=25.0, **network))
    return ech.Parts(CARTS, TREE, places, drive, world=world)


class Plain:
    """An agent's process: its law as plain Python, and the rules about messages."""

    def __init__(self, own, dt):
        functions = law_functions(own)
        self.law, self.own = {}, own
        exec(python_text(functions.values(), "A law.", {}), self.law)
        self.facts = network_facts(own, dt, functions)
        self.heard, self.packet, self.memory = {}, None, None

    def receive(self, message):
        last = self.heard.get(message.sender)
        if last is None or message.time > last.time:
            self.heard[message.sender] = message
        packet = message.packet
        if packet is None or self.own.leads and packet.leader >= self.number:
            return
        mine = self.packet
        if mine is None or (-packet.leader, packet.time) > (-mine.leader, mine.time):
            self.packet = packet

    def step(self, t, x):
        law, facts = self.law, self.facts
        state, leaderward = facts["messages"] == "state", facts["uses"] == "leaderward"
        memory = law["begin"](x) if self.memory is None else self.memory
        signal = law["signal"](x, memory)

        def away_from(other):
            return law["difference"](x, memory, other)

        ready = self.own.leads or self.packet is not None
        leader, forward, valid = signal, [0.0] * len(self.own.forward_names), True
        if self.packet is not None:
            leader, forward, valid = self.expected(t, signal)
        messages = [self.heard.get(k) for k in self.own.neighbours]
        ages = [math.inf if m is None else max(0.0, t - m.time) for m in messages]
        hops = [FAR if m is None else m.hops for m in messages]
        own_hops = self.hops(ages, hops)
        total, z = 0.0, [0.0] * len(signal)
        for weight, m, age, of_sender in zip(
            self.own.weights[0].tolist(), messages, ages, hops, strict=True
        ):
            fresh = age < math.inf if state else age <= facts["forget"]
            used = age < math.inf if state else ready
            if not used:
                continue
            value = list(m.signal[1]) if fresh else [0.0] * len(signal)
            other = value if state else [a + b for a, b in zip(leader, value, strict=True)]
            if leaderward and not ((fresh or of_sender == 0) and of_sender < own_hops):
                continue
            z = [a + weight * b for a, b in zip(z, away_from(other), strict=True)]
            total += weight
        if leaderward and total > 0.0:
            z = [a / total for a in z]
        elif leaderward:
            z = away_from(leader) if ready else z
        forward = [0.0] * len(forward) if self.own.leads else forward
        u, self.memory, _, _, *content, fine = law["tick"](t, x, z, forward, memory)
        assert valid and fine
        packet = self.packet
        if self.own.leads and packet is None:
            packet = self.number, t, content[0]
        value = signal if state else away_from(leader)
        return u, value, own_hops, packet

    def expected(self, t, signal):
        if self.facts["messages"] == "state":
            return signal, list(self.packet.content), True
        content, age = list(self.packet.content), max(0.0, t - self.packet.time)
        if "carry" in self.law:
            rounds, duration = self.law["pace"](age)
            for _ in range(int(rounds)):
                content, fine = self.law["carry"](content, duration)
                assert fine
        return self.law["expected"](t, content, age)

    def hops(self, ages, hops):
        if self.own.leads:
            return 0
        lasting = [h for a, h in zip(ages, hops, strict=True) if a <= self.facts["forget_hops"]]
        hops = min([FAR, *lasting]) + 1
        return hops if hops < self.facts["agents"] else FAR


def compare(parts, number, dt, steps, size=0.1):
    agent = ech.Agent(parts, number, dt)
    plain, own, draws = Plain(agent.own_law, dt), agent.own_law, np.random.default_rng(1)
    plain.number = number
    trim = np.array(own.loop.model.trim[0], float)
    sent = 0
    for k in range(steps):
        t = k * dt
        for sender in own.neighbours:
            # Lost or late, some for long, and none at first.
            if k > 5 and (k // 60) % 3 != 2 and draws.random() < 0.3:
                time = max(0.0, t - draws.uniform(0.0, 0.3))
                message = letter(own, plain.facts, sender, time, draws)
                agent.receive(message)
                plain.receive(message)
        x = trim + size * draws.normal(size=len(trim))
        u, message = agent.step(t, x)
        ours, value, hops, packet = plain.step(t, x.tolist())
        np.testing.assert_allclose(ours, u, rtol=0, atol=1e-13 * max(1.0, np.abs(u).max()))
        if message is None:
            continue
        sent += 1
        assert message.hops == hops
        np.testing.assert_allclose(value, message.signal.values, rtol=0, atol=1e-12)
        if packet is not None:
            assert packet[:2] == message.packet[:2]
            np.testing.assert_allclose(packet[2], message.packet.content, rtol=0, atol=1e-12)
    assert sent > steps // 2


def letter(own, facts, sender, time, draws):
    values = 0.2 * draws.normal(size=len(own.signal_names))
    leader, hops = facts["leaders"][0], int(draws.choice([0, 1, 2, FAR]))
    said = tuple((0.1 * draws.normal(size=facts["content"])).tolist())
    packet = Packet(leader, max(0.0, time - draws.uniform(0.0, 0.9)), said)
    return ech.Message(sender, (own.signal_names, values), None, time, hops, packet)


CASES = {
    "preview": ("stopping-point", 2, {}),
    "its-leader": ("stopping-point", 0, {}),
    "leaderward": ("stopping-point", 1, {"hears": "leaderward"}),
    "states": ("stopping-point", 1, {"messages": "state", "hears": "leaderward"}),
    "stopping-point-packet": ("stopping-point", 1, {"prediction": "packet"}),
    "consensus-packet": ("consensus", 1, {"prediction": "packet"}),
    "consensus-preview": ("consensus", 1, {}),
    "none": ("consensus", 1, {"prediction": "none"}),
    "leaders-packet": ("consensus", 0, {"prediction": "packet"}),
}


@pytest.mark.parametrize("case", CASES)
def test_a_plain_process_is_the_agent(case):
    law, number, network = CASES[case]
    compare(parts_of(law, **network), number, 0.01, 400)


@pytest.mark.slow
@pytest.mark.parametrize("number", [0, 2])
@pytest.mark.parametrize("name", ["paper-radio", "paper"])
def test_quadrotors_over_a_radio_are_agents_too(name, number):
    parts, settings = ech.build(ech.load_scenario(name))
    if name == "paper":
        network = ech.Network(rate=50.0, delay=0.02, prediction="packet")
        parts = parts.replace(world=dataclasses.replace(parts.world, network=network))
    compare(parts, number, settings.dt, 300)
