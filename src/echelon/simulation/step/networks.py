"""What arrives: in the ideal network what is said is heard; on a late one messages take time.

A late network has two parts: the rules by which each agent reads and writes messages, which an
agent alone has too, and the medium, which is the world's.

An agent predicts the leader from the newest packet of it that reached anybody on the way, and takes
each neighbour for the prediction plus the deviation that the neighbour last sent. So what is late
is a deviation, which hardly changes, and never a place, which does.
"""

import functools
from typing import NamedTuple, final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from echelon.agents.network.channel import NEVER, Channel
from echelon.agents.network.exchange import Difference, Exchange
from echelon.core.types import Array, PyTree, Scalar, State
from echelon.core.words import MessageContent, NeighbourChoice, Prediction
from echelon.laws.law import Expected, LocalView, Memory, Travels
from echelon.simulation.step.leadership import NOBODY, FixedLeaders
from echelon.simulation.step.loop import IdealNetwork, Loop
from echelon.simulation.step.records import (
    AgentOutput,
    Clock,
    Known,
    LeaderPackets,
    LeaderSpeech,
    Mask,
    Messages,
    NetworkEstimate,
)

HOP_LIFE = 10
"""Hop counts are used for this many times `forget`, so that losses do not change them."""

_CARRIED_FULLY, _SLOWING = 0.4, 2.0
"""s, for which a leader without a plan is taken to move on as it did, and the rate, 1/s, at which
its motion slows down afterwards."""


# ---- the ideal network with backups --------------------------------------------------------------


@final
class IdealWithBackups(IdealNetwork):
    """Packets of leaders reach all agents at once; it remembers each agent's."""

    announces = True

    def begin(self, loop: Loop, said: Float[jax.Array, "N s"], forward: int) -> PyTree:
        """Return the packets before the first one."""
        content = jnp.zeros((len(said), forward), said.dtype)
        return self.leadership.no_packets(jnp.asarray(loop.laws.numbers), content)

    def receive(self, loop: Loop, memory: PyTree, known: Known) -> tuple[NetworkEstimate, PyTree]:
        """Return the disagreement of the same step, and the packets after who took the lead."""
        since, number = loop.roster.since(known.clock.step), known.own.number
        memory = self.leadership.elect(memory, number, known.clock, since, known.here)
        return super().receive(loop, memory, known)


# ---- what messages contain, and where a leader is expected ---------------------------------------


class Saying(NamedTuple):
    """A leader in a step, or leaders with a row of each, and what it does.

    Attributes:
        x: its state.
        offset: of its place.
        memory: of its law, before the step.
        signal: what it says to neighbours.
        output: what it does.
    """

    x: State
    offset: State
    memory: Memory
    signal: Float[jax.Array, " s"]
    output: AgentOutput


class PlainValues(eqx.Module):
    """What the value of a message is: what its sender says.

    Nobody expects a leader anywhere; it says its feed-forward alone.

    Attributes:
        forget: steps after which what a neighbour sent is not used.
    """

    forget: Array
    # Whether a message says nothing without a packet.
    needs_packet = False

    def size(self, s: int, k: int, m: int) -> int:
        """Return how many numbers a leader says: signals (s,), feed-forward (k,), inputs (m,)."""
        return k

    def content(self, loop: Loop, t: Scalar, leader: Saying) -> Float[jax.Array, " p"]:
        """Return what a leader says of itself."""
        return leader.output.message

    def usable_age(self, dt: Array | float) -> jax.Array:
        """Return the age (s) beyond which what a neighbour sent is not used."""
        # Of a state there is no better guess than the last one, but never that of no message.
        return jnp.asarray(np.finfo(np.float32).max)

    def expect(
        self, loop: Loop, known: Known, packet: LeaderPackets, since: Float[jax.Array, " N"]
    ) -> tuple[Float[jax.Array, "N s"], Float[jax.Array, "N k"]]:
        """Return the signal at which each expects its leader, and the feed-forward."""
        return known.said, packet.content

    def received(
        self, mail: Messages, age: jax.Array, leader: jax.Array, knows: jax.Array, known: Known
    ) -> tuple[Float[jax.Array, "K s"], Bool[jax.Array, " K"], Bool[jax.Array, " K"]]:
        """Return what each link says, whether it says anything, and whether it is fresh.

        Args:
            mail: of the agents.
            age: (K,) of each link, s.
            leader: (N, s) the signal at which each expects its leader.
            knows: (N,) who knows of one.
            known: of the step.
        """
        return mail.value, age < jnp.inf, age <= self.usable_age(known.clock.dt)

    def value(
        self, said: jax.Array, leader: jax.Array, itself: jax.Array, difference: Difference
    ) -> Float[jax.Array, "N s"]:
        """Return the values of messages, of which `itself` (N,) are a leader's."""
        return said

    def another(self, mail: Messages, heard: NetworkEstimate) -> tuple[jax.Array, jax.Array]:
        """Return a signal (s,) of others that one agent knows, and whether it knows any."""
        known = jnp.append(mail.stamp != NEVER, False)
        signals = jnp.concatenate([mail.value, jnp.zeros_like(heard.leader)])
        return signals[jnp.argmax(known)], known.any()


