"""Interval arithmetic with rational ends, and rigorous enclosures of elementary functions.

Sums and products of rationals are exact. Irrational values (a cosine, a logarithm, a root) are
enclosed by a series with a bound on its remainder, so no result depends on the accuracy of a
mathematical library.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from fractions import Fraction
from functools import lru_cache
from typing import NamedTuple

_BITS = 96  # significant bits of an end that had to be rounded
_ONE = 1 << 256  # units of the last place in 1, for sums of series


@dataclass(frozen=True)
class Interval:
    """All reals between two rationals, both included."""

    lo: Fraction
    hi: Fraction

    def __add__(self, other: "Interval") -> "Interval":
        return Interval(self.lo + other.lo, self.hi + other.hi)

    def __mul__(self, other: "Interval") -> "Interval":
        # A product is linear in each factor, so its extremes are attained at ends.
        ends = [a * b for a in (self.lo, self.hi) for b in (other.lo, other.hi)]
        return Interval(min(ends), max(ends))

    def scale(self, factor: Fraction) -> "Interval":
        """Return factor times the interval."""
        ends = self.lo * factor, self.hi * factor
        return Interval(*ends) if factor >= 0 else Interval(*ends[::-1])

    def power(self, k: int) -> "Interval":
        """Return the range of x^k for an integer k >= 1."""
        ends = sorted((self.lo**k, self.hi**k))
        crosses = k % 2 == 0 and self.lo < 0 < self.hi
        return Interval(Fraction(0) if crosses else ends[0], ends[1])

    def holds(self, x: Fraction | int) -> bool:
        """Return whether x lies in the interval."""
        return self.lo <= x <= self.hi

    def union(self, other: "Interval") -> "Interval":
        """Return the smallest interval that contains both."""
        return Interval(min(self.lo, other.lo), max(self.hi, other.hi))

    def intersect(self, other: "Interval") -> "Interval":
        """Return the common part of two enclosures of the same set."""
        return Interval(max(self.lo, other.lo), min(self.hi, other.hi))

    def floats(self) -> tuple[float, float]:
        """Return the largest float that is not above the interval, the smallest not below it."""
        return float_below(self.lo), float_above(self.hi)

    def text(self) -> str:
        """Return the ends as decimal text."""
        return f"[{_decimal(self.lo)}, {_decimal(self.hi)}]"


def _decimal(x: Fraction) -> str:
    try:
        return f"{float(x):.6g}"
    except OverflowError:
        return "-inf" if x < 0 else "inf"


def point(x: Fraction | int) -> Interval:
    """Return the interval [x, x]."""
    return Interval(Fraction(x), Fraction(x))


def _round_end(x: Fraction, up: bool) -> Fraction:
    """Return x rounded down (or up) to `_BITS` significant bits."""
    # Exact fractions would double their length with each operation.
    shift = _BITS - abs(x.numerator).bit_length() + x.denominator.bit_length()
    scale = Fraction(2) ** shift
    return (math.ceil(x * scale) if up else math.floor(x * scale)) / scale


def outward(lo: Fraction, hi: Fraction) -> Interval:
    """Return an interval around [lo, hi] whose ends are short dyadic rationals."""
    return Interval(_round_end(lo, up=False), _round_end(hi, up=True))


def float_below(x: Fraction) -> float:
    """Return the largest float that is not above x."""
    near = float(x)
    # `float` rounds to nearest, and a lower bound must not be rounded up.
    return near if Fraction(near) <= x else math.nextafter(near, -math.inf)


def float_above(x: Fraction) -> float:
    """Return the smallest float that is not below x."""
    return -float_below(-x)


def root_bounds(x: Fraction) -> tuple[Fraction, Fraction]:
    """Return short rationals below and above the root of x >= 0; both are equal if it is short."""
    bits = x.denominator.bit_length() // 2 - x.numerator.bit_length() // 2
    shift = max(0, _BITS + bits)
    square = x * (1 << (2 * shift))
    # isqrt(floor(s)) <= sqrt(s) < isqrt(floor(s)) + 1.
    low = math.isqrt(math.floor(square))
    high = low if low * low == square else low + 1
    return Fraction(low, 1 << shift), Fraction(high, 1 << shift)


def inverse(x: Interval) -> Interval:
    """Return the range of 1/x for an interval without 0."""
    return outward(1 / x.hi, 1 / x.lo)


def _arctan_of_inverse(n: int) -> Fraction:
    """Return arctan(1/n) for n >= 5 with an error below 2^-600: the terms alternate and fall."""
    return sum(
        (Fraction((-1) ** k, (2 * k + 1) * n ** (2 * k + 1)) for k in range(140)), Fraction()
    )


@lru_cache
def pi() -> Interval:
    """Return pi by Machin's formula, to 2^-319."""
    value, unit = 16 * _arctan_of_inverse(5) - 4 * _arctan_of_inverse(239), 1 << 320
    return Interval(
        Fraction(math.floor(value * unit) - 1, unit), Fraction(math.ceil(value * unit) + 1, unit)
    )


