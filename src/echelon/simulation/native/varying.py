"""Numbers that differ between formations stepped in one batch, besides states and offsets.

Or between one formation now and later, if its parameters are changed during a run.
"""

import dataclasses
from collections.abc import Hashable, Sequence
from typing import Any, final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from echelon.core.cache import BoundedCache
from echelon.core.identity import digest, process_key
from echelon.core.types import Array, PyTree
from echelon.laws.law import Travels
from echelon.simulation.step.loop import Loop
from echelon.simulation.step.settings import Settings


def _separate_parts(loop: Loop) -> list[PyTree]:
    """Return the parts of a loop that have their own rows."""
    return [loop.places, loop.meter.offsets, loop.meter.spacings, loop.motion.rows]


def bare(loop: Loop) -> Loop:
    """Return a loop without the parts that have their own rows."""
    # Not by `tree_at`, which walks the whole loop several times.
    meter = dataclasses.replace(loop.meter, offsets=None, spacings=None)
    motion = dataclasses.replace(loop.motion, rows=())
    return dataclasses.replace(loop, places=None, meter=meter, motion=motion)


def is_number(leaf: object) -> bool:
    """Tell whether a leaf of a loop has real numbers."""
    return isinstance(leaf, float) or (
        isinstance(leaf, np.ndarray | jax.Array) and np.issubdtype(leaf.dtype, np.floating)
    )


def is_key(leaf: object) -> bool:
    """Tell whether a leaf of a loop is a key of random draws, whose bits have no sign."""
    return isinstance(leaf, np.ndarray | jax.Array) and np.issubdtype(
        leaf.dtype, np.unsignedinteger
    )


@final
class VaryingNumbers:
    """Numbers of loops that differ only in them, and in the keys of their draws.

    Args:
        loops: of the formations, equal in their trees and in all leaves that are not numbers.
        variant: another such loop: where it differs from the first, numbers may change later.

    Attributes:
        loop: the first.
        values: (loops, k) the numbers that differ, in the order of the tree.
        signature: a digest of what determines the program, equal for other values; None if it is
            not known: a user's class may have other methods when it is traced again.
    """

    def __init__(self, loops: Sequence[Loop], variant: Loop | None = None) -> None:
        self._take(loops[0])
        # By identity: runs that differ only in their initial states share one loop.
        distinct = list({id(loop): loop for loop in loops}.values())
        places = {id(loop): k for k, loop in enumerate(distinct)}
        others = distinct[1:] + ([] if variant is None else [variant])
        flat = [self._flat, *(jax.tree.leaves(bare(loop)) for loop in others)]
        self._masks = [_differing(leaves) for leaves in zip(*flat, strict=True)]
        # Now: somebody may write to an array later, and code is generated from its present numbers.
        plain = [0 if is_key(leaf) else leaf for leaf in self._constant(self._flat)]
        constant = self._tree.unflatten(plain)
        self.signature = digest((constant, self._masks))
        values = np.stack([self._values(leaves) for leaves in flat[: len(distinct)]])
        self.values = values[[places[id(loop)] for loop in loops]]

    def _take(self, loop: Loop) -> None:
        self.loop = loop
        self._flat, self._tree = jax.tree.flatten(bare(loop))

    def of(self, loop: Loop) -> Array:
        """Return the numbers (k,) of a loop that differs from the others only in them."""
        return self._values(jax.tree.leaves(bare(loop)))

    def _values(self, leaves: Sequence[object]) -> Array:
        pairs = zip(leaves, self._masks, strict=True)
        parts = [np.asarray(leaf, float)[mask] for leaf, mask in pairs if mask.any()]
        return np.concatenate([np.zeros(0), *parts])

    @property
    def count(self) -> int:
        """How many numbers differ."""
        return self.values.shape[1]

    def replace_loop(self, loop: Loop) -> None:
        """Replace the loop by one that differs from it only in these numbers."""
        self._take(loop)
        self.values = self._values(self._flat)[None]

    def _constant(self, leaves: Sequence[object]) -> list[Array]:
        """Return the leaves with 0 in place of the numbers that differ."""
        constant = list[Array]()
        for leaf, mask in zip(leaves, self._masks, strict=True):
            constant.append(np.array(leaf) if mask.any() else np.asarray(leaf))
            if mask.any():
                constant[-1][mask] = 0.0
        return constant

    def leaves(self, entries: Array) -> list[Array]:
        """Return the leaves in which numbers differ, with these entries in place of those."""
        leaves, at = list[Array](), 0
        for leaf, mask in zip(self._flat, self._masks, strict=True):
            if not mask.any():
                continue
            filled = np.asarray(leaf, float).astype(object)
            filled[mask] = entries[at : at + int(mask.sum())]
            leaves.append(filled)
            at += int(mask.sum())
        return leaves

    def keys_of(self, loop: Loop) -> list[Array]:
        """Return the keys of the draws of a loop."""
        return [np.asarray(leaf) for leaf in jax.tree.leaves(bare(loop)) if is_key(leaf)]

    def filled(self, leaves: Sequence[object], keys: Sequence[object]) -> Loop:
        """Return the loop with these leaves in place of those in which numbers differ, and keys."""
        if not leaves and not keys:
            return self.loop
        new_leaves, new_keys = iter(leaves), iter(keys)
        pairs = zip(self._flat, self._masks, strict=True)
        new = self._tree.unflatten(
            [
                next(new_keys) if is_key(leaf) else next(new_leaves) if m.any() else leaf
                for leaf, m in pairs
            ]
        )
        # None is an empty tree to JAX, and could not be replaced without `is_leaf`.
        return eqx.tree_at(
            _separate_parts,
            new,
            _separate_parts(self.loop),
            is_leaf=lambda x: x is None or isinstance(x, tuple) and not x,
        )


