"""Enclosures of a function of time and its derivatives, by interval Taylor series.

Each entry of a trace is a truncated Taylor series whose coefficients enclose those at every time of
the interval (Moore, Interval Analysis, 1966). Derivatives of JAX are not used, and the cost is
quadratic in the order. Ends are integer multiples of 2^-90, rounded outward by every product.
"""

import math
from collections.abc import Callable, Sequence
from fractions import Fraction
from typing import TypeAlias, final

from echelon.core.enclosure.interval import ELEMENTARY, Interval, wave
from echelon.core.errors import GainError

_BITS = 90
UNIT = 1 << _BITS

Ends: TypeAlias = tuple[int, int]
"""Ends of an interval in units of 2^-90."""


# ---- intervals between whole numbers of units ----------------------------------------------------


def down(x: Fraction) -> int:
    """Return a number in units, rounded down."""
    return math.floor(x * UNIT)


def up(x: Fraction) -> int:
    """Return a number in units, rounded up."""
    return math.ceil(x * UNIT)


def ends_of(x: Interval) -> Ends:
    """Return the ends of an interval, rounded outward."""
    return down(x.lo), up(x.hi)


def interval_of(x: Ends) -> Interval:
    """Return an interval from its ends."""
    return Interval(Fraction(x[0], UNIT), Fraction(x[1], UNIT))


def whole(x: int) -> Ends:
    """Return a whole number."""
    return x * UNIT, x * UNIT


def add_ends(a: Ends, b: Ends) -> Ends:
    """Return a + b."""
    return a[0] + b[0], a[1] + b[1]


def _minus(a: Ends) -> Ends:
    return -a[1], -a[0]


def scale_ends(a: Ends, numerator: int, denominator: int) -> Ends:
    """Return an interval times a positive fraction."""
    return a[0] * numerator // denominator, -(-a[1] * numerator // denominator)


def multiply_ends(a: Ends, b: Ends) -> Ends:
    """Return a b, rounded outward."""
    # A product is linear in each factor, so its extremes lie at ends.
    ends = a[0] * b[0], a[0] * b[1], a[1] * b[0], a[1] * b[1]
    return min(ends) >> _BITS, -(-max(ends) >> _BITS)


# ---- series --------------------------------------------------------------------------------------


@final
class Series:
    """Taylor coefficients of a function of time, as intervals; the first is its value."""

    __slots__ = ("parts",)

    def __init__(self, parts: Sequence[Ends]) -> None:
        self.parts = tuple(parts)

    @property
    def order(self) -> int:
        """Order of the highest coefficient."""
        return len(self.parts) - 1

    @property
    def moves(self) -> bool:
        """Whether the function varies with time."""
        return any(low or high for low, high in self.parts[1:])

    def __add__(self, other: "Series") -> "Series":
        return Series(tuple(map(add_ends, self.parts, other.parts)))

    def __neg__(self) -> "Series":
        return Series(tuple(map(_minus, self.parts)))

    def __sub__(self, other: "Series") -> "Series":
        return self + (-other)

    def __mul__(self, other: "Series") -> "Series":
        return Series([_product(self.parts, other.parts, k) for k in range(len(self.parts))])


def _product(a: Sequence[Ends], b: Sequence[Ends], k: int, first: int = 0) -> Ends:
    """Return coefficient k of a product, its terms from a[first] on."""
    total = 0, 0
    for i in range(first, k + 1):
        if a[i] != (0, 0):
            total = add_ends(total, multiply_ends(a[i], b[k - i]))
    return total


def number(x: float | Fraction, order: int) -> Series:
    """Return a constant."""
    x = Fraction(x)
    return Series(((down(x), up(x)), *[(0, 0)] * order))


def lifted(entry: Series | float, order: int) -> Series:
    """Return an entry as a series."""
    return entry if isinstance(entry, Series) else number(float(entry), order)


# ---- functions -----------------------------------------------------------------------------------


def reciprocal(x: Series) -> Series:
    """Return r = 1 / x, from x r = 1."""
    first, result = _applied("reciprocal", x.parts[0]), list[Ends]()
    for k in range(x.order + 1):
        rest = _product(x.parts, [*result, (0, 0)], k, first=1)
        result.append(_minus(multiply_ends(first, rest)) if k else first)
    return Series(result)


def whole_power(x: Series, k: int) -> Series:
    """Return x^k of a whole k."""
    if k < 0:
        return reciprocal(whole_power(x, -k))
    result = number(1, x.order)
    for _ in range(k):
        result = result * x
    # Even powers are nonnegative, which interval products do not use.
    value = ends_of(interval_of(x.parts[0]).power(k)) if k else result.parts[0]
    return Series((value, *result.parts[1:]))


