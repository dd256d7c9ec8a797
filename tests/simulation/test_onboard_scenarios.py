"""The exported law of every bundled scenario is `Agent`, in Python and in C."""

import pytest
from plain_agents import as_python, compare
from test_onboard import as_compiled_c

import echelon as ech
from echelon.experiments.scenario.scenario import bundled_scenarios
from echelon.simulation.onboard.agent_functions import (
    agent_functions,
    motions_of,
    move_function,
)

CHANGES = {
    "reshape, turning": (
        "reshape",
        ["safety=null", "formation.motion=[{rotate: 0.5}, {scale: 0.3, rate: 0.7}]"],
    ),
    "paper, links cut": ("paper", ["events=[{at: 20.0, cut: [1, 2], for: 20.0}]"]),
    "paper, switching": (
        "paper",
        ["graph.schedule=[{at: 2.0, edges: [[0, 3], [3, 2], [2, 1]]}]", "graph.period=5.0"],
    ),
}
STEPS, MANY = 12, 10_000


def flown(name, leads=False):
    scenario, changes = CHANGES.get(name, (name, []))
    parts, settings = ech.build(ech.load_scenario(scenario, changes))
    number = 0 if leads else parts.graph.followers[-1]
    # A signal has third derivatives of places: of a reshape sums of terms up to 8.2e5 / span^3.
    motion = parts.formation.motion
    terms = max([1.0, *(8.2e5 / span**3 for span in (() if motion is None else motion.spans))])
    return ech.Agent(parts, number, settings.dt, settings.limits), settings, terms


LEADERS = ["leader-lost", "paper", "paper-radio", "reshape", "yaw-turn"]
FOLLOWERS = [*bundled_scenarios(), *CHANGES]
BOTH = [*((name, False) for name in FOLLOWERS), *((name, True) for name in LEADERS)]


@pytest.mark.slow
@pytest.mark.parametrize(("name", "leads"), BOTH)
def test_the_law_of_an_agent_is_the_agents(name, leads):
    agent, settings, terms = flown(name, leads)
    law = as_python(agent_functions(agent.own_law).values())
    if agent.own_law.loop.network.late:
        compare(agent, [law], 4 * STEPS, settings.dt)
        return
    # Through all of the run, in few steps.
    compare(agent, [law], STEPS, settings.horizon / STEPS, terms=terms)


@pytest.mark.study
@pytest.mark.outside
@pytest.mark.parametrize(("name", "leads"), BOTH)
def test_it_still_is_after_ten_thousand_steps_and_c_is_python(name, leads, tmp_path):
    """In flight, since the memory of an agent that is put here and there grows without end."""
    agent, settings, terms = flown(name, leads)
    [motion] = motions_of(agent._loop.motion, 1, 1)
    move = as_python([move_function(motion)])["move"]
    functions = agent_functions(agent.own_law).values()
    laws = as_python(functions), as_compiled_c(functions, tmp_path)
    memories = compare(agent, laws, MANY, settings.dt, terms=terms, move=move)
    assert memories[0] == memories[1]
