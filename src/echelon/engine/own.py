"""What differs between formations that are stepped together, beside their states and offsets.

Or between one formation now and later, where somebody turns its knobs.
"""

from collections.abc import Hashable, Sequence
from typing import Any, final

import equinox as eqx
import jax
import numpy as np

from echelon.core.types import Array
from echelon.engine.loop import Loop


def _apart(loop: Loop) -> list[Any]:
    """Return the parts of a loop that have rows or draws of their own."""
    return [loop.offsets, loop.meter.offsets, loop.meter.spacings, loop.motion.wind]


def bare(loop: Loop) -> Loop:
    """Return a loop without what has rows or draws of its own."""
    return eqx.tree_at(_apart, loop, [None] * 4, is_leaf=lambda x: x is None)


def is_number(leaf: Any) -> bool:
    """Tell whether a leaf of a loop is made of real numbers."""
    return isinstance(leaf, float) or (
        isinstance(leaf, np.ndarray | jax.Array) and np.issubdtype(leaf.dtype, np.floating)
    )


@final
class Own:
    """Numbers of loops that are alike but for them.

    Args:
        loops: of the formations, alike in their trees and in all that is no number.
        unlike: another such loop, which none of them is: where it differs others may yet come.

    Attributes:
        loop: the first.
        values: (loops, k) the numbers that differ, in the order of the tree.
    """

    def __init__(self, loops: Sequence[Loop], unlike: Loop | None = None) -> None:
        """Find the numbers that differ."""
        self.loop = loops[0]
        # By identity: runs that differ in their starts alone share one loop.
        distinct = list({id(loop): loop for loop in loops}.values())
        places = {id(loop): k for k, loop in enumerate(distinct)}
        others = [] if unlike is None else [unlike]
        flat = [jax.tree.leaves(bare(loop)) for loop in [*distinct, *others]]
        self._masks = [_differing(leaves) for leaves in zip(*flat, strict=True)]
        values = np.stack([self.of(loop) for loop in distinct])
        self.values = values[[places[id(loop)] for loop in loops]]

    def of(self, loop: Loop) -> Array:
        """Return the numbers (k,) of a loop that is like the others."""
        pairs = zip(jax.tree.leaves(bare(loop)), self._masks, strict=True)
        found = [np.asarray(leaf, float)[mask] for leaf, mask in pairs if mask.any()]
        return np.concatenate([np.zeros(0), *found])

    @property
    def count(self) -> int:
        """How many numbers differ."""
        return self.values.shape[1]

    @property
    def signature(self) -> Hashable:
        """What decides the program, the same for other values; None where it cannot be told."""
        leaves, tree = jax.tree.flatten(bare(self.loop))
        fixed = (
            (np.where(mask, 0.0, leaf).tobytes() if mask.any() else np.asarray(leaf).tobytes())
            for leaf, mask in zip(leaves, self._masks, strict=True)
        )
        key = (tree, *fixed, *(mask.tobytes() for mask in self._masks))
        try:
            hash(key)
        except TypeError:
            return None
        return key

    def leaves(self, entries: Array) -> list[Array]:
        """Return the leaves in which something differs, of these entries where it does."""
        found, at = list[Array](), 0
        for leaf, mask in zip(jax.tree.leaves(bare(self.loop)), self._masks, strict=True):
            if not mask.any():
                continue
            filled = np.asarray(leaf, float).astype(object)
            filled[mask] = entries[at : at + int(mask.sum())]
            found.append(filled)
            at += int(mask.sum())
        return found

    def filled(self, leaves: Sequence[Any]) -> Loop:
        """Return the loop with these leaves in the place of those in which something differs."""
        if not leaves:
            return self.loop
        given, (old, tree) = iter(leaves), jax.tree.flatten(bare(self.loop))
        new = [next(given) if m.any() else leaf for leaf, m in zip(old, self._masks, strict=True)]
        kept = [part for part in _apart(self.loop)]
        return eqx.tree_at(_apart, tree.unflatten(new), kept, is_leaf=lambda x: x is None)


def _differing(leaves: Sequence[Any]) -> Array:
    """Return which entries of a leaf are not the same in all loops."""
    if not is_number(leaves[0]) or len(leaves) == 1:
        return np.zeros(np.shape(leaves[0]), bool)
    stacked = np.stack([np.asarray(leaf, float) for leaf in leaves])
    return (stacked != stacked[0]).any(axis=0)
