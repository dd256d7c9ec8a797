"""Exported laws over networks that are late: they are `Agent`, its rules for messages too."""

import dataclasses

import pytest
from carts import carts
from plain_agents import as_python, compare

import echelon as ech
from echelon.simulation.onboard.agent_functions import agent_functions

CASES = {
    "preview": ("stopping-point", 2, {}),
    "its-leader": ("stopping-point", 0, {}),
    "leaderward": ("stopping-point", 1, {"hears": "leaderward"}),
    "states": ("stopping-point", 1, {"messages": "state", "hears": "leaderward"}),
    "stopping-point-packet": ("stopping-point", 1, {"prediction": "packet"}),
    "consensus-packet": ("consensus", 1, {"prediction": "packet"}),
    "consensus-preview": ("consensus", 1, {}),
    "leaders-packet": ("consensus", 0, {"prediction": "packet"}),
    "apart": ("safety", 1, {}),
    "backup": ("stopping-point", 1, {"leadership": (1, 2)}),
    "follows-a-backup": ("stopping-point", 3, {"leadership": (1, 2)}),
    "leads-with-backups": ("stopping-point", 0, {"leadership": (1, 2)}),
}


@pytest.mark.parametrize("case", CASES)
def test_an_exported_law_is_the_agent(case):
    law, number, network = CASES[case]
    backups = network.pop("leadership", None) if (network := dict(network)) else None
    leadership = None if backups is None else ech.Leadership(backups, timeout=0.3)
    parts = carts(law, ech.Network(rate=25.0, **network), leadership=leadership)
    agent = ech.Agent(parts, number, 0.01)
    law = as_python(agent_functions(agent.own_law).values())
    compare(agent, [law], 400, 0.01)
    # Whoever hears of no leader for long has taken the lead, if it may.
    assert agent.leads == (number == 0 or case == "backup")


@pytest.mark.slow
@pytest.mark.parametrize("number", [0, 2])
def test_quadrotors_that_predict_by_packets_are_agents_too(number):
    parts, settings = ech.build(ech.load_scenario("paper"))
    network = ech.Network(rate=50.0, delay=0.02, prediction="packet")
    parts = parts.replace(world=dataclasses.replace(parts.world, network=network))
    agent = ech.Agent(parts, number, settings.dt)
    compare(agent, [as_python(agent_functions(agent.own_law).values())], 300, settings.dt)