class PlanDeviations(PlainValues):
    """How far the sender is off where it expects the leader, whose plan all know.

    A leader says its deviation from its plan.
    """

    needs_packet = True

    def size(self, s: int, k: int, m: int) -> int:
        """Return that of a signal."""
        return s

    def content(self, loop: Loop, t: Scalar, leader: Saying) -> Float[jax.Array, " p"]:
        """Return the deviation from the plan."""
        rows = t, leader.x, leader.offset, leader.memory
        deviation = Travels.of(loop.laws.leader).deviation(loop.model, *rows)
        assert deviation is not None, "a leader that others predict by its plan has one"
        return deviation

    def expected(
        self, loop: Loop, s: int, t: Scalar, content: Float[jax.Array, " p"], age: Scalar
    ) -> tuple[Float[jax.Array, " s"], Float[jax.Array, " k"]]:
        """Return the signal (s,) and the feed-forward of a leader, by its packet of an age (s)."""
        law, model = loop.laws.leader, loop.model
        expected = Travels.of(law).expected(model, t, content, age, loop.motion.dt)
        assert isinstance(expected, Expected), "a channel with a preview has a leader with a plan"
        x = expected.signal
        if expected.feedforward is not None:
            return x, expected.feedforward
        # What the leader's law would do there, alone.
        silence = jnp.zeros(len(model.input_names), x.dtype)
        view = LocalView(t, x, jnp.zeros_like(x), jnp.zeros_like(x), silence, loop.motion.dt)
        rows = model, loop.motion, law, view, law.begin(model, x), True
        return x, loop.laws.act(*rows).message

    def usable_age(self, dt: Array | float) -> jax.Array:
        """Return the age (s) beyond which what a neighbour sent is not used."""
        return jnp.asarray(self.forget * dt)

    def expect(
        self, loop: Loop, known: Known, packet: LeaderPackets, since: Float[jax.Array, " N"]
    ) -> tuple[Float[jax.Array, "N s"], Float[jax.Array, "N k"]]:
        """Return what is made of the packets."""
        rows = packet.content, jnp.where(since < jnp.inf, since, 0.0)
        one = functools.partial(self.expected, loop, known.said.shape[1], known.clock.t)
        return jax.vmap(one)(*rows)

    def received(
        self, mail: Messages, age: jax.Array, leader: jax.Array, knows: jax.Array, known: Known
    ) -> tuple[Float[jax.Array, "K s"], Bool[jax.Array, " K"], Bool[jax.Array, " K"]]:
        """Return the expected leader plus what is fresh of the deviations."""
        receivers = jnp.asarray(known.links.receivers)
        fresh, used = age <= self.usable_age(known.clock.dt), knows[receivers]
        value = leader[receivers] + jnp.where(fresh[:, None], mail.value, 0.0)
        # A leader is where it is expected, and its own message says no more.
        return value, used, fresh | ((age < jnp.inf) & (mail.hops == 0))

    def another(self, mail: Messages, heard: NetworkEstimate) -> tuple[jax.Array, jax.Array]:
        """Return the signal at which it expects its leader, and whether it knows of one."""
        return heard.leader[0], heard.packet.stamp[0] != NEVER

    def value(
        self, said: jax.Array, leader: jax.Array, itself: jax.Array, difference: Difference
    ) -> Float[jax.Array, "N s"]:
        """Return the deviations."""
        return jnp.where(itself[:, None], 0.0, difference(said, leader))


