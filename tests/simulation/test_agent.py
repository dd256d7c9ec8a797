"""A single `Agent` computes what it computes in `simulate`, from the messages it receives alone."""

import dataclasses
import math

import numpy as np
import pytest
from carts import CARTS, TREE, carts

import echelon as ech
from echelon.core.errors import EchelonError

X = np.array([0.3, -0.2, 0.1, 0.4])


@pytest.fixture(params=["consensus", "stopping-point", "safety"])
def pair(request):
    """Return agent 1 and a twin, which hear 0, 2 and 3, and agent 2."""
    parts = carts(request.param, feedforward="parent")
    return tuple(ech.Agent(parts, number, dt=0.01) for number in (1, 1, 2))


# So little noise that the run's own measurements are the states.
ESTIMATED = ech.World(sensing=ech.Sensing(noise={"position": 1e-18}, estimator="constant-gain"))


@pytest.mark.parametrize(
    ("law", "world"),
    [("consensus", ech.World()), ("stopping-point", ech.World()), ("stopping-point", ESTIMATED)],
)
def test_agents_by_themselves_do_what_simulate_does(law, world):
    parts = carts(law, feedforward="parent", initial={"position": 1.0}).replace(world=world)
    result = ech.simulate(parts, ech.Settings(horizon=0.2, dt=0.01, seed=3, engine="jax"))
    assert result.sums.avoidance.any() == (law == "safety")
    agents = [ech.Agent(parts, k, dt=0.01) for k in range(4)]
    for k, t in enumerate(result.times[:-1]):
        x = result.states[k]
        for agent in agents:
            broadcast(agents, agent.hello(x[agent.number]))
        # Outward: the leader, its neighbour, and the two behind.
        for agent in agents:
            u, message = agent.step(0.01 * k, x[agent.number])
            broadcast(agents, message)
            expected = result.inputs[k, agent.number]
            np.testing.assert_allclose(u, expected, atol=1e-12, err_msg=f"{t}")
            assert u.dtype == np.float64


def test_an_agent_with_weaker_motors_is_cut_at_its_own_limits():
    model, graph = ech.models.PlanarQuadrotor(), ech.Graph.path(2)
    formation = ech.Formation.line(model, graph)
    gain = ech.synthesize(model, graph, ech.gains.Riccati())
    laws = ech.Laws(ech.laws.TrimInput(), ech.laws.Consensus(gain, feedforward="none"))
    world = ech.World(plants={1: dataclasses.replace(model, motor_thrust=0.7 * model.motor_thrust)})
    parts = ech.Parts(model, graph, formation, laws, initial={"position": 3.0}, world=world)
    run = ech.simulate(parts, ech.Settings(horizon=0.1, dt=0.01, seed=2))
    agents = [ech.Agent(parts, k, dt=0.01) for k in (0, 1)]
    plain = ech.Agent(parts.replace(world=ech.World()), 1, dt=0.01)
    x = run.states[0]
    for agent in agents:
        broadcast([*agents, plain], agent.hello(x[agent.number]))
    broadcast([*agents, plain], agents[0].step(0.0, x[0])[1])
    np.testing.assert_allclose(agents[1].step(0.0, x[1])[0], run.inputs[0, 1], atol=1e-12)
    assert np.abs(plain.step(0.0, x[1])[0] - run.inputs[0, 1]).max() > 0.01


def broadcast(agents, message):
    for agent in agents:
        agent.receive(message)


def spoiled(message):
    """Yield what a network may deliver in place of a message, and the word for it."""
    names, values = message.signal
    ones = np.ones(len(values))
    for bad in (math.nan, math.inf, -math.inf, 1e13):
        for k in range(len(values)):
            wrong = np.where(np.arange(len(values)) == k, bad, values)
            yield message._replace(signal=(names, wrong)), "not-finite"
    # The least whole number has no absolute value of its own kind.
    yield message._replace(signal=(names, [-(2**63)] * len(values))), "not-finite"
    forward = message.feedforward
    yield message._replace(feedforward=(forward[0], forward[1] * math.nan)), "not-finite"
    yield message._replace(signal=(names, values[:-1])), "wrong-size"
    yield message._replace(signal=(names, values[None])), "wrong-size"
    yield message._replace(signal=(("height",), ones[:1])), "wrong-size"
    yield message._replace(signal=(names[:1] * len(names), values)), "wrong-size"
    yield message._replace(sender=2**70), "not-heard"
    yield message._replace(sender=1), "not-heard"
    texts = np.array(["1"] * len(values))
    for values_ in (None, "text", texts, [[1.0], [1.0, 2.0]], values * 1j, [object()]):
        yield message._replace(signal=(names, values_)), "no-message"
    for odd in (None, "text", 3, b"", {}, (), (2, values), math.nan, object()):
        yield odd, "no-message"
    for odd in (None, "text", np.zeros(3)):
        yield message._replace(signal=odd), "no-message"
        yield message._replace(sender=odd), "no-message"
    yield message._replace(feedforward="text"), "no-message"


