"""Enclosures of a function of time and its derivatives, by interval Taylor series."""

import functools
import math
import operator
from collections.abc import Callable, Iterator, Sequence
from fractions import Fraction
from typing import NamedTuple, TypeAlias, final

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import JaxprEqn

from echelon_ranges import rules
from echelon_ranges.errors import RangeError
from echelon_ranges.interval import ELEMENTARY, Interval, pi, wave
from echelon_ranges.jaxpr import (
    Algebra,
    Params,
    Rule,
    dot,
    entrywise,
    float64,
    map_entries,
    reduction,
    walk,
)

# ---- series --------------------------------------------------------------------------------------
# Each entry of a trace is a truncated Taylor series whose coefficients enclose those at every time
# of the interval (Moore, Interval Analysis, 1966). Derivatives of JAX are not used, and the cost is
# quadratic in the order. Ends are integer multiples of 2^-90, rounded outward by every product.

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
    elementary, x = ELEMENTARY[name], interval_of(ends)
    if not elementary.defined(x):
        raise RangeError(
            f"a path takes `{name}` of an expression in {x.text()}, which {elementary.domain}."
        )
    return ends_of(elementary.range(x))


def power(x: Series, exponent: Series | int) -> Series:
    """Return x to a constant exponent; raise `RangeError` if it varies."""
    k = exponent if isinstance(exponent, Series) else number(int(exponent), x.order)
    if k.moves:
        raise RangeError("a path has an exponent that varies in time, which has no enclosure.")
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


# ---- branches ------------------------------------------------------------------------------------
# On an interval that is all on one branch each is smooth. At a common end of two intervals both are
# on the same branch, since an edge belongs to one alone: intervals in a row that are each on one
# branch are all on the same.


def _side(x: Series, name: str, edge: bool = True) -> bool:
    """Return whether x >= 0, or x > 0 without the edge; raise where it changes on the interval."""
    low, high = x.parts[0]
    if low >= 0 if edge else low > 0:
        return True
    if high < 0 if edge else high <= 0:
        return False
    raise _changes(name)


def _changes(name: str) -> RangeError:
    what = f"`{name}`{_WRITTEN.get(name, '')}"
    return RangeError(f"a path uses {what}, and passes from one branch of it to another.")


_WRITTEN = {"rem": " (of `%` or `mod`)", "ne": " (of `//`, `%` or a comparison)"}
"""How somebody wrote a primitive, where its name does not say it."""


def _compared(name: str, swap: bool, edge: bool) -> Rule:
    """Return the rule of an inequality, a - b >= 0 or > 0, or of b - a."""

    def compare(order: int, a: Series | float, b: Series | float) -> bool:
        a, b = lifted(a, order), lifted(b, order)
        return _side(b - a if swap else a - b, name, edge)

    return lambda params, a, b: _truths(compare, a, b)


def _equal(name: str, equal: bool) -> Rule:
    def compare(order: int, a: Series | float, b: Series | float) -> bool:
        low, high = (lifted(a, order) - lifted(b, order)).parts[0]
        # As JAX's own functions look for NaN, and compare signs.
        if a is b or low == high == 0:
            return equal
        if low <= 0 <= high:
            raise _changes(name)
        return not equal

    return lambda params, a, b: _truths(compare, a, b)


def _truths(compare: Callable[..., bool], a: np.ndarray, b: np.ndarray) -> np.ndarray:
    order = next(x.order for part in (a, b) for x in part.flat if isinstance(x, Series))
    return map_entries(functools.partial(compare, order), a, b).astype(bool)


def _larger(name: str, a: Series, b: Series) -> Series:
    return a if _side(a - b, name) else b


def _smaller(name: str, a: Series, b: Series) -> Series:
    return b if _side(a - b, name) else a


def _clamped(params: Params, low: np.ndarray, x: np.ndarray, high: np.ndarray) -> np.ndarray:
    def clamp(low: Series, x: Series, high: Series) -> Series:
        return _smaller("clamp", _larger("clamp", x, low), high)

    return map_entries(clamp, low, x, high)


