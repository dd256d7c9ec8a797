"""Polygons around curves: (x, x^2, ...) on an interval and (cos, sin, cos 2, ...) on an arc.

A polynomial curve lies in the hull of its Bezier control points, and so does a curve of waves of
degree d on an arc below 180 degrees, written as a form of degree 2 d in the half-angle's direction
and divided by the form of the constant 1, whose coefficients are positive there. An arc's ends are
rational points of the circle just outside of its own, so that every control point is an exact
rational. Cut in two, an arc of degree 1 gives the trapezoid between chord and three tangents.
"""

from collections.abc import Iterable
from fractions import Fraction
from functools import lru_cache
from math import comb, gcd, lcm
from typing import TypeAlias

from echelon.core.enclosure.interval import Interval, circle, pi

Gaussian: TypeAlias = tuple[int, int]
"""A direction in the plane, as a complex integer."""

# Ends of an arc are turned outward by 2^-60, more than the rounding of 2^-64 of a direction.
_UNIT = 1 << 64
_TILT = 1 << 60
_FAR = 1 << 199  # rad; beyond it `circle` cannot locate an angle
# At half the angles a full turn is half a turn, here in four pieces.
_FULL: list[Gaussian] = [(1, 0), (1, 1), (0, 1), (-1, 1), (-1, 0)]


def power_points(interval: Interval, powers: Iterable[int]) -> list[dict[int, Fraction]]:
    """Return points whose hull contains (x^k for k in powers), x in the interval."""
    exponents = sorted(powers)
    if len(exponents) == 1:
        # A single power has a range, which is tighter than the control points of its curve.
        reached = interval.power(exponents[0])
        return [{exponents[0]: end} for end in (reached.lo, reached.hi)]
    degree = exponents[-1]
    lo, hi = interval.lo, interval.hi
    return [
        {
            k: sum(
                (
                    # The polar form of x^k at i times hi and degree - i times lo.
                    Fraction(comb(i, m) * comb(degree - i, k - m), comb(degree, k))
                    * hi**m
                    * lo ** (k - m)
                    for m in range(max(0, k - degree + i), min(i, k) + 1)
                ),
                Fraction(0),
            )
            for k in exponents
        }
        for i in range(degree + 1)
    ]


def common_unit(frequencies: Iterable[Fraction]) -> Fraction:
    """Return the largest rational of which all frequencies are integer multiples."""
    rationals = list(frequencies)
    denominator = lcm(*(w.denominator for w in rationals))
    return Fraction(gcd(*(int(w * denominator) for w in rationals)), denominator)


def wave_points(arc: Interval, orders: Iterable[int]) -> list[dict[tuple[int, int], Fraction]]:
    """Return points whose hull contains (cos k t, sin k t for k in orders), t in the arc (rad).

    Keys are (k, 0) for cos and (k, 1) for sin.
    """
    degrees = sorted(orders)
    degree = degrees[-1]
    cuts = _cuts(arc)
    closed = cuts == _FULL
    result = []
    for number, (a, b) in enumerate(zip(cuts, cuts[1:], strict=False)):
        first = 0 if number == 0 and not closed else 1
        last = 2 * degree if number == len(cuts) - 2 and not closed else 2 * degree - 1
        # Where two pieces meet, the curve's tangent runs between the neighbouring control points.
        result += [_control_point(a, b, degree, i, degrees) for i in range(first, last + 1)]
    return result


def _cuts(arc: Interval) -> list[Gaussian]:
    """Return directions at half the angles of the start, the cuts and the end of an arc.

    Two pieces below 180 degrees, four above; the full circle if the ends nearly meet.
    """
    start, end = arc.lo / 2, arc.hi / 2
    if end - start >= pi().lo - Fraction(1, 1 << 40) or max(abs(start), abs(end)) > _FAR:
        return _FULL
    # Each piece is below 90 degrees: towards 180 the end tangents intersect ever farther away.
    pieces = 2 if end - start < pi().lo / 2 else 4
    between = [start + (end - start) * Fraction(k, pieces) for k in range(1, pieces)]
    return [_direction(start, -1), *(_direction(a, 0) for a in between), _direction(end, 1)]


def _direction(angle: Fraction, turn: int) -> Gaussian:
    """Return a direction at most 2^-59 rad below (-1), near (0) or above (1) an angle.

    Rounding moves the direction by less than 2^-63, the turn by arctan 2^-60.
    """
    # Exact, with short fractions.
    if angle == 0:
        return 1, 0
    cosine, sine = circle(angle)
    c, s = round(cosine.lo * _UNIT), round(sine.lo * _UNIT)
    return c * _TILT - turn * s, s * _TILT + turn * c


def _times(a: Gaussian, b: Gaussian) -> Gaussian:
    return a[0] * b[0] - a[1] * b[1], a[0] * b[1] + a[1] * b[0]


# Every control point of an arc takes powers of the same few directions.
@lru_cache(maxsize=4096)
def _power(a: Gaussian, k: int) -> Gaussian:
    return (1, 0) if k == 0 else _times(a, _power(a, k - 1))


def _form(a: Gaussian, b: Gaussian, degree: int, i: int, k: int) -> tuple[Fraction, Fraction]:
    """Return the polar form of z^(d + k) conj(z)^(d - k) at 2 d - i times a and i times b."""
    real, imaginary = Fraction(0), Fraction(0)
    bar_a, bar_b, plain = (a[0], -a[1]), (b[0], -b[1]), degree + k
    for m in range(max(0, plain - 2 * degree + i), min(i, plain) + 1):
        # The polar form averages over which of the arguments go to z, m of them b.
        weight = Fraction(comb(i, m) * comb(2 * degree - i, plain - m), comb(2 * degree, plain))
        one = _times(_power(b, m), _power(a, plain - m))
        other = _times(_power(bar_b, i - m), _power(bar_a, 2 * degree - i - plain + m))
        product = _times(one, other)
        real, imaginary = real + weight * product[0], imaginary + weight * product[1]
    return real, imaginary


def _control_point(
    a: Gaussian, b: Gaussian, degree: int, i: int, orders: list[int]
) -> dict[tuple[int, int], Fraction]:
    """Return control point i of the waves on the arc from twice the angle of a to that of b."""
    weight = _form(a, b, degree, i, 0)[0]
    assert weight > 0, "an arc's piece must be shorter than 180 degrees"
    result = {}
    for k in orders:
        real, imaginary = _form(a, b, degree, i, k)
        result[k, 0], result[k, 1] = real / weight, imaginary / weight
    return result
