"""Memoization: results computed once per argument values, since JAX compiles each new function."""

import contextlib
import functools
import sys
import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable
from typing import Generic, ParamSpec, TypeVar, final

from echelon.core import disk_cache
from echelon.core.identity import process_key
from echelon.core.plain_format import decode, encode

_P = ParamSpec("_P")
_R = TypeVar("_R")
_V = TypeVar("_V")

_MOST = 256
"""Results cached per function: a sweep over parameters must not fill the memory."""


@final
class BoundedCache(Generic[_V]):
    """A bounded cache that drops the least recently used value.

    Args:
        most: largest number of values.
        size: function that returns the size of a value, such as its bytes.
        room: largest total size.
    """

    def __init__(
        self, most: int, size: Callable[[_V], int] | None = None, room: int = sys.maxsize
    ) -> None:
        """Create an empty cache."""
        self._most, self._size, self._room = most, size, room
        self._values: OrderedDict[Hashable, _V] = OrderedDict()
        self._lock = threading.Lock()

    def __len__(self) -> int:
        return len(self._values)

    def get_or_make(self, key: Hashable | None, make: Callable[[], _V]) -> _V:
        """Return the value of a key, or make and store it; without a key it is always made."""
        if key is not None:
            with self._lock:
                if key in self._values:
                    self._values.move_to_end(key)
                    return self._values[key]
        # Outside the lock, since `make` may take long and other threads would wait.
        value = make()
        if key is not None:
            self.put(key, value)
        return value

    def pop(self, key: Hashable) -> _V | None:
        """Remove and return the value of a key; None if there is none."""
        with self._lock:
            return self._values.pop(key, None)

    def put(self, key: Hashable, value: _V) -> None:
        """Store a value as the most recently used one."""
        with self._lock:
            self._values[key] = value
            self._values.move_to_end(key)
            while len(self._values) > self._most or self.total() > self._room:
                self._values.popitem(last=False)

    def total(self) -> int:
        """Return the size of all values together."""
        # Recomputed each time, since stored values may grow.
        return 0 if self._size is None else sum(map(self._size, self._values.values()))


def memoize(function: Callable[_P, _R]) -> Callable[_P, _R]:
    """Return a function that computes once per argument values.

    Arguments are compared bit by bit, since arrays can be changed in place. Without a hash of its
    arguments, a result is computed each time. Results are shared between callers, so they must be
    read-only.
    """
    name, results = f"{function.__module__}.{function.__qualname__}", BoundedCache[_R](_MOST)

    @functools.wraps(function)
    def once(*args: _P.args, **named: _P.kwargs) -> _R:
        def compute() -> _R:
            return load_or_compute(lambda: function(*args, **named), name, args, named)

        return results.get_or_make(process_key((args, named)), compute)

    return once


def load_or_compute(compute: Callable[[], _R], what: str, *values: object) -> _R:
    """Return a result for some values, from the disk cache if another process computed it."""
    file = disk_cache.file_for(what, *values)
    if file is None:
        return compute()
    packed = disk_cache.read(file)
    # Any failure of the cache is harmless: the result is then computed.
    if packed is not None:
        with contextlib.suppress(Exception):
            return decode(packed)
    result = compute()
    with contextlib.suppress(Exception):
        disk_cache.write_if_unchanged(file, encode(result))
    return result