def _stairs(name: str, step: Callable[[Fraction], int]) -> Callable[[Series], Series]:
    def function(x: Series) -> Series:
        low, high = (step(Fraction(end, UNIT)) for end in x.parts[0])
        if low != high:
            raise _changes(name)
        return number(low, x.order)

    return function


def _remainder(a: Series, b: Series) -> Series:
    """Return what a division leaves, with the sign of a."""
    return a - b * _stairs("rem", math.trunc)(a * reciprocal(b))


def _angle_of(y: Series, x: Series) -> Series:
    """Return atan2(y, x), off the half line on which it jumps."""
    quarter = Series((ends_of(pi().scale(Fraction(1, 2))), *[(0, 0)] * x.order))
    if x.parts[0][0] > 0:
        return FUNCTIONS["atan"](y * reciprocal(x))
    if y.parts[0][0] > 0:
        return quarter - FUNCTIONS["atan"](x * reciprocal(y))
    if y.parts[0][1] < 0:
        return -quarter - FUNCTIONS["atan"](x * reciprocal(y))
    raise _changes("atan2")


def _blocked(params: Params, x: np.ndarray) -> np.ndarray:
    raise RangeError("a path uses `stop_gradient`, behind which its derivatives are not its own.")


BRANCHES: dict[str, Rule] = {
    "abs": entrywise(lambda x: x if _side(x, "abs") else -x),
    "sign": entrywise(_stairs("sign", lambda x: (x > 0) - (x < 0))),
    "max": entrywise(functools.partial(_larger, "max")),
    "min": entrywise(functools.partial(_smaller, "min")),
    "clamp": _clamped,
    "floor": entrywise(_stairs("floor", math.floor)),
    "ceil": entrywise(_stairs("ceil", math.ceil)),
    "round": entrywise(_stairs("round", round)),
    "rem": entrywise(_remainder),
    "atan2": entrywise(_angle_of),
    "ge": _compared("ge", swap=False, edge=True),
    "gt": _compared("gt", swap=False, edge=False),
    "le": _compared("le", swap=True, edge=True),
    "lt": _compared("lt", swap=True, edge=False),
    "eq": _equal("eq", equal=True),
    "ne": _equal("ne", equal=False),
    "select_n": lambda params, which, *cases: np.asarray(np.choose(which.astype(int), cases)),
    "stop_gradient": _blocked,
}


# ---- enclosures ----------------------------------------------------------------------------------
# Each entry of a trace is a series. The trace is that of the values: derivatives of
# JAX are not used. A function with branches is enclosed where all of an interval is on one of them.

_SHORT = Fraction(1, 10**4)
"""s; shorter pieces of time are not halved."""
_HALVED = 2000
"""Pieces that are looked at beside those asked for."""


class NoEnclosureError(RangeError):
    """A function has no enclosure, however short the time."""


def enclose_derivatives(
    function: Callable[[jax.Array], jax.Array], times: Sequence[Fraction], order: int
) -> Iterator[list[list[Interval]]]:
    """Yield enclosures of a function of time and its derivatives between consecutive times.

    By the mean value theorem, a value differs from that at the midpoint by at most half the width
    times the range of the next derivative.

    Args:
        function: t () -> (k,), traceable by JAX.
        times: ascending, two or more.
        order: of the highest derivative.

    Yields:
        For each derivative from 0 on, the k intervals.

    Raises:
        RangeError: the function has no enclosure there; the primitive is named.
    """
    with float64():
        closed = jax.make_jaxpr(function)(jnp.zeros(()))

    def derivatives(low: Fraction, high: Fraction, order: int) -> list[list[Ends]]:
        t = np.empty((), object)
        t[()] = Series(((down(low), up(high)), *[whole(k == 1) for k in range(1, order + 1)]))
        with float64():
            [result] = walk(closed.jaxpr, closed.consts, [t], _algebra(order))
        rows = [lifted(entry, order).parts for entry in result.ravel()]
        return [
            [scale_ends(row[k], math.factorial(k), 1) for row in rows] for k in range(order + 1)
        ]

    for low, high in zip(times, times[1:], strict=False):
        there = derivatives((low + high) / 2, (low + high) / 2, order)
        all_over, half = derivatives(low, high, order + 1), up((high - low) / 2)
        yield [
            [_near(*three, half) for three in zip(*rows, strict=True)]
            for rows in zip(there, all_over, all_over[1:], strict=False)
        ]


