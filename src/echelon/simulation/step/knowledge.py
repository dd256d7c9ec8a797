"""What agents make of late and lost messages: where each expects its leader and its neighbours.

An agent predicts the leader from the newest packet of it that reached anybody on the way, and takes
each neighbour for the prediction plus the deviation that the neighbour last sent. So what is late
is a deviation, which hardly changes, and never a place, which does.
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from echelon.agents.network.channel import NEVER, Channel
from echelon.agents.network.exchange import Difference, Exchange
from echelon.core.types import Array, Input, Scalar, State
from echelon.core.words import MessageContent, NeighbourChoice, Prediction
from echelon.laws.law import Expected, LocalView, Memory
from echelon.simulation.step.action import act
from echelon.simulation.step.loop import Loop

NOBODY = 2**30
"""The leader of an agent that has no packet, and more hops than any agent has."""
HOP_LIFE = 10
"""Hop counts are used for this many times `forget`, so that losses do not change them."""

_CARRIED_FULLY, _SLOWING = 0.4, 2.0
"""s, for which a leader without a plan is taken to move on as it did, and the rate, 1/s, at which
its motion slows down afterwards."""


class Packets(NamedTuple):
    """What a leader last said of itself, passed on unchanged by everybody; the newest counts.

    Attributes:
        leader: its number.
        stamp: the step at which it said so; `NEVER` for no packet.
        content: a row of numbers, which depends on the prediction.
        term: how often the lead was taken over; None without backup leaders.
    """

    leader: Int[jax.Array, " N"]
    stamp: Int[jax.Array, " N"]
    content: Float[jax.Array, "N p"]
    term: Int[jax.Array, " N"] | None = None


class Letters(NamedTuple):
    """What each agent sends: its deviation or its signal, its hops to a leader, and its packet."""

    value: Float[jax.Array, "N s"]
    hops: Int[jax.Array, " N"]
    packet: Packets


class Mail(NamedTuple):
    """What agents keep of the messages that they received.

    Attributes:
        stamp: (K,) when the newest message of each link was sent; `NEVER` for none.
        value: (K, s) its deviation or signal.
        hops: (K,) of its sender.
        packet: of each agent.
    """

    stamp: Int[jax.Array, " K"]
    value: Float[jax.Array, "K s"]
    hops: Int[jax.Array, " K"]
    packet: Packets


class Ages(NamedTuple):
    """How old mail is, s: of each link (K,) and each packet (N,); infinite for none."""

    link: Float[jax.Array, " K"]
    packet: Float[jax.Array, " N"]


class Readers(NamedTuple):
    """Agents that read their mail: their numbers (N,), and which of them lead (N,)."""

    number: Int[jax.Array, " N"]
    leads: Bool[jax.Array, " N"]


class Knowledge(NamedTuple):
    """What agents know from messages at a step.

    Attributes:
        disagreement: z (N, s).
        feedforward: (N, k) that each expects of its leader.
        leader: (N, s) the signal at which each expects its leader.
        hops: (N,) to a leader.
    """

    disagreement: Float[jax.Array, "N s"]
    feedforward: Float[jax.Array, "N k"]
    leader: Float[jax.Array, "N s"]
    hops: Int[jax.Array, " N"]


# ---- one agent, or many --------------------------------------------------------------------------


def no_mail(
    readers: Readers, links: int, sent: Float[jax.Array, "N s"], packet: int, backups: bool = False
) -> Mail:
    """Return the mail before the first message, for signals as sent and packets (packet,)."""
    return Mail(
        jnp.full(links, NEVER, jnp.int32),
        jnp.zeros((links, sent.shape[1]), sent.dtype),
        jnp.full(links, NOBODY, jnp.int32),
        no_packets(readers, jnp.zeros((len(readers.number), packet), sent.dtype), backups),
    )


def no_packets(readers: Readers, content: Float[jax.Array, "N p"], backups: bool) -> Packets:
    """Return the packets before the first one, with terms where there are backup leaders."""
    leader = jnp.where(readers.leads, readers.number, NOBODY).astype(jnp.int32)
    never = jnp.full(len(leader), NEVER, jnp.int32)
    return Packets(leader, never, content, jnp.zeros_like(never) if backups else None)


def taken_over(
    packet: Packets, chosen: Bool[jax.Array, " N"], number: jax.Array, step: jax.Array
) -> Packets:
    """Return the packets of agents of which the chosen ones have just taken the lead."""
    assert packet.term is not None
    leader = jnp.where(chosen, number, packet.leader)
    stamp = jnp.where(chosen, step, packet.stamp)
    return packet._replace(leader=leader, stamp=stamp, term=packet.term + chosen)


def packet_size(channel: Channel, s: int, forward: int, m: int, backups: bool = False) -> int:
    """Return how many numbers a packet has, for signals (s,), a feed-forward and inputs (m,).

    Where the leader has `backups` it also says how its feed-forward changes, since it is carried on
    for longer.
    """
    if channel.messages is MessageContent.STATE:
        return forward
    carried = channel.prediction is Prediction.PACKET
    return s + carried * (forward + m + backups * forward)


def understand(
    loop: Loop,
    exchange: Exchange,
    readers: Readers,
    t: Scalar,
    mail: Mail,
    ages: Ages,
    sent: Float[jax.Array, "N s"],
    difference: Difference,
) -> Knowledge:
    """Return what agents know from their mail.

    Args:
        loop: with a channel.
        exchange: the links of the agents, with the weights of this step.
        readers: the agents.
        t: time, s.
        mail: of the agents.
        ages: of what it contains.
        sent: their signals, from their own states.
        difference: of two signals.
    """
    channel = loop.channel
    assert channel is not None
    leader, feedforward = _leaders(loop, readers, t, mail.packet, ages.packet, sent)
    lasting = ages.link <= hop_life(channel, loop.motion.dt)
    hops = count_hops(exchange, readers, mail.hops, lasting, len(loop.order))
    knows = readers.leads | (ages.packet < jnp.inf)
    receivers = jnp.asarray(exchange.receivers)
    received, used = mail.value, ages.link < jnp.inf
    fresh = ages.link <= usable_age(channel, loop.motion.dt)
    if channel.messages is MessageContent.DEVIATION:
        received = leader[receivers] + jnp.where(fresh[:, None], mail.value, 0.0)
        # A leader is where it is expected, and its own message says no more.
        used, fresh = knows[receivers], fresh | (used & (mail.hops == 0))
    received = jnp.where(used[:, None], received, sent[receivers])
    if channel.hears is NeighbourChoice.ALL:
        z = exchange(sent, received, difference)
    else:
        nearer = fresh & used & (mail.hops < hops[receivers])
        alone = jnp.where(knows[:, None], difference(sent, leader), 0.0)
        z = exchange.mean(sent, received, nearer, alone, difference)
    return Knowledge(z, feedforward, leader, hops)


def usable_age(channel: Channel, dt: Array | float) -> jax.Array:
    """Return the age (s) beyond which what a neighbour sent is not used."""
    deviations = channel.messages is MessageContent.DEVIATION
    # Of a state there is no better guess than the last one, but never that of no message.
    return jnp.asarray(channel.forget * dt if deviations else np.finfo(np.float32).max)


def hop_life(channel: Channel, dt: Array | float) -> jax.Array:
    """Return the age (s) beyond which a hop count is not used."""
    # Times a float: ten times the largest whole number would be negative.
    return jnp.asarray(float(HOP_LIFE) * channel.forget * dt)


def write(
    channel: Channel,
    readers: Readers,
    step: jax.Array,
    mail: Mail,
    knowledge: Knowledge,
    sent: Float[jax.Array, "N s"],
    difference: Difference,
    content: Float[jax.Array, "N p"],
) -> tuple[Letters, Bool[jax.Array, " N"]]:
    """Return what agents send at a step, and which of them can.

    `content` is what each would say of itself if it were a leader.
    """
    packet = mail.packet
    itself = readers.leads & (packet.leader == readers.number)
    packet = packet._replace(
        stamp=jnp.where(itself, step, packet.stamp),
        content=jnp.where(itself[:, None], content, packet.content),
    )
    if channel.messages is MessageContent.STATE:
        return Letters(sent, knowledge.hops, packet), jnp.ones(len(sent), bool)
    deviation = jnp.where(itself[:, None], 0.0, difference(sent, knowledge.leader))
    return Letters(deviation, knowledge.hops, packet), packet.stamp != NEVER


def content_of(
    loop: Loop,
    t: Scalar,
    x: State,
    offset: State,
    memory: Memory,
    signal: Float[jax.Array, " s"],
    forward: Float[jax.Array, " k"],
    u: Input,
) -> Float[jax.Array, " p"]:
    """Return what a leader says of itself, before its memory changes in this step."""
    channel = loop.channel
    assert channel is not None
    if channel.messages is MessageContent.STATE:
        return forward
    if channel.prediction is Prediction.PACKET:
        parts = jnp.concatenate([signal, forward, u])
        if loop.succession is None:
            return parts
        return jnp.concatenate([parts, _slope(loop, t, x, offset, memory, forward)])
    deviation = loop.leader.deviation(loop.model, t, x, offset, memory)
    assert deviation is not None, "a channel with a preview has a leader with a plan"
    return deviation


def _slope(
    loop: Loop,
    t: Scalar,
    x: State,
    offset: State,
    memory: Memory,
    forward: Float[jax.Array, " k"],
) -> Float[jax.Array, " k"]:
    """Return the rate at which the feed-forward of a leader with a plan changes, from a step on."""
    deviation, dt = loop.leader.deviation(loop.model, t, x, offset, memory), loop.motion.dt
    assert deviation is not None, "a leader with backup leaders has a plan"
    expected = loop.leader.expected(loop.model, t + dt, deviation, jnp.asarray(dt, t.dtype), dt)
    if expected is None or expected.feedforward is None:
        return jnp.zeros_like(forward)
    return (expected.feedforward - forward) / dt


def _leaders(
    loop: Loop,
    readers: Readers,
    t: Scalar,
    packet: Packets,
    ages: Float[jax.Array, " N"],
    sent: Float[jax.Array, "N s"],
) -> tuple[Float[jax.Array, "N s"], Float[jax.Array, "N k"]]:
    """Return where each agent expects its leader, and the feed-forward that it expects of it."""
    channel, knows = loop.channel, (ages < jnp.inf)[:, None]
    assert channel is not None
    if channel.messages is MessageContent.STATE:
        signal, feedforward = sent, packet.content
    else:
        rows = packet.content, jnp.where(ages < jnp.inf, ages, 0.0)
        one = functools.partial(expected_of, loop, sent.shape[1], t)
        signal, feedforward = jax.vmap(one)(*rows)
    own = (packet.leader == readers.number)[:, None]
    return jnp.where(own | ~knows, sent, signal), jnp.where(knows, feedforward, 0.0)


def expected_of(
    loop: Loop, s: int, t: Scalar, content: Float[jax.Array, " p"], age: Scalar
) -> tuple[Float[jax.Array, " s"], Float[jax.Array, " k"]]:
    """Return the signal (s,) and the feed-forward of a leader, by its packet of an age (s)."""
    assert loop.channel is not None
    if loop.channel.prediction is Prediction.PREVIEW:
        return _expected(loop, t, content, age)
    time, slope = carried_time(age), None
    if loop.succession is not None:
        k = (len(content) - s - len(loop.model.input_names)) // 2
        content, slope = content[:-k], content[-k:]
    signal, feedforward, u = parts_of(loop, s, content)
    if slope is None:
        return loop.follower.carried(loop.model, signal, feedforward, u, time), feedforward
    mean = feedforward + 0.5 * time * slope
    return loop.follower.carried(loop.model, signal, mean, u, time), feedforward + time * slope


def parts_of(
    loop: Loop, s: int, content: Float[jax.Array, " p"]
) -> tuple[Float[jax.Array, " s"], Float[jax.Array, " k"], Input]:
    """Return the signal (s,), the feed-forward and the input in a packet that is carried on."""
    m = len(loop.model.input_names)
    return content[:s], content[s:-m], content[-m:]


def carried_time(age: Scalar) -> Scalar:
    """Return how long (s) a leader is taken to have moved on since a packet of an age (s)."""
    # Nobody knows where a leader is that was not heard for long: its motion slows down.
    late = jnp.maximum(age - _CARRIED_FULLY, 0.0)
    return age - late + (1.0 - jnp.exp(-_SLOWING * late)) / _SLOWING


def _expected(
    loop: Loop, t: Scalar, deviation: Float[jax.Array, " s"], age: Scalar
) -> tuple[Float[jax.Array, " s"], Float[jax.Array, " k"]]:
    """Return the signal and the feed-forward of a leader, from its deviation of an age (s) ago."""
    expected = loop.leader.expected(loop.model, t, deviation, age, loop.motion.dt)
    assert isinstance(expected, Expected), "a channel with a preview has a leader with a plan"
    x = expected.signal
    if expected.feedforward is not None:
        return x, expected.feedforward
    # What the leader's law would do there, alone.
    silence = jnp.zeros(len(loop.model.input_names), x.dtype)
    view = LocalView(t, x, jnp.zeros_like(x), jnp.zeros_like(x), silence, loop.motion.dt)
    memory = loop.leader.begin(loop.model, x)
    return x, act(loop, loop.leader, view, memory, leads=True).message


def count_hops(
    exchange: Exchange,
    readers: Readers,
    of_senders: Int[jax.Array, " K"],
    lasting: Bool[jax.Array, " K"],
    agents: int,
) -> Int[jax.Array, " N"]:
    """Return the hops to a leader, as counted by the messages that are not too old."""
    of_link = jnp.where(lasting, of_senders, NOBODY)
    nearest = jax.ops.segment_min(of_link, jnp.asarray(exchange.receivers), len(readers.number))
    nearest = jnp.minimum(nearest, NOBODY)
    # Agents that are cut off together would count each other up for ever.
    hops = jnp.where(nearest + 1 >= agents, NOBODY, nearest + 1)
    return jnp.where(readers.leads, 0, hops).astype(jnp.int32)
