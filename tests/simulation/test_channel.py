"""A network that is not ideal: which messages arrive when, and what agents make of them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import echelon as ech
from echelon.agents.network.channel import NEVER
from echelon.core.errors import EchelonError, SimulationError
from echelon.simulation.engine.batch import Batch
from echelon.simulation.engine.prepare import prepare
from echelon.simulation.step.assembly import assemble
from echelon.simulation.step.leadership import FixedLeaders
from echelon.simulation.step.networks import MessageRules
from echelon.simulation.step.sequence import begin, step

DT = 0.01
SENDERS, RECEIVERS = np.array([0, 1, 1, 2, 0]), np.array([1, 0, 2, 1, 2])


def networks():
    return st.builds(
        lambda every, **more: ech.Network(rate=1.0 / (every * DT), forget=9.0, **more),
        every=st.integers(1, 4),
        delay=st.integers(0, 9).map(lambda k: k * DT),
        jitter=st.integers(0, 9).map(lambda k: k * DT),
        loss=st.sampled_from([0.0, 0.3, 1.0]),
        bursts=st.builds(ech.Bursts, st.sampled_from([0.0, 0.4]), st.just(0.1)),
        seed=st.integers(0, 2**63 - 1),
    )


def arrivals_of(channel, steps):
    """The newest stamp that each link has at each step, by the channel."""
    example = jnp.zeros((3, 1))
    sends = jnp.ones(5, bool)

    def step(carry, k):
        posts, newest = carry
        arrival = channel.arrivals(posts, k, newest)
        sent = jnp.full((3, 1), k, float)
        content = jnp.where(arrival.new, posts.content[arrival.slot, SENDERS, 0], -1.0)
        posts = channel.post(posts, k, sent, sends, RECEIVERS, SENDERS)
        return (posts, arrival.stamp), (arrival.stamp, content, arrival.new, posts.arrival)

    start = channel.begin(example, 5), jnp.full(5, NEVER, jnp.int32)
    return jax.lax.scan(step, start, jnp.arange(steps, dtype=jnp.int32))[1]


@pytest.mark.parametrize("forget", [1e6, 2e6, 1e7, 1e9, 1e300])
def test_hop_counts_are_never_forgotten_where_forgetting_takes_ages(forget):
    channel = ech.Network(forget=forget).prepared(DT, 10.0, 0)
    for bits in (False, True):
        with jax.enable_x64(bits):
            rules = MessageRules.of(channel, FixedLeaders(np.ones(1, bool)), 1)
            ages = jax.jit(lambda rules: rules.hop_life(DT))(rules)
            assert float(ages) >= 10.0 * min(forget, 1e6)
            assert ages.dtype == (np.float64 if bits else np.float32)


@settings(max_examples=25, deadline=None)
@given(network=networks())
def test_messages_arrive_as_in_a_plain_queue(network):
    steps = 60
    with jax.enable_x64(True):
        channel = network.prepared(DT, 10.0, 0)
        stamps, content, new, arrival = map(
            np.asarray, jax.jit(arrivals_of, static_argnums=1)(channel, steps)
        )
    every, delay, jitter = (int(x) for x in (channel.every, channel.delay, channel.jitter))
    slots = channel.slots
    for link in range(5):
        queue, newest = [], NEVER
        for k in range(steps):
            for sent, due in queue:
                if due == k and sent > newest:
                    newest = sent
            assert stamps[k, link] == newest
            if new[k, link]:
                # What arrives is what was sent then, and no slot was overwritten before.
                assert content[k, link] == newest
            if k % every == 0:
                due = int(arrival[k, (k // every) % slots, link])
                assert due == NEVER or k + delay <= due <= k + delay + jitter
                queue.append((k, due))
    if network.loss == 1.0:
        assert (stamps == NEVER).all()
    if network.loss == 0.0 and not channel.bursty:
        assert (arrival[-1][arrival[-1] != NEVER] > 0).all() and stamps.max() > NEVER


def test_draws_belong_to_a_message_and_its_ends_and_not_to_the_place_of_the_link():
    network = ech.Network(rate=100.0, jitter=0.05, loss=0.4, bursts=ech.Bursts(0.3, 0.05))
    with jax.enable_x64(True):
        channel = network.prepared(DT, 10.0, 5)
        example, sends = jnp.zeros((3, 1)), jnp.ones(5, bool)

        def posts(order):
            ends = RECEIVERS[order], SENDERS[order]

            def one(state, k):
                return channel.post(state, k, example, sends, *ends), None

            steps = jnp.arange(40, dtype=jnp.int32)
            run = jax.jit(lambda: jax.lax.scan(one, channel.begin(example, 5), steps)[0])
            return np.asarray(run().arrival)

        order = np.array([3, 1, 4, 0, 2])
        np.testing.assert_array_equal(posts(np.arange(5))[:, order], posts(order))


def test_the_shares_of_loss_and_of_outages_are_those_asked_for():
    steps = 4000
    for network, share in (
        (ech.Network(rate=100.0, loss=0.2), 0.2),
        (ech.Network(rate=100.0, bursts=ech.Bursts(0.33, 0.2)), 0.33),
        (ech.Network(rate=100.0, loss=0.5, bursts=ech.Bursts(0.5, 0.1)), 0.75),
    ):
        with jax.enable_x64(True):
            channel = network.prepared(DT, 100.0, 1)
            arrival = np.asarray(jax.jit(arrivals_of, static_argnums=1)(channel, steps)[3])
        rows = arrival[np.arange(steps), np.arange(steps) % channel.slots]
        outages = (rows == NEVER).mean()
        # Independent losses scatter by .4 %, outages of 20 messages by some 2 %.
        assert outages == pytest.approx(share, abs=0.04)


POINTS = ech.models.SingleIntegrator()
GRAPH = ech.Graph([(0, 1), (1, 2, 0.5), (2, 3), (3, 1, 2.0)])
STARTS = np.random.default_rng(4).normal(size=(4, len(POINTS.state_names)))
STEPS = 40


def parts(network=None):
    drive = ech.Laws(ech.laws.Agreement(), ech.laws.Agreement())
    places = ech.Formation.from_offsets(POINTS, GRAPH, {})
    world = ech.World(network=network)
    return ech.Parts(POINTS, GRAPH, places, drive, initial=STARTS, world=world)


def chosen(**more):
    return ech.Settings(
        **{"horizon": STEPS * DT, "dt": DT, "integrator": "euler", "engine": "jax", **more}
    )


def states_late(late):
    """The states of Euler's steps under messages that are so many steps old."""
    x = [STARTS]
    for k in range(STEPS):
        now = x[k]
        # Before the first message an agent takes its neighbours to be where it is.
        old = x[k - late] if k >= late else None
        z = np.zeros_like(now)
        for (i, j), weight in zip(GRAPH.edges, GRAPH.weights, strict=True):
            if old is not None:
                z[i] += weight * (now[i] - old[j])
                z[j] += weight * (now[j] - old[i])
        x.append(now - DT * z)
    return np.array(x)


