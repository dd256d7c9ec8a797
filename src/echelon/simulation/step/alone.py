"""An agent alone: the loop with one row, in which what really arrives replaces a simulated network.

It runs the same `control`. Its links and its turn are its own, messages come from outside, and its
clock counts seconds.
"""

import dataclasses
from typing import Any, NamedTuple, final

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from echelon.agents.network.channel import NEVER
from echelon.agents.network.exchange import Exchange, Near
from echelon.core.types import Array, PyTree, Scalar, State, States
from echelon.simulation.step.leadership import FixedLeaders
from echelon.simulation.step.loop import IdealNetwork, Loop, NobodyNear, Turns
from echelon.simulation.step.nearby import ExactHulls, all_hulls
from echelon.simulation.step.networks import LateNetwork
from echelon.simulation.step.records import (
    AgentOutput,
    Known,
    LawMemories,
    LeaderSpeech,
    Messages,
    NetworkEstimate,
    Played,
)
from echelon.simulation.step.roster import Everybody, Links
from echelon.simulation.step.turns import BackupsToo, Relay, follow, lead


class Arrived(NamedTuple):
    """What came last from others; NaN for what did not.

    Attributes:
        signals: (K, s) of the neighbours.
        forward: (k,) the feed-forward.
        messages: of the neighbours over a late network, with stamps in s; () in the ideal one.
        hulls: (L, r, d) of all others; no rows where agents do not keep apart.
    """

    signals: Float[Array, "K s"]
    forward: Float[Array, " k"]
    messages: PyTree = ()
    hulls: PyTree = ()


# ---- the network ---------------------------------------------------------------------------------


@final
class ReceivingIdeally(IdealNetwork):
    """What is said is heard in the same step, of those from whom it came."""

    arrived: Arrived

    def receive(self, loop: Loop, memory: PyTree, known: Known) -> tuple[NetworkEstimate, PyTree]:
        """Return what the agent knows from what came last."""
        mine = known.said[jnp.asarray(known.links.receivers)]
        signals, forward = map(jnp.asarray, self.arrived[:2])
        # The own value has no difference: a neighbour that is not heard does not act.
        received = jnp.where(jnp.isnan(signals), mine, signals)
        z = known.links(known.said, received, loop.laws.speech.difference(loop.model))
        forward = sent_or_alone(loop, known.clock.t, known.own.x[0], forward)[None]
        return NetworkEstimate(z, self.leadership.leads((), known.own.number), forward), memory

    def another(self, memory: PyTree, heard: NetworkEstimate) -> tuple[jax.Array, jax.Array]:
        """Return a signal (s,) of another agent that came, and whether one did."""
        signals = jnp.asarray(self.arrived.signals)
        whole = jnp.append(jnp.isfinite(signals).all(axis=1), False)
        return jnp.append(signals, heard.disagreement, axis=0)[jnp.argmax(whole)], whole.any()


def sent_or_alone(
    loop: Loop, t: Scalar, x: State, forward: Float[jax.Array, " k"]
) -> Float[jax.Array, " k"]:
    """Return the feed-forward of an agent at x that received one, or NaN for none."""
    alone = loop.laws.axes.alone(loop.laws.follower, loop.model, t, x, len(forward))
    return jnp.where(jnp.isnan(forward), alone, forward)


@final
class ReceivingLate(LateNetwork):
    """The rules of a late network; its medium is the real one, and no part of the computation.

    It remembers the message that was written last, and the mail.
    """

    arrived: Arrived

    def begin(self, loop: Loop, said: Float[jax.Array, "N s"], forward: int) -> PyTree:
        """Return the mail before the first message, with stamps in s."""
        mail = super().begin(loop, said, forward)[1]
        packet = mail.packet._replace(stamp=mail.packet.stamp.astype(float))
        mail = mail._replace(stamp=mail.stamp.astype(float), packet=packet)
        return Messages(said, jnp.zeros(1, jnp.int32), packet), mail

    def arriving(
        self, in_flight: PyTree, step: jax.Array, mail: Messages, links: Exchange
    ) -> tuple[Messages, jax.Array, jax.Array]:
        """Return what came; whatever came before is the same again."""
        received = jax.tree.map(jnp.asarray, self.arrived.messages)
        return received, received.stamp != NEVER, received.stamp

    def posted(
        self, in_flight: PyTree, step: jax.Array, sent: Messages, sends: jax.Array, links: Exchange
    ) -> PyTree:
        """Return what the agent writes."""
        return sent

    def another(self, memory: PyTree, heard: NetworkEstimate) -> tuple[jax.Array, jax.Array]:
        """Return a signal (s,) of another agent that this one knows, and whether it knows any."""
        return self.rules.content.another(memory[1], heard)


# ---- who is near ---------------------------------------------------------------------------------


