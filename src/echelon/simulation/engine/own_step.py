"""A step of one agent by itself, from its state, its memory and what it received."""

from collections.abc import Callable
from typing import NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from echelon.agents.models.model import ControlAffine
from echelon.agents.network.exchange import Exchange, Near
from echelon.agents.network.switching import Schedule
from echelon.agents.world.sensing import Estimate, Estimator
from echelon.core.compiled import cached_jit
from echelon.core.types import Array, PyTree, Scalar, State
from echelon.laws.flat_law import FlatLaw
from echelon.laws.law import Law, LocalView, Memory
from echelon.simulation.step.action import Action, act
from echelon.simulation.step.knowledge import (
    Ages,
    Letters,
    Mail,
    Readers,
    content_of,
    expected_of,
    understand,
    write,
)
from echelon.simulation.step.loop import Loop, offsets_at
from echelon.simulation.step.nearby import less_expected

Signal: TypeAlias = Float[jax.Array, " s"]
"""What an agent sends to its neighbours."""


class OwnState(NamedTuple):
    """What an agent knows without messages: its state (n,), its offset (n,) and its memory.

    `rate` (n,) is of the offset, as in `LocalView`.
    """

    x: State
    offset: State
    memory: Memory
    rate: State | None = None


@cached_jit
def begin_alone(loop: Loop, law: Law, x: State) -> Memory:
    """Return the memory of an agent that begins at x."""
    return law.begin(loop.model, x)


@cached_jit
def beside_alone(law: Law, memory: Memory, other: Signal) -> Memory:
    """Return the memory of an agent that begins late, with its headings beside another signal's.

    An angle is a number that grows with every turn, and who begins late knows none of them.
    """
    return law.beside(memory, other) if isinstance(law, FlatLaw) else memory


@cached_jit
def expected_alone(
    loop: Loop, t: Scalar, content: Float[jax.Array, " p"], age: Scalar, s: int
) -> Signal:
    """Return the signal (s,) at which an agent expects the leader, by its packet of an age (s)."""
    return expected_of(loop, s, t, content, jnp.maximum(age, 0.0))[0]


@cached_jit
def offset_alone(loop: Loop, law: Law, t: Scalar, agent: jax.Array) -> tuple[State, State | None]:
    """Return what an agent takes for its offset (n,) at a time (s), and its rate, or None."""
    offset, rate = offsets_at(loop, law, t, agent[None])
    return offset[0], None if rate is None else rate[0]


@cached_jit
def measured_alone(
    estimator: Estimator, model: ControlAffine, before: Estimate, y: State, first: jax.Array
) -> tuple[State, Estimate]:
    """Return the state that an agent assumes at a measurement (n,), and its estimate."""
    return estimator.measure(model, before, y, first)


@cached_jit
def signal_of(loop: Loop, law: Law, own: OwnState) -> Signal:
    """Return what the agent sends to its neighbours."""
    signal = law.signal(loop.model, *own[:3])
    return own.x - own.offset if signal is None else signal


@cached_jit
def hull_of(loop: Loop, law: Law, own: OwnState) -> Float[jax.Array, "r d"] | None:
    """Return the points in whose hull the agent's position stays, where agents keep apart."""
    return None if loop.follower.safety is None else law.hull(loop.model, own.x, own.memory)


def _gaps(near: Near | None, hull: Float[jax.Array, "r d"] | None) -> Near | None:
    """Return what an agent knows of others, from their hulls and its own."""
    return None if near is None or hull is None else near._replace(gaps=hull[None] - near.gaps)


class OwnLaw(NamedTuple):
    """The law of one agent, and whom it hears.

    Attributes:
        loop: of its formation.
        leads: whether it is a leader.
        number: of the agent.
        neighbours: the numbers of those that it hears.
        weights: of their signals (rows, K); a graph that switches has several rows.
        signal_names, forward_names: of what it sends.
        source: whose feed-forward it uses; None for nobody's.
        schedule: when which row of weights holds, of a graph that switches.
    """

    loop: Loop
    leads: bool
    number: int
    neighbours: tuple[int, ...]
    weights: Array
    signal_names: tuple[str, ...]
    forward_names: tuple[str, ...]
    source: int | None
    schedule: Schedule | None

    @property
    def law(self) -> Law:
        """The leaders' law or the others'."""
        return self.loop.leader if self.leads else self.loop.follower


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
    gaps = jax.vmap(lambda value: gap_of(loop, leads, own, value))(received)
    return step_with(loop, leads, t, own, weights @ gaps, forward, near)


def gap_of(loop: Loop, leads: bool, own: OwnState, received: Signal) -> Float[jax.Array, " k"]:
    """Return the difference of an agent's signal from another's; 0 where that one is NaN."""
    law = loop.leader if leads else loop.follower
    signal = signal_of(loop, law, own)
    # The own value has no difference: a neighbour that is not heard does not act.
    return _difference(loop, law, own)(signal, jnp.where(jnp.isnan(received), signal, received))


def _difference(loop: Loop, law: Law, own: OwnState) -> Callable[..., jax.Array]:
    """Return the difference of two signals: the model's, where they are states."""
    return loop.model.difference if law.signal(loop.model, *own[:3]) is None else jnp.subtract


def step_with(
    loop: Loop,
    leads: bool,
    t: Scalar,
    own: OwnState,
    z: Float[jax.Array, " s"],
    forward: Float[jax.Array, " k"],
    near: Near | None,
) -> Step:
    """Return what the agent does with a disagreement; a feed-forward is NaN if not received."""
    law, model = loop.leader if leads else loop.follower, loop.model
    signal, hull = signal_of(loop, law, own), hull_of(loop, law, own)
    alone = jnp.zeros_like(forward)
    if loop.follower.turning and not leads:
        alone = alone.at[-1].set(law.heading(model, t, own.x))
    forward = jnp.where(jnp.isnan(forward), alone, forward)
    forward = jnp.zeros(len(model.input_names)) if leads else forward
    rows = z, forward, loop.motion.dt, _gaps(near, hull), own.rate
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
    difference = jax.vmap(_difference(loop, law, own))
    rows = loop, Exchange(nobody, nobody, weights), reader, t, mail, ages, signal[None], difference
    knowledge = understand(*rows)
    forward = jnp.zeros(len(model.input_names)) if leads else knowledge.feedforward[0]
    z = knowledge.disagreement[0]
    hull = hull_of(loop, law, own)
    hull = None if hull is None else less_expected(loop, t, hull, knowledge.leader[0])
    rows = z, forward, loop.motion.dt, _gaps(near, hull), own.rate
    view = LocalView(t, own.x, own.offset, *rows)
    action = act(loop, law, view, own.memory, leads)
    content = mail.packet.content
    if leads:
        content = content_of(loop, t, *own[:3], signal, action.message, action.input)[None]
    step = jnp.zeros((), jnp.int32)
    assert loop.channel is not None
    letter, _ = write(
        loop.channel, reader, step, mail, knowledge, signal[None], difference, content
    )
    return Step(signal, action, is_finite((own.x, signal, action, letter, hull)), letter, hull)
