"""A pilot with an exported law does what `Agent` does, with the same letters."""

import types

import jax.numpy as jnp
import numpy as np
import pytest

import echelon as ech
from echelon.agents.network.formation_motion import Rotate
from echelon.output.archive.flight_folder import network_facts
from echelon.simulation.onboard.law_functions import law_functions
from echelon.simulation.onboard.source_code import python_text
from echelon_flight.pilot import NOBODY, Pilot
from echelon_flight.wire import Letter, Packet

CARTS, DT = ech.models.DoubleIntegrator(), 0.01


def parts_of(law, sensing=None, changes=(), **network):
    graph = ech.Graph([(0, 1), (1, 2), (1, 3)])
    offsets = {1: (1.0, 0.0), 2: (1.0, 0.8), 3: (1.0, -0.8)}
    circle = ech.references.Circle(rate=0.5)
    if law == "consensus":
        gain = ech.synthesize(CARTS, graph, ech.gains.Riccati())
        drive = ech.Laws(ech.laws.Tracking(circle), ech.laws.Consensus(gain))
    else:
        leader = ech.laws.StoppingLeader(reference=circle)
        drive = ech.Laws(leader, ech.laws.StoppingPoint())
    places = ech.Formation.from_offsets(CARTS, graph, offsets)
    if changes:
        places = places.moving(CARTS, graph, changes)
    world = ech.World(network=ech.Network(rate=25.0, **network), sensing=sensing)
    return ech.Parts(CARTS, graph, places, drive, world=world)


def pilot_of(agent, **options):
    own = agent.own_law
    functions = law_functions(own)
    law = types.ModuleType("law")
    exec(python_text(functions.values(), "A law.", {}), vars(law))
    facts = {
        "agent": agent.number,
        "dt": DT,
        "leads": own.leads,
        "hears": list(own.neighbours),
        "weights": own.weights[0].tolist(),
        "signal": own.signal_names,
        "message": own.forward_names,
        "network": network_facts(own, DT, functions),
    }
    return Pilot(law, facts, **options), facts


def draw(draws, facts, sender, t):
    time = max(0.0, t - draws.uniform(0.0, 0.3))
    said = tuple((0.1 * draws.normal(size=facts["network"]["content"])).tolist())
    packet = Packet(0, max(0.0, time - draws.uniform(0.0, 0.9)), said)
    value = tuple((0.2 * draws.normal(size=len(facts["signal"]))).tolist())
    return Letter(sender, time, int(draws.choice([0, 1, 2, NOBODY])), value, packet)


def as_message(letter, names):
    hops = 2**30 if letter.hops == NOBODY else letter.hops
    value = names, letter.value
    return ech.Message(letter.sender, value, None, letter.time, hops, letter.packet)


NOISE = ech.Sensing(noise={"position": 0.05}, estimator="constant-gain")
CASES = {
    "preview": ("stopping-point", 2, {}),
    "its-leader": ("stopping-point", 0, {}),
    "leaderward": ("stopping-point", 1, {"hears": "leaderward"}),
    "carried": ("consensus", 1, {"prediction": "packet", "hears": "leaderward"}),
    "estimated": ("stopping-point", 1, {"sensing": NOISE}),
    "turning": ("stopping-point", 2, {"changes": [Rotate(0.5)]}),
}


@pytest.mark.parametrize("case", CASES)
def test_a_pilot_is_the_agent(case):
    law, number, network = CASES[case]
    agent, draws = ech.Agent(parts_of(law, **network), number, DT), np.random.default_rng(1)
    pilot, facts = pilot_of(agent)
    sent = 0
    for k in range(150):
        t, x = k * DT, 0.1 * draws.normal(size=4)
        for sender in facts["hears"]:
            # Lost or late, some for long, and none at first.
            if k > 5 and (k // 40) % 3 != 2 and draws.random() < 0.3:
                letter = draw(draws, facts, sender, t)
                taken = pilot.box.receive(letter, t) is None
                answer = agent.receive(as_message(letter, facts["signal"]))
                assert taken == (str(answer) == "taken")
        u, message = agent.step(t, x)
        result = pilot.tick(t, x.tolist())
        assert result.valid
        np.testing.assert_allclose(result.u, u, rtol=0, atol=1e-13 * max(1.0, np.abs(u).max()))
        assert (result.letter is None) == (message is None)
        if message is not None:
            sent += 1
            ours = result.letter
            assert ours.hops == min(message.hops, NOBODY) and ours.time == message.time
            np.testing.assert_allclose(ours.value, message.signal.values, rtol=0, atol=1e-12)
            assert ours.packet[:2] == message.packet[:2]
            np.testing.assert_allclose(ours.packet.content, message.packet.content, atol=1e-12)
    assert sent > 100


@pytest.mark.parametrize("changes", [[], [Rotate(0.8)]])
def test_who_hears_nobody_flies_by_the_plan_and_then_holds(changes):
    agent = ech.Agent(parts_of("stopping-point", changes=changes), 1, DT)
    pilot, facts = pilot_of(agent, hold=1.0)
    draws, x = np.random.default_rng(0), [1.0, 0.0, 0.0, 0.0]
    letter = draw(draws, facts, 0, 0.0)
    assert pilot.box.receive(letter, 0.0) is None
    speeds = []
    for k in range(400):
        u = pilot.tick(k * DT, x).u
        x = [x[0] + DT * x[2], x[1] + DT * x[3], x[2] + DT * u[0], x[3] + DT * u[1]]
        speeds.append(np.hypot(*x[2:]))
    # By the plan it follows the leader on its circle, and later it stands still.
    assert min(speeds[60:100]) > 0.3 and max(speeds[350:]) < 1e-3


def test_an_heir_leads_by_the_plan_when_its_leader_is_lost():
    leadership = {"heirs": [1], "timeout": 0.3}
    agents = [ech.Agent(parts_of("stopping-point"), k, DT) for k in (0, 1, 2)]
    pilots = [pilot_of(agent, leadership=leadership, hold=1.0)[0] for agent in agents]
    x, places, epochs = [[0.0] * 4, [1.0, 0.0, 0.0, 0.0], [1.0, 0.8, 0.0, 0.0]], [], []
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
        epochs.append(pilots[2].box.packet.epoch if k > 10 else 0)
    assert epochs[330] == 0 and set(epochs[345:]) == {1}
    circle = ech.references.Circle(rate=0.5)
    for k in (700, 999):
        leader = np.asarray(circle(jnp.asarray(k * DT)))[:2]
        for who, offset in ((1, (1.0, 0.0)), (2, (1.0, 0.8))):
            assert np.linalg.norm(np.array(places[k][who]) - leader - offset) < 0.02
    # The old leader, back again, does not take the lead from it.
    assert pilots[1].box.receive(pilots[0].tick(10.0, x[0]).letter, 10.0) is None
    assert [pilot.box.packet.leader for pilot in pilots] == [1, 1, 1]


def test_what_is_not_finite_repeats_the_last_input():
    agent = ech.Agent(parts_of("stopping-point"), 0, DT)
    pilot, _ = pilot_of(agent)
    first = pilot.tick(0.0, [0.0] * 4)
    again = pilot.tick(DT, [0.0, np.nan, 0.0, 0.0])
    assert first.valid and not again.valid and again.u == first.u
    assert pilot.tick(2 * DT, [0.0] * 4).valid
