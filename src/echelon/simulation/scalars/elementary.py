"""Elementary functions as operations of a graph, so that no library's code runs lane by lane.

Arguments are reduced to a short interval by the function's symmetries, where a polynomial
approximates it: Taylor's, economized by Chebyshev's polynomials, so that the highest power is
replaced by the best approximation by lower powers on the interval, with an error of 2^(1-2k) of it
for degree k. Tests measure the error of each function, in units in the last place.
"""

import functools
import math
from collections.abc import Callable, Sequence
from fractions import Fraction

import numpy as np

from echelon.simulation.scalars.scalar_graph import Node


def _reduce(x: Node, k: Node, period: Fraction) -> Node:
    """Return x - k period."""
    for part in parts_of(period, x.graph.bits):
        x = x - k * part
    return x


# ---- choices -------------------------------------------------------------------------------------


def choose(which: Node, a: Node | float, b: Node | float) -> Node:
    """Return a where a truth holds, else b."""
    return which.graph.make("select", which, a, b)


def less(a: Node | float, b: Node) -> Node:
    """Return whether a < b."""
    return b.graph.make("lt", a, b)


def size(x: Node) -> Node:
    """Return |x|."""
    return x.graph.make("abs", x)


def signed(x: Node, like: Node) -> Node:
    """Return |x| with the sign of another number."""
    return x.graph.make("copysign", x, like)


# ---- functions -----------------------------------------------------------------------------------


def _sine_and_cosine(x: Node) -> tuple[Node, Node]:
    g, eps, width = x.graph, EPS[x.graph.bits], 0.62  # (pi / 4)^2 is 0.617
    # Below, nothing is subtracted, and the quarter is 0.
    far = g.make("unlikely", less(g.constant(0.61), x * x))
    # Only quarters of so few bits are subtracted exactly.
    g.except_where(far, g.make("and", far, less(_reach(x), size(x))))
    # Adding 1.5 2^52 puts the whole number nearest to x / (pi / 2) into the last bits.
    magic = 1.5 * 2.0 ** (52 if g.bits == 64 else 23)
    shifted = x * (2.0 / math.pi) + magic
    r = choose(far, _reduce(x, g.make("unfused_sub", shifted, magic), PI / 2), x)
    s = r * r
    sine = r + r * s * polynomial(s, economized(sine_series, width, eps))
    cosine = polynomial(s, economized(cosine_series, width, eps))
    cosine = (1.0 - 0.5 * s) + s * s * cosine
    # The quarter of the circle, 0 to 3, in two bits.
    odd, lower = (g.make("and", far, g.make(bit, shifted)) for bit in ("bit0", "bit1"))
    left = g.make("xor", odd, lower)
    first, second = choose(odd, cosine, sine), choose(odd, sine, cosine)
    return choose(lower, -first, first), choose(left, -second, second)


def _reach(x: Node) -> float:
    """Return up to which size an angle is reduced exactly; with separate roundings, less far."""
    if x.uniform:
        return 1e6 if x.graph.bits == 64 else 1e4
    return 1e10 if x.graph.bits == 64 else 1e6


def sin(x: Node) -> Node:
    """Return sin x; beyond `_reach` it is wrong, which the graph notes."""
    return _sine_and_cosine(x)[0]


def cos(x: Node) -> Node:
    """Return cos x, as `sin`."""
    return _sine_and_cosine(x)[1]


def tan(x: Node) -> Node:
    """Return tan x."""
    return sin(x) / cos(x)


def scaled_exponential(x: Node) -> tuple[Node, Node, Node]:
    """Return e^r - 1 and two factors whose product is 2^k, with x = r + k ln 2."""
    g = x.graph
    low, high = (-746.0, 710.0) if g.bits == 64 else (-105.0, 90.0)
    x = g.make("min", g.make("max", x, low), high)
    k = g.make("rint", x * float(1 / LN2))
    return _grown(_reduce(x, k, LN2)), *_power_of_two(k)


def _grown(r: Node) -> Node:
    """Return e^r - 1 for |r| <= 0.35."""
    return r + r * r * _both_signs(r, EPS[r.graph.bits])


def _power_of_two(k: Node) -> tuple[Node, Node]:
    """Return 2^k in two factors, because it may overflow when a result does not."""
    g, half = k.graph, k.graph.make("floor", 0.5 * k)
    return g.make("pow2", half), g.make("pow2", k - half)


def _both_signs(r: Node, eps: float) -> Node:
    """Return (e^r - 1 - r) / r^2 for |r| <= 0.35, with even and odd powers separate."""
    s = r * r
    even = polynomial(s, economized(even_series, 0.123, eps))
    odd = polynomial(s, economized(odd_series, 0.123, eps))
    return even + r * odd


