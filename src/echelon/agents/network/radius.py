"""How far agents at given places must hear so that all of them are connected."""

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np

from echelon.core.errors import GraphError
from echelon.core.types import Array

_MOST = 2000
"""Places of which all distances are taken, 32 MB of them."""


def pairs_within(places: Array, radius: float) -> Array:
    """Return the pairs (E, 2) of places (N, 2) that are closer than a radius, in order."""
    # Imported here: random graphs alone need it.
    from scipy.spatial import KDTree

    pairs = KDTree(places).query_pairs(radius, output_type="ndarray")
    # The tree returns pairs in no promised order; sorted, a seed is one graph everywhere. One
    # number a pair sorts ten times faster than two.
    number = np.sort(pairs[:, 0] * len(places) + pairs[:, 1])
    return np.stack(np.divmod(number, len(places)), axis=1)


@contextmanager
def advising(places: Array, radius: float) -> Iterator[None]:
    """Add to the error of agents at places (N, 2) that `radius` does not connect what would."""
    try:
        yield
    except GraphError as error:
        raise GraphError(f"{str(error)[:-1]}{_advice(places, radius)}.") from error


def _advice(places: Array, radius: float) -> str:
    """Return what would connect places, as a clause.

    It is empty where they are connected, or too many to measure. The longest edge of the shortest
    spanning tree is the least radius that connects.
    """
    if len(places) > _MOST:
        return ""
    from scipy.sparse.csgraph import minimum_spanning_tree
    from scipy.spatial.distance import pdist, squareform

    least = minimum_spanning_tree(squareform(pdist(places))).max()
    if least <= radius:
        return ""
    shown = np.ceil(least * 1000.0) / 1000.0
    return f"; a `radius` of {shown:g} connects these places, and another `seed` draws others"
