"""Who acts when in a step: leaders first, then followers with what they are sent."""

from typing import final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from echelon.agents.network.exchange import Near
from echelon.agents.network.graph import Graph
from echelon.core.types import Array, PyTree, State
from echelon.laws.law import Law, LocalView, Memory
from echelon.simulation.step.leadership import announced
from echelon.simulation.step.loop import Loop, Turns
from echelon.simulation.step.records import (
    AgentOutput,
    GroupOffsets,
    Known,
    LawMemories,
    LeaderSpeech,
    Played,
    choose,
)


def act_all(
    loop: Loop,
    known: Known,
    law: Law,
    agents: Array | jax.Array,
    offsets: GroupOffsets,
    forward: Float[jax.Array, "G k"],
    memory: Memory,
    near: Near | None,
    leads: bool = False,
) -> AgentOutput:
    """Return what some agents do: of everything known, each sees its own row and no other."""
    t = known.clock.t

    def one(
        x: State,
        own: GroupOffsets,
        z: jax.Array,
        forward: jax.Array,
        memory: Memory,
        row: PyTree,
        near: Near | None,
    ) -> AgentOutput:
        view = LocalView(t, x, own.offset, z, forward, loop.motion.dt, near, own.rate)
        return loop.laws.act(loop.model, loop.motion.of_row(row), law, view, memory, leads)

    rows, near = jax.tree.map(lambda leaf: leaf[agents], (loop.motion.rows, near))
    own = known.own.x[agents], offsets, known.heard.disagreement[agents]
    return jax.vmap(one)(*own, forward, memory, rows, near)


def lead(loop: Loop, known: Known, laws: LawMemories) -> AgentOutput:
    """Return what leaders do, to whom nobody sends an input."""
    law, agents = loop.laws.groups[0]
    size = len(agents), len(loop.model.input_names)
    silence = jnp.zeros(size, known.heard.disagreement.dtype)
    rows = known.offsets[0], silence, laws.leader, None
    return act_all(loop, known, law, agents, *rows, leads=True)


def follow(
    loop: Loop, known: Known, group: int, forward: Float[jax.Array, "G k"], memory: Memory
) -> AgentOutput:
    """Return what one of the two groups does as followers."""
    agents = loop.laws.groups[group][1]
    rows = known.offsets[group], forward, memory, known.near
    return act_all(loop, known, loop.laws.follower, agents, *rows)


# ---- what followers are sent of the leaders' inputs ----------------------------------------------


class Relay(eqx.Module):
    """What followers are sent of others' inputs: what each expects of its leader, from messages."""

    def followed(
        self, loop: Loop, known: Known, laws: LawMemories, led: AgentOutput
    ) -> AgentOutput:
        """Return what followers do after the leaders."""
        forward = known.heard.feedforward[loop.laws.followers]
        return follow(loop, known, 1, forward, laws.follower)

    def sent(
        self, loop: Loop, known: Known, network: PyTree, said: AgentOutput
    ) -> tuple[Float[jax.Array, "N k"], PyTree]:
        """Return what each agent is sent if leaders may follow, and the memory of the network."""
        return known.heard.feedforward, network


@final
class SameStep(Relay):
    """The feed-forward of the same step, of the nearest leader.

    Attributes:
        sender: the place of each follower's leader among the leaders.
    """

    sender: Array

    def followed(
        self, loop: Loop, known: Known, laws: LawMemories, led: AgentOutput
    ) -> AgentOutput:
        """Return what followers do after the leaders."""
        return follow(loop, known, 1, led.message[self.sender], laws.follower)


