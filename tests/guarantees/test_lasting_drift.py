"""What lasts and carries an agent away for ever: every agent's own plant, the wind and the air."""

import numpy as np
import pytest

import echelon as ech
from echelon.core.statement import Hypothesis
from echelon.core.words import Verdict

CART = ech.models.DoubleIntegrator(dimension=2)
DRAG = ech.models.DoubleIntegrator(dimension=2, drag=5.0)
PATH, TWO = ech.Graph.path(4), ech.Graph.path(4, leaders=[0, 3])
LINE = ech.references.Line(velocity=(2.0, 0.0, 0.0))
CIRCLE = ech.references.Circle(radius=2.0, rate=0.3)
ROOT = 4.0
SETTINGS = ech.Settings(horizon=40.0, dt=0.01, store_every=1000)


def laws_of(path, follower=None, **law):
    """Laws that make up for no push but by their speed."""
    settled = {"roots": [ROOT], "observer": False}
    leader = ech.laws.StoppingLeader(reference=path, **settled, **law)
    return ech.Laws(leader, ech.laws.StoppingPoint(**settled, **(follower or law)))


def parts_of(world, graph=PATH, path=LINE, **law):
    laws = laws_of(path, **({"speed": 1.0} | law))
    return ech.Parts(CART, graph, ech.Formation.line(CART, graph), laws, world=world)


def air(velocity, drag):
    return ech.World(disturbance=ech.Disturbance(air=velocity, drag=drag))


CASES = {
    "the leader": (ech.World(plants={0: DRAG}), PATH, LINE, 0),
    "a follower": (ech.World(plants={2: DRAG}), PATH, LINE, 2),
    "another leader": (ech.World(plants={3: DRAG}), TWO, LINE, 3),
    "moving air": (air((20.0, 0.0), 0.3), PATH, CIRCLE, 0),
    "air at rest": (air((0.0, 0.0), 5.0), PATH, LINE, 0),
}


def largest_deviation(parts):
    """How far the farthest agent is off its place of the path, at each stored frame, by itself."""
    result = ech.simulate(parts, SETTINGS)
    places = result.reference[:, None, :2] + parts.formation.offsets[:, :2]
    return np.linalg.norm(result.states[..., :2] - places, axis=2).max(axis=1)


@pytest.mark.parametrize("name", CASES)
def test_an_agent_that_drifts_away_is_named_with_the_speed_that_it_would_need(name):
    world, graph, path, who = CASES[name]
    parts = parts_of(world, graph, path)
    found = ech.guarantee(parts, SETTINGS)
    line = found.hypotheses[Hypothesis.EXACT_STATES]
    # Drag on the velocity of the path, through the chain s + root: k1 / k0 = 1 / root.
    asked = 0.3 * 20.0 / ROOT if name == "moving air" else 5.0 * 2.0 / ROOT
    assert line.verdict is Verdict.FAILS and not found.promised
    assert line.number == pytest.approx(asked, rel=0.02)
    assert f"that of agent {who} is 1" in line.text
    away = largest_deviation(parts)
    # It goes on for ever: each 10 s add as much as those before.
    assert away[-1] - away[-2] > 0.9 * (away[-2] - away[-3]) > 0.5
    # With more speed nobody drifts away, and the guarantee stays.
    parts = parts_of(world, graph, path, speed=3.0)
    assert ech.guarantee(parts, SETTINGS).promised
    away = largest_deviation(parts)
    assert abs(away[-1] - away[-2]) < 0.05


def test_followers_make_up_for_what_moves_them_more_than_their_sender_alone():
    # All have the same drag of 1.2 times the speed; the leader alone could not hold its path,
    # and with a faster leader the followers receive what it commands.
    drag = ech.models.DoubleIntegrator(dimension=2, drag=2.4)
    parts = parts_of(ech.World(plant=drag), speed=2.0, follower={"speed": 1.0})
    assert ech.guarantee(parts, SETTINGS).promised
    away = largest_deviation(parts)
    assert abs(away[-1] - away[-2]) < 0.05
    alone = parts.replace(world=ech.World(plants={0: drag}))
    assert not ech.guarantee(alone, SETTINGS).promised
    away = largest_deviation(alone)
    assert away[-1] - away[-2] > 0.5 * (away[-2] - away[-3])
    # What a wind does that carries nobody away is said to be ignored.
    parts = parts_of(air((0.2, 0.0), 0.3), path=CIRCLE)
    line = ech.guarantee(parts, SETTINGS).hypotheses[Hypothesis.EXACT_STATES]
    assert line.text.endswith("the guarantee ignores this")
