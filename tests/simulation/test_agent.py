"""A single `Agent` computes what it computes in `simulate`, from the messages it receives alone."""

import numpy as np
import pytest

import echelon as ech
from echelon.core.errors import EchelonError

CARTS = ech.models.DoubleIntegrator()
CIRCLE = ech.references.Circle(radius=1.0, rate=0.6)
TREE = ech.Graph([(0, 1, 0.7), (1, 2), (1, 3, 2.0)])


def gain():
    return ech.synthesize(CARTS, TREE, ech.gains.Riccati())


LAWS = {
    "consensus": lambda: ech.Laws(
        ech.laws.Tracking(CIRCLE), ech.laws.Consensus(gain(), feedforward="parent")
    ),
    "stopping-point": lambda: ech.Laws(
        ech.laws.StoppingLeader(reference=CIRCLE), ech.laws.StoppingPoint()
    ),
}


def formation(law):
    offsets = {1: (1.0, 0.0), 2: (1.0, 0.8), 3: (1.0, -0.8)}
    places = ech.Formation.from_offsets(CARTS, TREE, offsets)
    return ech.Parts(CARTS, TREE, places, LAWS[law](), initial={"position": 1.0})


@pytest.mark.parametrize("law", LAWS)
def test_agents_by_themselves_do_what_simulate_does(law):
    parts = formation(law)
    result = ech.simulate(parts, ech.Settings(horizon=0.2, dt=0.01, seed=3, engine="jax"))
    agents = [ech.Agent(parts, k, dt=0.01) for k in range(4)]
    for k, t in enumerate(result.times[:-1]):
        x = result.states[k]
        said = {agent.number: agent.hello(x[agent.number]) for agent in agents}
        # Outward: the leader, its neighbour, and the two behind.
        for agent in agents:
            heard = {j: said[j] for j in {*agent.neighbours, 0}}
            u, said[agent.number] = agent.step(0.01 * k, x[agent.number], heard)
            np.testing.assert_allclose(
                u, result.inputs[k, agent.number], atol=1e-12, err_msg=f"{t}"
            )
            assert u.dtype == np.float64


def test_an_agent_says_what_it_misses():
    agent = ech.Agent(formation("stopping-point"), 2)
    x = np.zeros(4)
    lone = {1: ech.Agent(formation("stopping-point"), 1).hello(x)}
    with pytest.raises(EchelonError, match="needs its message of agent 1"):
        agent.step(0.0, x, {})
    with pytest.raises(EchelonError, match="what it tells of its input of agent 0"):
        agent.step(0.0, x, lone)
    with pytest.raises(EchelonError, match="has shape"):
        agent.hello(np.zeros(3))
    with pytest.raises(EchelonError, match="not in this graph"):
        ech.Agent(formation("stopping-point"), 4)