@final
class ByDepth(Relay):
    """What their parents have just done: they act level by level.

    Attributes:
        parents: (N,) the neighbour nearer to the leader.
        levels: (D, W) the places of followers among the followers, level by level; a short row
            repeats a place.
    """

    parents: Array
    levels: Array

    @classmethod
    def of(cls, graph: Graph) -> "ByDepth":
        """Return the levels of a graph."""
        depth = graph.depths()[list(graph.followers)]
        rows = [np.flatnonzero(depth == d) for d in range(1, depth.max() + 1)]
        # One shape for all levels, as a scan needs; a copy of an agent does what the agent does.
        width = max(map(len, rows))
        levels = [np.append(row, np.repeat(row[0], width - len(row))) for row in rows]
        return cls(np.array(graph.parents()), np.stack(levels))

    def followed(
        self, loop: Loop, known: Known, laws: LawMemories, led: AgentOutput
    ) -> AgentOutput:
        """Return what followers do after the leaders."""
        followers, parents = jnp.asarray(loop.laws.followers), jnp.asarray(self.parents)
        messages = jnp.zeros((loop.agents, led.message.shape[1]), led.message.dtype)
        messages = messages.at[loop.laws.leaders].set(led.message)
        nothing = jnp.zeros((len(followers), led.input.shape[1]), led.input.dtype)

        def level(
            carry: tuple[jax.Array, AgentOutput], places: jax.Array
        ) -> tuple[tuple[jax.Array, AgentOutput], None]:
            messages, actions = carry
            agents = followers[places]
            rows = laws.follower, known.offsets[1]
            memory, own = jax.tree.map(lambda leaf: leaf[places], rows)
            rows = own, messages[parents[agents]], memory, known.near
            acted = act_all(loop, known, loop.laws.follower, agents, *rows)
            # Where a level repeats an agent, the same is written twice.
            actions = jax.tree.map(lambda a, b: a.at[places].set(b), actions, acted)
            return (messages.at[agents].set(acted.message), actions), None

        # Every follower is in one level, so that no zero of these is left.
        start = AgentOutput(nothing, nothing, laws.follower, messages[followers])
        return jax.lax.scan(level, (messages, start), jnp.asarray(self.levels))[0][1]


@final
class Announced(Relay):
    """In the ideal network with backups all hear at once who leads, and what it does."""

    def sent(
        self, loop: Loop, known: Known, network: PyTree, said: AgentOutput
    ) -> tuple[Float[jax.Array, "N k"], PyTree]:
        """Return what each agent is sent, and the packets."""
        rows = loop.laws.leaders, known.heard.leads, known.here, known.clock, said.message
        packet = announced(loop.network.leadership, network, *rows)
        return packet.content, packet


# ---- turns ---------------------------------------------------------------------------------------


@final
class LeadersFirst(Turns):
    """Leaders lead, and all others follow."""

    relay: Relay

    def play(self, loop: Loop, known: Known, laws: LawMemories, network: PyTree) -> Played:
        """Return what leaders and followers do, what leaders say, and the network's memory."""
        led = lead(loop, known, laws)
        followed = self.relay.followed(loop, known, laws, led)
        return Played(led, followed, LeaderSpeech(laws.leader, led), network)


def by_depth(loop: Loop) -> ByDepth | None:
    """Return the levels in which followers act; None where they act all at once."""
    relay = loop.turns.relay if isinstance(loop.turns, LeadersFirst) else None
    return relay if isinstance(relay, ByDepth) else None


@final
class BackupsToo(Turns):
    """Leaders and backup leaders lead or follow, as whoever leads by then."""

    relay: Relay

    def play(self, loop: Loop, known: Known, laws: LawMemories, network: PyTree) -> Played:
        """Return what leaders and followers do, what leaders say, and the network's memory."""
        said = lead(loop, known, laws)
        forward, network = self.relay.sent(loop, known, network, said)
        leaders, followers = loop.laws.leaders, loop.laws.followers
        followed = follow(loop, known, 1, forward[followers], laws.follower)
        follows = follow(loop, known, 0, forward[leaders], laws.leader)
        led = choose(known.heard.leads[leaders], said, follows)
        return Played(led, followed, LeaderSpeech(laws.leader, said), network)
