"""Agents under exported laws in plain Python, beside `Agent`: the same messages, the same steps."""

import math

import jax
import numpy as np

import echelon as ech
from echelon.output.archive.flight_folder import network_facts
from echelon.simulation.onboard.law_functions import law_functions
from echelon.simulation.onboard.source_code import python_text
from echelon_flight.wire import Packet

FAR = 2**30


def as_python(functions, folder=None):
    scope = {}
    exec(python_text(functions, "A law.", {}), scope)
    return {f.name: scope[f.name] for f in functions}


def receive(agent, draws):
    own = agent.own_law
    names, forward_names = own.signal_names, own.forward_names
    signals = [0.3 * draws.normal(size=len(names)) for _ in own.neighbours]
    forward = 0.1 * draws.normal(size=len(forward_names))
    sent = ech.Message(own.source, (names, np.zeros(len(names))), (forward_names, forward))
    if own.source is None:
        forward = forward * math.nan
    else:
        assert str(agent.receive(sent)) == "taken"
    for sender, signal in zip(own.neighbours, signals, strict=True):
        feed = (forward_names, forward) if sender == own.source else None
        assert str(agent.receive(ech.Message(sender, (names, signal), feed))) == "taken"
    return signals, forward


def compare(agent, runs, steps, dt, size=0.1, atol=1e-14):
    """Let an agent and copies of its law take the same random steps; returns their memories.

    Args:
        agent: in the ideal network.
        runs: functions by name, of each copy.
        steps: how many.
        dt: between two, s; the law's own, or longer to see more of its time.
        size: of the random states.
        atol: of numbers of size 1; more where the terms of a sum are larger.
    """
    own, draws = agent.own_law, np.random.default_rng(0)
    trim = np.array(own.loop.model.trim[0], float)
    memories = [run["begin"](trim.tolist()) for run in runs]
    for k in range(steps):
        x, time = trim + size * draws.normal(size=len(trim)) * (k > 0), k * dt
        signals, forward = receive(agent, draws)
        u, message = agent.step(time, x)
        leaves = [np.ravel(leaf) for leaf in jax.tree.leaves(agent._memory)]
        flat = np.concatenate([np.zeros(0), *leaves])
        expected = u, flat, message.signal.values, message.feedforward.values
        row = 0 if own.schedule is None else own.schedule.row(time)
        for number, run in enumerate(runs):
            before = memories[number]
            gaps = [run["difference"](time, x.tolist(), before, s.tolist()) for s in signals]
            z = own.weights[row] @ np.array(gaps) if gaps else np.zeros(len(own.signal_names))
            inputs = time, x.tolist(), z.tolist(), forward.tolist(), before
            *results, valid = run["tick"](*inputs)
            memories[number] = results[1]
            assert valid and run["signal"](time, x.tolist(), before) == results[2]
            # All but the input are sums of terms as large as the largest number of the step.
            largest = max(1.0, *(np.abs(value).max(initial=0.0) for value in expected))
            scales = max(1.0, np.abs(u).max()), largest, largest, largest
            for got, value, scale in zip(results, expected, scales, strict=True):
                np.testing.assert_allclose(got, value, rtol=0, atol=atol * scale)
    return memories


class Plain:
    """An agent's process: its law as plain Python, and the rules about messages."""

    def __init__(self, own, dt):
        functions = law_functions(own)
        self.law, self.own = as_python(functions.values()), own
        self.facts = network_facts(own, dt, functions)
        self.heard, self.packet, self.memory, self.estimate = {}, None, None, None

    def receive(self, message):
        last = self.heard.get(message.sender)
        if last is None or message.time > last.time:
            self.heard[message.sender] = message
        packet = message.packet
        if packet is None or self.own.leads and packet.leader >= self.own.number:
            return
        mine = self.packet
        if mine is None or (-packet.leader, packet.time) > (-mine.leader, mine.time):
            self.packet = packet

    def step(self, t, y):
        """Take a step at a state, or at a measurement where the agent estimates its state."""
        if "measure" not in self.law:
            return self.act(t, y)
        before = self.law["estimate"](y) if self.estimate is None else self.estimate
        x, estimate, valid = self.law["measure"](y, before)
        assert valid
        u, *rest = self.act(t, x)
        self.estimate = self.law["deliver"](u, estimate)
        return u, *rest

    def act(self, t, x):
        law, facts = self.law, self.facts
        state, leaderward = facts["messages"] == "state", facts["uses"] == "leaderward"
        memory = law["begin"](x) if self.memory is None else self.memory
        signal = law["signal"](t, x, memory)

        def away_from(other):
            return law["difference"](t, x, memory, other)

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
            packet = self.own.number, t, content[0]
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


def compare_late(agent, dt, steps, size=0.1):
    """Let an agent and its exported law take the same steps on the same random messages."""
    own, draws = agent.own_law, np.random.default_rng(1)
    plain = Plain(own, dt)
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
        # The input is a sum of terms as large as the own deviation.
        terms = [*u, *([] if message is None else message.signal.values)]
        np.testing.assert_allclose(ours, u, rtol=0, atol=1e-13 * max(1.0, np.abs(terms).max()))
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
    said = 0.1 * draws.normal(size=facts["content"])
    if facts["prediction"] == "packet":
        # In the vehicle's units: a torque of .1 N m would turn it by 10^4 rad/s^2.
        units = np.abs(np.diag(own.loop.model.input_scale))
        said[-len(units) :] *= units
    said = tuple(said.tolist())
    packet = Packet(leader, max(0.0, time - draws.uniform(0.0, 0.9)), said)
    return ech.Message(sender, (own.signal_names, values), None, time, hops, packet)
