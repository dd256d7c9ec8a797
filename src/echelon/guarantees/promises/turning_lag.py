"""How far followers end from their goals in a formation that turns with its leader on a circle.

Agents farther out move faster than the leader, whose input they are sent, so they lag. In axes that
turn with the leader all of them rest where f + g u of a follower differs from the leader's by the
turn of its offset; that place is found by Newton's method.
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from echelon.agents.models.heading_symmetry import state_turn
from echelon.agents.models.model import ControlAffine
from echelon.agents.network.formation_motion import Rotate
from echelon.core.compiled import cached_jit
from echelon.core.linear import newton_least
from echelon.core.types import Array, State
from echelon.core.words import Feedforward
from echelon.guarantees.promises.case import GuaranteeInputs
from echelon.guarantees.promises.frozen_laws import leader_run_of
from echelon.laws.law import Faces, Feeds, Law, LocalView, without_certificates
from echelon.simulation.engine.law_drive import Laws
from echelon.simulation.step.meter import measured_states

_SAME, _STEADY = 1e-6, 1e-3
"""Relative, of the rate of a turn; of the inputs on a circle."""
_MOST = 1200
"""Numbers of all followers up to which one matrix is made of them."""


class _Circle(NamedTuple):
    """A leader on a circle, in axes that turn with it, and its followers.

    Attributes:
        x, v: its state (n,) and its normalized input (m,).
        goals: (N, n) of all.
        heard: (F, N) what followers hear of all.
        followers: (F,).
        rate: of the turn, rad/s.
    """

    x: Array | jax.Array
    v: Array | jax.Array
    goals: Array | jax.Array
    heard: Array | jax.Array
    followers: Array | jax.Array
    rate: Array | jax.Array


def turning_lag(case: GuaranteeInputs) -> float | None:
    """Return how far the follower that lags most ends from its goal; None where nothing is known.

    The leader drives a circle, and the formation turns as fast.
    """
    circle, model = _circle_of(case), case.parts.model
    if circle is None:
        return None
    assert isinstance(case.parts.drive, Laws)
    law = without_certificates(case.parts.drive.follower)

    def left(z: Array) -> tuple[Array, Array]:
        rest, slope = map(np.asarray, _left(model, law, circle, jnp.asarray(z)))
        return rest, slope

    goals = np.asarray(circle.goals)[circle.followers]
    found = newton_least(left, goals.reshape(-1))
    if found is None:
        return None
    away = (found.reshape(goals.shape) - goals)[:, list(measured_states(model))]
    return float(np.linalg.norm(away, axis=1).max())


def _circle_of(case: GuaranteeInputs) -> _Circle | None:
    parts, drive, motion = case.parts, case.parts.drive, case.parts.formation.motion
    known = motion is not None and len(motion.motions) == 1 and not len(motion.begins)
    if not (known and isinstance(drive, Laws) and case.governed and drive.follower.turning):
        return None
    assert motion is not None
    turn, path = motion.motions[0], leader_run_of(parts, case.settings, case.leaders)
    followers = np.array(parts.graph.followers)
    small = parts.formation.offsets.size <= _MOST and len(parts.graph.leaders) == 1
    if not (isinstance(turn, Rotate) and small and len(path.times)):
        return None
    steady = np.abs(path.rates - turn.rate).max() <= _SAME * abs(turn.rate)
    if not steady or np.ptp(path.inputs, axis=0).max() > _STEADY:
        return None
    back = functools.partial(state_turn(parts.model), angle=jnp.asarray(-path.headings[0]))
    offsets = parts.formation.offsets_at([path.times[0]])[0] - parts.formation.offsets[0]
    goals = np.asarray(jax.vmap(back)(jnp.asarray(offsets))) + path.states[0]
    heard = parts.graph.laplacian().toarray()[followers]
    rate = np.asarray(turn.rate)
    return _Circle(path.states[0], path.inputs[0], goals, heard, followers, rate)


@cached_jit
def _left(
    model: ControlAffine, law: Law, circle: _Circle, z: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Return how followers z (F n) move in the axes of the circle, and the slope."""
    x, v, goals, heard, followers, rate = map(jnp.asarray, circle)
    spin, law = jnp.asarray(state_turn(model).slope), Faces.of(law).facing(jnp.zeros(()))
    led = model.velocity(x, model.physical(v))
    silent, sent = law.feedforward is Feedforward.NONE, jnp.zeros_like(v)
    sent = sent if silent else Feeds.of(law).broadcast(model, x, v)

    def one(y: State, z: State) -> State:
        view = LocalView(jnp.zeros(()), y, jnp.zeros_like(y), z, sent)
        u = law.update(model, view, law.init())[0]
        return model.velocity(y, u) - led - rate * (spin @ (y - x))

    def left(z: jax.Array) -> jax.Array:
        states = z.reshape(len(followers), -1)
        errors = jnp.zeros_like(goals).at[followers].set(states - goals[followers])
        return jax.vmap(one)(states, heard @ errors).reshape(-1)

    return left(z), jax.jacfwd(left)(z)
