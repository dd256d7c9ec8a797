"""Exported laws over networks that are late: they are `Agent`, its rules for messages too."""

import dataclasses

import numpy as np
import pytest
from carts import carts
from plain_agents import Draws, PlainAgent, as_python, compare
from test_onboard import as_read_c

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


def test_in_single_precision_the_same_messages_are_used(tmp_path):
    """Hops of nobody and numbers of leaders are whole there too; times have seven digits."""
    parts = carts("stopping-point", ech.Network(rate=25.0), leadership=ech.Leadership((1, 2)))
    own = (agent := ech.Agent(parts, 1, 0.01)).own_law
    single = as_read_c(agent_functions(own, 32).values(), tmp_path, 32)
    double, draws = as_python(agent_functions(own).values()), Draws(agent)
    plain, followed = [PlainAgent(own, law) for law in (double, single)], []
    for k in range(300):
        t, x = k * 0.01, draws.state(k).tolist()
        for message in draws.messages(k, t):
            for one in plain:
                one.receive(message)
        (u, row, valid), (ours, other, fine) = (one.step(t, x) for one in plain)
        assert valid and fine
        np.testing.assert_array_equal([row[1], row[4]], [other[1], other[4]])
        np.testing.assert_allclose(ours, u, rtol=0, atol=1e-3)
        followed += [row[4]] if followed[-1:] != [row[4]] and row[4] == row[4] else []
    # Of the leader it hears no more, and takes the lead.
    assert followed == [0.0, 1.0]
