"""Memory that is taken again and again, since what the system hands out anew is slow at first."""

import math
import sys
from typing import Any, final

import numpy as np

from echelon.core.types import Array

_MOST, _LARGE = 16, 2**20
"""Arrays whose memory is looked at again, and their bytes: smaller ones are kept by others."""


def _holders(owners: list[Array], k: int) -> int:
    """Return a number that grows with whoever holds one of some arrays, or a part of it."""
    return sys.getrefcount(owners[k])


_NOBODY = _holders([np.empty(0, np.uint8)], 0)


@final
class BufferPool:
    """Makes arrays, in memory of earlier ones that nobody holds any more where there is some.

    A large array costs more than all that is written to it where its pages are new: a virtual
    machine gets them from its host, which clears them.
    """

    def __init__(self) -> None:
        """Begin with nothing kept."""
        self._owners = list[Array]()

    def empty(self, shape: tuple[int, ...], dtype: np.dtype[Any] | type) -> Array:
        """Return an array whose numbers are anything."""
        kind, owners = np.dtype(dtype), self._owners
        size = math.prod(shape) * kind.itemsize
        if size < _LARGE:
            return np.empty(shape, kind)
        free = [k for k in range(len(owners)) if _holders(owners, k) == _NOBODY]
        fits = [k for k in free if len(owners[k]) == size]
        if not fits:
            # Others that are free are of another time, and would be kept for nothing.
            kept = [owner for k, owner in enumerate(owners) if k not in free][1 - _MOST :]
            self._owners, fits = [*kept, np.empty(size, np.uint8)], [-1]
        return self._owners[fits[0]].view(kind).reshape(shape)
