"""A pilot with an exported law does what `Agent` does, with the same letters."""

import jax.numpy as jnp
import numpy as np
import pytest
from plain_agents import compare_late, draw_letter, pilot_of

import echelon as ech
from echelon.agents.network.formation_motion import Rotate

CARTS, DT = ech.models.DoubleIntegrator(), 0.01


def parts_of(sensing=None, changes=(), **network):
    graph = ech.Graph([(0, 1), (1, 2), (1, 3)])
    offsets = {1: (1.0, 0.0), 2: (1.0, 0.8), 3: (1.0, -0.8)}
    leader = ech.laws.StoppingLeader(reference=ech.references.Circle(rate=0.5))
    drive = ech.Laws(leader, ech.laws.StoppingPoint())
    places = ech.Formation.from_offsets(CARTS, graph, offsets)
    if changes:
        places = places.moving(CARTS, graph, changes)
    world = ech.World(network=ech.Network(rate=25.0, **network), sensing=sensing)
    return ech.Parts(CARTS, graph, places, drive, world=world)


NOISE = ech.Sensing(noise={"position": 0.05}, estimator="constant-gain")
CASES = {
    "leaderward": (1, {"hears": "leaderward"}),
    "estimated": (1, {"sensing": NOISE}),
    "turning": (2, {"changes": [Rotate(0.5)]}),
}


@pytest.mark.parametrize("case", CASES)
def test_a_pilot_is_the_agent(case):
    """Other networks and laws are in tests/simulation."""
    number, options = CASES[case]
    compare_late(ech.Agent(parts_of(**options), number, DT), DT, 150)


@pytest.mark.parametrize("changes", [[], [Rotate(0.8)]])
def test_who_hears_nobody_flies_by_the_plan_and_then_holds(changes):
    agent = ech.Agent(parts_of(changes=changes), 1, DT)
    pilot, facts = pilot_of(agent, DT, hold=1.0)
    draws, x = np.random.default_rng(0), [1.0, 0.0, 0.0, 0.0]
    letter = draw_letter(agent.own_law, facts, 0, 0.0, draws)
    assert pilot.box.receive(letter, 0.0) is None
    speeds = []
    for k in range(400):
        u = pilot.tick(k * DT, x).u
        x = [x[0] + DT * x[2], x[1] + DT * x[3], x[2] + DT * u[0], x[3] + DT * u[1]]
        speeds.append(np.hypot(*x[2:]))
    # By the plan it follows the leader on its circle, and later it stands still.
    assert min(speeds[60:100]) > 0.3 and max(speeds[350:]) < 1e-3


def test_a_backup_leader_leads_by_the_plan_when_its_leader_is_lost():
    leadership = {"backups": [1], "timeout": 0.3}
    agents = [ech.Agent(parts_of(), k, DT) for k in (0, 1, 2)]
    pilots = [pilot_of(agent, DT, leadership=leadership, hold=1.0)[0] for agent in agents]
    x, places, terms = [[0.0] * 4, [1.0, 0.0, 0.0, 0.0], [1.0, 0.8, 0.0, 0.0]], [], []
    for k in range(1_000):
        letters = []
        # The leader is lost after 3 s.
        for who in range(k > 300, 3):
            result = pilots[who].tick(k * DT, x[who])
            letters.append(result.letter)
            a, b, c, d = x[who]
            x[who] = [a + DT * c, b + DT * d, c + DT * result.u[0], d + DT * result.u[1]]
        for letter in [each for each in letters if each is not None and k % 4 == 0]:
            for pilot in pilots:
                pilot.box.receive(letter, k * DT)
        places.append([p[:2] for p in x])
        terms.append(pilots[2].box.packet.term if k > 10 else 0)
    assert terms[330] == 0 and set(terms[345:]) == {1}
    circle = ech.references.Circle(rate=0.5)
    for k in (700, 999):
        leader = np.asarray(circle(jnp.asarray(k * DT)))[:2]
        for who, offset in ((1, (1.0, 0.0)), (2, (1.0, 0.8))):
            assert np.linalg.norm(np.array(places[k][who]) - leader - offset) < 0.02
    # The old leader, back again, does not take the lead from it.
    assert pilots[1].box.receive(pilots[0].tick(10.0, x[0]).letter, 10.0) is None
    assert [pilot.box.packet.leader for pilot in pilots] == [1, 1, 1]


def test_what_is_not_finite_repeats_the_last_input():
    agent = ech.Agent(parts_of(), 0, DT)
    pilot, _ = pilot_of(agent, DT)
    first = pilot.tick(0.0, [0.0] * 4)
    again = pilot.tick(DT, [0.0, np.nan, 0.0, 0.0])
    assert first.valid and not again.valid and again.u == first.u
    assert pilot.tick(2 * DT, [0.0] * 4).valid
