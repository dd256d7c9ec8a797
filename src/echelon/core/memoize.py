"""Results that are computed once and then held, since JAX compiles for every new function."""

import contextlib
import functools
import pickle
import sys
import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable
from typing import Generic, ParamSpec, TypeVar, final

from echelon.core import disk_cache
from echelon.core.identity import process_key

_P = ParamSpec("_P")
_R = TypeVar("_R")
_V = TypeVar("_V")

_MOST = 256
"""Results held of each function: a sweep over parameters must not fill the memory."""


@final
class BoundedCache(Generic[_V]):
    """Values by their keys, of which the least recently used is dropped when there are too many.

    Args:
        most: how many are held.
        size: of a value, such as its bytes; without it only their number counts.
        room: how much of that size is held.
    """

    def __init__(
        self, most: int, size: Callable[[_V], int] | None = None, room: int = sys.maxsize
    ) -> None:
        """Begin with none."""
        self._most, self._size, self._room = most, size, room
        self._values: OrderedDict[Hashable, _V] = OrderedDict()
        self._lock = threading.Lock()

    def __len__(self) -> int:
        return len(self._values)

    def get_or_make(self, key: Hashable | None, make: Callable[[], _V]) -> _V:
        """Return the value of a key, made where there is none; without a key it is made anew."""
        if key is not None:
            with self._lock:
                if key in self._values:
                    self._values.move_to_end(key)
                    return self._values[key]
        # Not under the lock: what takes long must not keep other threads waiting.
        value = make()
        if key is not None:
            self.put(key, value)
        return value

    def pop(self, key: Hashable) -> _V | None:
        """Return the value of a key, which is held no longer; None where there is none."""
        with self._lock:
            return self._values.pop(key, None)

    def put(self, key: Hashable, value: _V) -> None:
        """Hold a value as the latest used."""
        with self._lock:
            self._values[key] = value
            self._values.move_to_end(key)
            while len(self._values) > self._most or self.total() > self._room:
                self._values.popitem(last=False)

    def total(self) -> int:
        """Return the size of all values together."""
        # Anew each time, since what is held may grow.
        return 0 if self._size is None else sum(map(self._size, self._values.values()))


def memoize(function: Callable[_P, _R]) -> Callable[_P, _R]:
    """Return a function that computes once for all arguments of the same classes and values.

    They are compared bit by bit, since arrays may be changed in place and their identity says
    nothing. What cannot be hashed is computed for anew each time. What is returned is shared
    between callers, so it must be read-only.
    """
    name, results = f"{function.__module__}.{function.__qualname__}", BoundedCache[_R](_MOST)

    @functools.wraps(function)
    def once(*args: _P.args, **named: _P.kwargs) -> _R:
        def compute() -> _R:
            return load_or_compute(lambda: function(*args, **named), name, args, named)

        return results.get_or_make(process_key((args, named)), compute)

    return once


def load_or_compute(compute: Callable[[], _R], what: str, *values: object) -> _R:
    """Return what is computed of values, or what another process has computed of the same."""
    file = disk_cache.file_for(what, *values)
    if file is None:
        return compute()
    packed = disk_cache.read(file)
    # What cannot be read is computed again, and what cannot be written is not stored.
    if packed is not None:
        with contextlib.suppress(Exception):
            body, *buffers = pickle.loads(packed)
            return pickle.loads(body, buffers=buffers)
    result, parts = compute(), list[pickle.PickleBuffer]()
    with contextlib.suppress(Exception):
        # Arrays apart, so that they are read-only when they come back.
        body = pickle.dumps(result, 5, buffer_callback=parts.append)
        disk_cache.write_if_unchanged(file, pickle.dumps([body, *(bytes(part) for part in parts)]))
    return result