class EnclosedPiece(NamedTuple):
    """Enclosures of a function and its derivatives until the end (s) of a piece, [order][k]."""

    end: Fraction
    rows: list[list[Interval]]


def enclose_finely(
    function: Callable[[jax.Array], jax.Array], times: Sequence[Fraction], order: int
) -> Iterator[EnclosedPiece]:
    """Yield as `enclose_derivatives`, in pieces halved where there are none, to 0.1 ms."""
    spans, count = list(zip(times, times[1:], strict=False))[::-1], 0
    while spans:
        low, high = spans.pop()
        count += 1
        try:
            [rows] = enclose_derivatives(function, (low, high), order)
        except NoEnclosureError:
            raise
        except RangeError as error:
            if high - low < _SHORT or count > len(times) + _HALVED:
                why, span = str(error).rstrip("."), f"{float(low):.6g} and {float(high):.6g} s"
                raise RangeError(f"{why}, between {span}.") from error
            spans += [((low + high) / 2, high), (low, (low + high) / 2)]
            continue
        yield EnclosedPiece(high, rows)


def _near(middle: Ends, all_over: Ends, slope: Ends, half: int) -> Interval:
    """Return the values on an interval from those at its midpoint (mean value theorem)."""
    low, high = add_ends(middle, multiply_ends((-half, half), slope))
    return interval_of((max(low, all_over[0]), min(high, all_over[1])))


def _scan(equation: JaxprEqn, operands: list[np.ndarray], algebra: Algebra) -> list[np.ndarray]:
    params, first = equation.params, equation.params["num_consts"]
    last = first + params["num_carry"]
    fixed, carry, rows = operands[:first], operands[first:last], operands[last:]
    outputs = list[list[np.ndarray]]()
    for k in range(params["length"])[:: -1 if params["reverse"] else 1]:
        body = params["jaxpr"]
        every = walk(body.jaxpr, body.consts, [*fixed, *carry, *(x[k] for x in rows)], algebra)
        carry = every[: len(carry)]
        outputs.append(every[len(carry) :])
    turns = outputs[:: -1 if params["reverse"] else 1]
    return [*carry, *(np.stack(list(each)) for each in zip(*turns, strict=True))]


@functools.cache
def _algebra(order: int) -> Algebra:
    def lift(array: np.ndarray) -> np.ndarray:
        if array.dtype.kind == "f" and not np.isfinite(array).all():
            raise NoEnclosureError(
                "a path holds a number that is not finite, as a table does that is read by "
                "`interp` or `searchsorted`."
            )
        lifted = rules.lift(array)
        if lifted.dtype != object:
            return lifted
        # `rules.lift` returns constants as polynomials.
        return map_entries(lambda p: number(p.value() or 0.0, order), lifted)

    def unknown(equation: JaxprEqn, operands: list[np.ndarray]) -> list[np.ndarray]:
        if equation.primitive.name == "scan":
            return _scan(equation, operands, algebra)
        raise NoEnclosureError(
            f"a path uses `{equation.primitive.name}`, which has no enclosure over time."
        )

    zero, one = number(0, order), number(1, order)
    functions: dict[str, Rule] = {
        **{name: entrywise(function) for name, function in FUNCTIONS.items()},
        **BRANCHES,
        "div": entrywise(lambda a, b: a * reciprocal(b)),
        "integer_pow": lambda params, x: map_entries(lambda s: whole_power(s, params["y"]), x),
        "pow": entrywise(power),
        "convert_element_type": _convert,
        "dot_general": dot(zero),
        "reduce_sum": reduction(operator.add, zero),
        "reduce_prod": reduction(operator.mul, one),
    }
    algebra = Algebra(functions, lambda x: number(x, order), lift, rules.outside, unknown)
    return algebra


def _convert(params: Params, x: np.ndarray) -> np.ndarray:
    if np.dtype(params["new_dtype"]).kind in "biu":
        raise NoEnclosureError("a path converts time to a whole number, which has no enclosure.")
    return x
