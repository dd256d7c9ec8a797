"""What a network decides in a step: it depends on no state, so that messages may say nothing."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Bool, Float, Int

from echelon.core.types import Array
from echelon.simulation.step.leadership import NOBODY, FixedLeaders, announced
from echelon.simulation.step.networks import LateNetwork, carries
from echelon.simulation.step.records import (
    Clock,
    Known,
    LeaderPackets,
    Messages,
    NetworkEstimate,
    Steps,
)
from echelon.simulation.step.roster import Everybody, Links

NOTHING = -1.0
"""The place of a packet that an agent has already."""


class Announcement(NamedTuple):
    """Who announces to all others what it does in a step of the ideal network with backup leaders.

    Attributes:
        packets: of the agents after it.
        leads: (N,) who leads.
        place: (N,) whom each receives, by its place among those that may lead; `NOTHING` of none.
    """

    packets: LeaderPackets
    leads: Bool[jax.Array, " N"]
    place: Float[jax.Array, " N"]


def announce(
    leadership: FixedLeaders,
    roster: Everybody,
    leaders: Array,
    packets: LeaderPackets,
    clock: Clock,
) -> Announcement:
    """Return what the ideal network decides in a step: who leads, and whom agents receive.

    `leaders` are the numbers of those that may lead, and packets say nothing.
    """
    number, here = jnp.arange(len(packets.stamp), dtype=jnp.int32), roster.here(clock.step)
    packets = packets._replace(content=jnp.full((len(number), 1), NOTHING))
    packets = leadership.elect(packets, number, clock, roster.since(clock.step), here)
    leads = leadership.leads(packets, number)
    # The content of a packet is the place of its sender.
    places = jnp.arange(len(leaders), dtype=float)[:, None]
    packets = announced(leadership, packets, leaders, leads, here, clock, places)
    return Announcement(packets, leads, packets.content[:, 0])


class Radio(NamedTuple):
    """The network of a run, its links, who is there, and the step dt, s."""

    network: LateNetwork
    links: Links
    roster: Everybody
    dt: Array | float


class Empty(NamedTuple):
    """Messages that say nothing: in flight, and the mail of the agents."""

    in_flight: Any
    mail: Messages


class Delivery(NamedTuple):
    """What a network decides in a step; K links, N agents.

    Attributes:
        new, slot: (K,) whether a message arrives, and its row of the messages in flight.
        place: (N,) by which link a newer packet of a leader comes; `NOTHING` for by none.
        leads, itself: (N,) who leads, and whose packet is of itself.
        used: (K,) whose messages agents use.
        sends: (K,) along which messages leave.
        ages: (K,) of the messages, s.
        weights, alone: (K,) of the links in what agents receive, and (N,) which use none of them.
    """

    new: Bool[jax.Array, " K"]
    slot: Int[jax.Array, " K"]
    place: Float[jax.Array, " N"]
    leads: Bool[jax.Array, " N"]
    itself: Bool[jax.Array, " N"]
    used: Bool[jax.Array, " K"]
    sends: Bool[jax.Array, " K"]
    ages: Float[jax.Array, " K"]
    weights: Float[jax.Array, " K"]
    alone: Bool[jax.Array, " N"]


def empty(network: LateNetwork, links: int) -> Empty:
    """Return the messages before the first one, of a network with so many links."""
    rules = network.rules
    numbers, nothing = jnp.arange(rules.agents, dtype=jnp.int32), jnp.zeros((rules.agents, 0))
    mail = rules.begin(numbers, links, nothing, 1)
    sent = Messages(nothing, jnp.full(rules.agents, NOBODY, jnp.int32), mail.packet)
    return Empty(network.medium.begin(sent, links), mail)


def deliver(radio: Radio, now: Empty, step: jax.Array) -> tuple[Empty, Delivery]:
    """Return the messages after a step, and what the network decides in it."""
    network, rules, clock = radio.network, radio.network.rules, Steps(step, radio.dt)
    links, number = radio.links.at(step), jnp.arange(rules.agents, dtype=jnp.int32)
    since, here = radio.roster.since(step), radio.roster.here(step)
    sent, new, stamp = network.arriving(now.in_flight, step, now.mail, links)
    slot = network.medium.arrivals(now.in_flight, step, now.mail.stamp).slot
    # The content of a packet is the link by which it comes.
    by_link = jnp.arange(len(new), dtype=float)[:, None]
    sent = sent._replace(packet=sent.packet._replace(content=by_link))
    nothing = jnp.full((rules.agents, 1), NOTHING)
    mail = now.mail._replace(packet=now.mail.packet._replace(content=nothing))
    mail = network.taken(mail, (sent, new, stamp), number, clock, since, links, here)
    packet, ages = mail.packet, clock.age(mail.stamp)
    leads = network.leadership.leads(packet, number)
    hops = rules.hops(mail, ages, leads, links, clock.dt)
    used = rules.used(mail, ages, hops, links, clock.dt)
    silence = nothing[:, :0]
    heard = NetworkEstimate(silence, leads, silence, silence, hops)
    silent = silence, nothing, jnp.subtract
    messages, sends = rules.write(mail, heard, number, step, *silent)
    after = network.posted(now.in_flight, step, messages, sends, links)
    itself, carried = packet.leader == number, carries(links, sends)
    knows = leads | (clock.age(packet.stamp) < jnp.inf)
    nobody: Any = None
    known = Known(clock, here, nobody, nobody, silence, links)
    fresh = rules.chosen(mail, ages, hops, silence, knows, known)[1]
    shares = rules.neighbours.shares(fresh, links, rules.agents)
    decided = new, slot, packet.content[:, 0], leads, itself, used, carried, ages, *shares
    return Empty(after, mail), Delivery(*decided)
