"""The order of a step: agents send, receive, act and move; and many steps one after the other."""

import operator
from typing import NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
from jaxtyping import Float

from echelon.agents.network.exchange import Difference
from echelon.agents.network.near import Near
from echelon.core.compiled import cached_jit
from echelon.core.types import Array, Inputs, PyTree, State, States
from echelon.laws.law import Law, LocalView, Memory
from echelon.simulation.step.action import Action, act, limit_sides
from echelon.simulation.step.loop import Loop, Moment, WorldState, exchange_at
from echelon.simulation.step.messages import begin_network, read_messages, send_messages
from echelon.simulation.step.meter import Sums, reference_at
from echelon.simulation.step.motion import MotionState
from echelon.simulation.step.nearby import begin_sightings, look_around


@cached_jit
def begin(loop: Loop, states: States) -> Moment:
    """Return the moment at which a run begins from states (N, n)."""

    def remember(law: Law, agents: Array) -> Memory:
        return jax.vmap(lambda x: law.begin(loop.model, x))(jnp.asarray(states)[agents])

    moment = Moment(
        step=jnp.zeros((), jnp.int32),
        states=jnp.asarray(states),
        leader_memory=remember(loop.leader, loop.leaders),
        follower_memory=remember(loop.follower, loop.followers),
        cut=jnp.zeros((len(states), len(loop.model.input_names)), jnp.int8),
    )
    world = WorldState()
    memory = loop.motion.begin(moment.states)
    if memory != (None, None):
        world = world._replace(motion=memory)
    if loop.sensors is not None:
        world = world._replace(measured=loop.sensors.begin(moment.states))
        estimator = loop.sensors.estimator
        if estimator is not None:
            estimates = jax.vmap(lambda x: estimator.begin(loop.model, x))(moment.states)
            world = world._replace(estimates=estimates)
    if loop.channel is not None:
        size = _feedforward_size(loop, moment)
        world = begin_network(loop, world, _sent(loop, moment)[0], size)
        world = world._replace(seen=begin_sightings(loop, moment))
    return moment._replace(world=world)


def _feedforward_size(loop: Loop, moment: Moment) -> int:
    """Return how many numbers leaders send to their followers."""
    return jax.eval_shape(lambda: _lead(loop, moment, _sent(loop, moment)[0])).message.shape[1]


class Control(NamedTuple):
    """Delivered inputs (N, m), who was limited (N,), to which side (N, m), and what follows."""

    inputs: Inputs
    limited: jax.Array
    cut: jax.Array
    leader_memory: Memory
    follower_memory: Memory
    world: WorldState


def control(loop: Loop, now: Moment) -> Control:
    """Return what all agents do from a moment on."""
    now = _measured(loop, now)
    sent, difference = _sent(loop, now)
    exchange = exchange_at(loop.exchange, loop.switches, now.step)
    knowledge = mail = None
    if loop.channel is None:
        # The ideal network neither delays nor loses: what is sent is received.
        z = exchange(sent, exchange.along_edges(sent), difference)
    else:
        knowledge, mail = read_messages(loop, exchange, now, sent, difference)
        z = knowledge.disagreement
    near, seen = look_around(loop, now, knowledge, mail)
    led = _lead(loop, now, z)
    if loop.levels is not None:
        followed = _by_depth(loop, now, led, z)
    else:
        broadcast = led.message[loop.sender]
        forward = broadcast if knowledge is None else knowledge.feedforward[loop.followers]
        rows = loop.followers, forward, now.follower_memory
        followed = _act_all(loop, now, z, loop.follower, *rows, near=near)
    world = now.world
    if knowledge is not None and mail is not None:
        said = led.message, led.input
        world = send_messages(loop, exchange, now, mail, knowledge, sent, difference, *said)
        world = world._replace(seen=seen)
    u = jnp.concatenate([led.input, followed.input])[loop.order]
    if loop.sensors is not None and loop.sensors.estimator is not None:
        world = world._replace(estimates=jax.vmap(loop.sensors.estimator.act)(world.estimates, u))
    desired = jnp.concatenate([led.desired, followed.desired])[loop.order]
    limited, cut = limit_sides(u, desired)
    return Control(u, limited.any(axis=1), cut.astype(jnp.int8), led.memory, followed.memory, world)


