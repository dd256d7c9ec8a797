"""The messages of all agents of a run: what each sends, what arrives, and what it keeps of it."""

import jax
import jax.numpy as jnp
from jaxtyping import Bool, Float, Int

from echelon.agents.network.channel import NEVER, Channel, InFlight
from echelon.agents.network.exchange import Difference, Exchange
from echelon.core.types import Array
from echelon.simulation.step.knowledge import (
    NOBODY,
    Ages,
    Knowledge,
    Letters,
    Mail,
    Packets,
    Readers,
    content_of,
    no_mail,
    packet_size,
    taken_over,
    understand,
    write,
)
from echelon.simulation.step.loop import (
    Loop,
    LoopState,
    Roster,
    WorldState,
    offsets_at,
    present_at,
    since_at,
)


def all_readers(agents: int, leaders: Array) -> Readers:
    """Return all agents of a run as readers."""
    numbers = jnp.arange(agents, dtype=jnp.int32)
    return Readers(numbers, jnp.zeros(agents, bool).at[leaders].set(True))


def first_readers(loop: Loop) -> Readers:
    """Return all agents of a run as readers, as they are at the start."""
    if loop.succession is None:
        return all_readers(len(loop.order), loop.leaders)
    return Readers(jnp.arange(len(loop.order), dtype=jnp.int32), jnp.asarray(loop.succession.first))


def begin_network(
    loop: Loop, world: WorldState, sent: Float[jax.Array, "N s"], forward: int
) -> WorldState:
    """Return the world with a network before the first message, for a feed-forward (forward,)."""
    channel, readers = loop.channel, first_readers(loop)
    assert channel is not None
    links, s = len(loop.exchange.receivers), sent.shape[1]
    backups = loop.succession is not None
    size = packet_size(channel, s, forward, len(loop.model.input_names), backups)
    mail = no_mail(readers, links, sent, size, backups)
    posts = channel.begin(Letters(sent, readers.number, mail.packet), links)
    return world._replace(in_flight=posts, mail=mail)


def read_messages(
    loop: Loop,
    exchange: Exchange,
    now: LoopState,
    sent: Float[jax.Array, "N s"],
    difference: Difference,
) -> tuple[Knowledge, Mail]:
    """Return what all agents know at a step, and their mail with what arrives at it."""
    channel = loop.channel
    assert channel is not None
    mail = take(channel, exchange, now.step, now.world.in_flight, now.world.mail)
    mail = mail._replace(packet=led_by_backups(loop, now.step, mail.packet, loop.motion.dt))
    ages = Ages(*(age_of(now.step, x, loop.motion.dt) for x in (mail.stamp, mail.packet.stamp)))
    t, readers = now.step.astype(sent.dtype) * loop.motion.dt, readers_of(loop, mail.packet)
    return understand(loop, exchange, readers, t, mail, ages, sent, difference), mail


def led_by_backups(loop: Roster, step: jax.Array, packet: Packets, dt: Array | float) -> Packets:
    """Return the packets after backup leaders that hear of no leader took the lead; dt in s."""
    if loop.succession is None:
        return packet
    number = jnp.arange(len(packet.leader), dtype=jnp.int32)
    waited = jnp.minimum(age_of(step, packet.stamp, dt), step * dt - since_at(loop, step))
    silent = loop.succession.silent(number, packet.leader, waited)
    here = present_at(loop, step)
    silent = silent if here is None else silent & here
    return taken_over(packet, silent, number, step)


def readers_of(loop: Loop, packet: Packets) -> Readers:
    """Return all agents as readers, of which those lead that say so."""
    if loop.succession is None:
        return all_readers(len(loop.order), loop.leaders)
    number = jnp.arange(len(packet.leader), dtype=jnp.int32)
    return Readers(number, packet.leader == number)


def heard_at_once(
    loop: Loop, now: LoopState, packet: Packets, said: Float[jax.Array, "L k"]
) -> Packets:
    """Return the packets of an ideal network, in which all hear leaders in the same step."""
    agents, number = len(loop.order), jnp.asarray(loop.leaders)
    here = present_at(loop, now.step)
    here = jnp.ones(agents, bool) if here is None else here
    leads = readers_of(loop, packet).leads & here
    stamp = jnp.full(len(number), now.step, jnp.int32)
    assert packet.term is not None
    own = Packets(packet.leader[number], stamp, said, packet.term[number])
    each = jax.tree.map(lambda part: jnp.repeat(part, agents, axis=0), own)
    receivers = jnp.tile(jnp.arange(agents), len(number))
    new = jnp.repeat(leads[number], agents) & here[receivers]
    return newest(packet, each, new, receivers)


