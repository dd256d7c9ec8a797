"""The exported law of every bundled scenario is `Agent`, or there is none."""

import pytest
from plain_agents import as_python, compare, compare_late

import echelon as ech
from echelon.experiments.scenario.scenario import bundled_scenarios
from echelon.simulation.onboard.law_functions import law_functions
from echelon.simulation.scalars import Unsupported

REFUSED = {
    "crossing": "agents that keep away from each other",
    "leader-lost": "agents that are lost, join or take the lead",
    "reshape": "agents that keep away from each other",
}
CHANGES = {
    "reshape without safety": ("reshape", ["safety=null"]),
    "reshape, turning": (
        "reshape",
        ["safety=null", "formation.motion=[{rotate: 0.5}, {scale: 0.3, rate: 0.7}]"],
    ),
    "paper, links cut": ("paper", ["events=[{at: 20.0, cut: [1, 2], for: 20.0}]"]),
    "leader-lost, nobody lost": ("leader-lost", ["events=null", "leadership=null"]),
}
STEPS, LATE_STEPS = 12, 40


def flown(name):
    scenario, changes = CHANGES.get(name, (name, []))
    return ech.build(ech.load_scenario(scenario, changes))


def compare_both(name, number, steps, atol=1e-14):
    parts, settings = flown(name)
    agent = ech.Agent(parts, number, settings.dt, settings.limits)
    if agent.own_law.loop.channel is not None:
        compare_late(agent, settings.dt, max(steps, LATE_STEPS))
        return
    law = as_python(law_functions(agent.own_law).values())
    # Through all of the run, in few steps.
    compare(agent, [law], steps, settings.horizon / steps, atol=atol)


@pytest.mark.slow
@pytest.mark.parametrize("name", [*sorted({*bundled_scenarios()} - {*REFUSED}), *CHANGES])
def test_the_law_of_a_follower_is_the_agents(name):
    compare_both(name, flown(name)[0].graph.followers[-1], STEPS)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["paper", "paper-radio", "reshape without safety", "yaw-turn"])
def test_the_law_of_a_leader_is_the_agents(name):
    compare_both(name, 0, STEPS)


@pytest.mark.parametrize("name", REFUSED)
def test_what_has_no_law_by_itself_is_refused(name):
    parts, settings = flown(name)
    with pytest.raises(Unsupported, match=REFUSED[name]):
        law_functions(ech.Agent(parts, 1, settings.dt).own_law)


@pytest.mark.study
@pytest.mark.parametrize("number", [0, 2])
@pytest.mark.parametrize("name", ["paper", "paper-far", "paper-radio", "reshape without safety"])
def test_ten_thousand_steps_of_a_law_are_the_agents(name, number):
    # Offsets that change add five derivatives, whose terms are larger than their sum.
    compare_both(name, number, 10_000, 3e-14 if name.startswith("reshape") else 1e-14)
