"""What is computed once for a model and then compute, since JAX compiles for every new function."""

import dataclasses
import functools
from collections.abc import Callable, Hashable
from typing import Any, TypeVar, final

import equinox as eqx
import jax
import numpy as np

from echelon.models.model import ControlAffine

_T = TypeVar("_T")

_MOST = 256
"""Models remembered for each function: a sweep over parameters must not fill the memory."""


def once_per_model(function: Callable[[ControlAffine], _T]) -> Callable[[ControlAffine], _T]:
    """Return a function that computes once for all models of the same class and parameters.

    Models are compared by value, bit by bit, since their arrays may be changed in place and their
    identity says nothing. One that cannot be hashed is computed anew each time. What is returned is
    shared between callers, so it must be read-only.
    """

    @functools.lru_cache(_MOST)
    def compute(key: "_Key") -> _T:
        return function(key.model)

    @functools.wraps(function)
    def once(model: ControlAffine) -> _T:
        key = _Key(_identify(model), model)
        try:
            # Here, since a TypeError out of the cache could as well be the function's own.
            hash(key)
        except TypeError:
            return function(model)
        return compute(key)

    return once


@final
@dataclasses.dataclass(frozen=True)
class _Key:
    """A model, equal to another where the class and the value of every field are."""

    value: Hashable
    model: ControlAffine = dataclasses.field(compare=False)


def _identify(value: Any) -> Any:
    """Return what is equal, and hashable, for values of the same types and bits alone."""
    if isinstance(value, eqx.Module):
        fields = dataclasses.fields(value)
        return type(value), tuple(_identify(getattr(value, field.name)) for field in fields)
    # With the type, since 1, 1.0 and True are equal and are traced differently.
    if isinstance(value, tuple | list):
        return type(value), tuple(map(_identify, value))
    # Numbers by their bytes too, since 0.0 equals -0.0, and NaN not itself.
    if isinstance(value, float | complex | np.ndarray | jax.Array):
        array = np.asarray(value)
        # Those of objects would be addresses, which say nothing of what stands there.
        if not array.dtype.hasobject:
            return type(value), array.dtype.str, array.shape, array.tobytes()
    return type(value), value
