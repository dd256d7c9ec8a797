"""Which blocks of agents read neighbours that follow each other in memory."""

import numpy as np

from echelon.core.types import Array
from echelon.simulation.codegen import SHIFTED

_MOSTLY = 0.75
"""The share of blocks with contiguous neighbours from which on a row-major mirror is faster, and of
blocks with the same shifts for which code is written."""
_MOST_SHIFTS = 6
"""Slots that are written one by one: an agent of a grid has four."""


def contiguous_blocks(starts: Array, positions: Array, leaders: int = 0) -> tuple[Array, bool]:
    """Return which blocks have contiguous neighbours in all slots, and whether row-major is faster.

    If it is not, return which blocks have no leader among their neighbours, of so many positions.
    """
    block = np.repeat(np.arange(len(starts) - 1), np.diff(starts))

    def all_(slots: Array) -> Array:
        return np.bincount(block, ~slots, len(starts) - 1) == 0

    contiguous = all_(np.logical_and(follow(positions), positions[:, 0] >= leaders))
    # To gather a number lane by lane costs several times as much as to load contiguous ones.
    if contiguous.mean() > _MOSTLY:
        return contiguous, True
    return all_(np.asarray((positions >= leaders).all(axis=1))), False


def mark_shifted(starts: Array, positions: Array, contiguous: Array) -> tuple[int, ...]:
    """Return how many positions the neighbours of most blocks are away; mark those `SHIFTED`.

    There are none if blocks differ, or have many slots. The arguments are those of
    `contiguous_blocks`, and its result as whole numbers.
    """
    sizes, lanes = np.diff(starts), positions.shape[1]
    size = int(np.bincount(sizes[contiguous > 0]).argmax()) if contiguous.any() else 0
    if not 0 < size <= _MOST_SHIFTS:
        return ()
    some = np.flatnonzero((contiguous > 0) & (sizes == size))
    first = positions[starts[some][:, None] + np.arange(size), 0]
    kinds, kind, counts = np.unique(
        first - some[:, None] * lanes, axis=0, return_inverse=True, return_counts=True
    )
    most = counts.argmax()
    if counts[most] < _MOSTLY * len(contiguous):
        return ()
    contiguous[some[kind.reshape(-1) == most]] = SHIFTED
    return tuple(kinds[most].tolist())


def follow(positions: Array) -> Array:
    """Return which of some lists of positions (..., lanes) are consecutive numbers."""
    return (np.diff(positions, axis=-1) == 1).all(axis=-1)
