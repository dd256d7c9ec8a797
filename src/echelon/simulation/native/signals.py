"""What agents show to those that hear them, at a moment of a run."""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np

from echelon.core.types import Array
from echelon.simulation.step.loop import Loop, Moment
from echelon.simulation.step.sequence import signals


def offsets_of(loops: Sequence[Loop], dtype: np.dtype) -> Array:
    """Return the goals' offsets of all agents (N, n), loop by loop."""
    # Runs that differ in their starts alone share one loop, and are often thousands.
    loops_of = {id(loop): loop for loop in loops}
    made = {k: np.asarray(loop.offsets, dtype) for k, loop in loops_of.items()}
    if len(made) == 1:
        return np.tile(made[id(loops[0])], (len(loops), 1))
    return np.concatenate([made[id(loop)] for loop in loops])


def shown_by(loops: Sequence[Loop], now: Moment, x: Array, offsets: Array, signaled: bool) -> Array:
    """Return what all agents show (N, s).

    Args:
        loops: of formations that follow each other, with as many agents each.
        now: the moment.
        x: the states of then (N, n).
        offsets: of their goals (N, n).
        signaled: whether they show signals beside their states less these.
    """
    apart = x - offsets
    if not signaled:
        return apart
    counts = [len(loops[0].offsets), len(loops[0].leaders), len(loops[0].followers)]
    found = list[Array]()
    for k, loop in enumerate(loops):
        all_, led, others = (slice(k * count, (k + 1) * count) for count in counts)
        mine = now._replace(
            states=now.states[all_],
            leader_memory=jax.tree.map(lambda leaf, led=led: leaf[led], now.leader_memory),
            follower_memory=jax.tree.map(lambda leaf, o=others: leaf[o], now.follower_memory),
        )
        found.append(np.asarray(signals(loop, mine, jnp.asarray(offsets[all_]))))
    return np.concatenate([apart, np.concatenate(found)], axis=1)