def _circle(x: Series) -> tuple[Series, Series]:
    """Return c = cos x and s = sin x, from c' = -s x' and s' = c x'."""
    c, s = ([ends_of(wave(interval_of(x.parts[0]), sine=sine))] for sine in (False, True))
    for k in range(1, x.order + 1):
        rotated = _minus(_integral(x, s, k))
        s.append(_integral(x, c, k))
        c.append(rotated)
    return Series(c), Series(s)


def _integral(x: Series, f: Sequence[Ends], k: int) -> Ends:
    """Return coefficient k of the integral of f x', from the first k coefficients of f."""
    total = 0, 0
    for i in range(1, k + 1):
        total = add_ends(total, scale_ends(multiply_ends(x.parts[i], f[k - i]), i, k))
    return total


def _exp(x: Series) -> Series:
    result = [_applied("exp", x.parts[0])]
    for k in range(1, x.order + 1):
        result.append(_integral(x, result, k))
    return Series(result)


def _primitive(name: str, slope: Callable[[Series], Series]) -> Callable[[Series], Series]:
    """Return a function whose derivative is slope(x) x'."""

    def function(x: Series) -> Series:
        first = _applied(name, x.parts[0])
        if not x.moves:
            return Series((first, *x.parts[1:]))
        f = slope(x).parts
        return Series((first, *(_integral(x, f, k) for k in range(1, x.order + 1))))

    return function


def _sqrt(x: Series) -> Series:
    """Return r = sqrt x, from r r = x."""
    result = [_applied("sqrt", x.parts[0])]
    if not x.moves:
        return Series((result[0], *x.parts[1:]))
    half = scale_ends(_applied("reciprocal", result[0]), 1, 2)
    for k in range(1, x.order + 1):
        # Without the first and last term of the sum, which contain the unknown coefficient.
        rest = _product([*result, (0, 0)], [*result, (0, 0)], k, first=1)
        result.append(multiply_ends(half, add_ends(x.parts[k], _minus(rest))))
    return Series(result)


def _applied(name: str, ends: Ends) -> Ends:
    """Return the range of an elementary function.

    Raises:
        GainError: it is not defined there.
    """
    elementary, x = ELEMENTARY[name], interval_of(ends)
    if not elementary.defined(x):
        raise GainError(
            f"a path takes `{name}` of an expression in {x.text()}, which {elementary.domain}."
        )
    return ends_of(elementary.range(x))


def power(x: Series, exponent: Series | int) -> Series:
    """Return x to a constant exponent.

    Raises:
        GainError: the exponent varies.
    """
    k = exponent if isinstance(exponent, Series) else number(int(exponent), x.order)
    if k.moves:
        raise GainError("a path has an exponent that varies in time, which has no enclosure.")
    low, high = k.parts[0]
    if low == high and not low % UNIT:
        return whole_power(x, low >> _BITS)
    return _exp(k * _log(x))


_log = _primitive("log", reciprocal)
_SLOPES: dict[str, Callable[[Series], Series]] = {
    "log1p": lambda x: reciprocal(number(1, x.order) + x),
    "atan": lambda x: reciprocal(number(1, x.order) + x * x),
    "asin": lambda x: reciprocal(_sqrt(number(1, x.order) - x * x)),
    "acos": lambda x: -reciprocal(_sqrt(number(1, x.order) - x * x)),
}


def _hyperbolic(x: Series, sign: int) -> Series:
    """Return (exp x + sign exp -x) / 2."""
    up, down = _exp(x), _exp(-x)
    return number(Fraction(1, 2), x.order) * (up + number(sign, x.order) * down)


def _tangent(x: Series) -> Series:
    c, s = _circle(x)
    return s * reciprocal(c)


def _tanh(x: Series) -> Series:
    """Return 1 - 2 / (exp 2x + 1), within -1 and 1."""
    one, two = number(1, x.order), number(2, x.order)
    result = one - two * reciprocal(_exp(two * x) + one)
    return Series((_applied("tanh", x.parts[0]), *result.parts[1:]))


FUNCTIONS: dict[str, Callable[[Series], Series]] = {
    **{name: _primitive(name, slope) for name, slope in _SLOPES.items()},
    "log": _log,
    "exp": _exp,
    "expm1": lambda x: _exp(x) - number(1, x.order),
    "sqrt": _sqrt,
    "rsqrt": lambda x: reciprocal(_sqrt(x)),
    "sin": lambda x: _circle(x)[1],
    "cos": lambda x: _circle(x)[0],
    "tan": _tangent,
    "sinh": lambda x: _hyperbolic(x, -1),
    "cosh": lambda x: _hyperbolic(x, 1),
    "tanh": _tanh,
    "logistic": lambda x: reciprocal(number(1, x.order) + _exp(-x)),
    "asinh": lambda x: _log(x + _sqrt(number(1, x.order) + x * x)),
}
