"""What agents that join take over from those that are there: which turn their heading is of."""

import jax
import jax.numpy as jnp
from jaxtyping import Bool, Float

from echelon.core.types import Array
from echelon.laws.flat_law import FlatLaw
from echelon.laws.law import Law, Memory
from echelon.simulation.step.loop import Loop, LoopState


def has_angles(law: Law) -> bool:
    """Tell whether what agents send under a law has angles, which grow with every turn."""
    return isinstance(law, FlatLaw) and bool(law.ready.angles)


def beside_others(
    loop: Loop,
    now: LoopState,
    new: Bool[jax.Array, " N"],
    there: Bool[jax.Array, " N"],
    sent: Float[jax.Array, "N s"],
) -> LoopState:
    """Return the moment with the headings of new agents next to those of others.

    An angle is a number that grows with every turn, and who begins late knows none of them.

    Args:
        loop: of the run.
        now: the moment, with the new agents where they begin.
        new: who joins in this step.
        there: who was there before.
        sent: the signals of all; of those that were there the first one counts.
    """
    other = sent[jnp.argmax(there)]

    def taken(law: Law, agents: Array, memory: Memory) -> Memory:
        if not isinstance(law, FlatLaw) or not law.ready.angles:
            return memory

        def one(joins: jax.Array, own: Memory) -> Memory:
            beside = law.beside(own, other)
            return jax.tree.map(lambda *pair: jnp.where(joins, *pair), beside, own)

        return jax.vmap(one)((new & there.any())[agents], memory)

    lead = loop.leader if loop.succession is None else loop.follower
    return now._replace(
        leader_memory=taken(lead, loop.leaders, now.leader_memory),
        follower_memory=taken(loop.follower, loop.followers, now.follower_memory),
    )
