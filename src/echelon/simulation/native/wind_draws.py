"""Wind and noise for agents that native code steps, drawn for many holding intervals at once."""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np

from echelon.agents.world.disturbance import Wind, draw
from echelon.core.types import Array
from echelon.simulation.step.loop import Loop

_AHEAD, _AT_ONCE = 64, 50_000
"""Holding intervals that are drawn in a call, and the most draws; a call takes 0.5 ms."""


def holds_at_once(agents: int) -> int:
    """Return the number of holding intervals that are drawn at once."""
    return max(1, min(_AHEAD, _AT_ONCE // agents))


def draw_holds(loops: Sequence[Loop], holds: Array, hold: int) -> list[Array | None]:
    """Return what wind adds to the rates (T, F, N, n) and noise to the inputs in T intervals."""
    # Numbers beyond the end of the run may wrap: they are not used.
    steps, agents = (holds * hold).astype(np.int32), np.arange(len(loops[0].offsets))
    drawn = _drawn([loop.motion.wind for loop in loops], steps, agents)
    return [part if part is None else np.asarray(part) for part in drawn]


@jax.jit
def _drawn(
    winds: Sequence[Wind | None], steps: jax.Array, agents: jax.Array
) -> tuple[jax.Array | None, jax.Array | None]:
    """Return what each wind adds to the rates (T, F, N, n) and noise to the inputs at T steps."""
    many = jax.tree.map(lambda *leaves: jnp.stack([jnp.asarray(leaf) for leaf in leaves]), *winds)
    one = jax.vmap(draw, (None, None, 0))
    return jax.vmap(jax.vmap(one, (0, None, None)), (None, 0, None))(many, steps, agents)
