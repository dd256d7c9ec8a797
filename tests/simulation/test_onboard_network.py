"""Exported laws over networks that are late: with the rules of docs/onboard.md they are `Agent`."""

import dataclasses

import pytest
from carts import carts
from plain_agents import compare_late

import echelon as ech

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
    parts = carts(law, ech.Network(rate=25.0, **network))
    compare_late(ech.Agent(parts, number, 0.01), 0.01, 400)


@pytest.mark.slow
@pytest.mark.parametrize("number", [0, 2])
@pytest.mark.parametrize("name", ["paper-radio", "paper"])
def test_quadrotors_over_a_radio_are_agents_too(name, number):
    parts, settings = ech.build(ech.load_scenario(name))
    if name == "paper":
        network = ech.Network(rate=50.0, delay=0.02, prediction="packet")
        parts = parts.replace(world=dataclasses.replace(parts.world, network=network))
    compare_late(ech.Agent(parts, number, settings.dt), settings.dt, 300)