@lru_cache(maxsize=4096)
def circle(x: Fraction) -> tuple[Interval, Interval]:
    """Return enclosures, 2^-99 wide, of cos x and sin x; exact at 0.

    Of the 64 terms in fixed point (120 bits, |y| <= 4) each is off by at most 6 units of the last
    place, since the errors obey e[k+1] <= 4 e[k] / (k + 1) + 1; the remainder is below 4^64 / 64!.
    """
    if x == 0:
        return point(1), point(0)
    # The error 2^-319 of pi times the number of turns must stay far below the margin.
    turns = round(x / (2 * pi().lo))
    if abs(turns) >> 200:
        return Interval(Fraction(-1), Fraction(1)), Interval(Fraction(-1), Fraction(1))
    y = round((x - 2 * turns * pi().lo) * (1 << 120))
    totals, term = [0, 0], 1 << 120
    for k in range(64):
        totals[k % 2] += term if k % 4 < 2 else -term
        term = term * y // ((k + 1) << 120)
    # 64 terms by 6 units of 2^-120 are below 2^-111.
    margin = Fraction(1, 1 << 100)
    values = [Fraction(total, 1 << 120) for total in totals]
    cosine, sine = (
        Interval(max(v - margin, Fraction(-1)), min(v + margin, Fraction(1))) for v in values
    )
    return cosine, sine


def wave(x: Interval, sine: bool) -> Interval:
    """Return the range of cos (or of sin) on an interval, to 2^-99."""
    if x.hi - x.lo >= 2 * pi().lo:
        return Interval(Fraction(-1), Fraction(1))
    result = circle(x.lo)[sine].union(circle(x.hi)[sine])
    # Extremes lie at k pi for cos and (k + 1/2) pi for sin; fewer than eight fit, rounding
    # included.
    first = math.floor(x.lo / pi().lo) - 2
    for k in range(first, first + 8):
        place = pi().scale(k + Fraction(int(sine), 2))
        if place.lo <= x.hi and place.hi >= x.lo:
            result = result.union(point((-1) ** (k % 2)))
    return result


def _to_fixed_point(x: Fraction) -> int:
    """Return x in units of 2^-256, rounded down."""
    return math.floor(x * _ONE)


def _within(total: int, margin: Fraction) -> Interval:
    return outward(Fraction(total, _ONE) - margin, Fraction(total, _ONE) + margin)


def _exp(x: Fraction) -> Interval:
    """40 terms for |y| <= 1/2, then squarings; remainder < 2^-197, each term within 3 units."""
    if x == 0:
        return point(1)
    # 0 is a valid lower bound; the exact one would be an extremely long fraction.
    if x < -4096:
        return Interval(Fraction(0), _exp(Fraction(-4096)).hi)
    # exp x = exp(x / 2^k)^(2^k).
    halvings = max(0, math.ceil(abs(x)).bit_length() + 1)
    y, total, term = _to_fixed_point(x / 2**halvings), 0, _ONE
    for k in range(40):
        total += term
        term = term * y // ((k + 1) * _ONE)
    result = _within(total, Fraction(1, 1 << 190))
    for _ in range(halvings):
        result = outward(result.lo**2, result.hi**2)
    return result


def _log(x: Fraction) -> Interval:
    """Enclose log x as e log 2 + 2 artanh((m - 1) / (m + 1)) with x = m 2^e and m in (1/2, 2)."""
    e = x.numerator.bit_length() - x.denominator.bit_length()
    doubled = _twice_artanh(Fraction(1, 3)).scale(Fraction(e))
    m = x / Fraction(2) ** e
    total = doubled + _twice_artanh((m - 1) / (m + 1))
    return outward(total.lo, total.hi)


def _twice_artanh(z: Fraction) -> Interval:
    """For |z| <= 1/3: the remainder is below 3^-160, the error of each term at most 6 units."""
    if z == 0:
        return point(0)
    square, power, total = _to_fixed_point(z * z), _to_fixed_point(z), 0
    for k in range(80):
        total += 2 * power // (2 * k + 1)
        power = power * square // _ONE
    return _within(total, Fraction(1, 1 << 240))


def _atan(x: Fraction) -> Interval:
    """Euler's series for |x| <= 1: remainder below 2^-159, error of each term at most 6 units."""
    if x == 0:
        return point(0)
    # arctan x = +-pi/2 - arctan(1/x).
    if abs(x) > 1:
        rest, quarter = _atan(1 / x), pi().scale(Fraction(1 if x > 0 else -1, 2))
        return outward(quarter.lo - rest.hi, quarter.hi - rest.lo)
    ratio, term, total = _to_fixed_point(x * x / (1 + x * x)), _to_fixed_point(x / (1 + x * x)), 0
    for n in range(160):
        total += term
        term = term * ratio * (2 * n + 2) // ((2 * n + 3) * _ONE)
    return _within(total, Fraction(1, 1 << 150))


