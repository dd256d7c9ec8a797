"""Leaders whose plan waits for stragglers."""

import jax.numpy as jnp
import numpy as np
import pytest

import echelon as ech
from echelon.core.errors import SimulationError
from echelon.core.numerics import precision

CART = ech.models.DoubleIntegrator()
GRAPH = ech.Graph([(0, 1), (1, 2)])
CIRCLE = ech.references.Circle(radius=2.0, rate=0.5)
STOPPING = ech.Laws(ech.laws.StoppingLeader(reference=CIRCLE), ech.laws.StoppingPoint())
SETTINGS = ech.Settings(horizon=6.0, dt=0.02)
FAR = {2: [6.0, -3.0, 0.0, 0.0]}


def parts(initial=None, waits=0.5, drive=STOPPING, **more):
    formation = ech.Formation.from_offsets(CART, GRAPH, {1: [1.0, 0.0], 2: [0.0, 1.0]})
    leadership = None if waits is None else ech.Leadership(waits=waits)
    return ech.Parts(CART, GRAPH, formation, drive, initial, leadership=leadership, **more)


@pytest.fixture(scope="module")
def waited():
    return ech.simulate(parts(FAR), SETTINGS)


def test_nobody_is_waited_for_who_is_at_its_place():
    """To the bit, it is the run of leaders that do not wait."""
    on_time, other = (ech.simulate(parts(waits=waits), SETTINGS) for waits in (0.5, None))
    assert np.array_equal(on_time.states, other.states) and not on_time.late.any()
    assert np.array_equal(on_time.reference, other.reference) and other.late is None
    assert "waited for nobody" in ech.report(on_time)


def test_the_plan_stands_still_until_the_farthest_is_near(waited):
    errors, late = waited.formation_errors.max(axis=1), waited.late
    pace = 1.0 - np.diff(late) / np.diff(waited.times)
    assert (pace > -1e-9).all() and (pace < 1.0 + 1e-9).all()
    # The pace follows within 0.2 s.
    settled = np.flatnonzero(waited.times[:-1] > 1.5)
    far, near = (errors[settled] > 0.6), (errors[settled] < 0.05)
    assert far.any() and near.any()
    assert pace[settled][far].max() < 0.05 and pace[-1] > 0.95
    assert late[-1] > 1.0 and "s late at 6 s" in ech.report(waited)


def test_what_leaders_follow_is_their_path_at_the_time_of_the_plan(waited):
    with precision("float64"):
        there = STOPPING.reference_states(CART, jnp.asarray(waited.times - waited.late))
    assert waited.reference == pytest.approx(np.asarray(there), abs=1e-9)
    off = np.linalg.norm(waited.states[:, 0] - waited.reference, axis=1)
    assert off[-1] < 0.05 < off.max()


def test_agreement_does_not_depend_on_how_the_leader_moves(waited):
    """Disagreement is that of a leader that does not wait (T5), and so is the guarantee."""
    other = ech.simulate(parts(FAR, waits=None), SETTINGS)
    assert waited.errors == pytest.approx(other.errors, abs=1e-8)
    assert np.abs(waited.states - other.states).max() > 1.0
    guarantee = ech.promise(parts(FAR), SETTINGS)
    assert guarantee.promised and guarantee.rate == ech.promise(other.parts, SETTINGS).rate


def test_nothing_is_guaranteed_of_actuators_along_a_path_that_stands_still():
    agent = ech.models.Quadrotor.crazyflie()
    drive = ech.Laws(ech.laws.StoppingLeader(reference=CIRCLE), ech.laws.StoppingPoint())
    formation = ech.Formation.from_offsets(agent, GRAPH, {1: [1.0, 0.0, 0.0]})
    one = ech.Parts(agent, GRAPH, formation, drive, leadership=ech.Leadership(waits=1.0))
    guarantee = ech.promise(one, ech.Settings(horizon=1.0, dt=0.005))
    assert not guarantee.promised and "waits for stragglers" in guarantee.sentence()


def test_a_run_that_waits_is_stored_and_continued(waited, tmp_path):
    stretches = []
    ech.simulate(parts(FAR), SETTINGS, keep=stretches.append)
    assert np.array_equal(np.concatenate([x.late for x in stretches]), waited.late)
    stored = ech.load(ech.save_run(waited, tmp_path / "run", figures=False))
    assert np.array_equal(stored.late, waited.late)


@pytest.mark.parametrize(
    ("more", "words"),
    [
        ({"world": ech.World(network=ech.Network())}, "got `waits` and a `network`"),
        ({"waits": 0.0}, "`waits` is 0.0, and must be positive"),
        (
            {"drive": ech.Laws(ech.laws.StoppingLeader(), ech.laws.StoppingPoint())},
            "only leaders under the law `stopping-point` with a `reference`",
        ),
    ],
)
def test_what_cannot_wait_is_refused_in_a_sentence(more, words):
    with pytest.raises(SimulationError, match=words):
        ech.simulate(parts(**more), SETTINGS)


def test_a_single_agent_cannot_know_whom_to_wait_for():
    with pytest.raises(SimulationError, match="a single agent does not know"):
        ech.Agent(parts(), 1)
