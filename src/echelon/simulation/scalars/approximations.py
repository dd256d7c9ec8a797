"""Polynomials for elementary functions, and constants for argument reduction.

They are Taylor polynomials, economized by Chebyshev's: the highest power is replaced by the best
approximation by lower powers on the interval, with an error of 2^(1-2k) of it for degree k.
"""

import functools
import math
from collections.abc import Callable, Sequence
from fractions import Fraction

import numpy as np

from echelon.simulation.scalars.scalar_graph import Node

EPS = {64: 2.0**-53, 32: 2.0**-24}
TINY = {64: 2.0**-1022, 32: 2.0**-126}
"""The least numbers that are not denormal."""
_PARTS = {64: (33, 53), 32: (11, 11, 24)}
"""Bits of the parts of pi/2 and ln 2: products with whole numbers of 20 or 13 bits are exact."""


def _shifted_chebyshev(degree: int, width: Fraction) -> list[Fraction]:
    """Return the coefficients of T_k(2 s / width - 1), lowest first."""
    before, now = [Fraction(1)], [Fraction(-1), 2 / width]
    for _ in range(degree - 1):
        # T_k+1 = 2 y T_k - T_k-1 with y = 2 s / width - 1.
        up = [Fraction(0), *(4 / width * c for c in now)]
        same = [-2 * c for c in now] + [Fraction(0)]
        old = [*before, *[Fraction(0)] * (len(up) - len(before))]
        before, now = now, [a + b - c for a, b, c in zip(up, same, old, strict=True)]
    return now if degree else before


@functools.cache
def economized(series: Callable[[int], Fraction], width: float, tolerance: float) -> list[float]:
    """Return coefficients, lowest first, with an error below a tolerance for s in [0, width].

    `series(k)` is the Taylor coefficient of s^k.
    """
    end, rest, count = Fraction(width), Fraction(tolerance), 1
    while abs(series(count)) * end**count > rest / 8:
        count += 1
    coefficients = [series(k) for k in range(count + 1)]
    while len(coefficients) > 2:
        # Of all polynomials with this leading coefficient, Chebyshev's is smallest.
        chebyshev = _shifted_chebyshev(len(coefficients) - 1, end)
        share = coefficients[-1] / chebyshev[-1]
        if abs(share) > rest / 2:
            break
        rest -= abs(share)
        pairs = zip(coefficients[:-1], chebyshev[:-1], strict=True)
        coefficients = [c - share * t for c, t in pairs]
    return [float(c) for c in coefficients]


def polynomial(s: Node, coefficients: Sequence[float]) -> Node:
    """Return sum_k c_k s^k, by Horner's rule."""
    result = s.graph.constant(coefficients[-1])
    for c in coefficients[-2::-1]:
        result = result * s + c
    return result


def parts_of(value: Fraction, bits: int) -> list[float]:
    """Return numbers whose sum is a value, the first ones with few bits."""
    parts, rest = list[float](), value
    for width in _PARTS[bits]:
        scale = Fraction(2) ** (width - math.frexp(float(rest))[1])
        part = Fraction(round(rest * scale)) / scale
        parts.append(float(part))
        rest -= part
    return parts


# pi by Machin's formula and ln 2 by its own series, to 200 bits.
def _arctan_inverse(x: int) -> Fraction:
    return sum((Fraction((-1) ** k, (2 * k + 1) * x ** (2 * k + 1)) for k in range(50)), Fraction())


PI = 4 * (4 * _arctan_inverse(5) - _arctan_inverse(239))
LN2 = sum((Fraction(2, (2 * k + 1) * 3 ** (2 * k + 1)) for k in range(70)), Fraction())


# Taylor coefficients of s^k, s the square of the argument, of remainders of functions after their
# first terms.
def sine_series(k: int) -> Fraction:
    """Return the k-th coefficient of the remainder of sin x / x - 1."""
    return Fraction((-1) ** (k + 1), math.factorial(2 * k + 3))


def cosine_series(k: int) -> Fraction:
    """Return the k-th coefficient of the remainder of cos x - 1 + x^2 / 2."""
    return Fraction((-1) ** k, math.factorial(2 * k + 4))


def even_series(k: int) -> Fraction:
    """Return the k-th coefficient of the remainder of the even part of e^x - 1 - x."""
    return Fraction(1, math.factorial(2 * k + 2))


def odd_series(k: int) -> Fraction:
    """Return the k-th coefficient of the remainder of the odd part of e^x - 1 - x."""
    return Fraction(1, math.factorial(2 * k + 3))


def arctangent_series(k: int) -> Fraction:
    """Return the k-th coefficient of the remainder of arctan x / x - 1."""
    return Fraction((-1) ** (k + 1), 2 * k + 3)


def logarithm_series(k: int) -> Fraction:
    """Return the k-th coefficient of the remainder of 2 artanh x / x - 2."""
    return Fraction(2, 2 * k + 3)


@functools.cache
def error_function_fits() -> tuple[list[float], list[float]]:
    """Return fits of erf(x) / x in x^2 for |x| <= 1, and of e^(x^2) erfc(x) for 1 <= x <= 6.5.

    The second is a polynomial in (x - 3) / (x + 3), of which it is almost a linear function.
    """
    from scipy.special import erf, erfcx

    nodes = np.cos(np.pi * (np.arange(200) + 0.5) / 200)
    square = 0.5 * (nodes + 1.0)
    root = np.sqrt(square)
    near = np.polynomial.Chebyshev.fit(square, erf(root) / root, 12, domain=[0.0, 1.0])
    first, last = (1.0 - 3.0) / (1.0 + 3.0), (6.5 - 3.0) / (6.5 + 3.0)
    t = 0.5 * (last - first) * (nodes + 1.0) + first
    far = np.polynomial.Chebyshev.fit(t, erfcx(3.0 * (1.0 + t) / (1.0 - t)), 22, [first, last])
    power = np.polynomial.Polynomial
    return near.convert(kind=power).coef.tolist(), far.convert(kind=power).coef.tolist()


@functools.cache
def scaled_tail_fit() -> list[float]:
    """Return a fit of e^(x^2) erfc(x) for 1 <= x <= 28, in (x - 3) / (x + 3)."""
    from scipy.special import erfcx

    first, last = (1.0 - 3.0) / (1.0 + 3.0), (28.0 - 3.0) / (28.0 + 3.0)
    nodes = np.cos(np.pi * (np.arange(200) + 0.5) / 200)
    t = 0.5 * (last - first) * (nodes + 1.0) + first
    fit = np.polynomial.Chebyshev.fit(t, erfcx(3.0 * (1.0 + t) / (1.0 - t)), 24, [first, last])
    return fit.convert(kind=np.polynomial.Polynomial).coef.tolist()