class PacketDeviations(PlanDeviations):
    """The same, where all carry on the leader's last motion by the model.

    A leader says its signal, its feed-forward and its input.
    """

    def size(self, s: int, k: int, m: int) -> int:
        """Return that of the three."""
        return s + k + m

    def content(self, loop: Loop, t: Scalar, leader: Saying) -> Float[jax.Array, " p"]:
        """Return the three."""
        return jnp.concatenate([leader.signal, leader.output.message, leader.output.input])

    def expected(
        self, loop: Loop, s: int, t: Scalar, content: Float[jax.Array, " p"], age: Scalar
    ) -> tuple[Float[jax.Array, " s"], Float[jax.Array, " k"]]:
        """Return where its motion carries it."""
        signal, forward, u = parts_of(loop, s, content)
        rows = loop.laws.follower, loop.model, (signal, forward, u), carried_time(age)
        moved = loop.laws.speech.carried(*rows)
        return moved, forward


@final
class SlopedPacketDeviations(PacketDeviations):
    """The same, where it also says how its feed-forward changes: it is carried on for longer."""

    def size(self, s: int, k: int, m: int) -> int:
        """Return that of the four."""
        return s + 2 * k + m

    def content(self, loop: Loop, t: Scalar, leader: Saying) -> Float[jax.Array, " p"]:
        """Return the four; the slope is that of the plan."""
        deviation, dt = PlanDeviations.content(self, loop, t, leader), loop.motion.dt
        rows = loop.model, t + dt, deviation, jnp.asarray(dt, t.dtype), dt
        expected, message = Travels.of(loop.laws.leader).expected(*rows), leader.output.message
        slope = jnp.zeros_like(message)
        if isinstance(expected, Expected) and expected.feedforward is not None:
            slope = (expected.feedforward - message) / dt
        return jnp.concatenate([super().content(loop, t, leader), slope])

    def expected(
        self, loop: Loop, s: int, t: Scalar, content: Float[jax.Array, " p"], age: Scalar
    ) -> tuple[Float[jax.Array, " s"], Float[jax.Array, " k"]]:
        """Return where its motion carries it, with a feed-forward that changes."""
        time = carried_time(age)
        k = (len(content) - s - len(loop.model.input_names)) // 2
        content, slope = content[:-k], content[-k:]
        signal, forward, u = parts_of(loop, s, content)
        mean = forward + 0.5 * time * slope
        rows = loop.laws.follower, loop.model, (signal, mean, u), time
        moved = loop.laws.speech.carried(*rows)
        return moved, forward + time * slope


def parts_of(
    loop: Loop, s: int, content: Float[jax.Array, " p"]
) -> tuple[Float[jax.Array, " s"], Float[jax.Array, " k"], Float[jax.Array, " m"]]:
    """Return the signal (s,), the feed-forward and the input in a packet that is carried on."""
    m = len(loop.model.input_names)
    return content[:s], content[s:-m], content[-m:]


def carried_time(age: Scalar) -> Scalar:
    """Return how long (s) a leader is taken to have moved on since a packet of an age (s)."""
    # Nobody knows where a leader is that was not heard for long: its motion slows down.
    late = jnp.maximum(age - _CARRIED_FULLY, 0.0)
    return age - late + (1.0 - jnp.exp(-_SLOWING * late)) / _SLOWING


# ---- whom agents use -----------------------------------------------------------------------------


class AllNeighbours(eqx.Module):
    """Whom agents use of those who send to them: all."""

    # Whether the weights of links depend on what arrives.
    chooses = False

    def uses(self, mail: Messages, hops: jax.Array, links: Exchange) -> jax.Array | bool:
        """Return which links (K,) an agent uses whose messages are fresh."""
        return True

    def disagreement(
        self, known: Known, received: jax.Array, fresh: jax.Array, alone: jax.Array, loop: Loop
    ) -> Float[jax.Array, "N s"]:
        """Return z (N, s), of which `alone` (N, s) is of an agent without fresh messages (K,)."""
        return known.links(known.said, received, loop.laws.speech.difference(loop.model))

    def shares(
        self, fresh: jax.Array, links: Exchange, agents: int
    ) -> tuple[Float[jax.Array, " K"], Bool[jax.Array, " N"]]:
        """Return the weights of links (K,) in z, and which agents (N,) use none of them."""
        return jnp.asarray(links.weights), jnp.zeros(agents, bool)


