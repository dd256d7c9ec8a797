"""What neighbours read of agents, at a moment of a run."""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from echelon.core.types import Array
from echelon.simulation.step.loop import Loop, Moment
from echelon.simulation.step.sequence import signals


def offsets_of(loops: Sequence[Loop], dtype: np.dtype) -> Float[Array, "N n"]:
    """Return the goals' offsets of all agents, loop by loop."""
    # Runs that differ only in their initial states share one loop, and are often thousands.
    distinct = {id(loop): loop for loop in loops}
    offsets = {k: np.asarray(loop.offsets, dtype) for k, loop in distinct.items()}
    if len(offsets) == 1:
        return np.tile(offsets[id(loops[0])], (len(loops), 1))
    return np.concatenate([offsets[id(loop)] for loop in loops])


def mirror_values(
    loops: Sequence[Loop],
    now: Moment,
    x: Float[Array, "N n"],
    offsets: Float[Array, "N n"],
    with_signals: bool,
) -> Float[Array, "N k"]:
    """Return what neighbours read of all agents.

    Args:
        loops: of formations one after the other, with the same number of agents each.
        now: the moment.
        x: the states at that moment.
        offsets: of their goals.
        with_signals: whether they also send signals.
    """
    relative = x - offsets
    if not with_signals:
        return relative
    counts = [len(loops[0].offsets), len(loops[0].leaders), len(loops[0].followers)]
    sent = list[Array]()
    for k, loop in enumerate(loops):
        all_, leaders, others = (slice(k * count, (k + 1) * count) for count in counts)
        mine = now._replace(
            states=now.states[all_],
            leader_memory=jax.tree.map(lambda leaf, some=leaders: leaf[some], now.leader_memory),
            follower_memory=jax.tree.map(lambda leaf, some=others: leaf[some], now.follower_memory),
        )
        sent.append(np.asarray(signals(loop, mine, jnp.asarray(offsets[all_]))))
    return np.concatenate([relative, np.concatenate(sent)], axis=1)
