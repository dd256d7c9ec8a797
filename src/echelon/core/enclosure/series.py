"""What a function of time and its derivatives may be on an interval, by series of intervals.

Each entry of a trace is a truncated Taylor series whose coefficients hold those at every time of
the interval (Moore, Interval Analysis, 1966). So no derivative is taken from JAX, and the cost
grows with the square of the order. Ends are whole numbers of units of 2^-90, moved outward by every
product.
"""

import functools
import math
import operator
from collections.abc import Callable, Iterator, Sequence
from fractions import Fraction
from typing import TypeAlias, final

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import JaxprEqn

from echelon.core.enclosure import rules
from echelon.core.enclosure.interval import ELEMENTARY, Interval, wave
from echelon.core.errors import GainError
from echelon.core.jaxpr import Algebra, Params, Rule, dot, entrywise, map_entries, reduction, walk
from echelon.core.numerics import precision

_BITS = 90
_UNIT = 1 << _BITS

_Ends: TypeAlias = tuple[int, int]
"""Of an interval, in units of 2^-90."""


def enclose_derivatives(
    function: Callable[[jax.Array], jax.Array], times: Sequence[Fraction], order: int
) -> Iterator[list[list[Interval]]]:
    """Yield all values of a function of time and of its derivatives, between each two times.

    They are near what they are in the middle by the mean value theorem: half the width times what
    the next derivative may be.

    Args:
        function: t () -> (k,), traceable by JAX.
        times: ascending, two or more.
        order: of the highest derivative.

    Yields:
        For each derivative from 0 on, the k intervals.

    Raises:
        GainError: the function has no enclosure there; the primitive is named.
    """
    with precision("float64"):
        closed = jax.make_jaxpr(function)(jnp.zeros(()))

    def derivatives(low: Fraction, high: Fraction, order: int) -> list[list[_Ends]]:
        t = np.empty((), object)
        t[()] = Series(((_down(low), _up(high)), *[_whole(k == 1) for k in range(1, order + 1)]))
        with precision("float64"):
            [result] = walk(closed.jaxpr, closed.consts, [t], _algebra(order))
        rows = [_lifted(entry, order).parts for entry in result.ravel()]
        return [[_scaled(row[k], math.factorial(k), 1) for row in rows] for k in range(order + 1)]

    for low, high in zip(times, times[1:], strict=False):
        there = derivatives((low + high) / 2, (low + high) / 2, order)
        all_over, half = derivatives(low, high, order + 1), _up((high - low) / 2)
        yield [
            [_near(*three, half) for three in zip(*rows, strict=True)]
            for rows in zip(there, all_over, all_over[1:], strict=False)
        ]


def _near(middle: _Ends, all_over: _Ends, slope: _Ends, half: int) -> Interval:
    """Return the values on an interval by those in its middle, of which they are no farther."""
    low, high = _sum(middle, _times((-half, half), slope))
    return _interval((max(low, all_over[0]), min(high, all_over[1])))


# ---- intervals between whole numbers of units ----------------------------------------------------


def _down(x: Fraction) -> int:
    return math.floor(x * _UNIT)


def _up(x: Fraction) -> int:
    return math.ceil(x * _UNIT)


def _ends(x: Interval) -> _Ends:
    return _down(x.lo), _up(x.hi)


def _interval(x: _Ends) -> Interval:
    return Interval(Fraction(x[0], _UNIT), Fraction(x[1], _UNIT))


def _whole(x: int) -> _Ends:
    return x * _UNIT, x * _UNIT


def _sum(a: _Ends, b: _Ends) -> _Ends:
    return a[0] + b[0], a[1] + b[1]


def _minus(a: _Ends) -> _Ends:
    return -a[1], -a[0]


def _scaled(a: _Ends, numerator: int, denominator: int) -> _Ends:
    """Return a positive share of an interval."""
    return a[0] * numerator // denominator, -(-a[1] * numerator // denominator)


def _times(a: _Ends, b: _Ends) -> _Ends:
    # A product is linear in each factor, so its extremes lie at ends.
    ends = a[0] * b[0], a[0] * b[1], a[1] * b[0], a[1] * b[1]
    return min(ends) >> _BITS, -(-max(ends) >> _BITS)


# ---- series --------------------------------------------------------------------------------------


