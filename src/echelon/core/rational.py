"""Bounds in exact rational arithmetic: rounding in a stated direction, roots, and bisection.

The verifier has its own implementation, to be independent of the synthesis.
"""

import math
from collections.abc import Callable
from fractions import Fraction
from typing import TypeVar

_ROOT_BITS = 96  # significant bits of a root that is irrational
_FINE = 1 << 64
_ZERO = Fraction(0)

_Real = TypeVar("_Real", float, Fraction)


def float_below(x: Fraction) -> float:
    """Return the largest float that is not above x."""
    near = float(x)
    # `float` rounds to nearest, and a lower bound must not be rounded up.
    return near if Fraction(near) <= x else math.nextafter(near, -math.inf)


def float_above(x: Fraction) -> float:
    """Return the smallest float that is not below x."""
    return -float_below(-x)


def round_up(x: Fraction) -> Fraction:
    """Return a short rational that is not below x, and at most 2^-64 above it."""
    return Fraction(math.ceil(x * _FINE), _FINE)


def root_bounds(x: Fraction | int) -> tuple[Fraction, Fraction]:
    """Return short rationals below and above the root of x >= 0; both are equal if it is short."""
    x = Fraction(x)
    bits = x.denominator.bit_length() // 2 - x.numerator.bit_length() // 2
    shift = max(0, _ROOT_BITS + bits)
    square = x * (1 << (2 * shift))
    # isqrt(floor(s)) <= sqrt(s) < isqrt(floor(s)) + 1.
    low = math.isqrt(math.floor(square))
    high = low if low * low == square else low + 1
    return Fraction(low, 1 << shift), Fraction(high, 1 << shift)


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
