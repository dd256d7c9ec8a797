"""What agents know of all others that may come near: of the same instant, or from late messages.

Over a network each sends the points of its hull less where it expects those of the leader, which
hardly change while a message is under way. They are used until newer ones arrive.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from echelon.agents.network.channel import NEVER, InFlight
from echelon.agents.network.exchange import Near
from echelon.core.types import Array, States
from echelon.laws.law import Law, Memory
from echelon.simulation.step.knowledge import Knowledge, Mail
from echelon.simulation.step.loop import Loop, LoopState, present_at


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


def begin_sightings(loop: Loop, now: LoopState) -> NeighbourHulls | None:
    """Return the messages before the first one; None in the ideal network or without `safety`."""
    if loop.channel is None or loop.follower.safety is None:
        return None
    hulls = all_hulls(loop, now)
    links = len(_links(len(hulls))[0])
    points = jnp.zeros((links, *hulls.shape[1:]), hulls.dtype)
    stamp = jnp.full(links, NEVER, jnp.int32)
    return NeighbourHulls(loop.channel.begin(hulls, links), stamp, points)


def look_around(
    loop: Loop,
    now: LoopState,
    leads: Bool[jax.Array, " N"],
    knowledge: Knowledge | None,
    mail: Mail | None,
) -> tuple[Near | None, NeighbourHulls | None]:
    """Return what each agent knows of all others (N, N - 1, ..), and the messages after it."""
    if loop.follower.safety is None:
        return None, None
    hulls, agents = all_hulls(loop, now), len(loop.order)
    receivers, senders = _links(agents)
    here = present_at(loop, now.step)
    here = jnp.ones(agents, bool) if here is None else here
    points, known, seen = hulls[senders], here[senders], None
    if knowledge is not None and mail is not None:
        t = now.step.astype(hulls.dtype) * loop.motion.dt
        rows = hulls, knowledge.leader
        hulls = jax.vmap(lambda hull, leader: less_expected(loop, t, hull, leader))(*rows)
        sends = here & (leads | (mail.packet.stamp != NEVER))
        seen = _exchanged(loop, now, hulls, sends[senders], (receivers, senders))
        points, known = seen.points, known & (seen.stamp != NEVER)
    near = Near(hulls[receivers] - points, leads[senders], known)
    return jax.tree.map(lambda part: part.reshape(agents, agents - 1, *part.shape[1:]), near), seen


def less_expected(
    loop: Loop, t: jax.Array, hull: Float[jax.Array, "r d"], expected: Float[jax.Array, " s"]
) -> Float[jax.Array, "r d"]:
    """Return the points of a hull less those of a leader whose signal is expected somewhere."""
    there = loop.leader.expected_hull(loop.model, t, expected)
    assert there is not None, "a law with `safety` follows a leader that can be expected"
    return hull - there


def _exchanged(
    loop: Loop,
    now: LoopState,
    hulls: Float[jax.Array, "N r d"],
    sends: Bool[jax.Array, " K"],
    links: tuple[Array, Array],
) -> NeighbourHulls:
    channel, seen = loop.channel, now.world.seen
    assert channel is not None
    arrival = channel.arrivals(seen.posts, now.step, seen.stamp)
    new = arrival.new[:, None, None]
    points = jnp.where(new, seen.posts.content[arrival.slot, links[1]], seen.points)
    posts = channel.post(seen.posts, now.step, hulls, sends, *links)
    return NeighbourHulls(posts, arrival.stamp, points)


def all_hulls(loop: Loop, now: LoopState) -> Float[jax.Array, "N r d"]:
    """Return the points in whose hulls the positions of all agents stay."""

    def of(law: Law, states: States, memory: Memory) -> jax.Array | None:
        return jax.vmap(lambda x, own: law.hull(loop.model, x, own))(states, memory)

    leaders = of(loop.leader, now.states[loop.leaders], now.leader_memory)
    followers = of(loop.follower, now.states[loop.followers], now.follower_memory)
    assert leaders is not None and followers is not None, "a law with `safety` has hulls"
    return jnp.concatenate([leaders, followers])[loop.order]


def _links(agents: int) -> tuple[Array, Array]:
    """Return receivers and senders of all pairs, by receiver."""
    receivers, senders = np.nonzero(~np.eye(agents, dtype=bool))
    return receivers, senders