def _asin(x: Fraction) -> Interval:
    if abs(x) == 1:
        return pi().scale(x / 2)
    # arcsin x = arctan(x / sqrt(1 - x^2)).
    ends = sorted(x / root for root in root_bounds(1 - x * x))
    return _monotone_range(_atan)(outward(*ends))


def _tan(x: Fraction) -> Interval:
    cosine, sine = circle(x)
    result = sine * inverse(cosine)
    return outward(result.lo, result.hi)


def _sinh(x: Fraction) -> Interval:
    up, down = _exp(x), _exp(-x)
    return point(0) if x == 0 else outward((up.lo - down.hi) / 2, (up.hi - down.lo) / 2)


def _logistic(x: Fraction) -> Interval:
    return inverse(_exp(-x) + point(1))


def _tanh(x: Fraction) -> Interval:
    # tanh x = 2 / (1 + e^(-2x)) - 1.
    result = _logistic(2 * x)
    return point(0) if x == 0 else outward(2 * result.lo - 1, 2 * result.hi - 1)


def _cosh(x: Interval) -> Interval:
    sizes = sorted((abs(x.lo), abs(x.hi)))
    low = Fraction(0) if x.holds(0) else sizes[0]
    ends = [(_exp(t) + _exp(-t)).scale(Fraction(1, 2)) for t in (low, sizes[1])]
    return outward(ends[0].lo, ends[1].hi)


def _abs(x: Interval) -> Interval:
    sizes = sorted((abs(x.lo), abs(x.hi)))
    return Interval(Fraction(0) if x.holds(0) else sizes[0], sizes[1])


def _sign(x: Interval) -> Interval:
    return Interval(*(Fraction((end > 0) - (end < 0)) for end in (x.lo, x.hi)))


def _monotone_range(at: Callable[[Fraction], Interval]) -> Callable[[Interval], Interval]:
    return lambda x: Interval(at(x.lo).lo, at(x.hi).hi)


def _sqrt(x: Interval) -> Interval:
    return Interval(root_bounds(x.lo)[0], root_bounds(x.hi)[1])


def _acos(x: Interval) -> Interval:
    rest, quarter = _monotone_range(_asin)(x), pi().scale(Fraction(1, 2))
    return outward(quarter.lo - rest.hi, quarter.hi - rest.lo)


def _is_clear(x: Interval) -> bool:
    """Return whether x is bounded away from 0 (float64's pi/2 counts as 90 degrees)."""
    sizes = (abs(x.lo), abs(x.hi))
    return not x.holds(0) and min(sizes) * (1 << 40) >= max(sizes)


class Elementary(NamedTuple):
    """A real function: its range on an interval, and its domain as a test and as text."""

    range: Callable[[Interval], Interval]
    defined: Callable[[Interval], bool] = lambda x: True
    domain: str = ""


_POSITIVE = (lambda x: x.lo > 0, "must be positive")
# exp(710) overflows float64, so arguments beyond 2048 are useless.
_SHORT = (lambda x: x.hi <= 2048, "must be at most 2048")
_BOTH = (lambda x: -2048 <= x.lo and x.hi <= 2048, "must lie between -2048 and 2048")
_COSINES = (lambda x: -1 <= x.lo and x.hi <= 1, "must lie between -1 and 1")

ELEMENTARY: dict[str, Elementary] = {
    "reciprocal": Elementary(inverse, _is_clear, "must keep well away from 0"),
    "exp": Elementary(_monotone_range(_exp), *_SHORT),
    # Arithmetic is exact before the subtraction, so there is no cancellation.
    "expm1": Elementary(lambda x: _monotone_range(_exp)(x) + point(-1), *_SHORT),
    "log": Elementary(_monotone_range(_log), *_POSITIVE),
    "log1p": Elementary(
        lambda x: _monotone_range(_log)(x + point(1)), lambda x: x.lo > -1, "must be above -1"
    ),
    "sqrt": Elementary(_sqrt, lambda x: x.lo >= 0, "must not be negative"),
    "rsqrt": Elementary(lambda x: inverse(_sqrt(x)), *_POSITIVE),
    "tan": Elementary(
        _monotone_range(_tan),
        # tan is increasing between two poles, which are the zeros of cos.
        lambda x: _is_clear(wave(x, sine=False)),
        "must keep well between two odd multiples of 90 degrees",
    ),
    "asin": Elementary(_monotone_range(_asin), *_COSINES),
    "acos": Elementary(_acos, *_COSINES),
    "atan": Elementary(_monotone_range(_atan)),
    "sinh": Elementary(_monotone_range(_sinh), *_BOTH),
    "cosh": Elementary(_cosh, *_BOTH),
    "tanh": Elementary(_monotone_range(_tanh), *_BOTH),
    "logistic": Elementary(_monotone_range(_logistic), *_BOTH),
    "abs": Elementary(_abs),
    "sign": Elementary(_sign),
}
"""The functions that are enclosed, under the names of JAX's primitives (and `reciprocal`)."""
