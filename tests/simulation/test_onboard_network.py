"""Exported laws over networks that are late: with the rules of docs/onboard.md they are `Agent`."""

import dataclasses

import pytest
from plain_agents import compare_late

import echelon as ech

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


CASES = {
    "preview": ("stopping-point", 2, {}),
    "its-leader": ("stopping-point", 0, {}),
    "leaderward": ("stopping-point", 1, {"hears": "leaderward"}),
    "states": ("stopping-point", 1, {"messages": "state", "hears": "leaderward"}),
    "stopping-point-packet": ("stopping-point", 1, {"prediction": "packet"}),
    "consensus-packet": ("consensus", 1, {"prediction": "packet"}),
    "consensus-preview": ("consensus", 1, {}),
    "leaders-packet": ("consensus", 0, {"prediction": "packet"}),
}


@pytest.mark.parametrize("case", CASES)
def test_a_plain_process_is_the_agent(case):
    law, number, network = CASES[case]
    compare_late(ech.Agent(parts_of(law, **network), number, 0.01), 0.01, 400)


@pytest.mark.slow
@pytest.mark.parametrize("number", [0, 2])
@pytest.mark.parametrize("name", ["paper-radio", "paper"])
def test_quadrotors_over_a_radio_are_agents_too(name, number):
    parts, settings = ech.build(ech.load_scenario(name))
    if name == "paper":
        network = ech.Network(rate=50.0, delay=0.02, prediction="packet")
        parts = parts.replace(world=dataclasses.replace(parts.world, network=network))
    compare_late(ech.Agent(parts, number, settings.dt), settings.dt, 300)
