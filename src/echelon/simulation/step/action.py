"""What one agent does in a step: alone, as a row of many, or lowered to machine code."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Float

from echelon.agents.models.model import ControlAffine
from echelon.core.types import Input, Scalar, State
from echelon.core.words import Feedforward
from echelon.laws.law import Law, LocalView, Memory
from echelon.simulation.step.loop import Loop


class AgentOutput(NamedTuple):
    """What an agent does in a step.

    Attributes:
        desired: the input (m,) that its law asks for.
        input: what the actuators deliver of it (m,).
        memory: of its law, afterwards.
        message: what it sends to its followers in the same step, the feed-forward (k,).
    """

    desired: Input
    input: Input
    memory: Memory
    message: Float[jax.Array, " k"]


def act(loop: Loop, law: Law, view: LocalView, memory: Memory, leads: bool) -> AgentOutput:
    """Return what one agent does with what it knows.

    The heading that a follower is sent comes last in the feed-forward, and is passed on.
    """
    follower, heading = loop.follower, jnp.zeros(0, view.x.dtype)
    if loop.follower.turning:
        view, angle = _split_heading(loop, law, view, leads)
        law, follower, heading = law.facing(angle), follower.facing(angle), angle[None]
    if loop.share is not None and not leads:
        share = jnp.asarray(loop.share, view.x.dtype) * view.feedforward
        view = eqx.tree_at(lambda view: view.feedforward, view, share)
    desired, memory = law.update(loop.model, view, memory)
    # After the limits: what a leader could not do its followers must not copy (theory page).
    delivered = loop.motion.deliver(desired)
    memory = law.settle(loop.model, view, desired, delivered, memory)
    forward = feedforward_of(follower, loop.model, view.x, loop.model.normalized(delivered), memory)
    return AgentOutput(desired, delivered, memory, jnp.concatenate([forward, heading]))


def _split_heading(loop: Loop, law: Law, view: LocalView, leads: bool) -> tuple[LocalView, Scalar]:
    """Return what an agent knows besides the heading, and the heading: its own or received."""
    if leads:
        return view, law.heading(loop.model, view.t, view.x)
    received = view.feedforward
    return eqx.tree_at(lambda view: view.feedforward, view, received[:-1]), received[-1]


def feedforward_of(
    follower: Law, model: ControlAffine, x: State, v: Input, memory: Memory
) -> Float[jax.Array, " k"]:
    """Return the feed-forward of an agent at x with normalized input v and its next memory."""
    if follower.feedforward is Feedforward.NONE:
        return jnp.zeros_like(v)
    return follower.message(model, x, v, memory)


def limit_sides(
    model: ControlAffine, delivered: jax.Array, desired: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Return which desired inputs (..., m) limits changed, and to which side, -1, 0 or 1."""
    # To the bit, as `limit` returns what fits. NaN differs from itself, and is a divergence.
    limited = (delivered != desired) & ~jnp.isnan(desired)
    # Where one input is cut, mixing there and back rounds all others, which says nothing of a side.
    change = jnp.abs(delivered - desired)
    clear = change > 1e-6 * (jnp.abs(delivered) + jnp.abs(desired))
    if model.input_limits is not None:
        # A change that moves no limited row by a millionth of its range is rounding too.
        G, low, high = (jnp.asarray(part, change.dtype) for part in model.input_limits)
        share = (jnp.abs(G) / (high - low)[:, None]).max(axis=0)
        clear &= change * jnp.broadcast_to(share, change.shape) > 1e-6
    side = jnp.where(delivered > desired, 1.0, -1.0)
    return limited, jnp.where(limited & clear, side, 0.0)