def exp(x: Node) -> Node:
    """Return e^x."""
    grown, first, second = scaled_exponential(x)
    return (grown + 1.0) * first * second


def exp2(x: Node) -> Node:
    """Return 2^x."""
    g, end = x.graph, 1080.0 if x.graph.bits == 64 else 160.0
    x = g.make("min", g.make("max", x, -end), end)
    k = g.make("rint", x)
    first, second = _power_of_two(k)
    return (_grown((x - k) * float(LN2)) + 1.0) * first * second


def expm1(x: Node) -> Node:
    """Return e^x - 1, without cancellation near 0."""
    grown, first, second = scaled_exponential(x)
    # Up to 2^60 the digits of the two terms overlap; beyond, subtracting 1 changes nothing.
    factor = first * second
    near = factor * grown + (factor - 1.0)
    large = less(40.0 if x.graph.bits == 64 else 20.0, x)
    return choose(large, (grown + 1.0) * first * second, near)


def log(x: Node) -> Node:
    """Return ln x; -inf at 0, and NaN below."""
    g, bits = x.graph, x.graph.bits
    e, f = g.make("exponent", x), g.make("mantissa", x) - 1.0
    # ln(1 + f) = f - (f^2/2 - s (f^2/2 + R)) with s = f / (2 + f), 2 artanh s = 2 s + s R.
    s = f / (f + 2.0)
    half = 0.5 * f * f
    high, *rest = parts_of(LN2, bits)
    R = logarithm_remainder(s)
    result = e * high - ((half - (s * (half + R) + e * sum(rest))) - f)
    result = choose(g.make("eq", x, math.inf), math.inf, result)
    # A denormal number is 0, as in all operations.
    result = choose(less(size(x), g.constant(TINY[bits])), -math.inf, result)
    # NaN below 0, and of NaN, for which the comparison does not hold.
    return choose(g.make("le", 0.0, x), result, math.nan)


def logarithm_remainder(s: Node) -> Node:
    """Return R of ln((1 + s) / (1 - s)) = 2 s + s R for |s| <= 0.172."""
    square = s * s
    return square * polynomial(square, economized(logarithm_series, 0.0295, EPS[s.graph.bits]))


def log1p(x: Node) -> Node:
    """Return ln(1 + x), without cancellation near 0."""
    g, u = x.graph, 1.0 + x
    # The rounding error of 1 + x; without fast-math flags a compiler may not simplify it to 0.
    error = x - (u - 1.0)
    result = log(u) + error / u
    plain = g.make("or", g.make("eq", u, math.inf), g.make("le", u, 0.0))
    result = choose(plain, log(u), result)
    # Preserves the sign of 0, and numbers too small to change 1.
    return choose(g.make("eq", u, 1.0), x, result)


def tanh(x: Node) -> Node:
    """Return tanh x."""
    # From 22 on it is 1 to the last place; `min` preserves NaN.
    grown = expm1(2.0 * x.graph.make("min", size(x), 22.0))
    return signed(grown / (grown + 2.0), x)


def sinh(x: Node) -> Node:
    """Return sinh x."""
    grown = expm1(size(x))
    near = 0.5 * (grown + grown / (grown + 1.0))
    half = exp(0.5 * size(x))
    far = less(700.0 if x.graph.bits == 64 else 85.0, size(x))
    return signed(choose(far, 0.5 * half * half, near), x)


def cosh(x: Node) -> Node:
    """Return cosh x."""
    grown, half = exp(size(x)), exp(0.5 * size(x))
    far = less(700.0 if x.graph.bits == 64 else 85.0, size(x))
    return choose(far, 0.5 * half * half, 0.5 * grown + 0.5 / grown)


def asinh(x: Node) -> Node:
    """Return arsinh x."""
    a = size(x)
    root = x.graph.make("sqrt", a * a + 1.0)
    return signed(_log1p_or_of_double(a, a + a * a / (root + 1.0)), x)


def acosh(x: Node) -> Node:
    """Return arcosh x."""
    above = x - 1.0
    result = _log1p_or_of_double(x, above + x.graph.make("sqrt", above * (x + 1.0)))
    return choose(x.graph.make("le", 1.0, x), result, math.nan)


def _log1p_or_of_double(a: Node, grown: Node) -> Node:
    """Return ln(1 + a number), or, where a is so large that its square may overflow, ln 2 a."""
    far = less(1e100 if a.graph.bits == 64 else 1e15, a)
    return log1p(choose(far, a, grown)) + choose(far, float(LN2), 0.0)


def atanh(x: Node) -> Node:
    """Return artanh x."""
    a = size(x)
    return signed(0.5 * log1p(2.0 * a / (1.0 - a)), x)


