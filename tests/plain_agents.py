"""Agents under exported laws in plain Python, beside `Agent`: the same messages, the same steps."""

import math
import types

import jax
import numpy as np

import echelon as ech
from echelon.output.archive.flight_folder import network_facts
from echelon.simulation.onboard.law_functions import law_functions
from echelon.simulation.onboard.source_code import python_text
from echelon_flight.pilot import NOBODY, Letterbox, Pilot, TickResult
from echelon_flight.wire import LeaderPacket, Message


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


def compare(agent, runs, steps, dt, size=0.1, terms=1.0):
    """Let an agent and copies of its law take the same random steps; returns their memories.

    Args:
        agent: in the ideal network.
        runs: functions by name, of each copy.
        steps: how many.
        dt: between two, s; the law's own, or longer to see more of its time.
        size: of the random states.
        terms: the largest of which a number of the step is the sum.
    """
    own, draws = agent.own_law, np.random.default_rng(0)
    trim = np.array(own.loop.model.trim[0], float)
    memories = [run["begin"](trim.tolist()) for run in runs]
    for k in range(steps):
        x, time = trim + size * draws.normal(size=len(trim)) * (k > 0), k * dt
        signals, forward = receive(agent, draws)
        u, message = agent.step(time, x)
        memory = agent._now.memory.laws[not own.leads]
        leaves = [np.ravel(leaf[0]) for leaf in jax.tree.leaves(memory)]
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
                atol = max(1e-14 * scale, 4.0 * np.finfo(float).eps * terms)
                np.testing.assert_allclose(got, value, rtol=0, atol=atol)
    return memories


def pilot_of(agent, dt, **options):
    """A pilot with the exported law of an agent, and the facts that it is given."""
    own = agent.own_law
    functions = law_functions(own)
    facts = {
        "agent": agent.number,
        "dt": dt,
        "leads": own.leads,
        "hears": list(own.neighbours),
        "weights": own.weights[0].tolist(),
        "signal": own.signal_names,
        "message": own.forward_names,
        "network": network_facts(own, dt, functions),
    }
    law = types.SimpleNamespace(**as_python(functions.values()))
    states = facts["network"]["messages"] == "state"
    return (StatePilot if states else Pilot)(law, facts, **options), facts


class StatePilot:
    """A follower that hears leaderward, over a network whose messages contain states.

    Pilots refuse such messages; docs/onboard.md has the rules.
    """

    def __init__(self, law, facts):
        assert facts["network"]["uses"] == "leaderward" and not facts["leads"]
        self.law, self.facts, self.memory = law, facts, None
        self.box = Letterbox(facts["hears"], facts["network"]["leaders"], None)

    def tick(self, t, x):
        law, facts, letters = self.law, self.facts, [*self.box.letters.values()]
        memory = law.begin(x) if self.memory is None else self.memory
        forget, agents = facts["network"]["forget_hops"], facts["network"]["agents"]
        hops = min((m.hops for m in letters if m and t - m.time <= forget), default=NOBODY) + 1
        hops = hops if hops < agents else NOBODY
        used = [(w, m) for w, m in zip(facts["weights"], letters) if m and m.hops < hops]
        gaps = [np.multiply(w, law.difference(t, x, memory, m.value)) for w, m in used]
        z = sum(gaps, np.zeros(len(facts["signal"]))) / (sum(w for w, _ in used) or 1.0)
        packet = self.box.packet
        forward = [0.0] * len(facts["message"]) if packet is None else list(packet.content)
        u, after, signal, _, valid = law.tick(t, x, z.tolist(), forward, memory)
        self.memory = after
        return TickResult(u, Message(facts["agent"], t, hops, tuple(signal), packet), valid)


def compare_late(agent, dt, steps, size=0.1):
    """Let an agent and a pilot with its law take the same steps on the same random messages."""
    own, draws = agent.own_law, np.random.default_rng(1)
    pilot, facts = pilot_of(agent, dt)
    trim, sent = np.array(own.loop.model.trim[0], float), 0
    for k in range(steps):
        t = k * dt
        for sender in own.neighbours:
            # Lost or late, some for long, and none at first.
            if k > 5 and (k // 60) % 3 != 2 and draws.random() < 0.3:
                time = max(0.0, t - draws.uniform(0.0, 0.3))
                letter = draw_letter(own, facts, sender, time, draws)
                answer = agent.receive(as_message(letter, own.signal_names))
                assert (pilot.box.receive(letter, t) is None) == (str(answer) == "taken")
        x = trim + size * draws.normal(size=len(trim))
        u, message = agent.step(t, x)
        ours, letter, valid = pilot.tick(t, x.tolist())
        # The input is a sum of terms as large as the own deviation.
        terms = [*u, *([] if message is None else message.signal.values)]
        np.testing.assert_allclose(ours, u, rtol=0, atol=1e-13 * max(1.0, np.abs(terms).max()))
        assert valid and (message is None) == (letter is None)
        if message is not None:
            sent += 1
            assert letter.hops == min(message.hops, NOBODY) and letter.time == message.time
            np.testing.assert_allclose(letter.value, message.signal.values, rtol=0, atol=1e-12)
            if letter.packet is not None:
                content = message.packet.content
                assert letter.packet[:2] == message.packet[:2]
                np.testing.assert_allclose(letter.packet.content, content, rtol=0, atol=1e-12)
    assert sent > steps // 2


def draw_letter(own, facts, sender, time, draws):
    network = facts["network"]
    values = 0.2 * draws.normal(size=len(own.signal_names))
    hops = int(draws.choice([0, 1, 2, NOBODY]))
    said = 0.1 * draws.normal(size=network["content"])
    if network["prediction"] == "packet":
        # In the vehicle's units: a torque of .1 N m would turn it by 10^4 rad/s^2.
        units = np.abs(np.diag(own.loop.model.input_scale))
        said[-len(units) :] *= units
    said = tuple(said.tolist())
    # A leader says one thing at a time: two packets of one time would be the same.
    packet = LeaderPacket(network["leaders"][0], time - draws.uniform(0.0, 0.9), said)
    return Message(sender, time, hops, tuple(values.tolist()), packet)


def as_message(letter, names):
    hops = 2**30 if letter.hops == NOBODY else letter.hops
    signal = names, letter.value
    return ech.Message(letter.sender, signal, None, letter.time, hops, letter.packet)
