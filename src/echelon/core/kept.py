"""What was computed is kept for as long as the process lives: pure functions of plain values."""

import dataclasses
import functools
from collections import OrderedDict
from collections.abc import Callable, Hashable, Mapping
from typing import Any, ParamSpec, TypeVar

import jax
import numpy as np

_MOST = 64
_P = ParamSpec("_P")
_R = TypeVar("_R")


def kept(function: Callable[_P, _R]) -> Callable[_P, _R]:
    """Return a pure function that remembers its last 64 answers, which nobody may change.

    Arguments are compared by value, arrays and models to the bit; where one has no value that can
    be compared, the answer is computed each time.
    """
    answers: OrderedDict[Hashable, _R] = OrderedDict()

    @functools.wraps(function)
    def remember(*args: _P.args, **kwargs: _P.kwargs) -> _R:
        try:
            # The precision decides what a traced function computes.
            key = (jax.config.jax_enable_x64, value_of(args), value_of(kwargs))  # pyright: ignore
        except TypeError:
            return function(*args, **kwargs)
        if key not in answers:
            answers[key] = function(*args, **kwargs)
        answers.move_to_end(key)
        while len(answers) > _MOST:
            answers.popitem(last=False)
        return answers[key]

    return remember


def value_of(thing: Any) -> Hashable:
    """Return what stands for a value in a comparison: equal keys are of equal values.

    Raises:
        TypeError: it holds something that cannot be compared by value.
    """
    if isinstance(thing, np.ndarray | jax.Array):
        array = np.asarray(thing)
        return (array.shape, array.dtype.str, array.tobytes())
    if isinstance(thing, Mapping):
        return tuple((key, value_of(value)) for key, value in thing.items())
    if isinstance(thing, tuple | list):
        return (type(thing), *map(value_of, thing))
    if dataclasses.is_dataclass(thing) and not isinstance(thing, type):
        fields = dataclasses.fields(thing)
        return (type(thing), *(value_of(getattr(thing, field.name)) for field in fields))
    hash(thing)
    # In hexadecimal -0.0 is not 0.0; the type keeps 1 apart from True.
    return (type(thing), thing.hex() if isinstance(thing, float) else thing)
