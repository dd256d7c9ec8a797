"""What differs between formations that are stepped together, beside their states and offsets.

Or between one formation now and later, where somebody turns its knobs.
"""

import dataclasses
import operator
from collections.abc import Sequence
from typing import Any, final

import equinox as eqx
import jax
import numpy as np

from echelon.core.identity import digest
from echelon.core.types import Array
from echelon.simulation.step.loop import Loop


def _apart(loop: Loop) -> list[Any]:
    """Return the parts of a loop that have rows or draws of their own."""
    return [loop.offsets, loop.meter.offsets, loop.meter.spacings, loop.motion.wind]


def bare(loop: Loop) -> Loop:
    """Return a loop without what has rows or draws of its own."""
    # By hand, since `tree_at` walks the whole loop several times.
    meter = dataclasses.replace(loop.meter, offsets=None, spacings=None)
    motion = dataclasses.replace(loop.motion, wind=None)
    return dataclasses.replace(loop, offsets=None, meter=meter, motion=motion)


def is_number(leaf: Any) -> bool:
    """Tell whether a leaf of a loop is made of real numbers."""
    return isinstance(leaf, float) or (
        isinstance(leaf, np.ndarray | jax.Array) and np.issubdtype(leaf.dtype, np.floating)
    )


@final
class VaryingNumbers:
    """Numbers of loops that are alike but for them.

    Args:
        loops: of the formations, alike in their trees and in all that is no number.
        unlike: another such loop, which none of them is: where it differs others may yet come.

    Attributes:
        loop: the first.
        values: (loops, k) the numbers that differ, in the order of the tree.
        signature: a digest of what decides the program, the same for other values; None where it
            cannot be told, as of a user's class, whose methods may be others when traced again.
    """

    def __init__(self, loops: Sequence[Loop], unlike: Loop | None = None) -> None:
        """Find the numbers that differ."""
        self._take(loops[0])
        # By identity: runs that differ in their starts alone share one loop.
        distinct = list({id(loop): loop for loop in loops}.values())
        places = {id(loop): k for k, loop in enumerate(distinct)}
        others = [] if unlike is None else [unlike]
        flat = [self._flat, *(jax.tree.leaves(bare(loop)) for loop in [*distinct[1:], *others])]
        self._masks = [_differing(leaves) for leaves in zip(*flat, strict=True)]
        # At once: somebody may write to an array later, and code is made of what stands there now.
        constant = self._constant(self._flat)
        self._digest = digest(constant)
        self.signature = digest((self._tree.unflatten(constant), self._masks))
        values = np.stack([self._values(leaves) for leaves in flat[: len(distinct)]])
        self.values = values[[places[id(loop)] for loop in loops]]

    def _take(self, loop: Loop) -> None:
        self.loop = loop
        self._flat, self._tree = jax.tree.flatten(bare(loop))

    def of(self, loop: Loop) -> Array:
        """Return the numbers (k,) of a loop that is like the others."""
        return self._values(jax.tree.leaves(bare(loop)))

    def _values(self, leaves: Sequence[Any]) -> Array:
        pairs = zip(leaves, self._masks, strict=True)
        found = [np.asarray(leaf, float)[mask] for leaf, mask in pairs if mask.any()]
        return np.concatenate([np.zeros(0), *found])

    @property
    def count(self) -> int:
        """How many numbers differ."""
        return self.values.shape[1]

    def covers(self, loop: Loop) -> bool:
        """Tell whether a loop is like the first but for these numbers."""
        leaves, tree = jax.tree.flatten(bare(loop))
        same = _forms(leaves, tree) == _forms(self._flat, self._tree)
        # The bits of functions are addresses, so that they have no digest.
        return same and self._digest is not None and digest(self._constant(leaves)) == self._digest

    def turn(self, loop: Loop) -> None:
        """Take another loop that is like the first but for these numbers in its place."""
        self._take(loop)
        self.values = self._values(self._flat)[None]

    def _constant(self, leaves: Sequence[Any]) -> list[Array]:
        """Return the leaves with 0 in place of the numbers that differ."""
        constant = list[Array]()
        for leaf, mask in zip(leaves, self._masks, strict=True):
            constant.append(np.array(leaf) if mask.any() else np.asarray(leaf))
            if mask.any():
                constant[-1][mask] = 0.0
        return constant

    def leaves(self, entries: Array) -> list[Array]:
        """Return the leaves in which something differs, of these entries where it does."""
        found, at = list[Array](), 0
        for leaf, mask in zip(self._flat, self._masks, strict=True):
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
        given, pairs = iter(leaves), zip(self._flat, self._masks, strict=True)
        new = self._tree.unflatten([next(given) if m.any() else leaf for leaf, m in pairs])
        return eqx.tree_at(_apart, new, _apart(self.loop), is_leaf=lambda x: x is None)


def alike(loop: Loop, other: Loop) -> bool:
    """Tell whether two loops are alike but for what stands in their leaves."""
    return operator.eq(*(_forms(*jax.tree.flatten(bare(each))) for each in (loop, other)))


def _forms(leaves: Sequence[Any], tree: Any) -> tuple[Any, ...]:
    arrays = [np.asarray(leaf) for leaf in leaves]
    return tree, *((array.dtype, array.shape) for array in arrays)


def _differing(leaves: Sequence[Any]) -> Array:
    """Return which entries of a leaf are not the same in all loops."""
    if not is_number(leaves[0]) or len(leaves) == 1:
        return np.zeros(np.shape(leaves[0]), bool)
    stacked = np.stack([np.asarray(leaf, float) for leaf in leaves])
    return (stacked != stacked[0]).any(axis=0)