def _differing(leaves: Sequence[Any]) -> Array:
    # All other leaves are equal already: they are in the key of the program.
    if not is_number(leaves[0]) or len(leaves) == 1:
        return np.zeros(np.shape(leaves[0]), bool)
    stacked = np.stack([np.asarray(leaf, float) for leaf in leaves])
    return (stacked != stacked[0]).any(axis=0)


_MOST = 256
"""Kinds of loops for which it is cached which numbers they read."""


@final
class ProgramKeys:
    """Returns the keys of loops; which numbers a kind of loop reads is traced once."""

    def __init__(self) -> None:
        self._fixed = BoundedCache[list[bool]](_MOST)

    def of(self, loop: Loop, settings: Settings) -> Hashable:
        """Return what is equal for all loops that one program can step.

        It has the tree, all leaves that are neither numbers nor keys, and the numbers that a
        reference, an initial memory, the weights or the difference of two states depend on.
        """
        leaves, tree = jax.tree.flatten(bare(loop))
        shapes = [np.shape(x) if is_number(x) or is_key(x) else x for x in leaves]
        rows = jax.tree.map(np.shape, loop.motion.rows)
        kind = process_key((tree.unflatten(shapes), rows, settings))
        pairs = zip(
            leaves, self._fixed.get_or_make(kind, lambda: _fixed(leaves, tree)), strict=True
        )
        numbers = process_key([leaf for leaf, fixed in pairs if fixed])
        # A loop without a digest shares its program with no other one.
        return id(loop) if kind is None or numbers is None else (kind, numbers)


def _fixed(leaves: Sequence[object], tree: Any) -> list[bool]:
    numbers = [k for k, leaf in enumerate(leaves) if is_number(leaf)]

    def outside(values: list[jax.Array]) -> PyTree:
        replaced = list(leaves)
        for k, value in zip(numbers, values, strict=True):
            replaced[k] = value
        other: Loop = tree.unflatten(replaced)
        n = len(other.model.state_names)
        return (
            Travels.of(other.laws.leader).reference_states(other.model, jnp.zeros(1)),
            other.model.difference(jnp.ones(n), jnp.zeros(n)),
            other.laws.leader.init(),
            other.laws.follower.init(),
            other.graph.exchange.weights,
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