@final
class LeaderwardNeighbours(AllNeighbours):
    """Those with fewer hops to the leader alone."""

    chooses = True

    def uses(self, mail: Messages, hops: jax.Array, links: Exchange) -> jax.Array | bool:
        """Return which links (K,) an agent uses whose messages are fresh."""
        return mail.hops < hops[jnp.asarray(links.receivers)]

    def disagreement(
        self, known: Known, received: jax.Array, fresh: jax.Array, alone: jax.Array, loop: Loop
    ) -> Float[jax.Array, "N s"]:
        """Return the mean over the links that are used."""
        difference = loop.laws.speech.difference(loop.model)
        return known.links.mean(known.said, received, fresh, alone, difference)

    def shares(
        self, fresh: jax.Array, links: Exchange, agents: int
    ) -> tuple[Float[jax.Array, " K"], Bool[jax.Array, " N"]]:
        """Return the weights of links (K,) in this mean, and which agents (N,) use none of them."""
        return links.shares(fresh, agents)


# ---- the rules of messages -----------------------------------------------------------------------


@final
class MessageRules(eqx.Module):
    """What agents make of messages, and what they write: N agents of a run, or one alone.

    Attributes:
        leadership: who leads.
        content: of the messages.
        neighbours: whom agents use.
        agents: in the formation.
    """

    leadership: FixedLeaders
    content: PlainValues
    neighbours: AllNeighbours
    agents: int = eqx.field(static=True)

    @classmethod
    def of(cls, channel: Channel, leadership: FixedLeaders, agents: int) -> "MessageRules":
        """Return the rules of a network."""
        kind = SlopedPacketDeviations if leadership.changes else PacketDeviations
        kind = PlanDeviations if channel.prediction is Prediction.PREVIEW else kind
        kind = PlainValues if channel.messages is MessageContent.STATE else kind
        all_ = channel.hears is NeighbourChoice.ALL
        neighbours = AllNeighbours() if all_ else LeaderwardNeighbours()
        return cls(leadership, kind(channel.forget), neighbours, agents)

    def begin(
        self, number: jax.Array, links: int, said: Float[jax.Array, "N s"], size: int
    ) -> Messages:
        """Return the mail of agents before the first message, for signals and packets (size,)."""
        content = jnp.zeros((len(number), size), said.dtype)
        return Messages(
            jnp.zeros((links, said.shape[1]), said.dtype),
            jnp.full(links, NOBODY, jnp.int32),
            self.leadership.no_packets(number, content),
            jnp.full(links, NEVER, jnp.int32),
        )

    def take(
        self,
        mail: Messages,
        sent: Messages,
        new: Bool[jax.Array, " K"],
        stamp: jax.Array,
        links: Exchange,
    ) -> Messages:
        """Return the mail with messages (K, ...) of which some are `new`."""
        return Messages(
            jnp.where(new[:, None], sent.value, mail.value),
            jnp.where(new, sent.hops, mail.hops),
            self.leadership.newest(mail.packet, sent.packet, new, links),
            stamp,
        )

    def read(self, loop: Loop, mail: Messages, known: Known) -> NetworkEstimate:
        """Return what agents know from their mail, with what they say themselves."""
        packet, number, links, clock = mail.packet, known.own.number, known.links, known.clock
        age, since = clock.age(mail.stamp), clock.age(packet.stamp)
        leads, aware = self.leadership.leads(packet, number), since < jnp.inf
        leader, forward = self.content.expect(loop, known, packet, since)
        itself = packet.leader == number
        leader = jnp.where((itself | ~aware)[:, None], known.said, leader)
        forward = jnp.where(aware[:, None], forward, 0.0)
        hops, knows = self.hops(mail, age, leads, links, clock.dt), leads | aware
        received, fresh = self.chosen(mail, age, hops, leader, knows, known)
        alone = self.alone(loop, known.said, leader, knows)
        z = self.neighbours.disagreement(known, received, fresh, alone, loop)
        return NetworkEstimate(z, leads, forward, leader, hops, packet)

    def alone(
        self, loop: Loop, said: Float[jax.Array, "N s"], leader: jax.Array, knows: jax.Array
    ) -> Float[jax.Array, "N s"]:
        """Return z (N, s) of agents that use no message: how far off they expect the leader."""
        off = loop.laws.speech.difference(loop.model)(said, leader)
        return jnp.where(knows[:, None], off, 0.0)

    def chosen(
        self,
        mail: Messages,
        age: jax.Array,
        hops: jax.Array,
        leader: jax.Array,
        knows: jax.Array,
        known: Known,
    ) -> tuple[Float[jax.Array, "K s"], Bool[jax.Array, " K"]]:
        """Return the signal of the sender of each link, and which links agents use."""
        received, fresh = self.received(mail, age, leader, knows, known)
        return received, fresh & self.neighbours.uses(mail, hops, known.links)

    def received(
        self, mail: Messages, age: jax.Array, leader: jax.Array, knows: jax.Array, known: Known
    ) -> tuple[Float[jax.Array, "K s"], Bool[jax.Array, " K"]]:
        """Return the signal of the sender of each link, the own one of none, and which is fresh."""
        received, used, fresh = self.content.received(mail, age, leader, knows, known)
        own = known.said[jnp.asarray(known.links.receivers)]
        return jnp.where(used[:, None], received, own), fresh & used

    def hops(
        self,
        mail: Messages,
        age: Float[jax.Array, " K"],
        leads: Bool[jax.Array, " N"],
        links: Exchange,
        dt: Array | float,
    ) -> jax.Array:
        """Return the hops to a leader (N,), as counted by the messages that are not too old."""
        lasting = age <= self.hop_life(dt)
        nearest = links.least(jnp.where(lasting, mail.hops, NOBODY), len(leads))
        nearest = jnp.minimum(nearest, NOBODY)
        # Agents that are cut off together would count each other up for ever.
        hops = jnp.where(nearest + 1 >= self.agents, NOBODY, nearest + 1)
        return jnp.where(leads, 0, hops).astype(jnp.int32)

    def hop_life(self, dt: Array | float) -> jax.Array:
        """Return the age (s) beyond which a hop count is not used."""
        # Times a float: ten times the largest whole number would be negative.
        return jnp.asarray(float(HOP_LIFE) * self.content.forget * dt)

    def used(
        self, mail: Messages, age: jax.Array, hops: jax.Array, links: Exchange, dt: Array | float
    ) -> Bool[jax.Array, " K"]:
        """Return which links of the graph agents use, with messages of these ages (s)."""
        used = (jnp.asarray(links.weights) > 0.0) & (age <= self.content.usable_age(dt))
        return used & self.neighbours.uses(mail, hops, links)

    def contents(
        self, loop: Loop, mail: Messages, known: Known, speech: LeaderSpeech
    ) -> Float[jax.Array, "N p"]:
        """Return what each would say of itself as a leader; zeros of those that cannot be one."""
        numbers, t = loop.laws.leaders, known.clock.t
        own = known.own.x[numbers], known.offsets[0].offset, speech.before, known.said[numbers]
        one = functools.partial(self.content.content, loop, t)
        content = jax.vmap(one)(Saying(*own, speech.output))
        return jnp.zeros_like(mail.packet.content).at[numbers].set(content)

    def write(
        self,
        mail: Messages,
        heard: NetworkEstimate,
        number: jax.Array,
        stamp: jax.Array,
        said: Float[jax.Array, "N s"],
        content: Float[jax.Array, "N p"],
        difference: Difference,
    ) -> tuple[Messages, Bool[jax.Array, " N"]]:
        """Return what agents send at a time, and which of them can.

        `content` is what each would say of itself if it were a leader.
        """
        packet = mail.packet
        itself = heard.leads & (packet.leader == number)
        packet = packet._replace(
            stamp=jnp.where(itself, stamp, packet.stamp),
            content=jnp.where(itself[:, None], content, packet.content),
        )
        value = self.content.value(said, heard.leader, itself, difference)
        sends = packet.stamp != NEVER if self.content.needs_packet else jnp.ones(len(said), bool)
        return Messages(value, heard.hops, packet), sends