def _measured(loop: Loop, now: Moment) -> Moment:
    """Return the moment as the agents measure it: they know nothing of their true states."""
    if loop.sensors is None:
        return now
    states, last = loop.sensors.read(now.world.measured, now.states, now.step)
    world, estimator = now.world._replace(measured=last), loop.sensors.estimator
    if estimator is not None:
        states, estimates = jax.vmap(
            lambda before, y: estimator.measure(loop.model, before, y, now.step == 0)
        )(world.estimates, states)
        world = world._replace(estimates=estimates)
    return now._replace(states=states, world=world)


def _lead(loop: Loop, now: Moment, z: Float[jax.Array, "N s"]) -> Action:
    """Return what the leaders do."""
    # Nobody is before a leader whose input it could be sent.
    silence = jnp.zeros((len(loop.leaders), len(loop.model.input_names)), z.dtype)
    rows = loop.leaders, silence, now.leader_memory
    return _act_all(loop, now, z, loop.leader, *rows, leads=True)


def _act_all(
    loop: Loop,
    now: Moment,
    z: Float[jax.Array, "N s"],
    law: Law,
    agents: Array | jax.Array,
    forward: Float[jax.Array, "K k"],
    memory: Memory,
    leads: bool = False,
    near: Near | None = None,
) -> Action:
    """Return what some agents do, with what they are sent (K, k), remember and know of others."""
    x, offsets = now.states, jnp.asarray(loop.offsets, now.states.dtype)
    # From the step number, since a sum of many dt would gather rounding.
    t = now.step.astype(x.dtype) * loop.motion.dt

    # One time for all; of everything else, an agent sees its own row and no other.
    def one(
        x: State,
        offset: State,
        z: jax.Array,
        forward: jax.Array,
        memory: Memory,
        row: PyTree,
        near: Near | None,
    ) -> Action:
        view = LocalView(t, x, offset, z, forward, loop.motion.dt, near)
        return act(loop.with_motion(row), law, view, memory, leads)

    rows, near = jax.tree.map(lambda leaf: leaf[agents], (loop.motion.rows, near))
    return jax.vmap(one)(x[agents], offsets[agents], z[agents], forward, memory, rows, near)


def _by_depth(loop: Loop, now: Moment, led: Action, z: Float[jax.Array, "N s"]) -> Action:
    """Let the followers act level by level, each sent what its parent has just done."""
    followers, parents = jnp.asarray(loop.followers), jnp.asarray(loop.parents)
    messages = jnp.zeros((len(now.states), led.message.shape[1]), led.message.dtype)
    messages = messages.at[loop.leaders].set(led.message)
    nothing = jnp.zeros((len(followers), led.input.shape[1]), led.input.dtype)

    def level(
        carry: tuple[jax.Array, Action], places: jax.Array
    ) -> tuple[tuple[jax.Array, Action], None]:
        messages, actions = carry
        agents = followers[places]
        memory = jax.tree.map(lambda leaf: leaf[places], now.follower_memory)
        forward = messages[parents[agents]]
        acted = _act_all(loop, now, z, loop.follower, agents, forward, memory)
        # Where a level repeats an agent, the same is written twice.
        actions = jax.tree.map(lambda a, b: a.at[places].set(b), actions, acted)
        return (messages.at[agents].set(acted.message), actions), None

    # Every follower is in one level, so that no zero of these is left.
    start = Action(nothing, nothing, now.follower_memory, messages[followers])
    return jax.lax.scan(level, (messages, start), jnp.asarray(loop.levels))[0][1]


# ---- what is sent and received -------------------------------------------------------------------


