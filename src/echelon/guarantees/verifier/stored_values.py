"""Comparison of stored values with the same values computed again, possibly on another machine.

Processors and libraries round differently, so numbers agree to six digits, and residuals of
rounding agree with each other. Words agree letter by letter.
"""

import re
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from echelon.core.types import Array
from echelon.core.words import amount
from echelon.guarantees.verifier.findings import ClaimCheck


class Digits(NamedTuple):
    """How far numbers of two machines may be apart.

    Attributes:
        same: relative difference; eigenvalues and solutions of Riccati equations differ by less.
        noise: numbers below it, or in a matrix below this fraction of its largest, are rounding.
    """

    same: float = 1e-6
    noise: float = 1e-12


_USUAL = Digits()
_NUMBER = re.compile(r"(?<![\w.])[-+]?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?")
_SHOWN = 60
"""Letters of a text that a finding shows from where it differs."""


def compare_values(
    claim: str, stored: object, value: object, digits: Digits = _USUAL
) -> Iterator[ClaimCheck]:
    """Yield a finding for each number, matrix or text of a stored value."""
    arrays = _array(stored), _array(value)
    if isinstance(stored, dict) and isinstance(value, dict):
        for key in [*value, *(key for key in stored if key not in value)]:
            name = f"{claim}.{key}" if claim else str(key)
            if key not in stored:
                yield _differs(name, "", _shown(value[key]), "it is missing")
            elif key not in value:
                # In ASCII, so that a letter that looks like another one is seen.
                yield _differs(ascii(name)[1:-1], _shown(stored[key]), "", "it is unknown")
            else:
                yield from compare_values(name, stored[key], value[key], digits)
    elif arrays[0] is not None and arrays[1] is not None:
        yield _finding(claim, stored, value, _agree(arrays[0], arrays[1], digits))
    elif isinstance(stored, list) and isinstance(value, list) and len(stored) == len(value):
        for k, pair in enumerate(zip(stored, value, strict=True)):
            yield from compare_values(f"{claim}.{k}", *pair, digits)
    else:
        yield _compare_leaf(claim, stored, value, digits)


def compare_arrays(
    claim: str, stored: Array | None, value: Array, digits: Digits = _USUAL
) -> ClaimCheck:
    """Return the finding for an array of numbers or words; NaN agrees with NaN."""
    if stored is None:
        return _differs(claim, "", _described(value), "it is missing")
    shown, same = (claim, _described(stored), _described(value)), stored.shape == value.shape
    if not (same and value.dtype.kind in "iufb" and stored.dtype.kind in "iufb"):
        fine = same and bool(np.array_equal(stored, value))
    else:
        gaps = np.isnan(np.asarray(value, float))
        theirs, ours = (np.where(gaps, 0.0, x) for x in (stored, value))
        fine = bool((gaps == np.isnan(np.asarray(stored, float))).all())
        fine = fine and (not value.size or _agree(theirs, ours, digits))
    if not fine:
        return _differs(*shown, "")
    return ClaimCheck(*shown, "recomputed", "", True)


def _described(array: Array) -> str:
    return f"{' x '.join(map(str, array.shape)) or 1} {'number' if array.size == 1 else 'numbers'}"


def _compare_leaf(claim: str, stored: object, value: object, digits: Digits) -> ClaimCheck:
    if isinstance(stored, str) and isinstance(value, str):
        fine, pairs = _same_text(stored, value), enumerate(zip(stored, value))
        at = next((k for k, (x, y) in pairs if x != y), min(len(stored), len(value)))
        shown = [ascii(text[at : at + _SHOWN])[1:-1] for text in (stored, value)]
        reason = f"from character {at} on `{shown[0]}` is stored, and computed is `{shown[1]}`"
        return _finding(claim, stored, value, fine, reason)
    if _is_number(stored) and _is_number(value):
        fine = _agree(np.array(stored, float), np.array(value, float), digits)
        return _finding(claim, stored, value, fine)
    # `True == 1` in Python, so types are compared too.
    return _finding(claim, stored, value, type(stored) is type(value) and stored == value)


def _finding(claim: str, stored: object, value: object, fine: bool, reason: str = "") -> ClaimCheck:
    if not fine:
        return _differs(claim, _shown(stored), _shown(value), reason)
    return ClaimCheck(claim, _shown(stored), _shown(value), "recomputed", "", True)


def _differs(claim: str, stored: str, value: str, reason: str) -> ClaimCheck:
    return ClaimCheck(
        claim, stored, value, "refused", reason or "the scenario gives another value", True
    )


def _shown(value: object) -> str:
    array = _array(value)
    if array is not None:
        return f"{' x '.join(map(str, array.shape))} number{'s' * (array.size != 1)}"
    if isinstance(value, dict | list):
        return amount(len(value), "value")
    if isinstance(value, str):
        return "text" if len(value) > 12 else ascii(value)[1:-1]
    return f"{value:.10g}" if isinstance(value, float) else str(value).lower()


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _array(value: object) -> Array | None:
    def plain(x: object) -> bool:
        return all(map(plain, x)) if isinstance(x, list) else _is_number(x)

    if not isinstance(value, list) or not value or not plain(value):
        return None
    try:
        return np.array(value, float)
    except ValueError:  # rows of different lengths
        return None


def _agree(stored: Array, value: Array, digits: Digits) -> bool:
    if stored.shape != value.shape:
        return False
    size = np.maximum(np.abs(stored), np.abs(value))
    # Of finite numbers alone, or beside an infinite bound every number would be rounding.
    largest = float(np.abs(np.where(np.isfinite(value), value, 0.0)).max()) if value.ndim else 1.0
    least = digits.noise * max(1.0, largest)
    with np.errstate(invalid="ignore"):
        near = np.abs(stored - value) <= digits.same * np.where(np.isfinite(size), size, 0.0)
    # Infinite bounds are equal, and have no difference.
    return bool((near | (stored == value) | (size <= least)).all())


def _same_text(stored: str, value: str) -> bool:
    """Return whether two texts agree, but for residuals of rounding in them."""
    if stored == value:
        return True
    if _NUMBER.split(stored) != _NUMBER.split(value):
        return False
    pairs = zip(_NUMBER.findall(stored), _NUMBER.findall(value), strict=True)
    return all(a == b or max(abs(float(a)), abs(float(b))) <= _USUAL.noise for a, b in pairs)
