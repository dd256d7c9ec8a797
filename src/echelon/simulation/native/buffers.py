"""Reused memory for large arrays: new pages from the system are slow at first use."""

import math
import sys
from typing import final

import numpy as np

from echelon.core.types import Array

_MOST, _LARGE = 16, 2**20
"""The most arrays of a pool, and their least bytes: smaller ones the system's allocator reuses."""


def _holders(owners: list[Array], k: int) -> int:
    """Return the number of references to one of some arrays, or to views of it."""
    return sys.getrefcount(owners[k])


_UNUSED = _holders([np.empty(0, np.uint8)], 0)


@final
class BufferPool:
    """Returns arrays, in the memory of earlier ones without references, if there are any.

    A large array with new pages costs more time than writing to it: a virtual machine gets them
    from its host, which clears them.
    """

    def __init__(self) -> None:
        """Begin with no memory."""
        self._owners = list[Array]()

    def empty(self, shape: tuple[int, ...], dtype: np.dtype | type) -> Array:
        """Return an array with arbitrary numbers."""
        kind, owners = np.dtype(dtype), self._owners
        size = math.prod(shape) * kind.itemsize
        if size < _LARGE:
            return np.empty(shape, kind)
        free = [k for k in range(len(owners)) if _holders(owners, k) == _UNUSED]
        fits = [k for k in free if len(owners[k]) == size]
        if not fits:
            # Free memory of other sizes is from earlier runs, and is released.
            in_use = [owner for k, owner in enumerate(owners) if k not in free][1 - _MOST :]
            self._owners, fits = [*in_use, np.empty(size, np.uint8)], [-1]
        return self._owners[fits[0]].view(kind).reshape(shape)