# ---- the network that is late --------------------------------------------------------------------


class LateNetwork(IdealNetwork):
    """Messages by the rules, over a medium that delays and loses them.

    It remembers what is in flight, and the mail of the agents.

    Attributes:
        rules: of the messages.
        medium: what the world does to them.
    """

    rules: MessageRules
    medium: Channel
    late = True

    def begin(self, loop: Loop, said: Float[jax.Array, "N s"], forward: int) -> PyTree:
        """Return the network before the first message."""
        numbers, links = jnp.asarray(loop.laws.numbers), len(loop.graph.exchange.receivers)
        sizes = said.shape[1], forward, len(loop.model.input_names)
        size = self.rules.content.size(*sizes)
        mail = self.rules.begin(numbers, links, said, size)
        return self.medium.begin(Messages(said, numbers, mail.packet), links), mail

    def receive(self, loop: Loop, memory: PyTree, known: Known) -> tuple[NetworkEstimate, PyTree]:
        """Return what agents know with what arrives now, and the mail with it."""
        in_flight, mail = memory
        since, number = loop.roster.since(known.clock.step), known.own.number
        rows = number, known.clock, since, known.links, known.here
        mail = self.delivered(in_flight, mail, *rows)
        return self.rules.read(loop, mail, known), (in_flight, mail)

    def delivered(
        self,
        in_flight: PyTree,
        mail: Messages,
        number: jax.Array,
        clock: Clock,
        since: jax.Array,
        links: Exchange,
        here: Mask,
    ) -> Messages:
        """Return the mail with what arrives now, and with who takes the lead."""
        arriving = self.arriving(in_flight, clock.step, mail, links)
        return self.taken(mail, arriving, number, clock, since, links, here)

    def taken(
        self,
        mail: Messages,
        arriving: tuple[Messages, jax.Array, jax.Array],
        number: jax.Array,
        clock: Clock,
        since: jax.Array,
        links: Exchange,
        here: Mask,
    ) -> Messages:
        """Return the mail with what is arriving, and with who takes the lead."""
        mail = self.rules.take(mail, *arriving, links)
        packet = self.leadership.elect(mail.packet, number, clock, since, here)
        return mail._replace(packet=packet)

    def arriving(
        self, in_flight: PyTree, step: jax.Array, mail: Messages, links: Exchange
    ) -> tuple[Messages, jax.Array, jax.Array]:
        """Return a message of each link (K, ...), which of them arrives now, and its stamp."""
        arrival = self.medium.arrivals(in_flight, step, mail.stamp)
        places = arrival.slot, jnp.asarray(links.senders)
        sent: Messages = jax.tree.map(lambda rows: rows[places], in_flight.content)
        return sent, arrival.new, arrival.stamp

    def send(self, loop: Loop, memory: PyTree, known: Known, speech: LeaderSpeech) -> PyTree:
        """Return the network after what agents send now."""
        in_flight, mail = memory
        sent, sends = self.written(loop, mail, known, speech)
        return self.posted(in_flight, known.clock.step, sent, sends, known.links), mail

    def written(
        self, loop: Loop, mail: Messages, known: Known, speech: LeaderSpeech
    ) -> tuple[Messages, Bool[jax.Array, " N"]]:
        """Return what agents write, and which of them can."""
        content = self.rules.contents(loop, mail, known, speech)
        difference = loop.laws.speech.difference(loop.model)
        rows = known.own.number, known.clock.now, known.said, content, difference
        return self.rules.write(mail, known.heard, *rows)

    def with_medium(self, medium: Channel) -> IdealNetwork:
        """Return the network over another medium."""
        rules = MessageRules.of(medium, self.leadership, self.rules.agents)
        return LateNetwork(self.leadership, rules, medium)

    def posted(
        self, in_flight: PyTree, step: jax.Array, sent: Messages, sends: jax.Array, links: Exchange
    ) -> PyTree:
        """Return what is in flight after a step; links that the graph lacks carry nothing."""
        carried = carries(links, sends)
        return self.medium.post(in_flight, step, sent, carried, links.receivers, links.senders)


def carries(links: Exchange, sends: Bool[jax.Array, " N"]) -> Bool[jax.Array, " K"]:
    """Return the links along which messages leave."""
    return sends[jnp.asarray(links.senders)] & (jnp.asarray(links.weights) > 0.0)