@cached_jit
def signals(
    loop: Loop, now: Moment, offsets: Float[jax.Array, "N n"]
) -> Float[jax.Array, "N s"] | None:
    """Return the signals of all agents (N, s); None where they send their states less offsets."""
    x = jnp.asarray(now.states)

    def of(law: Law, agents: Array, memory: Memory) -> jax.Array | None:
        rows = x[agents], offsets[agents], memory
        return jax.vmap(lambda *row: law.signal(loop.model, *row))(*rows)

    followers = of(loop.follower, loop.followers, now.follower_memory)
    if followers is None:
        return None
    leaders = of(loop.leader, loop.leaders, now.leader_memory)
    assert leaders is not None, "a law with a signal takes a leader that gives it"
    return jnp.concatenate([leaders, followers])[loop.order]


def _sent(loop: Loop, now: Moment) -> tuple[Float[jax.Array, "N s"], Difference]:
    """Return what all agents send to their neighbours, and how far two such values are apart."""
    offsets = jnp.asarray(loop.offsets, now.states.dtype)
    sent = signals(loop, now, offsets)
    if sent is not None:
        return sent, operator.sub
    return now.states - offsets, jax.vmap(loop.model.difference)


# ---- steps ---------------------------------------------------------------------------------------


def step(loop: Loop, now: Moment) -> Moment:
    """Return the moment one dt later."""
    return _move(loop, now, control(loop, now))


def _move(loop: Loop, now: Moment, acted: Control) -> Moment:
    """Return the moment one dt later under what all agents do."""
    world = acted.world
    own = MotionState() if world.motion is None else world.motion
    states, own = loop.motion.advance(now.states, acted.inputs, now.step, own)
    world = world if world.motion is None else world._replace(motion=own)
    memories = acted.leader_memory, acted.follower_memory
    return Moment(now.step + 1, states, *memories, acted.cut, world)


def measured_step(
    loop: Loop, now: Moment, reference: Array | None, first: jax.Array | int
) -> tuple[Moment, Sums]:
    """Return the moment one dt later, and the sums of this step.

    `reference` (S, n) is what the leaders follow from the step `first` on.
    """
    acted = control(loop, now)
    followed = reference_at(reference, now.step - first, now.states)
    chatter = (acted.cut * now.cut < 0).any(axis=1)
    moment = now.step, now.states, acted.inputs
    read = loop.meter.read(*moment, acted.limited, chatter, followed)
    active = loop.follower.active(acted.follower_memory)
    if active is not None:
        every = jnp.zeros(len(now.states), active.dtype).at[loop.followers].set(active)
        read = read._replace(**loop.meter.of_slice(now.step, now.states, every))
    return _move(loop, now, acted), read


Frames: TypeAlias = tuple[Float[jax.Array, "T N n"], Float[jax.Array, "T N m"]]
"""States and inputs at T times."""


@cached_jit
def advance(
    loop: Loop, now: Moment, counts: jax.Array, reference: Array | None, first: jax.Array | int
) -> tuple[Moment, Frames, Sums]:
    """Store a frame and take counts[k] steps, for each k.

    Return the last moment, the stored states and inputs, and the sums over the steps. `reference`
    (S, n) is what the leaders follow from the step `first` on.
    """

    def one(_: jax.Array, carry: tuple[Moment, Sums]) -> tuple[Moment, Sums]:
        now, sums = measured_step(loop, carry[0], reference, first)
        return now, carry[1].plus(sums)

    def frame(
        carry: tuple[Moment, Sums], count: jax.Array
    ) -> tuple[tuple[Moment, Sums], tuple[States, Inputs]]:
        # The first step computes these inputs again, but after the last frame there is none.
        stored = (carry[0].states, control(loop, carry[0]).inputs)
        return jax.lax.fori_loop(0, count, one, carry), stored

    (now, sums), stored = jax.lax.scan(frame, (now, loop.meter.zero_sums()), counts)
    return now, stored, sums


@cached_jit
def final_states(
    loop: Loop, starts: Float[jax.Array, "S N n"], steps: int
) -> Float[jax.Array, "S N n"]:
    """Return the states (S, N, n) after `steps` steps from each of the starts (S, N, n)."""

    def last(states: States) -> States:
        now = begin(loop, states)
        return jax.lax.fori_loop(0, steps, lambda _, now: step(loop, now), now).states

    return jax.vmap(last)(starts)