@final
class ReceivedHulls(NobodyNear):
    """Those whose hulls came. It remembers what the agent says of its own (r, d).

    Attributes:
        kind: what agents say of their hulls.
        numbers: (K,) of the others.
        leading: (K,) which of them lead or may.
    """

    kind: ExactHulls
    numbers: Array
    leading: Array
    arrived: Arrived
    keeps_apart = True

    def begin(self, loop: Loop, states: States, laws: LawMemories) -> PyTree:
        """Return the own hull."""
        return all_hulls(loop, states, laws)[0]

    def look(
        self, loop: Loop, memory: PyTree, laws: LawMemories, known: Known
    ) -> tuple[Near | None, PyTree]:
        """Return what the agent knows of the others."""
        own = self.kind.said(loop, all_hulls(loop, known.own.x, laws), known)[0]
        hulls, packet = jnp.asarray(self.arrived.hulls), known.heard.packet
        there = ~jnp.isnan(hulls).any(axis=(1, 2))
        leads = loop.network.leadership.named(packet, jnp.asarray(self.numbers), self.leading)
        near = Near(own[None] - hulls, leads, there)
        return jax.tree.map(lambda part: part[None], near), own


# ---- turns ---------------------------------------------------------------------------------------


def _nobody(acted: AgentOutput, memory: PyTree) -> AgentOutput:
    """Return what the group without agents does, whose memories have no rows."""
    nothing = jax.tree.map(lambda row: row[:0], acted._replace(memory=()))
    return nothing._replace(memory=memory)


@final
class OnlyLeads(Turns):
    """The agent leads."""

    def play(self, loop: Loop, known: Known, laws: LawMemories, network: PyTree) -> Played:
        """Return what it does and says."""
        led = lead(loop, known, laws)
        nobody = _nobody(led, laws.follower)
        return Played(led, nobody, LeaderSpeech(laws.leader, led), network)


@final
class OnlyFollows(Turns):
    """The agent follows."""

    def play(self, loop: Loop, known: Known, laws: LawMemories, network: PyTree) -> Played:
        """Return what it does."""
        followed = follow(loop, known, 1, known.heard.feedforward, laws.follower)
        nobody = _nobody(followed, laws.leader)
        return Played(nobody, followed, LeaderSpeech(laws.leader, nobody), network)


# ---- the loop ------------------------------------------------------------------------------------


def one_row(
    loop: Loop, leads: bool, number: Array | jax.Array, rows: PyTree, **members: Any
) -> Loop:
    """Return the loop of one agent, which leads or follows, of a `number` (1,).

    Args:
        loop: of its formation.
        leads: whether it is a leader.
        number: of the agent.
        rows: of its plant, as `PlantStep.rows`.
        members: its own, in place of those of the formation.
    """
    first, none = np.array([0]), np.array([], int)
    groups = (first, none) if leads else (none, first)
    laws = dataclasses.replace(
        loop.laws, leaders=groups[0], followers=groups[1], order=first, numbers=number
    )
    motion = dataclasses.replace(loop.motion, rows=rows)
    turn = OnlyLeads() if leads else OnlyFollows()
    if loop.laws.backups and leads:
        turn = BackupsToo(Relay())
    own = {"laws": laws, "motion": motion, "roster": Everybody(), "turns": turn}
    return loop.replace(**own, **members)


def alone(loop: Loop, number: int, arrived: Arrived) -> Loop:
    """Return the loop of one agent of a formation: one row of each member."""
    own, laws = slice(number, number + 1), loop.laws
    leads = number in np.asarray(laws.leaders)
    exchange, network = loop.graph.exchange, loop.network
    mine = np.asarray(exchange.receivers) == number
    senders, weights = np.arange(mine.sum()), np.asarray(exchange.weights)[..., mine]
    links = Exchange(np.zeros(mine.sum(), int), senders, weights)
    leadership: FixedLeaders = dataclasses.replace(
        network.leadership, first=np.asarray(network.leadership.first)[own]
    )
    if isinstance(network, LateNetwork):
        rules = dataclasses.replace(network.rules, leadership=leadership)
        network = ReceivingLate(leadership, rules, network.medium, arrived)
    else:
        network = ReceivingIdeally(leadership, arrived)
    near = loop.surroundings
    if isinstance(near, ExactHulls):
        others = np.delete(np.arange(loop.agents), number)
        near = ReceivedHulls(near, others, np.isin(others, loop.laws.leaders), arrived)
    return one_row(
        loop,
        leads,
        laws.numbers[own],
        jax.tree.map(lambda leaf: leaf[own], loop.motion.rows),
        sensing=loop.sensing.on_board,
        places=loop.places.of_one(number),
        graph=Links(links),
        network=network,
        surroundings=near,
    )


def after_mail(loop: Loop, arrived: Arrived, weights: Float[Array, " K"]) -> Loop:
    """Return the loop of one agent with what came, and the weights of its links."""
    links, near = loop.graph.exchange, loop.surroundings
    if isinstance(near, ReceivedHulls):
        near = dataclasses.replace(near, arrived=arrived)
    return loop.replace(
        network=dataclasses.replace(loop.network, arrived=arrived),
        surroundings=near,
        graph=Links(Exchange(links.receivers, links.senders, weights)),
    )
