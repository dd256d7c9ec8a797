"""Texts of files of earlier formats, in which numbers of guarantees are rounded to the nearest."""

import math
import re
from collections.abc import Iterator

from echelon.core.digits import about, at_least, at_most

_NUMBER = re.compile(r"((?<![\w.])-?\d+(?:\.\d+)?(?:e[-+]\d+)?)")
_FACTORS = (1.0, -1.0, 1e3, 100.0, math.degrees(1.0))
"""Of numbers in texts: rates of modes, ms, percent, degrees."""
_LATER = ("verdict", "conditions")
_DIGITS = range(3, 7)
"""Of numbers in texts. With fewer, a count could pass for a rounded number."""


def as_rounded_now(stored: object, value: object) -> object:
    """Return what a file states of a guarantee, with its numbers in texts rounded as now.

    A number is replaced only if it is the nearest rounding of one in `value`, the guarantee as it
    is computed now; any other stays, and is refused.
    """
    exact = {factor * x for x in _numbers(value) for factor in _FACTORS}
    pairs = {
        (about(x, digits), text(x, digits))
        for x in exact
        for digits in _DIGITS
        for text in (at_most, at_least)
    }
    return _renewed(stored, value, pairs)


def _numbers(value: object) -> Iterator[float]:
    if isinstance(value, float):
        yield value
    elif isinstance(value, dict | list):
        for part in value.values() if isinstance(value, dict) else value:
            yield from _numbers(part)


def _renewed(stored: object, value: object, pairs: set[tuple[str, str]]) -> object:
    if isinstance(stored, dict) and isinstance(value, dict):
        renewed = {key: _renewed(x, value.get(key), pairs) for key, x in stored.items()}
        # What earlier formats did not state.
        later = {key: value[key] for key in _LATER if key in value and "promised" in stored}
        return later | renewed
    if isinstance(stored, list) and isinstance(value, list) and len(stored) == len(value):
        return [_renewed(*both, pairs) for both in zip(stored, value, strict=True)]
    if not (isinstance(stored, str) and isinstance(value, str)):
        return stored
    old, now = _NUMBER.split(stored), _NUMBER.split(value)
    if len(old) != len(now):
        return stored
    both = zip(old, now, strict=True)
    return "".join(b if (a, b) in pairs else a for a, b in both)
