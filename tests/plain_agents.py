"""Agents under exported laws in plain Python, beside `Agent`: the same messages, the same steps."""

import itertools
import math
import types

import numpy as np

import echelon as ech
from echelon.agents.network.inbox import LeaderPacket, NamedValues
from echelon.simulation.engine.agent import hull_names
from echelon.simulation.onboard.agent_functions import agent_functions, message_sizes, senders_of
from echelon.simulation.onboard.source_code import python_text
from echelon.simulation.step.leadership import NOBODY
from echelon_flight.pilot import Pilot

EPS = np.finfo(float).eps


def as_python(functions, folder=None):
    scope = {}
    exec(python_text(functions, "A law.", {}), scope)
    return {f.name: scope[f.name] for f in functions}


class PlainAgent:
    """An exported law with what its user has to do: keep the last message of each sender."""

    def __init__(self, own, law):
        self.own, self.law, self.memory = own, law, None
        self.sizes, self.senders = message_sizes(own), senders_of(own)
        self.rows = dict.fromkeys(self.senders, [math.nan] * sum(self.sizes.values()))

    def row(self, message, before=None):
        """The numbers of a message; what it lacks is as it was before."""
        own, packet, sizes = self.own, message.packet, self.sizes
        parts = {"signal": named(message.signal, own.signal_names)}
        if "time" in sizes:
            parts |= {"time": [message.time], "hops": [message.hops]}
            if packet is not None:
                parts |= {"leader": [packet.leader], "said": [packet.time], "term": [packet.term]}
                parts |= {"content": packet.content}
        if message.feedforward is not None:
            parts |= {"feed_forward": named(message.feedforward, own.forward_names)}
        if message.hull is not None:
            parts |= {"hull": message.hull.values}
        row = [*(before or [math.nan] * sum(sizes.values()))]
        for begin, (name, size) in zip(
            itertools.accumulate(sizes.values(), initial=0), sizes.items()
        ):
            if name in parts:
                row[begin : begin + size] = map(float, parts[name])
        return row

    def receive(self, message):
        self.rows[message.sender] = self.row(message, self.rows[message.sender])

    def inputs(self, t, x):
        memory = self.law["begin"](x) if self.memory is None else self.memory
        return t, x, sum(self.rows.values(), []), memory

    def speak(self, t, x):
        message, valid = self.law["speak"](*self.inputs(t, x))
        assert valid
        return message

    def step(self, t, x):
        u, after, message, valid = self.law["step"](*self.inputs(t, x))
        self.memory = after if valid else self.memory
        return u, message, valid


def pilot_of(agent, backups=()):
    """A pilot with the exported law of an agent."""
    own = agent.own_law
    facts = {"agent": agent.number, "leads": own.leads, "hears": senders_of(own)}
    facts |= {"message": message_sizes(own), "network": {"leaders": own.loop.laws.leaders.tolist()}}
    law = types.SimpleNamespace(**as_python(agent_functions(own).values()))
    return Pilot(law, facts, backups)


def named(part, names):
    values = dict(zip(part[0], np.asarray(part[1]).tolist(), strict=True))
    return [values.get(name, math.nan) for name in names]


