"""Who takes the lead when nobody hears of the leader any more.

Each packet of a leader has a term. A backup leader that hears of no leader for long raises the term
by one and leads along the plan, at its own offset; everybody, an old leader too, follows the packet
of the highest term. The next ones wait longer by a timeout each, so that no agent must know who is
left.
"""

import dataclasses
import math
from collections.abc import Sequence
from typing import final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from echelon.agents.network.channel import NEVER, Network
from echelon.agents.network.exchange import Exchange
from echelon.agents.network.graph import Graph
from echelon.core.errors import SimulationError, is_number
from echelon.core.types import Array, PyTree
from echelon.simulation.step.records import Clock, LeaderPackets, Mask, as_array

_NO_BACKUP = -1
_ROUNDED = 1e-9
"""s; what differences of times leave."""


@final
@dataclasses.dataclass(frozen=True)
class Leadership:
    """Who takes the lead when nobody hears of the leader any more.

    Args:
        backups: the numbers of followers, in the order in which they take over.
        timeout: s without news of a leader after which the first of them does, the second after
            twice that, and so on.

    Raises:
        SimulationError: there is no backup leader, or the timeout is not positive and finite.
    """

    backups: Sequence[int]
    timeout: float = 0.3

    def __post_init__(self) -> None:
        object.__setattr__(self, "backups", tuple(self.backups))
        if not self.backups:
            raise SimulationError("`backups` is empty, and must name at least one follower.")
        if not (is_number(self.timeout) and 0.0 < float(self.timeout) < math.inf):
            raise SimulationError(f"`timeout` is {self.timeout}, and must be positive and finite.")

    def check_network(self, network: Network | None) -> None:
        """Check that backup leaders wait longer than messages of an undisturbed network take.

        Raises:
            SimulationError: they do not.
        """
        least = 0.0 if network is None else 2.0 / network.rate + network.delay + network.jitter
        if self.timeout < least:
            raise SimulationError(
                f"`timeout` of the leadership is {self.timeout:g} s, and must be at least two "
                f"periods of the network, its delay and its jitter together, {least:g} s."
            )


NOBODY = 2**23
"""The leader of an agent that has no packet, and more hops than any agent has; one more of it is
exact in single precision."""


class FixedLeaders(eqx.Module):
    """Who leads: the leaders, always.

    Attributes:
        first: (N,) who leads at the start.
    """

    first: Array
    changes = False

    def leads(self, packet: PyTree, number: jax.Array) -> Bool[jax.Array, " N"]:
        """Return which of the agents lead that have these packets."""
        return jnp.asarray(self.first)

    def named(
        self, packet: PyTree, numbers: jax.Array, leading: Bool[Array, " K"]
    ) -> Bool[jax.Array, " K"]:
        """Return which of others lead as one agent knows it, which has the one `packet`.

        `leading` are those that lead or may.
        """
        return jnp.asarray(leading)

    def terms(self, agents: int) -> PyTree:
        """Return the terms of packets before the first one; () without terms."""
        return ()

    def elect(
        self, packet: LeaderPackets, number: jax.Array, clock: Clock, since: jax.Array, here: Mask
    ) -> LeaderPackets:
        """Return the packets after those who hear of no leader took the lead."""
        return packet

    def contest(
        self, own: LeaderPackets, others: LeaderPackets, valid: jax.Array, links: Exchange
    ) -> tuple[PyTree, jax.Array, jax.Array]:
        """Return the terms, which of others' packets count (K,), and whom each follows so far."""
        return (), valid, own.leader

    def no_packets(self, number: jax.Array, content: Float[jax.Array, "N p"]) -> LeaderPackets:
        """Return the packets before the first one, with an example of their content."""
        leader = jnp.where(jnp.asarray(self.first), number, NOBODY).astype(jnp.int32)
        never = jnp.full(len(leader), NEVER, jnp.int32)
        return LeaderPackets(leader, never, content, self.terms(len(leader)))

    def newest(
        self, own: LeaderPackets, others: LeaderPackets, new: jax.Array, links: Exchange
    ) -> LeaderPackets:
        """Return the packet of each agent: of the leader with the lowest number, the newest one.

        Of several terms the highest counts.

        Args:
            own: of the agents.
            others: (K, ...) that messages contain.
            new: (K,) which of these arrived.
            links: along which they came.
        """
        count, receivers = len(own.stamp), jnp.asarray(links.receivers)
        if not len(receivers):
            return own
        valid = new & (others.stamp != NEVER)
        term, valid, current = self.contest(own, others, valid, links)
        leaders = jnp.where(valid, others.leader, NOBODY)
        leader = jnp.minimum(current, links.least(leaders, count))
        of_it = valid & (leaders == leader[receivers])
        last = jnp.where(current == leader, own.stamp, NEVER)
        stamp = links.most(jnp.where(of_it, others.stamp, NEVER), count)
        stamp = jnp.maximum(last, stamp)
        latest = of_it & (others.stamp == stamp[receivers])
        places = jnp.where(latest, jnp.arange(len(receivers)), -1)
        place = links.most(places, count)
        better = (place >= 0) & (stamp > last)
        content = jnp.where(better[:, None], others.content[place], own.content)
        return LeaderPackets(leader, stamp, content, term)


