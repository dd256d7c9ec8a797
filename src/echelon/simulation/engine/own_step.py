"""A step of one agent by itself, from its state, its memory and what it received."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from echelon.agents.models.model import ControlAffine
from echelon.agents.network.exchange import Exchange
from echelon.agents.network.near import Near
from echelon.agents.world.estimator import Estimate, Estimator
from echelon.core.compiled import cached_jit
from echelon.core.types import PyTree, Scalar, State
from echelon.laws.law import Law, LocalView, Memory
from echelon.simulation.step.action import Action, act
from echelon.simulation.step.knowledge import (
    Ages,
    Letters,
    Mail,
    Readers,
    content_of,
    understand,
    write,
)
from echelon.simulation.step.loop import Loop
from echelon.simulation.step.nearby import less_expected


class OwnState(NamedTuple):
    """What an agent knows without messages: its state (n,), its offset (n,) and its memory."""

    x: State
    offset: State
    memory: Memory


@cached_jit
def begin_alone(loop: Loop, law: Law, x: State) -> Memory:
    """Return the memory of an agent that begins at x."""
    return law.begin(loop.model, x)


@cached_jit
def measured_alone(
    estimator: Estimator, model: ControlAffine, before: Estimate, y: State, first: jax.Array
) -> tuple[State, Estimate]:
    """Return the state that an agent assumes at a measurement (n,), and its estimate."""
    return estimator.measure(model, before, y, first)


@cached_jit
def signal_of(loop: Loop, law: Law, own: OwnState) -> Float[jax.Array, " s"]:
    """Return what the agent sends to its neighbours."""
    signal = law.signal(loop.model, *own)
    return own.x - own.offset if signal is None else signal


@cached_jit
def hull_of(loop: Loop, law: Law, own: OwnState) -> Float[jax.Array, "r d"] | None:
    """Return the points in whose hull the agent's position stays, where agents keep apart."""
    return None if loop.follower.safety is None else law.hull(loop.model, own.x, own.memory)


def _gaps(near: Near | None, hull: Float[jax.Array, "r d"] | None) -> Near | None:
    """Return what an agent knows of others, from their hulls and its own."""
    return None if near is None or hull is None else near._replace(gaps=hull[None] - near.gaps)


class Step(NamedTuple):
    """The signal (s,) of an agent, what it does, and whether both and its state are finite.

    `letter` is what it sends over a network that is late, as a row of one, and `hull` its hull.
    """

    signal: jax.Array
    action: Action
    finite: jax.Array
    letter: Letters | None = None
    hull: jax.Array | None = None


@cached_jit
def step_alone(
    loop: Loop,
    leads: bool,
    t: Scalar,
    own: OwnState,
    received: Float[jax.Array, "K s"],
    weights: Float[jax.Array, " K"],
    forward: Float[jax.Array, " k"],
    near: Near | None,
) -> Step:
    """Return what the agent does with what it received, NaN for what it did not."""
    law, model = loop.leader if leads else loop.follower, loop.model
    signal = signal_of(loop, law, own)
    states = law.signal(model, *own) is None
    difference = model.difference if states else jnp.subtract
    # The own value has no difference: a neighbour that is not heard does not act.
    theirs = jnp.where(jnp.isnan(received), signal, received)
    gaps = jax.vmap(lambda value: difference(signal, value))(theirs)
    alone = jnp.zeros_like(forward)
    if loop.follower.turning and not leads:
        alone = alone.at[-1].set(law.heading(model, t, own.x))
    forward = jnp.where(jnp.isnan(forward), alone, forward)
    forward = jnp.zeros(len(model.input_names)) if leads else forward
    hull = hull_of(loop, law, own)
    rows = weights @ gaps, forward, loop.motion.dt, _gaps(near, hull)
    action = act(loop, law, LocalView(t, own.x, own.offset, *rows), own.memory, leads)
    return Step(signal, action, is_finite((own.x, signal, action, hull)), hull=hull)


def is_finite(tree: PyTree) -> jax.Array:
    """Return whether all numbers of a tree are finite."""
    leaves = [leaf for leaf in jax.tree.leaves(tree) if jnp.issubdtype(leaf.dtype, jnp.inexact)]
    return jnp.all(jnp.array([jnp.isfinite(leaf).all() for leaf in leaves]))


@cached_jit
def step_over_network(
    loop: Loop,
    leads: bool,
    reader: Readers,
    t: Scalar,
    own: OwnState,
    mail: Mail,
    ages: Ages,
    weights: Float[jax.Array, " K"],
    near: Near | None,
) -> Step:
    """Return what the agent does and sends over a network that is late."""
    law, model = loop.leader if leads else loop.follower, loop.model
    signal, nobody = signal_of(loop, law, own), np.zeros(len(weights), np.int32)
    states = law.signal(model, *own) is None
    difference = jax.vmap(model.difference if states else jnp.subtract)
    rows = loop, Exchange(nobody, nobody, weights), reader, t, mail, ages, signal[None], difference
    knowledge = understand(*rows)
    forward = jnp.zeros(len(model.input_names)) if leads else knowledge.feedforward[0]
    z = knowledge.disagreement[0]
    hull = hull_of(loop, law, own)
    hull = None if hull is None else less_expected(loop, t, hull, knowledge.leader[0])
    view = LocalView(t, own.x, own.offset, z, forward, loop.motion.dt, _gaps(near, hull))
    action = act(loop, law, view, own.memory, leads)
    content = mail.packet.content
    if leads:
        content = content_of(loop, t, *own, signal, action.message, action.input)[None]
    step = jnp.zeros((), jnp.int32)
    assert loop.channel is not None
    letter, _ = write(
        loop.channel, reader, step, mail, knowledge, signal[None], difference, content
    )
    return Step(signal, action, is_finite((own.x, signal, action, letter, hull)), letter, hull)