@final
class Series:
    """Taylor's coefficients of a function of time, each an interval; the first is its value."""

    __slots__ = ("parts",)

    def __init__(self, parts: Sequence[_Ends]) -> None:
        self.parts = tuple(parts)

    @property
    def order(self) -> int:
        """Of the highest coefficient."""
        return len(self.parts) - 1

    @property
    def moves(self) -> bool:
        """Whether it is no constant."""
        return any(low or high for low, high in self.parts[1:])

    def __add__(self, other: "Series") -> "Series":
        return Series(tuple(map(_sum, self.parts, other.parts)))

    def __neg__(self) -> "Series":
        return Series(tuple(map(_minus, self.parts)))

    def __sub__(self, other: "Series") -> "Series":
        return self + (-other)

    def __mul__(self, other: "Series") -> "Series":
        return Series([_product(self.parts, other.parts, k) for k in range(len(self.parts))])


def _product(a: Sequence[_Ends], b: Sequence[_Ends], k: int, first: int = 0) -> _Ends:
    """Return coefficient k of a product, its terms from a[first] on."""
    total = 0, 0
    for i in range(first, k + 1):
        if a[i] != (0, 0):
            total = _sum(total, _times(a[i], b[k - i]))
    return total


def number(x: float | Fraction, order: int) -> Series:
    """Return a constant."""
    x = Fraction(x)
    return Series(((_down(x), _up(x)), *[(0, 0)] * order))


def _lifted(entry: Series | float, order: int) -> Series:
    return entry if isinstance(entry, Series) else number(float(entry), order)


# ---- functions -----------------------------------------------------------------------------------


def _reciprocal(x: Series) -> Series:
    """Return 1 / x: from x r = 1."""
    first, result = _applied("reciprocal", x.parts[0]), list[_Ends]()
    for k in range(x.order + 1):
        rest = _product(x.parts, [*result, (0, 0)], k, first=1)
        result.append(_minus(_times(first, rest)) if k else first)
    return Series(result)


def _whole_power(x: Series, k: int) -> Series:
    if k < 0:
        return _reciprocal(_whole_power(x, -k))
    result = number(1, x.order)
    for _ in range(k):
        result = result * x
    # A square is not negative, which a product of two intervals does not know.
    value = _ends(_interval(x.parts[0]).power(k)) if k else result.parts[0]
    return Series((value, *result.parts[1:]))


def _circle(x: Series) -> tuple[Series, Series]:
    """Return cos x and sin x: from c' = -s x' and s' = c x'."""
    c, s = ([_ends(wave(_interval(x.parts[0]), sine=sine))] for sine in (False, True))
    for k in range(1, x.order + 1):
        rotated = _minus(_integral(x, s, k))
        s.append(_integral(x, c, k))
        c.append(rotated)
    return Series(c), Series(s)


def _integral(x: Series, f: Sequence[_Ends], k: int) -> _Ends:
    """Return coefficient k of the integral of f x', of which the first k of f are known."""
    total = 0, 0
    for i in range(1, k + 1):
        total = _sum(total, _scaled(_times(x.parts[i], f[k - i]), i, k))
    return total


def _exp(x: Series) -> Series:
    result = [_applied("exp", x.parts[0])]
    for k in range(1, x.order + 1):
        result.append(_integral(x, result, k))
    return Series(result)


def _primitive(name: str, slope: Callable[[Series], Series]) -> Callable[[Series], Series]:
    """Return a function with a slope of its own: its derivative is slope(x) x'."""

    def function(x: Series) -> Series:
        first = _applied(name, x.parts[0])
        if not x.moves:
            return Series((first, *x.parts[1:]))
        f = slope(x).parts
        return Series((first, *(_integral(x, f, k) for k in range(1, x.order + 1))))

    return function


def _sqrt(x: Series) -> Series:
    """Return the root: from r r = x."""
    result = [_applied("sqrt", x.parts[0])]
    if not x.moves:
        return Series((result[0], *x.parts[1:]))
    half = _scaled(_applied("reciprocal", result[0]), 1, 2)
    for k in range(1, x.order + 1):
        # Without the two ends of the sum, which hold the coefficient that is sought.
        rest = _product([*result, (0, 0)], [*result, (0, 0)], k, first=1)
        result.append(_times(half, _sum(x.parts[k], _minus(rest))))
    return Series(result)


