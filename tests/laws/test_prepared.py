"""Laws that were prepared for one model and graph, and are put on others."""

import numpy as np
import pytest

import echelon as ech
from echelon.core.identity import process_key
from echelon.core.numerics import precision
from echelon.guarantees.promises.promise import guarantee
from echelon.simulation.engine.prepare import prepare

LIGHT, HEAVY = ech.models.DoubleIntegrator(3), ech.models.DoubleIntegrator(3, drag=0.4)
CIRCLE = ech.references.Circle(radius=2.0, rate=0.7)
LINE, STAR = ech.Graph.path(5), ech.Graph.star(5)
SETTINGS = ech.Settings(horizon=2.0, dt=0.02)
ROUND = ech.Safety(radii=(0.1, 0.1, 0.3))


class Small(ech.models.DoubleIntegrator):
    """A cart with a radius."""

    radius: float = 0.1


def laws():
    """Laws that complete themselves by a model and a graph."""
    leader = ech.laws.StoppingLeader(reference=CIRCLE)
    yield "stopping-point", ech.Laws(leader, ech.laws.StoppingPoint())
    yield "parents", ech.Laws(leader, ech.laws.StoppingPoint(feedforward="parent"))
    yield "safety", ech.Laws(leader, ech.laws.StoppingPoint(safety=ROUND))
    gain = ech.synthesize(LIGHT, LINE, ech.gains.Riccati())
    follower = ech.laws.Consensus(gain)
    yield "tracking", ech.Laws(ech.laws.Tracking(CIRCLE), follower)
    yield "lqr", ech.Laws(ech.laws.PathLQR(CIRCLE, horizon=2.0), follower)


@pytest.mark.parametrize(("name", "drive"), [*laws()], ids=[name for name, _ in laws()])
def test_a_law_prepared_elsewhere_is_the_one_that_is_prepared_here(name, drive):
    with precision("float64"):
        there, here = drive.prepare(LIGHT, LINE), drive.prepare(HEAVY, STAR)
        assert process_key(there.prepare(HEAVY, STAR)) == process_key(here)
        # What is complete stays the same object, of which caches remember what was computed.
        assert here.prepare(HEAVY, STAR) is here
        assert process_key(there) != process_key(here)


def test_speeds_are_those_that_the_other_model_bears():
    drive = ech.Laws(ech.laws.StoppingLeader(), ech.laws.StoppingPoint())
    with precision("float64"):
        on_earth = drive.prepare(ech.models.Quadrotor(), LINE)
        on_moon = on_earth.prepare(ech.models.Quadrotor(gravity=1.62), LINE)
    speeds = [law.follower.speed_of(2) for law in (on_earth, on_moon)]
    # The thrust leaves a speed in proportion to gravity, until other limits act.
    assert speeds[1] < 0.5 * speeds[0]


def test_a_radius_of_the_model_is_that_of_the_other_model():
    drive = ech.Laws(ech.laws.StoppingLeader(), ech.laws.StoppingPoint(safety=ech.Safety()))
    with precision("float64"):
        first = drive.prepare(Small(), LINE)
        second = first.prepare(Small(radius=0.2), LINE)
    sizes = [law.follower.safety.size for law in (first, second)]
    np.testing.assert_allclose(sizes, [[0.1, 0.1, 0.3], [0.2, 0.2, 0.6]], rtol=1e-15)


def test_what_is_set_by_hand_on_a_prepared_law_counts():
    drive = ech.Laws(ech.laws.StoppingLeader(), ech.laws.StoppingPoint())
    with precision("float64"):
        law = drive.prepare(LIGHT, LINE).follower
        slow = drive.with_follower(ech.laws.StoppingPoint(speed=0.5, loop=law.loop))
        assert slow.prepare(LIGHT, LINE).follower.speed_of(0) == 0.5


@pytest.mark.parametrize("graph", [STAR, ech.Graph([(0, 1, 0.1), (1, 2, 5.0), (2, 3), (3, 4)])])
def test_a_run_on_another_graph_has_the_guarantee_of_that_graph(graph):
    leader = ech.laws.StoppingLeader(reference=CIRCLE)
    goals = ech.Formation(np.zeros((5, 6)))
    parts = ech.Parts(LIGHT, LINE, goals, ech.Laws(leader, ech.laws.StoppingPoint()))
    ready = prepare(parts, SETTINGS).parts
    fresh, again = (guarantee(each.replace(graph=graph), SETTINGS) for each in (parts, ready))
    assert again.as_mapping() == fresh.as_mapping()
    assert (again.coupling, again.hold) == (fresh.coupling, fresh.hold)
    assert again.coupling != guarantee(parts, SETTINGS).coupling