def test_a_bad_message_is_rejected_with_a_reason_and_changes_nothing(pair):
    agent, twin, neighbour = pair
    _, message = neighbour.step(0.0, X)
    for one in (agent, twin):
        assert str(one.receive(message)) == "taken"
    for bad, word in spoiled(message):
        assert str(agent.receive(bad)) == word, bad
    for k in range(3):
        (u, sent), (other, other_sent) = agent.step(0.01 * k, -X), twin.step(0.01 * k, -X)
        np.testing.assert_array_equal(u, other)
        for mine, theirs in zip(sent[1:3], other_sent[1:3], strict=True):
            np.testing.assert_array_equal(mine.values, theirs.values)


def test_an_agent_that_hears_nobody_acts_and_goes_on_with_what_it_last_heard(pair):
    agent, _, neighbour = pair
    alone, _ = agent.step(0.0, X)
    assert np.isfinite(alone).all()
    agent.receive(neighbour.hello(X + 1.0))
    (first, _), (later, _) = agent.step(0.01, X), agent.step(0.01, X)
    assert np.isfinite([first, later]).all() and np.abs(first - alone).max() > 1e-3


def test_a_state_that_is_not_finite_leaves_the_input_and_the_memory(pair):
    agent, twin, _ = pair
    assert agent.step(0.0, X * math.nan)[1] is None and agent.hello(X * math.inf) is None
    np.testing.assert_array_equal(agent.step(0.0, X * math.nan)[0], CARTS.trim[1])
    u, message = agent.step(0.0, X)
    held, again = agent.step(0.01, X * math.nan)
    np.testing.assert_array_equal(held, u)
    assert again is message and agent.blind == 3
    twin.step(0.0, X)
    np.testing.assert_array_equal(agent.step(0.02, -X)[0], twin.step(0.02, -X)[0])


def test_unlike_agents_use_the_outputs_that_both_have():
    places = {1: (1.0, 0.0, 0.0), 2: (1.0, 0.8, 0.0), 3: (1.0, -0.8, 0.0)}
    laws = ech.Laws(ech.laws.StoppingLeader(), ech.laws.StoppingPoint())

    def agent_of(model, number):
        formation = ech.Formation.from_offsets(model, TREE, places)
        return ech.Agent(ech.Parts(model, TREE, formation, laws), number)

    models = ech.models.Quadrotor(), ech.models.DoubleIntegrator(dimension=3)
    for mine, theirs in (models, models[::-1]):
        agent, other = agent_of(mine, 1), agent_of(theirs, 2)
        x, y = np.array(mine.trim[0]), np.array(theirs.trim[0])
        alone, _ = agent.step(0.0, x)
        assert str(agent.receive(other.step(0.0, y)[1])) == "taken"
        # At the same place relative to their goals nothing is to be done.
        y[1] += 0.8
        agent.receive(other.hello(y))
        np.testing.assert_allclose(agent.step(0.005, x)[0], alone, atol=1e-9)
        y[0] += 5.0
        agent.receive(other.hello(y))
        assert np.abs(agent.step(0.01, x)[0] - alone).max() > 1e-6


