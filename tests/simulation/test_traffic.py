"""The ages, losses and numbers of messages, computed after a run."""

import jax
import numpy as np
import pytest

import echelon as ech
from echelon.agents.network.channel import NEVER
from echelon.agents.network.hearing import edges_of
from echelon.core.numerics import precision
from echelon.simulation.engine.prepare import prepare
from echelon.simulation.engine.traffic import Traffic, traffic
from echelon.simulation.step.assembly import assemble
from echelon.simulation.step.sequence import begin, step

DT, STEPS = 0.02, 150


def parts_of(network, **graph):
    cart = ech.models.DoubleIntegrator()
    graph = ech.Graph([(0, 1), (1, 2), (2, 3), (1, 3)], **graph)
    laws = ech.Laws(ech.laws.StoppingLeader(), ech.laws.StoppingPoint())
    line = ech.Formation.line(cart, graph)
    return ech.Parts(cart, graph, line, laws, {"position": 0.5}, world=ech.World(network=network))


def followed(network, every=1, **graph):
    settings = ech.Settings(horizon=STEPS * DT, dt=DT)
    prepared = prepare(parts_of(network, **graph), settings)
    times = DT * np.arange(0, STEPS + 1, every)
    found = traffic(prepared.parts, settings, times, STEPS)
    assert found is not None
    return prepared, found


NETWORKS = {
    "jitter": ech.Network(rate=25.0, delay=0.06, jitter=0.1, loss=0.3, seed=3),
    "leaderward": ech.Network(rate=50.0, loss=0.5, hears="leaderward", forget=0.1),
    "outages": ech.Network(bursts=ech.Bursts(0.4, 0.2), messages="state"),
}


@pytest.mark.parametrize(
    ("name", "directed"), list(zip(NETWORKS, (False, False, True), strict=True))
)
def test_ages_are_those_of_the_messages_that_the_run_itself_used(name, directed):
    prepared, found = followed(NETWORKS[name], directed=directed)
    drive = prepared.parts.drive
    with precision("float64"):
        loop = assemble(prepared.problem, drive.leader, drive.follower)

        def one(now, _):
            after = step(loop, now)
            return after, after.memory.network[1].stamp

        run = jax.jit(lambda now: jax.lax.scan(one, now, None, STEPS)[1])
        stamps = np.asarray(run(begin(loop, prepared.problem.states)))
    # Mail is taken at the beginning of a step, and so is a frame.
    place = edges_of(prepared.parts.graph, loop.graph.exchange)
    times = np.arange(STEPS)[:, None]
    expected = np.where(stamps == NEVER, np.nan, DT * (times - stamps))
    expected = np.where(prepared.parts.receives[place], expected, np.nan)
    np.testing.assert_allclose(found.ages[:-1, *place], expected, atol=1e-12)
    # Of an agent it is the oldest one.
    worst = found.of_agents(prepared.parts.graph.edges, 4)
    for agent in range(4):
        own = found.ages[:, prepared.parts.graph.edges == agent]
        known = ~np.isnan(own).all(axis=1)
        assert np.array_equal(known, ~np.isnan(worst[:, agent]))
        assert np.array_equal(np.nanmax(own[known], axis=1), worst[known, agent])


def test_a_network_without_losses_has_the_ages_of_its_rate_and_delay():
    _, found = followed(ech.Network(rate=12.5, delay=0.1), directed=True)
    assert (found.lost, found.late) == (0, 0) and not found.losses.any()
    assert found.largest == pytest.approx(0.1 + 0.08 - DT)
    tail = found.ages[-40:, :, 1]
    assert tail.mean() == pytest.approx(0.1 + (0.08 - DT) / 2)
    # From when each sender has a packet: the leader at once, the others a delay later each.
    first = [0, 8, 16, 8]
    assert found.sent == sum(len(range(0, STEPS - k, 4)) for k in first)


def test_messages_in_use_are_those_of_neighbours_nearer_to_the_leader():
    network = ech.Network(rate=50.0, delay=0.02, jitter=0.06, hears="leaderward", seed=1)
    _, found = followed(network)
    # Of the edges 0-1, 1-2 and 1-3, outward; 2 and 3 are as far away as each other.
    used, every = found.ages[:-1, [0, 1, 3], 1], found.ages[:-1]
    assert found.mean == pytest.approx(np.nanmean(used), rel=1e-12)
    assert abs(found.mean - np.nanmean(every)) > 1e-5


def test_every_message_is_lost_or_arrives_or_is_late_or_under_way():
    network = ech.Network(rate=25.0, delay=0.02, jitter=0.2, loss=0.3, forget=9.0)
    _, found = followed(network, directed=True)
    assert found.sent - found.lost > found.late > 0
    # A frame of each step: every newer message makes the age smaller.
    newer = np.nan_to_num(found.ages, nan=1e9)
    taken = int((np.diff(newer, axis=0) < -DT / 2).sum())
    under_way = found.sent - found.lost - found.late - taken
    assert 0 <= under_way <= 4 * (0.22 / 0.04 + 1)
    assert found.losses.sum() == found.lost


def test_frames_change_no_number_of_a_run():
    network = NETWORKS["jitter"]
    (_, fine), (_, coarse) = followed(network), followed(network, every=7)
    assert fine[2:] == coarse[2:]
    assert np.array_equal(fine.ages[::7], coarse.ages, equal_nan=True)
    assert np.array_equal(
        np.add.reduceat(fine.losses[1:], range(0, STEPS - 3, 7))[:20], coarse.losses[1:21]
    )


def test_all_messages_lost_and_those_of_an_absent_sender_have_no_age():
    _, found = followed(ech.Network(loss=1.0))
    assert found.sent == found.lost > 0 and np.isnan(found.ages).all() and np.isnan(found.mean)
    ages = np.array([[[0.1, 0.2], [0.3, 0.4]], [[0.5, 0.6], [0.7, 0.8]]])
    found = Traffic(ages, np.zeros((2, 2, 2), int), 0, 0, 0, 0.8, 0.4)
    edges = np.array([[0, 1], [1, 2]])
    here = np.array([[True, True, True], [False, True, True]])
    expected = [[0.1, 0.3, 0.4], [np.nan, 0.7, 0.8]]
    np.testing.assert_array_equal(found.of_agents(edges, 3, here), expected)


@pytest.mark.slow
def test_a_run_reports_its_messages():
    network = ech.Network(loss=0.3, seed=1)
    result = ech.simulate(parts_of(network), ech.Settings(horizon=1.0, dt=DT))
    numbers = ech.summary(result)
    assert numbers["messages_lost"] == result.traffic.lost > 0
    assert numbers["largest_age_s"] >= numbers["mean_age_s"] >= DT
    assert f"Messages: {result.traffic.sent} sent" in ech.report(result)
    data = ech.dataset(result)
    assert data.age.dims == ("time", "agent") and float(data.forget) == network.forget
    ideal = ech.simulate(parts_of(None), ech.Settings(horizon=1.0, dt=DT))
    assert ideal.traffic is None and ech.summary(ideal)["messages_sent"] is None
    assert "age" not in ech.dataset(ideal) and "Messages" not in ech.report(ideal)