def age_of(
    step: jax.Array, stamp: Int[jax.Array, " K"], dt: Array | float
) -> Float[jax.Array, " K"]:
    """Return the age (s) of what was sent at steps (K,)."""
    return jnp.where(stamp == NEVER, jnp.inf, (step - stamp) * jnp.asarray(dt))


def take(
    channel: Channel, exchange: Exchange, step: jax.Array, posts: InFlight, mail: Mail
) -> Mail:
    """Return the mail with what arrives at a step."""
    arrival = channel.arrivals(posts, step, mail.stamp)
    places = arrival.slot, jnp.asarray(exchange.senders)
    letter: Letters = jax.tree.map(lambda rows: rows[places], posts.content)
    new = arrival.new
    value = jnp.where(new[:, None], letter.value, mail.value)
    hops = jnp.where(new, letter.hops, mail.hops)
    packet = newest(mail.packet, letter.packet, new, jnp.asarray(exchange.receivers))
    return Mail(arrival.stamp, value, hops, packet)


def newest(own: Packets, others: Packets, new: jax.Array, receivers: jax.Array) -> Packets:
    """Return the packet of each agent: of the leader with the lowest number, the newest one.

    Of several terms the highest counts.

    Args:
        own: of the agents.
        others: (K, ...) that messages contain.
        new: (K,) which of these arrived.
        receivers: (K,) of the messages.
    """
    count = len(own.stamp)
    valid, term, current = new & (others.stamp != NEVER), own.term, own.leader
    if others.term is not None and term is not None:
        terms = jnp.where(valid, others.term, 0)
        term = jnp.maximum(term, jax.ops.segment_max(terms, receivers, count))
        valid &= others.term == term[receivers]
        # Whoever led in an earlier term does so no more.
        current = jnp.where(own.term == term, current, NOBODY)
    leaders = jnp.where(valid, others.leader, NOBODY)
    leader = jnp.minimum(current, jax.ops.segment_min(leaders, receivers, count))
    of_it = valid & (leaders == leader[receivers])
    last = jnp.where(current == leader, own.stamp, NEVER)
    stamp = jax.ops.segment_max(jnp.where(of_it, others.stamp, NEVER), receivers, count)
    stamp = jnp.maximum(last, stamp)
    latest = of_it & (others.stamp == stamp[receivers])
    places = jnp.where(latest, jnp.arange(len(receivers)), NEVER)
    place = jax.ops.segment_max(places, receivers, count)
    better = (place >= 0) & (stamp > last)
    content = jnp.where(better[:, None], others.content[place], own.content)
    return Packets(leader, stamp, content, term)


def send_messages(
    loop: Loop,
    exchange: Exchange,
    now: LoopState,
    mail: Mail,
    knowledge: Knowledge,
    sent: Float[jax.Array, "N s"],
    difference: Difference,
    forward: Float[jax.Array, "L k"],
    inputs: Float[jax.Array, "L m"],
) -> WorldState:
    """Return the world after a step in which agents may send.

    Args:
        loop: with a channel.
        exchange: with the weights of this step.
        now: the moment at the beginning of the step.
        mail: of the agents.
        knowledge: of the agents.
        sent: their signals.
        difference: of two signals.
        forward: of the leaders, from the inputs that they have just chosen.
        inputs: of the leaders, as delivered.
    """
    channel, numbers = loop.channel, loop.leaders
    assert channel is not None
    t = now.step.astype(sent.dtype) * loop.motion.dt
    own = now.states[numbers], offsets_at(loop, loop.leader, t, numbers)[0], now.leader_memory
    rows = *own, sent[numbers], forward, inputs
    content = jax.vmap(lambda *row: content_of(loop, t, *row))(*rows)
    content = jnp.zeros_like(mail.packet.content).at[numbers].set(content)
    letters, sends = write(
        channel, readers_of(loop, mail.packet), now.step, mail, knowledge, sent, difference, content
    )
    carried = links_with(exchange, sends)
    links = exchange.receivers, exchange.senders
    posts = channel.post(now.world.in_flight, now.step, letters, carried, *links)
    return now.world._replace(in_flight=posts, mail=mail)


def links_with(exchange: Exchange, sends: Bool[jax.Array, " N"]) -> Bool[jax.Array, " K"]:
    """Return the links along which messages leave; those that the graph lacks carry nothing."""
    return sends[jnp.asarray(exchange.senders)] & (jnp.asarray(exchange.weights) > 0.0)