def logistic(x: Node) -> Node:
    """Return 1 / (1 + e^-x)."""
    return 1.0 / (1.0 + exp(-x))


def atan2(y: Node, x: Node) -> Node:
    """Return the angle of the point (x, y)."""
    whole = _angle(y, x)
    if not x.at_least_0:
        return whole
    # An angle is mostly below pi/8: then the ratio need not be reduced.
    t = y / x
    far = y.graph.make("unlikely", less(y.graph.constant(0.41**2), t * t))
    return choose(far, whole, signed(_small_angle(t), y))


def _small_angle(t: Node) -> Node:
    """Return arctan t for |t| up to tan(pi/8)."""
    s = t * t
    series = economized(arctangent_series, math.tan(math.pi / 8) ** 2, EPS[t.graph.bits])
    return t + t * s * polynomial(s, series)


def _angle(y: Node, x: Node) -> Node:
    g, a, b = y.graph, size(y), size(x)
    low, high = g.make("min", a, b), g.make("max", a, b)
    # Two infinite sides are equal, and two zero sides have the angle 0.
    ratio = choose(g.make("eq", low, high), choose(g.make("eq", high, 0.0), 0.0, 1.0), low / high)
    # NaN equals nothing, so `low / high` preserves it. Beyond tan(pi/8) expanded about 1.
    far = less(math.tan(math.pi / 8), ratio)
    angle = _small_angle(choose(far, (ratio - 1.0) / (ratio + 1.0), ratio))
    angle = choose(far, math.pi / 4 + angle, angle)
    rest = float(PI / 2 - Fraction(math.pi / 2))
    angle = choose(less(b, a), math.pi / 2 - (angle - rest), angle)
    behind = less(signed(g.constant(1.0), x), g.constant(0.0))
    return signed(choose(behind, math.pi - (angle - 2.0 * rest), angle), y)


def atan(x: Node) -> Node:
    """Return arctan x."""
    return atan2(x, x.graph.constant(1.0))


def asin(x: Node) -> Node:
    """Return arcsin x."""
    return atan2(x, x.graph.make("sqrt", (1.0 - x) * (1.0 + x)))


def acos(x: Node) -> Node:
    """Return arccos x."""
    return atan2(x.graph.make("sqrt", (1.0 - x) * (1.0 + x)), x)


def erf(x: Node) -> Node:
    """Return the error function of x."""
    near, far = error_function_fits()
    a = x.graph.make("min", size(x), 6.5)
    inner = a * polynomial(a * a, near)
    outer = 1.0 - exp(-(a * a)) * polynomial((a - 3.0) / (a + 3.0), far)
    return signed(choose(less(1.0, a), outer, inner), x)


def erfc(x: Node) -> Node:
    """Return 1 - erf x, without cancellation for large x."""
    g = x.graph
    a = g.make("min", size(x), 28.0 if g.bits == 64 else 11.0)
    square = a * a
    # The exponent is large, and so would be the effect of its rounding error.
    error = g.make("fms", a, a, square)
    tail = exp(-square) * (1.0 - error) * polynomial((a - 3.0) / (a + 3.0), scaled_tail_fit())
    outer = choose(less(x, g.constant(0.0)), 2.0 - tail, tail)
    return choose(less(1.0, a), outer, 1.0 - erf(x))


def sign(x: Node) -> Node:
    """Return 1, -1, or x itself if it is 0 or NaN."""
    return choose(less(0.0, x), 1.0, choose(less(x, x.graph.constant(0.0)), -1.0, x))


def remainder(x: Node, y: Node) -> Node:
    """Return x - y trunc(x / y), exact while the quotient is below 2^52 (2^23)."""
    g = x.graph
    quotient = g.make("exact_div", x, y)
    rest = g.make("fnma", y, signed(g.make("floor", size(quotient)), quotient), x)
    # A quotient just below a whole number may be rounded to it; then one y too many is subtracted.
    beyond = less(rest * signed(g.constant(1.0), x), g.constant(0.0))
    rest = choose(beyond, rest + signed(y, x), rest)
    many = less(2.0 ** (52 if g.bits == 64 else 23), size(quotient))
    regular = g.make("and", g.make("ne", y, 0.0), less(size(x), g.constant(math.inf)))
    g.except_where(quotient, g.make("and", many, regular))
    endless = g.make("and", g.make("eq", size(y), math.inf), regular)
    return choose(endless, x, choose(g.make("eq", y, 0.0), math.nan, rest))


def round_half_away(x: Node) -> Node:
    """Return the nearest whole number, halves away from zero."""
    low = x.graph.make("floor", size(x))
    up = x.graph.make("le", 0.5, size(x) - low)
    return signed(choose(up, low + 1.0, low), x)


