"""How far agents at given places must hear so that all of them are connected."""

import numpy as np
from scipy.sparse.csgraph import minimum_spanning_tree
from scipy.spatial.distance import pdist, squareform

from echelon.core.types import Array

_MOST = 2000
"""Places of which all distances are taken, 32 MB of them."""


def advise_radius(places: Array, radius: float) -> str:
    """Return what would connect places (N, 2) that hear no farther than `radius`, as a clause.

    It is empty where they are connected, or too many to measure. The longest edge of the shortest
    spanning tree is the least radius that connects.
    """
    if len(places) > _MOST:
        return ""
    least = minimum_spanning_tree(squareform(pdist(places))).max()
    if least <= radius:
        return ""
    shown = np.ceil(least * 1000.0) / 1000.0
    return f"; a `radius` of {shown:g} connects these places, and another `seed` draws others"
