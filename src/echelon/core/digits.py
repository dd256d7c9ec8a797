"""Numbers as text in few digits, rounded so that a sentence states no more than is known.

What is guaranteed is written with one of two functions: `at_most` for what may not be stated too
large, such as rates, radii, margins and allowed ranges, and `at_least` for what may not be stated
too small, such as times of arrival, largest thrusts and the coupling from which on modes decay.
A slowest mode is the negative of a rate, and is written with `at_least`. `about` is for all else.
"""

import decimal
import math
from typing import Final, SupportsFloat

_KNOWN: Final = 12
"""Digits of a number that are read: what is behind them is rounding of its computation."""


def at_most(x: float, digits: int = 3) -> str:
    """Return a number with so many digits, rounded down: what is stated is not more than it."""
    return _towards(x, digits, decimal.ROUND_FLOOR)


def at_least(x: float, digits: int = 3) -> str:
    """Return a number with so many digits, rounded up: what is stated is not less than it."""
    return _towards(x, digits, decimal.ROUND_CEILING)


def about(x: complex, digits: int = 3) -> str:
    """Return a number with so many digits, to the nearest: what was set, seen or found false."""
    return f"{x:.{digits}g}"


def finite_or_none(value: SupportsFloat | None) -> float | None:
    """Return a number as a float, or None where it does not exist or is not finite."""
    return float(value) if value is not None and math.isfinite(value) else None


def _towards(x: float, digits: int, rounding: str) -> str:
    number = decimal.Decimal(f"{x:.{_KNOWN}g}")
    # So few digits are the same as a float.
    return f"{float(decimal.Context(digits, rounding).create_decimal(number)):.{digits}g}"