class Draws:
    """Random states of one agent, and random messages for it."""

    def __init__(self, agent, size=0.1, seed=0):
        self.own, self.draws, self.size = agent.own_law, np.random.default_rng(seed), size
        self.sizes, self.senders = message_sizes(self.own), senders_of(self.own)
        self.hull_names = hull_names(self.own)
        self.trim = np.array(self.own.loop.model.trim[0], float)
        # What the agent said last, about which others are.
        self.said, self.place = 0.0, 0.0

    def flies(self, row):
        """Put others about an agent that flies, by its last message."""
        ends = dict(zip(self.sizes, itertools.accumulate(self.sizes.values())))
        if "time" not in self.sizes:
            self.said = np.array(row[: ends["signal"]])
        if self.hull_names and not math.isnan(row[-1]):
            d = len(self.own.loop.model.position)
            self.place = np.reshape(row[-len(self.hull_names) :], (-1, d)).mean(axis=0)

    def state(self, k):
        return self.trim + self.size * self.draws.normal(size=len(self.trim)) * (k > 0)

    def messages(self, k, t):
        if "time" not in self.sizes:
            yield from map(self.ideal, self.senders)
            return
        for sender in self.senders:
            # Lost or late, some for long, and none at first.
            if k > 5 and (k // 60) % 3 != 2 and self.draws.random() < 0.3:
                yield self.late(sender, max(0.0, t - self.draws.uniform(0.0, 0.3)))

    def normal(self, names, size):
        return NamedValues(tuple(names), size * self.draws.normal(size=len(names)))

    def hull(self, sender):
        """Points about a place that is as near as agents come that keep apart, or farther."""
        if not self.hull_names:
            return None
        d = len(self.own.loop.model.position)
        angle, far = self.draws.uniform(0.0, 2.0 * math.pi), self.draws.uniform(0.7, 3.0)
        place = np.resize([far * math.cos(angle), far * math.sin(angle), 0.1], d)
        points = self.place + place + 0.1 * self.draws.normal(size=(len(self.hull_names) // d, d))
        return NamedValues(self.hull_names, points.ravel())

    def ideal(self, sender):
        own = self.own
        forward = self.normal(own.forward_names, 0.1) if sender == own.source else None
        signal = self.normal(own.signal_names, 0.3)
        signal = signal._replace(values=self.said + signal.values)
        return ech.Message(sender, signal, forward, hull=self.hull(sender))

    def late(self, sender, time):
        own, draws = self.own, self.draws
        signal, hops = self.normal(own.signal_names, 0.2), int(draws.choice([0, 1, 2, NOBODY]))
        said = 0.1 * draws.normal(size=self.sizes["content"])
        units = np.abs(np.diag(own.loop.model.input_scale))
        inputs = len(own.signal_names) + len(own.forward_names)
        # In the vehicle's units: a torque of .1 N m would turn it by 10^4 rad/s^2.
        if len(said) >= inputs + len(units):
            said[inputs : inputs + len(units)] *= units
        # A leader says one thing at a time: two packets of one time would be the same.
        leader = int(own.loop.laws.leaders[0])
        packet = LeaderPacket(leader, time - draws.uniform(0.0, 0.9), tuple(said.tolist()))
        return ech.Message(sender, signal, None, time, hops, packet, self.hull(sender))


def compare(agent, laws, steps, dt, size=0.1, terms=1.0, move=None):
    """Let an agent and copies of its law take the same steps; returns their memories.

    Args:
        agent: in any network.
        laws: functions by name, of each copy.
        steps: how many.
        dt: between two, s; the law's own, or longer to see more of its time.
        size: of the random states.
        terms: the largest of which a number of the step is the sum.
        move: how its vehicle moves under the inputs; without it all states are random.
    """
    draws, plain, sent = Draws(agent, size), [PlainAgent(agent.own_law, law) for law in laws], 0
    motors = list(map(float, agent.own_law.loop.model.trim[1]))
    for k in range(steps):
        t, x = k * dt, draws.state(k) if move is None or k == 0 else np.array(x)
        for message in draws.messages(k, t):
            if str(agent.receive(message)) == "taken":
                for one in plain:
                    one.receive(message)
        if "speak" in laws[0]:
            hello = agent.hello(x, t)
            for one in plain:
                check(one.speak(t, x.tolist()), one.row(hello), terms=terms)
        u, message = agent.step(t, x)
        sent += message is not None
        for one in plain:
            ours, numbers, valid = one.step(t, x.tolist())
            assert valid and (message is None) == math.isnan(numbers[0]), (k, t)
            if message is not None:
                check(numbers, one.row(message), terms=terms)
            # The input is a sum of terms as large as the own deviation.
            off = [] if message is None or "time" not in draws.sizes else message.signal.values
            check(ours, u, max([1.0, *np.abs(off)]), terms)
        if move is not None:
            draws.flies(numbers)
            x, motors = move(x.tolist(), ours, motors, [0.0] * len(x))
    assert sent > steps // 2
    return [one.memory for one in plain]


def check(got, expected, largest=1.0, terms=1.0):
    """Compare numbers to 1e-14 of the largest; whole numbers, times and NaN are the same."""
    sizes = np.abs([x for x in expected if abs(x) < NOBODY])
    atol = max(1e-14 * sizes.max(initial=largest), 4.0 * EPS * terms)
    np.testing.assert_allclose(got, expected, rtol=0, atol=atol)
