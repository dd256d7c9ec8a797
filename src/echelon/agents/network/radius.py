"""Links between points closer than a radius, and the radius that connects all of them."""

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np

from echelon.core.errors import GraphError
from echelon.core.types import Array

_MOST = 2000
"""Largest number of points whose distances are all computed, 32 MB."""


def pairs_within(points: Array, radius: float) -> Array:
    """Return the pairs (E, 2) of points (N, 2) that are closer than a radius, in order."""
    # Imported here: only random graphs need it.
    from scipy.spatial import KDTree

    pairs = KDTree(points).query_pairs(radius, output_type="ndarray")
    # The tree guarantees no order of the pairs; sorted, a seed gives the same graph everywhere. One
    # number for each pair sorts ten times faster than two.
    number = np.sort(pairs[:, 0] * len(points) + pairs[:, 1])
    return np.stack(np.divmod(number, len(points)), axis=1)


@contextmanager
def advising(points: Array, radius: float) -> Iterator[None]:
    """Add to the error of points (N, 2) that `radius` does not connect the radius that would."""
    try:
        yield
    except GraphError as error:
        raise GraphError(f"{str(error)[:-1]}{_advice(points, radius)}.") from error


def _advice(points: Array, radius: float) -> str:
    """Return the smallest radius that connects the points, as a clause.

    It is empty where they are connected, or too many to measure. The radius is the longest edge of
    the shortest spanning tree.
    """
    if len(points) > _MOST:
        return ""
    from scipy.sparse.csgraph import minimum_spanning_tree
    from scipy.spatial.distance import pdist, squareform

    least = minimum_spanning_tree(squareform(pdist(points))).max()
    if least <= radius:
        return ""
    enough = np.ceil(least * 1000.0) / 1000.0
    return f"; a `radius` of {enough:g} connects these points, and another `seed` draws others"
