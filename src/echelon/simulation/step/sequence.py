"""The order of a step: agents send, receive, act and move; and many steps one after the other."""

import operator
from collections.abc import Callable
from typing import NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
from jaxtyping import Bool, Float

from echelon.agents.network.exchange import Difference, Near
from echelon.core.compiled import cached_jit
from echelon.core.types import Array, Inputs, PyTree, State, States
from echelon.laws.law import Law, LocalView, Memory
from echelon.simulation.step.action import AgentOutput, act, limit_sides
from echelon.simulation.step.arrivals import beside_others, has_angles
from echelon.simulation.step.distances import closest_two
from echelon.simulation.step.knowledge import no_packets
from echelon.simulation.step.loop import (
    Loop,
    LoopState,
    WorldState,
    all_offsets,
    exchange_at,
    goals_at,
    measured,
    nearest_at,
    offsets_at,
    present_at,
    time_of,
)
from echelon.simulation.step.messages import (
    begin_network,
    first_readers,
    heard_at_once,
    led_by_backups,
    read_messages,
    readers_of,
    send_messages,
)
from echelon.simulation.step.meter import Sums, reference_at
from echelon.simulation.step.motion import MotionState
from echelon.simulation.step.nearby import begin_sightings, look_around


@cached_jit
def begin(loop: Loop, states: States) -> LoopState:
    """Return the moment at which a run begins from states (N, n)."""

    def remember(law: Law, agents: Array) -> Memory:
        return jax.vmap(lambda x: law.begin(loop.model, x))(jnp.asarray(states)[agents])

    # Backup leaders, and a leader that may follow one of them, have the memory of followers.
    lead = loop.leader if loop.succession is None else loop.follower
    moment = LoopState(
        step=jnp.zeros((), jnp.int32),
        states=jnp.asarray(states),
        leader_memory=remember(lead, loop.leaders),
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
    elif loop.succession is not None:
        content = jnp.zeros((len(states), _feedforward_size(loop, moment)), moment.states.dtype)
        world = world._replace(led=no_packets(first_readers(loop), content, True))
    if loop.presence is not None and loop.presence.returns:
        world = world._replace(starts=moment.states)
    return moment._replace(world=world)


def _feedforward_size(loop: Loop, moment: LoopState) -> int:
    return jax.eval_shape(lambda: _lead(loop, moment, _sent(loop, moment)[0])).message.shape[1]


class Control(NamedTuple):
    """Delivered inputs (N, m), who was limited (N,), to which side (N, m), and what follows."""

    inputs: Inputs
    limited: jax.Array
    cut: jax.Array
    leader_memory: Memory
    follower_memory: Memory
    world: WorldState


def control(loop: Loop, now: LoopState) -> Control:
    """Return what all agents do from a moment on."""
    now = measured(loop, now)
    here = present_at(loop, now.step)
    sent, difference = _sent(loop, now)
    exchange = exchange_at(loop.exchange, loop.switches, now.step)
    knowledge = mail = None
    if loop.channel is None:
        # The ideal network neither delays nor loses: what is sent is received.
        z = exchange(sent, exchange.along_edges(sent), difference)
    else:
        knowledge, mail = read_messages(loop, exchange, now, sent, difference)
        z = knowledge.disagreement
    dt, led = loop.motion.dt, now.world.led
    packet = mail.packet if mail is not None else led_by_backups(loop, now.step, led, dt)
    leads = readers_of(loop, packet).leads
    near, seen = look_around(loop, now, leads, knowledge, mail)
    said, led = (_lead(loop, now, z),) * 2
    world = now.world
    if loop.levels is not None:
        followed = _by_depth(loop, now, led, z)
    else:
        if knowledge is not None:
            forward = knowledge.feedforward
        elif loop.succession is None:
            forward = led.message
        else:
            packet = heard_at_once(loop, now, packet, led.message)
            world, forward = world._replace(led=packet), packet.content
        direct = knowledge is None and loop.succession is None
        sender = loop.sender if direct else loop.followers
        rows = loop.followers, forward[sender], now.follower_memory
        followed = _act_all(loop, now, z, loop.follower, *rows, near=near)
        if loop.succession is not None:
            rows = loop.leaders, forward[loop.leaders], now.leader_memory
            follows = _act_all(loop, now, z, loop.follower, *rows, near=near)
            led = _chosen(leads[loop.leaders], led, follows)
    if knowledge is not None and mail is not None:
        rows = sent, difference, said.message, said.input
        world = send_messages(loop, exchange, now, mail, knowledge, *rows)
        world = world._replace(seen=seen)
    u = jnp.concatenate([led.input, followed.input])[loop.order]
    u = u if here is None else jnp.where(here[:, None], u, 0.0)
    if loop.sensors is not None and loop.sensors.estimator is not None:
        world = world._replace(estimates=jax.vmap(loop.sensors.estimator.act)(world.estimates, u))
    desired = jnp.concatenate([led.desired, followed.desired])[loop.order]
    limited, cut = limit_sides(loop.model, u, desired)
    if here is not None:
        limited, cut = (jnp.where(here[:, None], part, 0) for part in (limited, cut))
    return Control(u, limited.any(axis=1), cut.astype(jnp.int8), led.memory, followed.memory, world)


def _chosen(first: Bool[jax.Array, " L"], one: AgentOutput, other: AgentOutput) -> AgentOutput:
    def pick(a: jax.Array, b: jax.Array) -> jax.Array:
        return jnp.where(first.reshape(-1, *[1] * (jnp.ndim(a) - 1)), a, b)

    return jax.tree.map(pick, one, other)


def _lead(loop: Loop, now: LoopState, z: Float[jax.Array, "N s"]) -> AgentOutput:
    # Nobody is before a leader whose input it could be sent.
    silence = jnp.zeros((len(loop.leaders), len(loop.model.input_names)), z.dtype)
    rows = loop.leaders, silence, now.leader_memory
    return _act_all(loop, now, z, loop.leader, *rows, leads=True)


def _act_all(
    loop: Loop,
    now: LoopState,
    z: Float[jax.Array, "N s"],
    law: Law,
    agents: Array | jax.Array,
    forward: Float[jax.Array, "K k"],
    memory: Memory,
    leads: bool = False,
    near: Near | None = None,
) -> AgentOutput:
    x, t = now.states, time_of(loop, now)
    offsets, rates = offsets_at(loop, law, t, agents)

    # One time for all; of everything else, an agent sees its own row and no other.
    def one(
        x: State,
        offset: State,
        z: jax.Array,
        forward: jax.Array,
        memory: Memory,
        row: PyTree,
        near: Near | None,
        rate: State | None,
    ) -> AgentOutput:
        view = LocalView(t, x, offset, z, forward, loop.motion.dt, near, rate)
        return act(loop.with_motion(row), law, view, memory, leads)

    rows, near = jax.tree.map(lambda leaf: leaf[agents], (loop.motion.rows, near))
    return jax.vmap(one)(x[agents], offsets, z[agents], forward, memory, rows, near, rates)


def _by_depth(
    loop: Loop, now: LoopState, led: AgentOutput, z: Float[jax.Array, "N s"]
) -> AgentOutput:
    """Let the followers act level by level, each sent what its parent has just done."""
    followers, parents = jnp.asarray(loop.followers), jnp.asarray(loop.parents)
    messages = jnp.zeros((len(now.states), led.message.shape[1]), led.message.dtype)
    messages = messages.at[loop.leaders].set(led.message)
    nothing = jnp.zeros((len(followers), led.input.shape[1]), led.input.dtype)

    def level(
        carry: tuple[jax.Array, AgentOutput], places: jax.Array
    ) -> tuple[tuple[jax.Array, AgentOutput], None]:
        messages, actions = carry
        agents = followers[places]
        memory = jax.tree.map(lambda leaf: leaf[places], now.follower_memory)
        forward = messages[parents[agents]]
        acted = _act_all(loop, now, z, loop.follower, agents, forward, memory)
        # Where a level repeats an agent, the same is written twice.
        actions = jax.tree.map(lambda a, b: a.at[places].set(b), actions, acted)
        return (messages.at[agents].set(acted.message), actions), None

    # Every follower is in one level, so that no zero of these is left.
    start = AgentOutput(nothing, nothing, now.follower_memory, messages[followers])
    return jax.lax.scan(level, (messages, start), jnp.asarray(loop.levels))[0][1]


# ---- what is sent and received -------------------------------------------------------------------


@cached_jit
def signals(
    loop: Loop, now: LoopState, offsets: Float[jax.Array, "N n"]
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


def _sent(loop: Loop, now: LoopState) -> tuple[Float[jax.Array, "N s"], Difference]:
    """Return what all agents send to their neighbours, and how far two such values are apart."""
    offsets = all_offsets(loop, time_of(loop, now))
    sent = signals(loop, now, offsets)
    if sent is not None:
        return sent, operator.sub
    return now.states - offsets, jax.vmap(loop.model.difference)


# ---- steps ---------------------------------------------------------------------------------------


def step(loop: Loop, now: LoopState) -> LoopState:
    """Return the moment one dt later."""
    now = _with_arrivals(loop, now)
    return _move(loop, now, control(loop, now))


def _with_arrivals(loop: Loop, now: LoopState) -> LoopState:
    """Return the moment with who returns where it began, who joins beside others' headings."""
    here, before = present_at(loop, now.step), present_at(loop, now.step - 1)
    returns = now.world.starts is not None
    if here is None or before is None or not (returns or has_angles(loop.follower)):
        return now
    new = here & ~before & (now.step > 0)

    def begun(now: LoopState) -> LoopState:
        moment = _where(loop, new, begin(loop, now.world.starts), now) if returns else now
        return beside_others(loop, moment, new, here & before, _sent(loop, now)[0])

    return jax.lax.cond(new.any(), begun, lambda now: now, now)


def _where(
    loop: Loop, chosen: Bool[jax.Array, " N"], one: LoopState, other: LoopState
) -> LoopState:
    def some(agents: Array | slice) -> Callable[[jax.Array, jax.Array], jax.Array]:
        def pick(a: jax.Array, b: jax.Array) -> jax.Array:
            mask = chosen[agents]
            return jnp.where(mask.reshape(-1, *[1] * (jnp.ndim(a) - 1)), a, b)

        return pick

    def of_all(part: Callable[[LoopState], PyTree]) -> PyTree:
        return jax.tree.map(some(slice(None)), part(one), part(other))

    return other._replace(
        states=of_all(lambda moment: moment.states),
        cut=of_all(lambda moment: moment.cut),
        leader_memory=jax.tree.map(some(loop.leaders), one.leader_memory, other.leader_memory),
        follower_memory=jax.tree.map(
            some(loop.followers), one.follower_memory, other.follower_memory
        ),
        world=other.world._replace(
            motion=of_all(lambda moment: moment.world.motion),
            estimates=of_all(lambda moment: moment.world.estimates),
        ),
    )


def _move(loop: Loop, now: LoopState, acted: Control) -> LoopState:
    world = acted.world
    own = MotionState() if world.motion is None else world.motion
    states, own = loop.motion.advance(now.states, acted.inputs, now.step, own)
    world = world if world.motion is None else world._replace(motion=own)
    memories = acted.leader_memory, acted.follower_memory
    after = LoopState(now.step + 1, states, *memories, acted.cut, world)
    here = present_at(loop, now.step)
    # Who is absent stays as it is.
    return (
        after
        if here is None
        else _where(loop, here, after, now._replace(step=after.step, world=world))
    )


def measured_step(
    loop: Loop, now: LoopState, reference: Array | None, first: jax.Array | int
) -> tuple[LoopState, Sums]:
    """Return the moment one dt later and its sums; `reference` (S, n) starts at step `first`."""
    now = _with_arrivals(loop, now)
    acted = control(loop, now)
    followed = reference_at(reference, now.step - first, now.states)
    chatter = (acted.cut * now.cut < 0).any(axis=1)
    moment, here = (now.step, now.states, acted.inputs), present_at(loop, now.step)
    meter = loop.meter if here is None else loop.meter.following(nearest_at(loop, now.step))
    read = meter.read(*moment, acted.limited, chatter, followed, goals_at(loop, now))
    active = loop.follower.active(acted.follower_memory)
    if active is not None:
        every = jnp.zeros(len(now.states), active.dtype).at[loop.followers].set(active)
        if loop.succession is not None:
            every = every.at[loop.leaders].set(loop.follower.active(acted.leader_memory))
        read = read._replace(**meter.of_slice(now.step, now.states, every, here))
    read = read if here is None else meter.of_present(read, here)
    if meter.paired:
        places = now.states[:, jnp.array(meter.paired)]
        read = read._replace(**closest_two(now.step, places, here))
    return _move(loop, now, acted), read


Frames: TypeAlias = tuple[Float[jax.Array, "T N n"], Float[jax.Array, "T N m"]]
"""States and inputs at T times."""


@cached_jit
def advance(
    loop: Loop, now: LoopState, counts: jax.Array, reference: Array | None, first: jax.Array | int
) -> tuple[LoopState, Frames, Sums]:
    """Store a frame and take counts[k] steps, for each k.

    Return the last moment, the stored states and inputs, and the sums over the steps. `reference`
    (S, n) is what the leaders follow from the step `first` on.
    """

    def one(_: jax.Array, carry: tuple[LoopState, Sums]) -> tuple[LoopState, Sums]:
        now, sums = measured_step(loop, carry[0], reference, first)
        return now, carry[1].plus(sums)

    def frame(
        carry: tuple[LoopState, Sums], count: jax.Array
    ) -> tuple[tuple[LoopState, Sums], tuple[States, Inputs]]:
        # The first step computes these inputs again, but after the last frame there is none.
        now = _with_arrivals(loop, carry[0])
        stored = (now.states, control(loop, now).inputs)
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
