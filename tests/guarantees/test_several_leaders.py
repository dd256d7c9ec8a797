"""Guarantees behind several leaders: their own motion is part of the followers' errors."""

import jax.numpy as jnp
import numpy as np
import pytest
from in_words import in_words

import echelon as ech
from echelon.guarantees.promises.promise import guarantee
from echelon.laws import Consensus, TrimInput
from echelon.laws.stopping_point import StoppingLeader, StoppingPoint

LINE = ech.Graph.path(4, leaders=(0, 3))


class Sinking(ech.ControlAffine):
    """A body that comes to rest at its origin by itself, but slowly."""

    state_names = ("x",)
    input_names = ("speed",)
    position = ("x",)

    def drift(self, x):
        return -0.05 * x

    def input_map(self, x):
        return jnp.ones((1, 1), x.dtype)


def formation(apart, coupling):
    """Two leaders so far apart (m) and their followers under stopping points, on a line."""
    states = np.zeros((4, 4))
    states[1, :2], states[3, 0] = (1.0, 2.0), apart
    drive = ech.Laws(StoppingLeader(coupling=coupling), StoppingPoint())
    goals = ech.Formation(np.zeros((4, 4)))
    return ech.Parts(ech.models.DoubleIntegrator(2), LINE, goals, drive, initial=states)


def shrinking(parts, begin, end):
    """At what rate the errors of all agents shrink between two times, 1/s, and the promise."""
    settings = ech.Settings(horizon=end, dt=0.02)
    result = ech.simulate(parts, settings)
    sizes = np.linalg.norm(result.errors.reshape(len(result.times), -1), axis=1)
    first, last = np.searchsorted(result.times, [begin, end])
    measured = np.log(sizes[first] / sizes[last]) / (result.times[last] - result.times[first])
    return measured, guarantee(parts, settings)


@pytest.mark.slow
@pytest.mark.parametrize("coupling", [0.05, 0.3])
def test_leaders_apart_come_together_no_faster_than_their_own_coupling(coupling):
    measured, found = shrinking(formation(1.0, coupling), 20.0, 40.0)
    assert found.rate == pytest.approx(coupling) and measured == pytest.approx(coupling, rel=1e-2)
    assert found.slowest == -found.rate and found.tube.arrival is None
    assert f"rate {coupling} 1/s eventually, on this graph" in in_words(found)
    # Leaders that start alike leave the rate to their followers.
    alike = guarantee(formation(0.0, coupling), ech.Settings(horizon=2.0, dt=0.02))
    assert alike.rate == pytest.approx(4.0) and alike.tube.arrival is not None


@pytest.mark.slow
def test_passive_leaders_apart_come_together_by_their_own_drift():
    model, goals = Sinking(), ech.Formation(np.zeros((4, 1)))
    laws = ech.Laws(TrimInput(), Consensus(ech.synthesize(model, LINE, ech.gains.Riccati())))
    for leader, rate, times in ((1.0, 0.05, (10.0, 20.0)), (0.0, None, (0.5, 1.0))):
        states = np.array([[0.0], [1.0], [2.0], [leader]])
        measured, found = shrinking(ech.Parts(model, LINE, goals, laws, initial=states), *times)
        assert found.rate == pytest.approx(rate or -found.loop.slowest)
        assert measured == pytest.approx(found.rate, rel=0.05) and found.slowest == -found.rate


@pytest.mark.slow
def test_agents_without_chains_are_promised_at_the_coupling_that_their_step_holds():
    # Twice the root over lambda_min is more than the step holds, so that c d_max dt is 1.
    states = np.zeros((10, 2))
    states[1:] = np.random.default_rng(0).uniform(-1.0, 1.0, (9, 2))
    drive, goals = ech.Laws(StoppingLeader(), StoppingPoint()), ech.Formation(np.zeros((10, 2)))
    model = ech.models.SingleIntegrator(2)
    parts = ech.Parts(model, ech.Graph.path(10), goals, drive, initial=states)
    measured, found = shrinking(parts, 0.0, 2.0)
    assert found.promised and found.coupling * 2.0 * 0.02 == pytest.approx(1.0)
    assert measured > 0.0
