"""What is computed once and then kept, since JAX compiles for every new function."""

import contextlib
import dataclasses
import functools
import hashlib
import pickle
from collections.abc import Callable, Hashable
from typing import Any, ParamSpec, TypeVar, final

import jax
import numpy as np

from echelon.core import disk_cache

_P = ParamSpec("_P")
_R = TypeVar("_R")

_MOST = 256
"""Answers remembered of each function: a sweep over parameters must not fill the memory."""
_LARGE = 4096
"""Bytes of an array of which a digest is remembered."""


def memoize(function: Callable[_P, _R]) -> Callable[_P, _R]:
    """Return a function that computes once for all arguments of the same classes and values.

    They are compared bit by bit, since arrays may be changed in place and their identity says
    nothing. What cannot be hashed is computed for anew each time. What is returned is shared
    between callers, so it must be read-only.
    """

    @functools.lru_cache(_MOST)
    def answer(call: "_MemoKey") -> _R:
        name = f"{function.__module__}.{function.__qualname__}"
        return load_or_compute(
            lambda: function(*call.args, **call.named), name, call.args, call.named
        )

    @functools.wraps(function)
    def once(*args: _P.args, **named: _P.kwargs) -> _R:
        call = _MemoKey(identify((args, named)), args, named)
        try:
            hash(call)
        except TypeError:
            return function(*args, **named)
        return answer(call)

    return once


def load_or_compute(make: Callable[[], _R], what: str, *values: Any) -> _R:
    """Return what is made of values, or what another process has made and kept of the same."""
    file = disk_cache.file_for(what, *values)
    if file is None:
        return make()
    packed = disk_cache.read(file)
    # What cannot be read is made again, and what cannot be written is not kept.
    if packed is not None:
        with contextlib.suppress(Exception):
            body, *buffers = pickle.loads(packed)
            return pickle.loads(body, buffers=buffers)
    made, parts = make(), list[pickle.PickleBuffer]()
    with contextlib.suppress(Exception):
        # Arrays apart, so that they are read-only when they come back.
        body = pickle.dumps(made, 5, buffer_callback=parts.append)
        disk_cache.write_if_unchanged(file, pickle.dumps([body, *(bytes(part) for part in parts)]))
    return made


@final
@dataclasses.dataclass(frozen=True)
class _MemoKey:
    """Arguments, equal to others where the class and the value of each part are."""

    value: Hashable
    args: tuple[Any, ...] = dataclasses.field(compare=False)
    named: dict[str, Any] = dataclasses.field(compare=False)


def identify(value: Any) -> Any:
    """Return what is equal, and hashable, for values of the same types and bits alone.

    What is no value of a known kind stands for itself. Where that cannot be hashed, nor can this.
    """
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        fields = dataclasses.fields(value)
        return type(value), tuple(identify(getattr(value, field.name)) for field in fields)
    if isinstance(value, tuple | list):
        return type(value), tuple(map(identify, value))
    if isinstance(value, dict):
        return dict, tuple((identify(key), identify(each)) for key, each in value.items())
    # Numbers by their bytes too, since 0.0 equals -0.0, and NaN not itself.
    if isinstance(value, float | complex | np.ndarray | jax.Array):
        array = np.asarray(value)
        # Those of objects would be addresses, which say nothing of what stands there.
        if not array.dtype.hasobject:
            return type(value), array.dtype.str, array.shape, bits_of(array)
    return type(value), value


def bits_of(array: np.ndarray) -> bytes:
    """Return the bits of an array; of a large one, such as a graph's, a digest that is held."""
    return array.tobytes() if array.nbytes < _LARGE else hashlib.sha256(array.tobytes()).digest()
