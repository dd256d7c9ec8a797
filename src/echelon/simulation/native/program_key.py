"""Which loops are alike but for numbers, so that one program steps them all."""

from collections.abc import Hashable, Sequence
from typing import Any, final

import jax
import jax.numpy as jnp
import numpy as np

from echelon.core.identity import process_key
from echelon.core.memoize import BoundedCache
from echelon.simulation.native.varying import bare, is_number
from echelon.simulation.step.loop import Loop
from echelon.simulation.step.settings import Settings

_MOST = 256
"""Kinds of loops of which it is held what they read."""


@final
class ProgramKeys:
    """Tells families apart; what a kind of loop reads of its numbers is traced once."""

    def __init__(self) -> None:
        """Begin with no kind known."""
        self._fixed = BoundedCache[list[bool]](_MOST)

    def of(self, loop: Loop, settings: Settings) -> Hashable:
        """Return what is the same for all loops that one program can step, each with own numbers.

        Their trees, all that is no number, the draws' times, and the numbers that a reference, a
        memory at its beginning, the weights or the difference of two states rest on.
        """
        leaves, tree = jax.tree.flatten(bare(loop))
        wind = loop.motion.wind
        draws = None if wind is None else (jax.tree.structure(wind), int(wind.window))
        shapes = [np.shape(leaf) if is_number(leaf) else leaf for leaf in leaves]
        kind = process_key((tree.unflatten(shapes), draws, settings))
        pairs = zip(
            leaves, self._fixed.get_or_make(kind, lambda: _fixed(leaves, tree)), strict=True
        )
        numbers = process_key([leaf for leaf, fixed in pairs if fixed])
        return id(loop) if kind is None or numbers is None else (kind, numbers)


def _fixed(leaves: Sequence[Any], tree: Any) -> list[bool]:
    """Return which leaves must be the same in all loops."""
    numbers = [k for k, leaf in enumerate(leaves) if is_number(leaf)]

    def outside(given: list[Any]) -> Any:
        whole = list(leaves)
        for k, leaf in zip(numbers, given, strict=True):
            whole[k] = leaf
        other: Loop = tree.unflatten(whole)
        n = len(other.model.state_names)
        return (
            other.leader.reference_states(other.model, jnp.zeros(1)),
            other.model.difference(jnp.ones(n), jnp.zeros(n)),
            other.leader.init(),
            other.follower.init(),
            other.exchange.weights,
        )

    try:
        traced = jax.make_jaxpr(outside)([jnp.asarray(leaves[k], float) for k in numbers]).jaxpr
    except Exception:
        # Code of anyone's that wants numbers gets them: such loops share no program.
        return [True] * len(leaves)
    read = {id(v) for each in traced.eqns for v in each.invars} | {id(v) for v in traced.outvars}
    free = {k for k, v in zip(numbers, traced.invars, strict=True) if id(v) not in read}
    return [k not in free for k in range(len(leaves))]