@pytest.mark.parametrize("late", [1, 5])
def test_messages_that_contain_states_are_received_as_they_were_sent(late):
    network = ech.Network(rate=1.0 / DT, delay=late * DT, messages="state")
    result = ech.simulate(parts(network), chosen())
    np.testing.assert_allclose(result.states, states_late(late), atol=1e-12)
    native = ech.simulate(parts(network), chosen(engine="native"))
    np.testing.assert_allclose(native.states, result.states, rtol=0, atol=1e-13)


def test_a_run_continues_with_the_messages_that_are_under_way():
    network = ech.Network(rate=50.0, delay=0.03, loss=0.3, messages="state")
    sensing = ech.Sensing(delay=0.02, noise={"x": 0.1}, estimator="constant-gain")
    world = ech.World(network=network, sensing=sensing)
    run = parts(network).replace(world=world), chosen(horizon=200 * DT)
    whole, stretches = ech.simulate(*run), []

    def enough(so_far):
        if so_far.done >= 20:
            raise KeyboardInterrupt

    ech.simulate(*run, progress=enough, keep=stretches.append)
    resumed = ech.simulate(*run, before=stretches)
    assert len(stretches[-1].times) < len(whole.times)
    np.testing.assert_array_equal(resumed.states, whole.states)


def test_a_batch_draws_for_each_seed_what_a_run_alone_draws():
    network = ech.Network(rate=100.0, loss=0.5, jitter=0.02, messages="state")
    runs = [(parts(network), chosen(seed=k)) for k in range(3)]
    alone = [ech.simulate(*run).states for run in runs]
    together = [result.states for result in Batch(1).fly(runs)]
    np.testing.assert_allclose(together, alone, atol=1e-13)
    assert not np.allclose(alone[0], alone[1])


