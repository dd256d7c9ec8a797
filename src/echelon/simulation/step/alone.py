"""An agent alone: the loop with one row, in which what really arrives replaces a simulated network.

It runs the same `control`. Its links and its turn are its own, messages come from outside, and its
clock counts seconds.
"""

import dataclasses
from typing import Any, NamedTuple, final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from echelon.agents.network.channel import NEVER
from echelon.agents.network.exchange import Exchange, Near
from echelon.agents.network.switching import ROUNDED, Schedule
from echelon.core.types import Array, PyTree, Scalar, State, States
from echelon.simulation.step.leadership import FixedLeaders
from echelon.simulation.step.loop import IdealNetwork, Loop, NobodyNear, Turns
from echelon.simulation.step.nearby import ExactHulls, all_hulls
from echelon.simulation.step.networks import LateNetwork
from echelon.simulation.step.records import (
    AgentOutput,
    ComponentMemory,
    Control,
    Known,
    LawMemories,
    LeaderSpeech,
    LoopState,
    Messages,
    NetworkEstimate,
    Played,
    Seconds,
)
from echelon.simulation.step.roster import Everybody, Links
from echelon.simulation.step.run_laws import has_angles
from echelon.simulation.step.sequence import begin, control, hear
from echelon.simulation.step.turns import BackupsToo, Relay, follow, lead


class Arrived(NamedTuple):
    """What came last from others; NaN for what did not.

    Attributes:
        signals: (K, s) of the neighbours.
        forward: (k,) the feed-forward.
        messages: of the neighbours over a late network, with stamps in s; () in the ideal one.
        hulls: (L, r, d) of all others; no rows where agents do not keep apart.
    """

    signals: Float[Array | jax.Array, "K s"]
    forward: Float[Array | jax.Array, " k"]
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

    It remembers the message that was written last, and the newest packet of a leader.
    """

    arrived: Arrived

    def begin(self, loop: Loop, said: Float[jax.Array, "N s"], forward: int) -> PyTree:
        """Return that it has no packet, with stamps in s."""
        packet = super().begin(loop, said, forward)[1].packet
        return (packet._replace(stamp=packet.stamp.astype(float)),)

    def receive(self, loop: Loop, memory: PyTree, known: Known) -> tuple[NetworkEstimate, PyTree]:
        """Return what the agent knows, and the mail; whatever came before is the same again."""
        *_, before = memory
        mail: Messages = jax.tree.map(jnp.asarray, self.arrived.messages)
        leadership, new = self.rules.leadership, mail.stamp != NEVER
        packet = leadership.newest(before, mail.packet, new, known.links)
        since, clock = loop.roster.since(known.clock.step), known.clock
        packet = leadership.elect(packet, known.own.number, clock, since, known.here)
        mail = mail._replace(packet=packet)
        return self.rules.read(loop, mail, known), mail

    def send(self, loop: Loop, memory: PyTree, known: Known, speech: LeaderSpeech) -> PyTree:
        """Return what the agent writes, and the packet that it has."""
        written = self.written(loop, memory, known, speech)[0]
        return written, memory.packet

    def another(self, memory: PyTree, heard: NetworkEstimate) -> tuple[jax.Array, jax.Array]:
        """Return a signal (s,) of another agent that this one knows, and whether it knows any."""
        return self.rules.content.another(memory, heard)


# ---- whom it hears -------------------------------------------------------------------------------


@final
class LinksByTime(Links):
    """Links whose weights switch, with a row of weights from each of some times (s) on.

    Attributes:
        starts: these times.
        period: after which the rows repeat, s; None where the last one holds for ever.
    """

    starts: Array
    period: float | None = eqx.field(static=True)

    def at(self, step: jax.Array) -> Exchange:
        """Return the exchange with the weights of a time (s)."""
        t = step + ROUNDED
        t = t if self.period is None else t % self.period
        return self.exchange.during((jnp.asarray(self.starts) <= t).sum() - 1)


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


def alone(loop: Loop, number: int, arrived: Arrived, schedule: Schedule | None) -> Loop:
    """Return the loop of one agent of a formation: one row of each member.

    `schedule` is that of a graph that switches.
    """
    own, laws = slice(number, number + 1), loop.laws
    leads = number in np.asarray(laws.leaders)
    exchange, network = loop.graph.exchange, loop.network
    mine = np.asarray(exchange.receivers) == number
    senders, weights = np.arange(mine.sum()), np.asarray(exchange.weights)[..., mine]
    links = Exchange(np.zeros(mine.sum(), int), senders, weights)
    graph = Links(links)
    if schedule is not None:
        graph = LinksByTime(links, schedule.starts, schedule.period)
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
        graph=graph,
        network=network,
        surroundings=near,
    )


def after_mail(loop: Loop, arrived: Arrived) -> Loop:
    """Return the loop of one agent with what came."""
    near = loop.surroundings
    if isinstance(near, ReceivedHulls):
        near = dataclasses.replace(near, arrived=arrived)
    network = dataclasses.replace(loop.network, arrived=arrived)
    return loop.replace(network=network, surroundings=near)


# ---- the step ------------------------------------------------------------------------------------


class OwnMemory(NamedTuple):
    """What an agent alone remembers between two steps.

    Attributes:
        components: of these; what it said is no part of it.
        begun: when it first acted, s; infinite before.
        asks: whether it has yet to learn how often others turned.
    """

    components: ComponentMemory
    begun: jax.Array
    asks: jax.Array

    @classmethod
    def of(cls, memory: ComponentMemory, begun: jax.Array, asks: jax.Array) -> "OwnMemory":
        """Return what an agent needs of the memory after a step."""
        kept = memory._replace(plant=(), near=(), network=memory.network[-1:])
        return cls(kept, begun, asks)


def begin_alone(loop: Loop, x: State) -> OwnMemory:
    """Return the memory of an agent that begins at x."""
    memory = begin(loop, x[None]).memory
    return OwnMemory.of(memory, jnp.asarray(jnp.inf, x.dtype), jnp.asarray(False))


def step_alone(loop: Loop, own: OwnMemory, t: jax.Array, x: State) -> tuple[Control, OwnMemory]:
    """Return what an agent at x does at a time (s), and its memory after it."""
    first, begun = own.begun == jnp.inf, jnp.minimum(own.begun, t)
    clock = Seconds(t, loop.motion.dt, begun, first)
    cut = jnp.zeros((1, len(loop.model.input_names)), jnp.int8)
    now, asks = LoopState(jnp.zeros((), jnp.int32), x[None], cut, own.components), own.asks
    if has_angles(loop.laws.follower):
        # An angle is a number that grows with every turn, and who begins late knows none of them:
        # it takes them from another's signal.
        asks = asks | first & (t > 0.0)
        laws, asks = jax.lax.cond(
            asks,
            lambda: _beside_others(loop, now, clock),
            lambda: (now.memory.laws, jnp.asarray(False)),
        )
        now = now._replace(memory=now.memory._replace(laws=laws))
    acted = control(loop, now, clock)
    return acted, OwnMemory.of(acted.memory, begun, asks)


def _beside_others(loop: Loop, now: LoopState, clock: Seconds) -> tuple[LawMemories, jax.Array]:
    """Return the memory beside another's signal, and whether no signal came."""
    known, _, network = hear(loop, now, clock)
    assert isinstance(loop.network, ReceivingIdeally | ReceivingLate), "it is alone"
    other, there = loop.network.another(network, known.heard)
    return loop.laws.beside(now.memory.laws, there[None], other), ~there
