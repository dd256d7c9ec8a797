"""A pilot with an exported law does what `Agent` does, with the same letters."""

import math

import jax.numpy as jnp
import numpy as np
import pytest
from plain_agents import Draws, PlainAgent, check, pilot_of

import echelon as ech
from echelon.agents.network.formation_motion import Rotate
from echelon_flight import wire
from echelon_flight.pilot import NOBODY

CARTS, DT = ech.models.DoubleIntegrator(), 0.01


def parts_of(sensing=None, changes=(), leadership=None, **network):
    graph = ech.Graph([(0, 1), (1, 2), (1, 3)])
    offsets = {1: (1.0, 0.0), 2: (1.0, 0.8), 3: (1.0, -0.8)}
    leader = ech.laws.StoppingLeader(reference=ech.references.Circle(rate=0.5))
    drive = ech.Laws(leader, ech.laws.StoppingPoint())
    places = ech.Formation.from_offsets(CARTS, graph, offsets)
    if changes:
        places = places.moving(CARTS, graph, changes)
    world = ech.World(network=ech.Network(rate=25.0, **network), sensing=sensing)
    return ech.Parts(CARTS, graph, places, drive, world=world, leadership=leadership)


NOISE = ech.Sensing(noise={"position": 0.05}, estimator="constant-gain")
CASES = {
    "leaderward": (1, {"hears": "leaderward"}),
    "estimated": (1, {"sensing": NOISE}),
    "turning": (2, {"changes": [Rotate(0.5)]}),
}


@pytest.mark.parametrize("case", CASES)
def test_a_pilot_is_the_agent(case):
    number, options = CASES[case]
    agent = ech.Agent(parts_of(**options), number, DT)
    pilot, draws, plain = pilot_of(agent), Draws(agent), PlainAgent(agent.own_law, {})
    for k in range(150):
        t, x = k * DT, draws.state(k)
        for message in draws.messages(k, t):
            answer = agent.receive(message)
            letter = wire.Message(message.sender, tuple(plain.row(message)))
            assert (pilot.box.receive(letter, t) is None) == (str(answer) == "taken")
        u, message = agent.step(t, x)
        ours, letter, valid = pilot.tick(t, x.tolist())
        assert valid and (message is None) == (letter is None)
        np.testing.assert_allclose(ours, u, rtol=0, atol=1e-13 * max(1.0, np.abs(u).max()))
        if message is not None:
            check(letter.row, plain.row(message))
            assert pilot.leader == message.packet.leader


def flight(pilots, steps, lost, period=4):
    """Let pilots fly carts, and return their places (T, N, 2); the leader is lost at a step."""
    x, places = [[0.0] * 4, [1.0, 0.0, 0.0, 0.0], [1.0, 0.8, 0.0, 0.0]], []
    for k in range(steps):
        letters = []
        for who in range(k > lost, len(pilots)):
            result = pilots[who].tick(k * DT, x[who])
            letters.append(result.letter)
            a, b, c, d = x[who]
            x[who] = [a + DT * c, b + DT * d, c + DT * result.u[0], d + DT * result.u[1]]
        for letter in [each for each in letters if each is not None and k % period == 0]:
            for pilot in pilots:
                pilot.box.receive(letter, k * DT)
        places.append([p[:2] for p in x])
    return np.array(places)


def off_the_plan(places, k, offset):
    leader = np.asarray(ech.references.Circle(rate=0.5)(jnp.asarray(k * DT)))[:2]
    return np.linalg.norm(places - leader - offset)


def test_who_hears_nobody_flies_by_the_plan():
    """As in a run: all know the plan, and what is lost is news of deviations from it."""
    agents = [ech.Agent(parts_of(), k, DT) for k in (0, 1, 2)]
    places = flight([*map(pilot_of, agents)], 700, lost=300)
    for who, offset in ((1, (1.0, 0.0)), (2, (1.0, 0.8))):
        assert off_the_plan(places[699, who], 699, offset) < 0.02


def test_a_backup_leader_leads_by_the_plan_when_its_leader_is_lost():
    parts = parts_of(leadership=ech.Leadership((1,), timeout=0.3))
    pilots = [pilot_of(ech.Agent(parts, k, DT), [1]) for k in (0, 1, 2)]
    places = flight(pilots, 1_000, lost=300)
    for k in (700, 999):
        for who, offset in ((1, (1.0, 0.0)), (2, (1.0, 0.8))):
            assert off_the_plan(places[k, who], k, offset) < 0.02
    assert [pilot.leader for pilot in pilots] == [0, 1, 1]
    # The old leader, back again, follows the one that took the lead.
    back = pilots[0].tick(10.0, [1.0, 0.0, 0.0, 0.0])
    assert pilots[0].leader == 1 and back.letter.row[-1] == 1.0


def test_nobody_is_followed_and_nothing_said_before_a_leader_is_heard():
    pilot = pilot_of(ech.Agent(parts_of(), 1, DT))
    result = pilot.tick(0.0, [0.0] * 4)
    assert result.valid and result.letter is None and pilot.leader == NOBODY


def test_what_is_not_finite_repeats_the_last_input():
    pilot = pilot_of(ech.Agent(parts_of(), 0, DT))
    first = pilot.tick(0.0, [0.0] * 4)
    again = pilot.tick(DT, [0.0, np.nan, 0.0, 0.0])
    assert first.valid and not again.valid and again.u == first.u
    assert pilot.tick(2 * DT, [0.0] * 4).valid and math.isfinite(first.u[0])
