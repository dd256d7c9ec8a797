"""The exported law of every bundled scenario is `Agent`, or there is none."""

import pytest
from plain_agents import as_python, compare, compare_late

import echelon as ech
from echelon.experiments.scenario.scenario import bundled_scenarios
from echelon.simulation.onboard.law_functions import law_functions
from echelon.simulation.scalars import Unsupported
from echelon.simulation.step.networks import LateNetwork

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


LEADERS = ["paper", "paper-radio", "reshape without safety", "yaw-turn"]
FOLLOWERS = [*sorted({*bundled_scenarios()} - {*REFUSED}), *CHANGES]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "leads"), [*((name, False) for name in FOLLOWERS), *((name, True) for name in LEADERS)]
)
def test_the_law_of_an_agent_is_the_agents(name, leads):
    parts, settings = flown(name)
    number = 0 if leads else parts.graph.followers[-1]
    agent = ech.Agent(parts, number, settings.dt, settings.limits)
    if isinstance(agent.own_law.loop.network, LateNetwork):
        compare_late(agent, settings.dt, LATE_STEPS)
        return
    law = as_python(law_functions(agent.own_law).values())
    # Through all of the run, in few steps.
    motion = parts.formation.motion
    spans = [] if motion is None else motion.spans
    # A signal has third derivatives of places: of a reshape sums of terms up to 8.2e5 / span^3.
    terms = max([1.0, *(8.2e5 / span**3 for span in spans)])
    compare(agent, [law], STEPS, settings.horizon / STEPS, terms=terms)


@pytest.mark.parametrize("name", REFUSED)
def test_what_has_no_law_by_itself_is_refused(name):
    parts, settings = flown(name)
    with pytest.raises(Unsupported, match=REFUSED[name]):
        law_functions(ech.Agent(parts, 1, settings.dt).own_law)