@final
class Failover(FixedLeaders):
    """Who leads: whom the packet of the highest term names. Backup leaders take the lead in turn.

    Attributes:
        rank: (N,) the place of each agent among the backup leaders; -1 of no backup leader.
        timeout: s.
    """

    rank: Array
    timeout: Array
    changes = True

    def leads(self, packet: PyTree, number: jax.Array) -> Bool[jax.Array, " N"]:
        """Return which of the agents lead that have these packets."""
        return packet.leader == number

    def named(
        self, packet: PyTree, numbers: jax.Array, leading: Bool[Array, " K"]
    ) -> Bool[jax.Array, " K"]:
        """Return which of others lead as one agent knows it: whom its packet names."""
        return packet.leader == numbers

    def terms(self, agents: int) -> PyTree:
        """Return the terms of packets before the first one."""
        return jnp.zeros(agents, jnp.int32)

    def elect(
        self, packet: LeaderPackets, number: jax.Array, clock: Clock, since: jax.Array, here: Mask
    ) -> LeaderPackets:
        """Return the packets after those who hear of no leader took the lead."""
        waited = jnp.minimum(clock.age(packet.stamp), clock.waited(since))
        silent = self.silent(number, packet.leader, waited)
        silent = silent & as_array(here, len(number))
        leader = jnp.where(silent, number, packet.leader)
        stamp = jnp.where(silent, clock.now, packet.stamp)
        return packet._replace(leader=leader, stamp=stamp, term=packet.term + silent)

    def contest(
        self, own: LeaderPackets, others: LeaderPackets, valid: jax.Array, links: Exchange
    ) -> tuple[PyTree, jax.Array, jax.Array]:
        """Return the terms, which of others' packets count (K,), and whom each follows so far."""
        terms = jnp.where(valid, others.term, 0)
        term = jnp.maximum(own.term, links.most(terms, len(own.stamp)))
        valid = valid & (others.term == term[jnp.asarray(links.receivers)])
        # Whoever led in an earlier term does so no more.
        return term, valid, jnp.where(own.term == term, own.leader, NOBODY)

    def silent(
        self,
        number: Int[jax.Array, " K"] | Array,
        leader: Int[jax.Array, " K"] | Array,
        waited: Float[jax.Array, " K"] | Array,
    ) -> Bool[jax.Array, " K"]:
        """Return which of `number` take the lead, having `waited` (s) for whom they follow."""
        rank = jnp.asarray(self.rank)[number]
        # Beyond rounding, so that all see the same step.
        late = jnp.asarray(waited) > jnp.asarray(self.timeout) * (rank + 1) + _ROUNDED
        return (rank != _NO_BACKUP) & (jnp.asarray(leader) != number) & late


def announced(
    leadership: FixedLeaders,
    packet: LeaderPackets,
    leaders: Array,
    leads: jax.Array,
    here: Mask,
    clock: Clock,
    content: Float[jax.Array, "L k"],
) -> LeaderPackets:
    """Return the packets of N agents after those that lead reach everybody with theirs.

    Args:
        leadership: of the formation.
        packet: of the agents.
        leaders: the numbers of those that may lead.
        leads: (N,) who does.
        here: who is there: all others neither send nor receive.
        clock: of the step.
        content: of the packets of those that may lead.
    """
    agents, number = len(packet.stamp), jnp.asarray(leaders)
    here = as_array(here, agents)
    leads = leads & here
    stamp = jnp.full(len(number), clock.now, jnp.int32)
    own = LeaderPackets(packet.leader[number], stamp, content, packet.term[number])
    each = jax.tree.map(lambda part: jnp.repeat(part, agents, axis=0), own)
    receivers = jnp.tile(jnp.arange(agents), len(number))
    new = jnp.repeat(leads[number], agents) & here[receivers]
    everywhere = Exchange(receivers, receivers, jnp.zeros(0))
    return leadership.newest(packet, each, new, everywhere)


def leaders_of(graph: Graph, leadership: Leadership | None) -> FixedLeaders:
    """Return who leads in a run."""
    first = np.isin(np.arange(graph.agents), graph.leaders)
    if leadership is None:
        return FixedLeaders(first)
    rank = np.full(graph.agents, _NO_BACKUP, np.int32)
    rank[list(leadership.backups)] = np.arange(len(leadership.backups))
    return Failover(first, rank, np.asarray(float(leadership.timeout)))