def test_what_a_caller_does_wrong_raises():
    parts = carts("stopping-point")
    agent = ech.Agent(parts, 2)
    with pytest.raises(EchelonError, match="has shape"):
        agent.hello(np.zeros(3))
    for odd in (None, "text", ["1", "2", "3", "4"], [object()] * 4):
        with pytest.raises(EchelonError, match="numbers"):
            agent.step(0.0, odd)
    agent.step(1.0, X)
    for t in (0.5, math.nan, math.inf, "1", None):
        with pytest.raises(EchelonError, match="`t` is"):
            agent.step(t, X)
    for number in (4, -1, 1.0, "1", None):
        with pytest.raises(EchelonError, match="not in this graph"):
            ech.Agent(parts, number)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("law", "network"),
    [
        ("stopping-point", {"delay": 0.05, "hears": "leaderward"}),
        ("consensus", {"delay": 0.03, "prediction": "packet"}),
        ("stopping-point", {"delay": 0.03, "messages": "state"}),
        ("safety", {"delay": 0.05}),
    ],
)
def test_agents_over_a_plain_queue_fly_as_simulated(law, network):
    """A queue of one's own between single agents, against the channel of all together."""
    radio, dt, steps = ech.Network(rate=25.0, **network), 0.01, 150
    parts = carts(law, radio, initial={"position": 1.0}, start_error={"x": 0.7})
    settings = ech.Settings(horizon=steps * dt, dt=dt, engine="jax", integrator="euler")
    simulated = ech.simulate(parts, settings)
    assert simulated.sums.avoidance.any() == (law == "safety")
    agents = [ech.Agent(parts, k, dt) for k in range(4)]
    x, queue = simulated.states[0].copy(), []
    delay = max(1, round(network["delay"] / dt))
    for k in range(steps):
        np.testing.assert_allclose(x, simulated.states[k], atol=1e-9)
        for due, message in queue:
            if due == k:
                broadcast(agents, message)
        inputs, messages = zip(*(a.step(k * dt, x[a.number]) for a in agents), strict=True)
        if k % 4 == 0:
            queue += [(k + delay, message) for message in messages if message is not None]
        x = x + dt * np.concatenate([x[:, 2:], inputs], axis=1)


@pytest.fixture
def late():
    """A leader over a radio, agent 1 and its twin, and a state."""
    parts = carts("stopping-point", ech.Network(rate=25.0, delay=0.05))
    return *(ech.Agent(parts, k, 0.01) for k in (0, 1, 1)), np.array([0.3, 0.1, 0.0, 0.2])


def test_late_damaged_and_forged_messages_change_nothing(late):
    leader, agent, twin, x = late
    # On a network whose jitter is longer than its delay there are agents too.
    jitter = carts("consensus", ech.Network(rate=25.0, jitter=0.4, forget=2.0))
    assert ech.Agent(jitter, 1, dt=0.01).neighbours
    assert agent.step(0.0, x)[1] is None
    twin.step(0.0, x)
    _, first = leader.step(0.0, x)
    _, message = leader.step(0.01, x + 0.1)
    for one in (agent, twin):
        assert str(one.receive(message)) == "taken"
    bad = [({}, "late"), ({"time": math.nan}, "no-message"), ({"time": None}, "no-message")]
    bad += [({"time": 9.0}, "ahead"), ({"time": 10**400}, "no-message")]
    bad += [({"packet": (0, 0.0)}, "no-message"), ({"packet": None}, "no-message")]
    bad += [({"hops": "text"}, "no-message")]
    forged = [({"time": 9.0}, "ahead"), ({"time": 10**400}, "no-message")]
    forged += [({"leader": 2}, "no-message"), ({"leader": [0]}, "no-message")]
    forged += [({"content": (math.nan, 0.0)}, "not-finite"), ({"content": (0.0,)}, "wrong-size")]
    forged += [({"term": "1"}, "no-message"), ({"term": 10**9}, "no-message")]
    bad += [({"packet": message.packet._replace(**change)}, word) for change, word in forged]
    assert str(agent.receive(first)) == "late"
    for change, word in bad:
        damaged = message._replace(**({"time": 0.02} | change if change else {}))
        assert str(agent.receive(damaged)) == word, change
    check_twins(agent, twin, x)


def check_twins(agent, twin, x):
    for k in range(1, 4):
        (u, sent), (other, other_sent) = agent.step(0.02 * k, x), twin.step(0.02 * k, x)
        assert np.array_equal(u, other) and sent.time == other_sent.time
        assert np.array_equal(sent.signal[1], other_sent.signal[1])


def test_a_message_is_used_as_it_was_when_it_came(late):
    """Whoever reads messages into one buffer may overwrite it, and may send whole numbers."""
    leader, agent, twin, x = late
    _, message = leader.step(0.0, x)
    buffer = np.array([1, -2])
    for one, content in ((twin, (1.0, -2.0)), (agent, buffer)):
        sent = message._replace(packet=message.packet._replace(content=content))
        assert str(one.receive(sent)) == "taken"
    buffer[:] = -(2**63)
    check_twins(agent, twin, x)
