"""What agents know of all others that may come near: of the same instant, or from late messages.

Over a network each sends the points of its hull less where it expects those of the leader, which
hardly change while a message is under way. They are used until newer ones arrive.
"""

from typing import NamedTuple, final

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from echelon.agents.network.channel import NEVER, Channel, InFlight
from echelon.agents.network.exchange import Near
from echelon.core.types import Array, PyTree, States
from echelon.laws.law import KeepsApart, Law, Memory
from echelon.simulation.step.loop import Loop, NobodyNear
from echelon.simulation.step.meter import Sums
from echelon.simulation.step.records import Known, LawMemories, LoopState, Mask, as_array


class NeighbourHulls(NamedTuple):
    """Messages about the places of all agents, along K = N (N - 1) links.

    Attributes:
        posts: the last messages of each agent.
        stamp: (K,) when the newest one that arrived was sent; `NEVER` for none.
        points: (K, r, d) that it contains.
    """

    posts: InFlight
    stamp: Int[jax.Array, " K"]
    points: Float[jax.Array, "K r d"]


class ExactHulls(NobodyNear):
    """All know the hulls of all others of the same instant."""

    keeps_apart = True

    def look(
        self, loop: Loop, memory: PyTree, laws: LawMemories, known: Known
    ) -> tuple[Near | None, PyTree]:
        """Return what each agent knows of all others."""
        hulls, agents = all_hulls(loop, known.own.x, laws), loop.agents
        receivers, senders = _pairs(agents)
        hulls, points, seen, memory = self._exchanged(loop, memory, hulls, known)
        near = Near(hulls[receivers] - points, known.heard.leads[senders], seen)
        shape = agents, agents - 1
        return jax.tree.map(lambda part: part.reshape(*shape, *part.shape[1:]), near), memory

    def said(
        self, loop: Loop, hulls: Float[jax.Array, "N r d"], known: Known
    ) -> Float[jax.Array, "N r d"]:
        """Return what agents say of their hulls."""
        return hulls

    def _exchanged(
        self, loop: Loop, memory: PyTree, hulls: Float[jax.Array, "N r d"], known: Known
    ) -> tuple[jax.Array, jax.Array, jax.Array, PyTree]:
        """Return own points, others' (K, r, d), whose are known (K,), and the memory."""
        senders = _pairs(loop.agents)[1]
        return hulls, hulls[senders], as_array(known.here, loop.agents)[senders], memory

    def measured(
        self, loop: Loop, read: Sums, now: LoopState, laws: LawMemories, here: Mask
    ) -> Sums:
        """Return the sums with distances, and with how many others held each agent back."""
        own, active = loop.laws, jnp.zeros(loop.agents, now.states.dtype)
        active = active.at[own.followers].set(KeepsApart.of(own.follower).active(laws.follower))
        if own.backups:
            active = active.at[own.leaders].set(KeepsApart.of(own.follower).active(laws.leader))
        return read._replace(**loop.meter.of_slice(now.step, now.states, active, here))


@final
class LateHulls(ExactHulls):
    """All know them from messages, less those of the leader where each expects it.

    It remembers these, as `NeighbourHulls`.
    """

    medium: Channel

    def with_medium(self, medium: Channel) -> NobodyNear:
        """Return the same over another medium."""
        return LateHulls(medium)

    def begin(self, loop: Loop, states: States, laws: LawMemories) -> PyTree:
        """Return the messages before the first one."""
        hulls = all_hulls(loop, states, laws)
        links = len(_pairs(loop.agents)[0])
        points = jnp.zeros((links, *hulls.shape[1:]), hulls.dtype)
        stamp = jnp.full(links, NEVER, jnp.int32)
        return NeighbourHulls(self.medium.begin(hulls, links), stamp, points)

    def said(
        self, loop: Loop, hulls: Float[jax.Array, "N r d"], known: Known
    ) -> Float[jax.Array, "N r d"]:
        """Return them less those of the leader where each expects it."""
        t = known.clock.t

        def one(hull: jax.Array, expected: jax.Array) -> jax.Array:
            there = KeepsApart.of(loop.laws.leader).expected_hull(loop.model, t, expected)
            assert there is not None, "a law with `safety` follows a leader that can be expected"
            return hull - there

        return jax.vmap(one)(hulls, known.heard.leader)

    def _exchanged(
        self, loop: Loop, memory: PyTree, hulls: Float[jax.Array, "N r d"], known: Known
    ) -> tuple[jax.Array, jax.Array, jax.Array, PyTree]:
        receivers, senders = _pairs(loop.agents)
        clock, heard, here = known.clock, known.heard, as_array(known.here, loop.agents)
        hulls = self.said(loop, hulls, known)
        sends = (here & (heard.leads | (heard.packet.stamp != NEVER)))[senders]
        arrival = self.medium.arrivals(memory.posts, clock.step, memory.stamp)
        new = arrival.new[:, None, None]
        points = jnp.where(new, memory.posts.content[arrival.slot, senders], memory.points)
        posts = self.medium.post(memory.posts, clock.step, hulls, sends, receivers, senders)
        seen = here[senders] & (arrival.stamp != NEVER)
        return hulls, points, seen, NeighbourHulls(posts, arrival.stamp, points)


def all_hulls(loop: Loop, states: States, laws: LawMemories) -> Float[jax.Array, "N r d"]:
    """Return the points in whose hulls the positions of all agents stay."""

    def of(law: Law, states: States, memory: Memory) -> jax.Array:
        hulls = jax.vmap(lambda x, own: KeepsApart.of(law).hull(loop.model, x, own))(states, memory)
        assert hulls is not None, "a law with `safety` has hulls"
        return hulls

    pairs = zip(loop.laws.groups, laws, strict=True)
    return loop.laws.ordered(*(of(law, states[agents], own) for (law, agents), own in pairs))


def _pairs(agents: int) -> tuple[Array, Array]:
    """Return receivers and senders of all pairs, by receiver."""
    receivers, senders = np.nonzero(~np.eye(agents, dtype=bool))
    return receivers, senders
