"""What agents make of late and lost messages: where each expects its leader and its neighbours.

An agent predicts the leader from the newest packet of it that reached anybody on the way, and takes
each neighbour for the prediction plus the deviation that the neighbour last sent. So what is late
is a deviation, which hardly changes, and never a place, which does.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Float, Int

from echelon.agents.network.channel import NEVER, Channel
from echelon.agents.network.exchange import Difference, Exchange
from echelon.core.types import Scalar
from echelon.core.words import MessageContent, NeighbourChoice, Prediction
from echelon.laws.law import Expected, LocalView
from echelon.simulation.step.action import act
from echelon.simulation.step.loop import Loop, Moment, WorldState

_NOBODY = 2**30
"""The leader of an agent that has no packet, and more hops than any agent has."""
_HOP_LIFE = 10
"""Hop counts are used for this many times `forget`, so that losses do not change them."""


class Packet(NamedTuple):
    """What a leader last said of itself, passed on unchanged by everybody; the newest counts.

    Attributes:
        leader: its number.
        stamp: the step at which it said so; `NEVER` for no packet.
        content: a row of numbers, which depends on the prediction.
    """

    leader: Int[jax.Array, " N"]
    stamp: Int[jax.Array, " N"]
    content: Float[jax.Array, "N p"]


class Message(NamedTuple):
    """What each agent sends: its deviation or its signal, its hops to a leader, and its packet."""

    value: Float[jax.Array, "N s"]
    hops: Int[jax.Array, " N"]
    packet: Packet


class Inbox(NamedTuple):
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
    packet: Packet


class Knowledge(NamedTuple):
    """What agents know from messages at a step.

    Attributes:
        disagreement: z (N, s).
        feedforward: (N, k) that each expects of its leader.
        leader: (N, s) the signal at which each expects its leader.
        hops: (N,) to a leader.
        inbox: afterwards.
    """

    disagreement: Float[jax.Array, "N s"]
    feedforward: Float[jax.Array, "N k"]
    leader: Float[jax.Array, "N s"]
    hops: Int[jax.Array, " N"]
    inbox: Inbox


def empty_inbox(loop: Loop, sent: Float[jax.Array, "N s"], forward: int) -> Inbox:
    """Return the inbox before the first message, for a feed-forward of so many numbers."""
    agents, links, s = len(sent), len(loop.exchange.receivers), sent.shape[1]
    assert loop.channel is not None
    size = _packet_size(loop.channel, s, forward)
    own = (
        jnp.full(agents, _NOBODY, jnp.int32)
        .at[loop.leaders]
        .set(jnp.asarray(loop.leaders, jnp.int32))
    )
    never = jnp.full(agents, NEVER, jnp.int32)
    return Inbox(
        jnp.full(links, NEVER, jnp.int32),
        jnp.zeros((links, s), sent.dtype),
        jnp.full(links, _NOBODY, jnp.int32),
        Packet(own, never, jnp.zeros((agents, size), sent.dtype)),
    )


def _packet_size(channel: Channel, s: int, forward: int) -> int:
    if channel.messages is MessageContent.STATE:
        return forward
    return s if channel.prediction is Prediction.PREVIEW else s + forward


def read_messages(
    loop: Loop,
    exchange: Exchange,
    now: Moment,
    sent: Float[jax.Array, "N s"],
    difference: Difference,
) -> Knowledge:
    """Return what agents know at a step, of which `sent` are the signals.

    Args:
        loop: with a channel.
        exchange: with the weights of this step.
        now: the moment.
        sent: signals of the agents, from their own states.
        difference: of two signals.
    """
    channel = loop.channel
    assert channel is not None
    inbox = _take(channel, exchange, now)
    leader, feedforward = _leaders(loop, now, inbox.packet, sent)
    hops = _hops(loop, exchange, inbox, now.step)
    knows = inbox.packet.stamp != NEVER
    knows = knows.at[loop.leaders].set(True)
    receivers = jnp.asarray(exchange.receivers)
    received, used = inbox.value, inbox.stamp != NEVER
    if channel.messages is MessageContent.DEVIATION:
        fresh = used & (now.step - inbox.stamp <= channel.forget)
        received = leader[receivers] + jnp.where(fresh[:, None], inbox.value, 0.0)
        # A leader is where it is expected, and its own message says no more.
        used, fresh = knows[receivers], fresh | (used & (inbox.hops == 0))
    else:
        fresh = used
    received = jnp.where(used[:, None], received, sent[receivers])
    if channel.hears is NeighbourChoice.ALL:
        z = exchange(sent, received, difference)
    else:
        nearer = fresh & used & (inbox.hops < hops[receivers])
        alone = jnp.where(knows[:, None], difference(sent, leader), 0.0)
        z = exchange.mean(sent, received, nearer, alone, difference)
    return Knowledge(z, feedforward, leader, hops, inbox)


def _take(channel: Channel, exchange: Exchange, now: Moment) -> Inbox:
    """Return the inbox with what arrives at a step."""
    posts, inbox = now.world.in_flight, now.world.inbox
    arrival = channel.arrivals(posts, now.step, inbox.stamp)
    places = arrival.slot, jnp.asarray(exchange.senders)
    message: Message = jax.tree.map(lambda rows: rows[places], posts.content)
    new = arrival.new
    value = jnp.where(new[:, None], message.value, inbox.value)
    hops = jnp.where(new, message.hops, inbox.hops)
    packet = _newest(inbox.packet, message.packet, new, jnp.asarray(exchange.receivers))
    return Inbox(arrival.stamp, value, hops, packet)


def _newest(own: Packet, others: Packet, new: jax.Array, receivers: jax.Array) -> Packet:
    """Return the packet of each agent: of the leader with the lowest number, the newest one.

    Args:
        own: of the agents.
        others: (K, ...) that messages contain.
        new: (K,) which of these arrived.
        receivers: (K,) of the messages.
    """
    count = len(own.stamp)
    leaders_sent = jnp.where(new & (others.stamp != NEVER), others.leader, _NOBODY)
    leader = jnp.minimum(own.leader, jax.ops.segment_min(leaders_sent, receivers, count))
    of_it = leaders_sent == leader[receivers]
    last = jnp.where(own.leader == leader, own.stamp, NEVER)
    stamp = jax.ops.segment_max(jnp.where(of_it, others.stamp, NEVER), receivers, count)
    stamp = jnp.maximum(last, stamp)
    newest = of_it & (others.stamp == stamp[receivers])
    place = jax.ops.segment_max(
        jnp.where(newest, jnp.arange(len(receivers)), NEVER), receivers, count
    )
    better = (place >= 0) & (stamp > last)
    content = jnp.where(better[:, None], others.content[place], own.content)
    return Packet(leader, stamp, content)


def _leaders(
    loop: Loop, now: Moment, packet: Packet, sent: Float[jax.Array, "N s"]
) -> tuple[Float[jax.Array, "N s"], Float[jax.Array, "N k"]]:
    """Return where each agent expects its leader, and the feed-forward that it expects of it."""
    channel, dtype = loop.channel, sent.dtype
    assert channel is not None
    t = now.step.astype(dtype) * loop.motion.dt
    if channel.messages is MessageContent.STATE:
        signal, feedforward = sent, packet.content
    elif channel.prediction is Prediction.NONE:
        signal, feedforward = jnp.split(packet.content, [sent.shape[1]], axis=1)
    else:
        age = (now.step - packet.stamp).astype(dtype) * loop.motion.dt
        signal, feedforward = jax.vmap(lambda c, T: _expected(loop, t, c, T))(packet.content, age)
    knows = (packet.stamp != NEVER)[:, None]
    own = (packet.leader == jnp.arange(len(sent)))[:, None]
    return jnp.where(own | ~knows, sent, signal), jnp.where(knows, feedforward, 0.0)


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


def _hops(loop: Loop, exchange: Exchange, inbox: Inbox, step: jax.Array) -> Int[jax.Array, " N"]:
    """Return the hops to a leader, as counted by the messages that arrive."""
    channel, count = loop.channel, len(loop.order)
    assert channel is not None
    lasting = (inbox.stamp != NEVER) & (step - inbox.stamp <= _HOP_LIFE * channel.forget)
    of_link = jnp.where(lasting, inbox.hops, _NOBODY)
    hops = 1 + jax.ops.segment_min(of_link, jnp.asarray(exchange.receivers), count)
    # Agents that are cut off together would count each other up for ever.
    hops = jnp.where(hops >= count, _NOBODY, hops)
    return hops.at[loop.leaders].set(0)


def send_messages(
    loop: Loop,
    now: Moment,
    knowledge: Knowledge,
    sent: Float[jax.Array, "N s"],
    difference: Difference,
    leaders: Float[jax.Array, "L k"],
) -> WorldState:
    """Return the state of the network after a step, in which agents may send.

    Args:
        loop: with a channel.
        now: the moment at the beginning of the step.
        knowledge: at the step.
        sent: signals of the agents.
        difference: of two signals.
        leaders: their feed-forward, of the inputs that they have just chosen.
    """
    assert loop.channel is not None
    message, sends = _write(loop, now, knowledge, sent, difference, leaders)
    links = loop.exchange.receivers, loop.exchange.senders
    posts = loop.channel.post(now.world.in_flight, now.step, message, sends, *links)
    return now.world._replace(in_flight=posts, inbox=knowledge.inbox)


def _write(
    loop: Loop,
    now: Moment,
    knowledge: Knowledge,
    sent: Float[jax.Array, "N s"],
    difference: Difference,
    leaders: Float[jax.Array, "L k"],
) -> tuple[Message, jax.Array]:
    """Return what agents send at a step, and which of them (N,) can."""
    channel, packet = loop.channel, knowledge.inbox.packet
    assert channel is not None
    numbers = jnp.asarray(loop.leaders)
    own = packet.leader[numbers] == numbers
    content = _content(loop, now, sent, leaders)
    packet = packet._replace(
        stamp=packet.stamp.at[numbers].set(jnp.where(own, now.step, packet.stamp[numbers])),
        content=packet.content.at[numbers].set(
            jnp.where(own[:, None], content, packet.content[numbers])
        ),
    )
    if channel.messages is MessageContent.STATE:
        return Message(sent, knowledge.hops, packet), jnp.ones(len(sent), bool)
    itself = (packet.leader == jnp.arange(len(sent)))[:, None]
    deviation = jnp.where(itself, 0.0, difference(sent, knowledge.leader))
    return Message(deviation, knowledge.hops, packet), packet.stamp != NEVER


def _content(
    loop: Loop, now: Moment, sent: Float[jax.Array, "N s"], leaders: Float[jax.Array, "L k"]
) -> Float[jax.Array, "L p"]:
    """Return what leaders say of themselves."""
    channel, numbers = loop.channel, loop.leaders
    assert channel is not None
    if channel.messages is MessageContent.STATE:
        return leaders
    if channel.prediction is Prediction.NONE:
        return jnp.concatenate([sent[numbers], leaders], axis=1)
    t = now.step.astype(sent.dtype) * loop.motion.dt
    offsets = jnp.asarray(loop.offsets, sent.dtype)[numbers]

    def one(x: jax.Array, offset: jax.Array, memory: object) -> jax.Array:
        deviation = loop.leader.deviation(loop.model, t, x, offset, memory)
        assert deviation is not None, "a channel with a preview has a leader with a plan"
        return deviation

    return jax.vmap(one)(now.states[numbers], offsets, now.leader_memory)