def _applied(name: str, ends: _Ends) -> _Ends:
    """Return the range of an elementary function.

    Raises:
        GainError: it is not defined there.
    """
    elementary, x = ELEMENTARY[name], _interval(ends)
    if not elementary.defined(x):
        raise GainError(
            f"a path takes `{name}` of what may be anything in {x.text()}, and that "
            f"{elementary.domain}."
        )
    return _ends(elementary.range(x))


def _power(x: Series, exponent: Series | int) -> Series:
    k = exponent if isinstance(exponent, Series) else number(int(exponent), x.order)
    if k.moves:
        raise GainError("a path raises to a power that varies, which has no enclosure.")
    low, high = k.parts[0]
    if low == high and not low % _UNIT:
        return _whole_power(x, low >> _BITS)
    return _exp(k * _log(x))


_log = _primitive("log", _reciprocal)
_SLOPES: dict[str, Callable[[Series], Series]] = {
    "log1p": lambda x: _reciprocal(number(1, x.order) + x),
    "atan": lambda x: _reciprocal(number(1, x.order) + x * x),
    "asin": lambda x: _reciprocal(_sqrt(number(1, x.order) - x * x)),
    "acos": lambda x: -_reciprocal(_sqrt(number(1, x.order) - x * x)),
}


def _hyperbolic(x: Series, sign: int) -> Series:
    """Return (exp x + sign exp -x) / 2."""
    up, down = _exp(x), _exp(-x)
    return number(Fraction(1, 2), x.order) * (up + number(sign, x.order) * down)


def _tangent(x: Series) -> Series:
    c, s = _circle(x)
    return s * _reciprocal(c)


def _tanh(x: Series) -> Series:
    """Return 1 - 2 / (exp 2x + 1), within -1 and 1."""
    one, two = number(1, x.order), number(2, x.order)
    result = one - two * _reciprocal(_exp(two * x) + one)
    return Series((_applied("tanh", x.parts[0]), *result.parts[1:]))


_FUNCTIONS: dict[str, Callable[[Series], Series]] = {
    **{name: _primitive(name, slope) for name, slope in _SLOPES.items()},
    "log": _log,
    "exp": _exp,
    "expm1": lambda x: _exp(x) - number(1, x.order),
    "sqrt": _sqrt,
    "rsqrt": lambda x: _reciprocal(_sqrt(x)),
    "sin": lambda x: _circle(x)[1],
    "cos": lambda x: _circle(x)[0],
    "tan": _tangent,
    "sinh": lambda x: _hyperbolic(x, -1),
    "cosh": lambda x: _hyperbolic(x, 1),
    "tanh": _tanh,
    "logistic": lambda x: _reciprocal(number(1, x.order) + _exp(-x)),
}


@functools.cache
def _algebra(order: int) -> Algebra:
    """Return the algebra of series up to an order."""

    def lift(array: np.ndarray) -> np.ndarray:
        lifted = rules.lift(array)
        if lifted.dtype != object:
            return lifted
        # Constants are polynomials of no variable.
        return map_entries(lambda p: number(p.value() or 0.0, order), lifted)

    def unknown(equation: JaxprEqn, operands: list[np.ndarray]) -> list[np.ndarray]:
        raise GainError(
            f"a path uses `{equation.primitive.name}`, of which there is no enclosure over time."
        )

    zero, one = number(0, order), number(1, order)
    functions: dict[str, Rule] = {
        **{name: entrywise(function) for name, function in _FUNCTIONS.items()},
        "div": entrywise(lambda a, b: a * _reciprocal(b)),
        "integer_pow": lambda params, x: map_entries(lambda s: _whole_power(s, params["y"]), x),
        "pow": entrywise(_power),
        "convert_element_type": _convert,
        "dot_general": dot(zero),
        "reduce_sum": reduction(operator.add, zero),
        "reduce_prod": reduction(operator.mul, one),
    }
    return Algebra(functions, lambda x: number(x, order), lift, rules.outside, unknown)


def _convert(params: Params, x: np.ndarray) -> np.ndarray:
    if np.dtype(params["new_dtype"]).kind in "biu":
        raise GainError("a path turns time into a whole number, of which there is no enclosure.")
    return x
