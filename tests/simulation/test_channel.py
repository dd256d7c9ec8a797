"""A network that is not ideal: messages in flight are part of the moment of a run."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

import echelon as ech
from echelon.agents.network.channel import Channel
from echelon.core.errors import EchelonError

POINTS = ech.models.SingleIntegrator()
GRAPH = ech.Graph([(0, 1), (1, 2, 0.5), (2, 3), (3, 1, 2.0)])
STARTS = np.random.default_rng(4).normal(size=(4, len(POINTS.state_names)))
STEPS, DT = 40, 0.02


class Late(Channel):
    """Every message arrives so many steps after it was sent."""

    steps: int = eqx.field(static=True)

    def begin(self, sent):
        return jnp.repeat(sent[None], self.steps, axis=0)

    def carry(self, in_flight, sent, step):
        queue = jnp.concatenate([in_flight, sent[None]])
        return queue[0], queue[1:]


def parts(channel=None):
    drive = ech.Laws(ech.laws.Agreement(), ech.laws.Agreement())
    places = ech.Formation.from_offsets(POINTS, GRAPH, {})
    world = ech.World(channel=channel)
    return ech.Parts(POINTS, GRAPH, places, drive, initial=STARTS, world=world)


def settings(**more):
    return ech.Settings(
        **{"horizon": STEPS * DT, "dt": DT, "integrator": "euler", "engine": "jax", **more}
    )


def by_hand(late):
    """The states of Euler's steps under messages that are so many steps old."""
    x = [STARTS]
    for k in range(STEPS):
        old, now = x[max(0, k - late)], x[k]
        z = np.zeros_like(now)
        for (i, j), weight in zip(GRAPH.edges, GRAPH.weights, strict=True):
            z[i] += weight * (now[i] - old[j])
            z[j] += weight * (now[j] - old[i])
        x.append(now - DT * z)
    return np.array(x)


@pytest.mark.parametrize("late", [0, 1, 5])
def test_a_late_message_is_received_as_it_was_sent(late):
    result = ech.simulate(parts(Late(late)), settings())
    np.testing.assert_allclose(result.states, by_hand(late), atol=1e-12)


def test_messages_that_take_no_time_are_the_ideal_network_to_the_bit():
    ideal, late = (ech.simulate(parts(channel), settings()) for channel in (None, Late(0)))
    np.testing.assert_array_equal(late.states, ideal.states)


def test_a_run_goes_on_with_the_messages_in_flight():
    run = parts(Late(3)), settings(horizon=200 * DT)
    whole, stretches = ech.simulate(*run), []

    def enough(so_far):
        if so_far.done >= 20:
            raise KeyboardInterrupt

    ech.simulate(*run, progress=enough, keep=stretches.append)
    resumed = ech.simulate(*run, before=stretches)
    assert len(stretches[-1].times) < len(whole.times)
    np.testing.assert_array_equal(resumed.states, whole.states)


def test_native_code_refuses_what_it_has_no_memory_for():
    with pytest.raises(EchelonError, match="a network that is not ideal"):
        ech.simulate(parts(Late(1)), settings(engine="native"))