@pytest.mark.slow
def test_a_link_that_is_cut_carries_nothing_and_hops_heal():
    """A follower that has lost its way to the leader is reached by another one."""
    turns = [(0.0, [(0, 1), (1, 2)]), (0.5, [(0, 1), (0, 2)]), (1.0, [(0, 2), (2, 1)])]
    graph = ech.Graph.switching(turns, directed=True)
    law = ech.laws.StoppingPoint(hears="all", coupling=4.0)
    drive = ech.Laws(ech.laws.StoppingLeader(), law)
    carts = ech.models.DoubleIntegrator()
    network = ech.Network(rate=100.0, hears="leaderward", forget=0.05)
    made = ech.Parts(
        carts,
        graph,
        ech.Formation.from_offsets(carts, graph, {1: [1.0, 0.0], 2: [2.0, 0.0]}),
        drive,
        world=ech.World(network=network),
    )
    prepared = prepare(made, ech.Settings(horizon=2.0, dt=DT, engine="jax"))
    drive = prepared.parts.drive
    with jax.enable_x64(True):
        loop = assemble(prepared.problem, drive.leader, drive.follower)

        def hops_of(now):
            last = (now.step - 1) // loop.network.medium.every
            return now.memory.network[0].content.hops[last % loop.network.medium.slots]

        def one(now, _):
            now = step(loop, now)
            return now, hops_of(now)

        start = begin(loop, jnp.zeros((3, 4)))
        hops = np.asarray(jax.jit(lambda now: jax.lax.scan(one, now, length=200)[1])(start))
    # The last stretch begins at 1 s, and counts outlive ten times `forget`.
    for k, expected in ((40, [0, 1, 2]), (45, [0, 1, 2]), (199, [0, 2, 1])):
        assert hops[k].tolist() == expected


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"jitter": 1e12, "forget": 1e13}, r"`jitter` of the network is 1e\+12 s"),
        ({"rate": 1e-300, "forget": 1e308}, r"`rate` of the network is 1e-300 Hz"),
        ({"rate": 1e-9, "forget": 1e12}, r"`rate` of the network is 1e-09 Hz"),
        ({"rate": 1e300}, r"`rate` of the network is 1e\+300 Hz"),
        ({"rate": 30.0}, r"`rate` .* 30 Hz, .* control rate 100 Hz divided by a whole number"),
        ({"delay": 9.0, "forget": 10.0}, r"`delay` .* 9 s, .* at most the horizon, 0.4 s"),
        ({"loss": 1.5}, r"`loss` .* 1.5, .* from 0 to 1"),
        ({"loss": True}, r"`loss` .* True, .* a number"),
        ({"bursts": ech.Bursts(share=1.0)}, r"`bursts.share` .* at least 0 and below 1"),
        ({"forget": 0.02}, r"`forget` .* 0.02 s, .* at least two periods"),
        ({"messages": "stat"}, r"`messages` .* `stat`, allowed are .* .did you mean"),
        ({"prediction": "preview"}, r"`prediction` .* `Agreement` has no plan; use `packet`"),
    ],
)
def test_a_network_that_cannot_work_is_refused_in_one_sentence(change, message):
    with pytest.raises(SimulationError, match=message):
        ech.simulate(parts(ech.Network(**{"rate": 50.0, **change})), chosen())


CART, ROW = ech.models.DoubleIntegrator(dimension=1), ech.Graph.path(3)


def in_a_row(leader, radio, **more):
    """Carts in a row under a law of states, over a radio."""
    line = ech.Formation.from_offsets(CART, ROW, {1: [1.0], 2: [2.0]})
    drive = ech.Laws(leader, ech.laws.Consensus(ech.synthesize(CART, ROW, ech.gains.Riccati())))
    return ech.Parts(CART, ROW, line, drive, world=ech.World(network=radio), **more)


def test_a_leader_without_a_plan_is_carried_on_by_the_model():
    radio = ech.Network(rate=25.0, delay=0.1, loss=0.3, prediction="packet")
    starts = {"initial": {"position": 0.3}, "start_error": {"vx": 0.8}}
    parts, settings = in_a_row(ech.laws.TrimInput(), radio, **starts), ech.Settings(12.0, DT)
    # It drifts at .8 m/s, and what is heard of it is some .15 s old.
    assert ech.simulate(parts, settings._replace(engine="jax")).formation_errors[-1].max() < 1e-3
    with pytest.raises(EchelonError, match="has no plan; use `packet`"):
        ech.simulate(in_a_row(ech.laws.TrimInput(), ech.Network()), settings)


@pytest.mark.slow
def test_states_are_not_predicted_by_a_plan_of_stopping_points():
    leader, short = ech.laws.StoppingLeader(), ech.Settings(horizon=0.05, dt=DT)
    with pytest.raises(SimulationError, match="`Consensus` do not send what the plan .* `packet`"):
        ech.simulate(in_a_row(leader, ech.Network()), short)
    assert ech.simulate(in_a_row(leader, ech.Network(prediction="packet")), short).outcome.reached
