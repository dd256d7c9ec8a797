"""Differences of states: how far they are x - y, whoever wrote them."""

import jax.numpy as jnp
import numpy as np
import pytest
from in_words import in_words

import echelon as ech
from echelon.agents.models.model import wrap_angles
from echelon.agents.models.straight_range import straight_range
from echelon.core.statement import Hypothesis
from echelon.core.words import Kind, Verdict


def dial(difference):
    """An angle that is turned by its input."""

    class Dial(ech.ControlAffine):
        state_names, input_names = ("angle",), ("rate",)

        def drift(self, x):
            return jnp.zeros_like(x)

        def input_map(self, x):
            return jnp.ones((1, 1), x.dtype)

    if difference is not None:
        Dial.difference = lambda self, x, y: difference(x, y)
    return Dial()


def shorter(period):
    return lambda x, y: (x - y + 0.5 * period) % period - 0.5 * period


def nearest(period):
    return lambda x, y: (x - y) - period * jnp.round((x - y) / period)


@pytest.mark.parametrize("period", [1e-3, 0.5, 2.0 * np.pi, 24.0, 360.0, 6400.0, 1e7])
@pytest.mark.parametrize("make", [shorter, nearest])
def test_the_period_of_a_difference_is_found_and_never_called_proved(make, period):
    found = straight_range(dial(make(period)))
    assert 0.98 * 0.5 * period <= found.reach[0] <= 0.5 * period * (1.0 + 1e-9)
    assert not found.proved


def test_plain_differences_and_wrapped_angles_are_proved():
    assert straight_range(dial(None)) == (np.inf, True)
    assert straight_range(dial(lambda x, y: x - y)) == (np.inf, True)
    assert straight_range(dial(lambda x, y: wrap_angles(x - y, 0))) == (np.pi, True)
    found = straight_range(ech.models.Quadrotor())
    assert found.proved and (found.reach[6:9] == np.pi).all() and np.isinf(found.reach[:6]).all()


def test_a_difference_that_is_another_somewhere_is_plain_up_to_there():
    found = straight_range(dial(lambda x, y: jnp.where(jnp.abs(x - y) < 40.0, x - y, 0.0)))
    assert 39.0 < found.reach[0] <= 40.0 and not found.proved


def wrapped(period):
    return lambda x, y: wrap_angles(x - y, 0)


@pytest.mark.parametrize(
    ("make", "period"),
    [(shorter, 360.0), (nearest, 1.0), (wrapped, 2.0 * np.pi)],
)
def test_a_ring_that_is_twisted_once_is_outside_of_what_is_guaranteed(make, period):
    model, graph = dial(make(period)), ech.Graph.ring(6)
    gain = ech.synthesize(model, graph, ech.gains.RobustLQR(domain={}))
    drive = ech.Laws(ech.laws.TrimInput(), ech.laws.Consensus(gain))
    starts = period * np.arange(6)[:, None] / 6
    parts = ech.Parts(model, graph, ech.Formation(np.zeros((6, 1))), drive, initial=starts)
    chosen = ech.Settings(5.0, 0.01)
    found = ech.guarantee(parts, chosen)
    result = ech.simulate(parts, chosen)
    # Nobody's neighbours pull more one way than the other.
    assert np.ptp(result.states[-1]) > 0.8 * period
    assert "everywhere" not in in_words(found)
    assert found.hypotheses[Hypothesis.STARTS].verdict is Verdict.FAILS
    assert found.kind is (Kind.VERTICES if make is wrapped else Kind.SAMPLES)
    assert found.certified.radius < 0.5 * period
    assert not any("covers this run" in line for line in ech.report(result).splitlines())
    (low,), (high,) = found.region.domain.box
    assert high - low < 0.5 * period