# ---- roots and powers ----------------------------------------------------------------------------


def cbrt(x: Node) -> Node:
    """Return the cube root of x."""
    # What is left of the least numbers would be denormal: they are scaled by a cube first.
    low = less(size(x), x.graph.constant(2.0**-900 if x.graph.bits == 64 else 2.0**-96))
    a = choose(low, size(x) * 2.0**90, size(x))
    root = exp(log(a) / 3.0)
    # One step of Newton's method doubles the digits.
    better = root - (root * root * root - a) / (3.0 * root * root)
    regular = x.graph.make("and", less(0.0, a), less(a, x.graph.constant(math.inf)))
    result = choose(regular, better, a)
    return signed(choose(low, result * 2.0**-30, result), x)


def rsqrt(x: Node) -> Node:
    """Return 1 / sqrt(x), in a quarter of the time of a root and a quotient."""
    g = x.graph
    exact = 1.0 / g.make("sqrt", x)
    if x.op == "constant":
        return exact
    half, y = 0.5 * x, g.make("root_guess", x)
    # If x is 0, infinite or negative, the guess is wrong.
    far = g.make("rare", less(0.05, size((half * y) * y - 0.5)))
    # Each step maps the error e to 1.5 e^2: 0.034, 1.8e-3, 4.7e-6, 3e-11.
    for _ in range(4 if g.bits == 64 else 3):
        y = y * (1.5 - (half * y) * y)
    return choose(far, exact, y)


def integer_power(x: Node, exponent: int) -> Node:
    """Return x^k by squaring."""
    if exponent < 0:
        return 1.0 / integer_power(x, -exponent)
    result, square = x.graph.constant(1.0), x
    while exponent:
        result = result * square if exponent & 1 else result
        square, exponent = square * square, exponent >> 1
    return result


def power(x: Node, y: Node) -> Node:
    """Return x^y."""
    g = x.graph
    if y.op == "constant":
        if y.value == 0.5:
            return choose(g.make("eq", x, -math.inf), math.inf, g.make("sqrt", x))
        if y.value == round(y.value) and abs(y.value) <= 64:
            return integer_power(x, int(y.value))
    positive = _positive_power(size(x), y)
    whole = g.make("eq", g.make("floor", y), y)
    odd = g.make("ne", 2.0 * g.make("floor", 0.5 * y), y)
    minus = choose(whole, choose(odd, -positive, positive), math.nan)
    # Of what is infinite, no power is less than none.
    minus = choose(g.make("eq", x, -math.inf), choose(whole, minus, positive), minus)
    result = choose(less(x, g.constant(0.0)), minus, positive)
    one = g.make("or", g.make("eq", y, 0.0), g.make("eq", x, 1.0))
    endless = g.make("and", g.make("eq", x, -1.0), g.make("eq", size(y), math.inf))
    return choose(g.make("or", one, endless), 1.0, result)


def _positive_power(x: Node, y: Node) -> Node:
    """Return x^y for x >= 0: e^(y ln x), with the rounding error of the exponent."""
    g = x.graph
    high, low = _logarithm(x)
    exponent = y * high
    error = g.make("fms", y, high, exponent) + y * low
    # Beyond, the result is 0 or infinite, and the error is no number.
    near = less(size(exponent), g.constant(800.0 if g.bits == 64 else 110.0))
    # Before it is scaled: the power itself may be infinite.
    grown, first, second = scaled_exponential(exponent)
    return (grown + 1.0) * choose(near, 1.0 + error, 1.0) * first * second


def _logarithm(x: Node) -> tuple[Node, Node]:
    """Return ln x for x >= 0 as a number and its rounding error: a power needs these digits."""
    g, bits = x.graph, x.graph.bits
    e, f = g.make("exponent", x), g.make("mantissa", x) - 1.0
    below = f + 2.0
    s = f / below
    rest = (g.make("fnma", s, below, f) - s * (f - (below - 2.0))) / below
    first, *others = parts_of(LN2, bits)
    # Errors of sums are exact where the first term is the larger one; e first is, or it is 0.
    large = e * first + 2.0 * s
    small = 2.0 * s - (large - e * first)
    small = small + (2.0 * rest + s * logarithm_remainder(s) + e * sum(others))
    high = large + small
    low = small - (high - large)
    special = g.make("or", less(x, g.constant(TINY[bits])), g.make("eq", x, math.inf))
    special = g.make("or", special, g.make("ne", x, x))
    return choose(special, log(x), high), choose(special, 0.0, low)


# ---- polynomials, and constants for argument reduction -------------------------------------------

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
    """Return coefficients of sum series(k) s^k, lowest first, within a tolerance on [0, width]."""
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
