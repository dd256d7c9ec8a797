"""Which loops differ only in numbers, so that one program steps them all."""

from collections.abc import Hashable, Sequence
from typing import Any, final

import jax
import jax.numpy as jnp
import numpy as np

from echelon.core.cache import BoundedCache
from echelon.core.identity import process_key
from echelon.core.types import PyTree
from echelon.simulation.native.varying import bare, is_number
from echelon.simulation.step.loop import Loop
from echelon.simulation.step.settings import Settings

_MOST = 256
"""Kinds of loops for which it is cached which numbers they read."""


@final
class ProgramKeys:
    """Returns the keys of loops; which numbers a kind of loop reads is traced once."""

    def __init__(self) -> None:
        """Begin with an empty cache."""
        self._fixed = BoundedCache[list[bool]](_MOST)

    def of(self, loop: Loop, settings: Settings) -> Hashable:
        """Return what is equal for all loops that one program can step.

        It has the tree, all leaves that are not numbers, the times of the draws, and the numbers
        that a reference, an initial memory, the weights or the difference of two states depend on.
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
        # A loop without a digest shares its program with no other one.
        return id(loop) if kind is None or numbers is None else (kind, numbers)


def _fixed(leaves: Sequence[object], tree: Any) -> list[bool]:
    """Return which leaves must be equal in all loops."""
    numbers = [k for k, leaf in enumerate(leaves) if is_number(leaf)]

    def outside(values: list[jax.Array]) -> PyTree:
        replaced = list(leaves)
        for k, value in zip(numbers, values, strict=True):
            replaced[k] = value
        other: Loop = tree.unflatten(replaced)
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
        # A user's code may need concrete numbers: such loops share no program.
        return [True] * len(leaves)
    read = {id(v) for equation in traced.eqns for v in equation.invars} | {
        id(v) for v in traced.outvars
    }
    free = {k for k, v in zip(numbers, traced.invars, strict=True) if id(v) not in read}
    return [k not in free for k in range(len(leaves))]
