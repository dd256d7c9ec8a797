"""A motion of the formation has the derivatives that T5 asks of it, or nothing is guaranteed."""

import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from in_words import in_words

import echelon as ech
from echelon.agents.network.formation_motion import OffsetMotion, Reshape, Rotate
from echelon.guarantees.stopping.moving_offsets import offset_fault

CART = ech.models.DoubleIntegrator()
GRAPH = ech.Graph.path(3)
LAWS = ech.Laws(ech.laws.StoppingLeader(), ech.laws.StoppingPoint())
MOVED = np.array([[0, 0, 0, 0], [0.5, 1, 0, 0], [1, 2, 0, 0.0]])


def motion(name, call):
    """A motion of somebody's own, a function of an agent's place and the time."""
    own = {"__module__": __name__, "__call__": lambda self, place, t: call(place, t)}
    return type(name, (OffsetMotion,), own)


# A jump after all samples; one where an agent is far out, which the place of the samples is not; a
# kink that is small beside the rest; a part without derivatives.
Late = motion("Late", lambda place, t: place + jnp.where(t > 61.0, place, 0.0))
Place = motion("Place", lambda place, t: jnp.where(place > 1.5, place + 0.5, place))
Small = motion(
    "Small", lambda place, t: place.at[0].add(1e-4 * jnp.abs(t - 13.1) + 2.0 * jnp.sin(t))
)
Hidden = motion(
    "Hidden",
    lambda place, t: place.at[0].add(10.0 * jnp.sin(t) + 1e-3 * jnp.sin(jax.lax.stop_gradient(t))),
)
# A wave that is larger where an agent is far out.
Smooth = motion("Smooth", lambda place, t: place.at[1].add(0.2 * place[0] * jnp.sin(t)))


_JUMPS = False


class Told(OffsetMotion):
    """A wave, or what a global says."""

    def __call__(self, place, t):
        wave = place.at[0].add(0.1 * jnp.sin(t))
        return jnp.where(t > 5.0, wave + place, wave) if _JUMPS else wave


def guaranteed(*changes, horizon=20.0):
    formation = ech.Formation.from_offsets(CART, GRAPH, {1: (1.0, 0.0), 2: (2.0, 1.0)})
    parts = ech.Parts(CART, GRAPH, formation.moving(CART, GRAPH, changes), LAWS)
    return parts, ech.guarantee(parts, ech.Settings(horizon=horizon, dt=0.01))


@pytest.mark.parametrize(
    ("changes", "horizon"),
    [
        ((Late(),), 70.0),
        ((Rotate(0.5), Place()), 20.0),
        ((Reshape(MOVED, 1.1, 2.3), Place()), 20.0),
        ((Small(),), 20.0),
        ((Hidden(),), 20.0),
    ],
    ids=["after all samples", "on its way round", "on its way", "small", "without derivatives"],
)
def test_a_motion_that_is_not_shown_smooth_is_not_guaranteed(changes, horizon):
    parts, value = guaranteed(*changes, horizon=horizon)
    assert not value.promised
    name = type(changes[-1]).__name__
    assert f"the motion `{name}` is not known to have 2 bounded derivatives" in in_words(value)
    if isinstance(changes[0], Rotate):  # nor was it true: errors jump with it
        run = ech.simulate(parts, ech.Settings(horizon=10.0, dt=0.01))
        assert run.formation_errors[run.times > 4.0].max() > 0.4


def test_what_a_motion_reads_is_asked_again(monkeypatch):
    parts, value = guaranteed(Told())
    assert value.promised
    monkeypatch.setattr(sys.modules[__name__], "_JUMPS", True)
    assert not ech.guarantee(parts, ech.Settings(horizon=20.0, dt=0.01)).promised


def test_a_smooth_motion_between_reshapes_is_guaranteed():
    _, value = guaranteed(Reshape(MOVED, 1.1, 2.3), Rotate(0.3), Smooth())
    assert value.promised and value.rate > 1.0
    # Until the jump nothing keeps it from that.
    _, before = guaranteed(Late(), horizon=60.0)
    assert before.promised
    # A reshape has no derivatives for longer chains.
    still = guaranteed(Reshape(MOVED, 1.1, 2.3))[0].formation.motion
    assert offset_fault(still, 6, 20.0) == ""
    fault = "a reshape has 5 continuous derivatives, and 6 are needed"
    assert offset_fault(still, 7, 20.0) == fault
