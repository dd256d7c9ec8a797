"""Bounds in exact rational arithmetic: rounding in a stated direction, roots, and bisection.

The verifier has its own implementation, to be independent of the synthesis.
"""

import math
from collections.abc import Callable
from fractions import Fraction
from typing import TypeVar

from echelon_ranges import ELEMENTARY, point

_FINE = 1 << 64
_ZERO = Fraction(0)

_Real = TypeVar("_Real", float, Fraction)


def float_below(x: Fraction) -> float:
    """Return the largest float that is not above x."""
    return point(x).floats()[0]


def float_above(x: Fraction) -> float:
    """Return the smallest float that is not below x."""
    return point(x).floats()[1]


def round_up(x: Fraction) -> Fraction:
    """Return a short rational that is not below x, and at most 2^-64 above it."""
    return Fraction(math.ceil(x * _FINE), _FINE)


def root_bounds(x: Fraction | int) -> tuple[Fraction, Fraction]:
    """Return short rationals below and above the root of x >= 0; both are equal if it is short."""
    root = ELEMENTARY["sqrt"].range(point(x))
    return root.lo, root.hi


def norm_above(first: Fraction, *others: Fraction) -> Fraction:
    """Return a short rational that is not below the Euclidean norm of numbers >= 0."""
    if not any(others):
        return round_up(first)
    return round_up(root_bounds(sum((x * x for x in others), first * first))[1])


def bisect(holds: Callable[[_Real], bool], low: _Real, high: _Real, halvings: int) -> _Real:
    """Return a number near the border where `holds`, which is true at `low`, becomes false."""
    for _ in range(halvings):
        middle = (low + high) / 2
        low, high = (middle, high) if holds(middle) else (low, middle)
    return low
