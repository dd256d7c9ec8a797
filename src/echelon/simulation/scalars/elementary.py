"""Elementary functions as operations of a graph, so that no library's code runs lane by lane.

Arguments are reduced to a short interval by the function's symmetries, where a polynomial
approximates it. Tests measure the error of each, in units in the last place.
"""

import math
from fractions import Fraction

from echelon.simulation.scalars.polynomials import (
    EPS,
    LN2,
    PI,
    arctangent_series,
    cosine_series,
    economized,
    error_function_fits,
    even_series,
    logarithm_series,
    odd_series,
    parts_of,
    polynomial,
    sine_series,
)
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


def _less(a: Node | float, b: Node) -> Node:
    return b.graph.make("lt", a, b)


def size(x: Node) -> Node:
    """Return |x|."""
    return x.graph.make("abs", x)


def signed(x: Node, like: Node) -> Node:
    """Return |x| with the sign of another number."""
    return x.graph.make("copysign", x, like)


# ---- functions -----------------------------------------------------------------------------------


def _sine_and_cosine(x: Node) -> tuple[Node, Node]:
    """Return both; the graph shares their common operations."""
    g, eps, width = x.graph, EPS[x.graph.bits], 0.62  # (pi / 4)^2 is 0.617
    # Below, nothing is subtracted, and the quarter is 0.
    far = g.make("unlikely", _less(g.constant(0.61), x * x))
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


def sin(x: Node) -> Node:
    """Return sin x, for |x| up to 1e5 (1e3 in single precision)."""
    return _sine_and_cosine(x)[0]


def cos(x: Node) -> Node:
    """Return cos x, for |x| up to 1e5 (1e3 in single precision)."""
    return _sine_and_cosine(x)[1]


def tan(x: Node) -> Node:
    """Return tan x."""
    return sin(x) / cos(x)


def _scaled_exponential(x: Node) -> tuple[Node, Node, Node]:
    """Return e^r - 1 and two factors whose product is 2^k, with x = r + k ln 2."""
    g, eps = x.graph, EPS[x.graph.bits]
    low, high = (-746.0, 710.0) if g.bits == 64 else (-105.0, 90.0)
    x = g.make("min", g.make("max", x, low), high)
    k = g.make("rint", x * float(1 / LN2))
    r = _reduce(x, k, LN2)
    grown = r + r * r * _both_signs(r, eps)
    # In two factors, because 2^k may overflow when the result does not.
    half = g.make("floor", 0.5 * k)
    return grown, g.make("pow2", half), g.make("pow2", k - half)


def _both_signs(r: Node, eps: float) -> Node:
    """Return (e^r - 1 - r) / r^2 for |r| <= 0.35, with even and odd powers separate."""
    s = r * r
    even = polynomial(s, economized(even_series, 0.123, eps))
    odd = polynomial(s, economized(odd_series, 0.123, eps))
    return even + r * odd


def exp(x: Node) -> Node:
    """Return e^x."""
    grown, first, second = _scaled_exponential(x)
    return (grown + 1.0) * first * second


def expm1(x: Node) -> Node:
    """Return e^x - 1, without cancellation near 0."""
    grown, first, second = _scaled_exponential(x)
    # Up to 2^60 the digits of the two terms overlap; beyond, subtracting 1 changes nothing.
    factor = first * second
    near = factor * grown + (factor - 1.0)
    large = _less(40.0 if x.graph.bits == 64 else 20.0, x)
    return choose(large, (grown + 1.0) * first * second, near)


def log(x: Node) -> Node:
    """Return ln x; -inf at 0, and NaN below."""
    g, bits = x.graph, x.graph.bits
    tiny, lift = (2.0**-1022, 54) if bits == 64 else (2.0**-126, 25)
    low = _less(x, g.constant(tiny))
    normal = choose(low, x * 2.0**lift, x)
    e = g.make("exponent", normal) - choose(low, float(lift), 0.0)
    f = g.make("mantissa", normal) - 1.0
    # ln(1 + f) = f - (f^2/2 - s (f^2/2 + R)) with s = f / (2 + f), 2 artanh s = 2 s + s R.
    s = f / (f + 2.0)
    square = s * s
    R = square * polynomial(square, economized(logarithm_series, 0.0295, EPS[bits]))
    half = 0.5 * f * f
    high, *rest = parts_of(LN2, bits)
    result = e * high - ((half - (s * (half + R) + e * sum(rest))) - f)
    result = choose(g.make("eq", x, math.inf), math.inf, result)
    result = choose(g.make("eq", x, 0.0), -math.inf, result)
    # NaN below 0, and of NaN, for which the comparison does not hold.
    return choose(g.make("le", 0.0, x), result, math.nan)


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
    far = _less(700.0 if x.graph.bits == 64 else 85.0, size(x))
    return signed(choose(far, 0.5 * half * half, near), x)


def cosh(x: Node) -> Node:
    """Return cosh x."""
    grown, half = exp(size(x)), exp(0.5 * size(x))
    far = _less(700.0 if x.graph.bits == 64 else 85.0, size(x))
    return choose(far, 0.5 * half * half, 0.5 * grown + 0.5 / grown)


def asinh(x: Node) -> Node:
    """Return arsinh x, for |x| up to 1e150 (1e18 in single precision)."""
    a = size(x)
    root = x.graph.make("sqrt", a * a + 1.0)
    return signed(log1p(a + a * a / (root + 1.0)), x)


def acosh(x: Node) -> Node:
    """Return arcosh x, for x up to 1e150 (1e18 in single precision)."""
    above = x - 1.0
    return log1p(above + x.graph.make("sqrt", above * (x + 1.0)))


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
    far = y.graph.make("unlikely", _less(y.graph.constant(0.41**2), t * t))
    return choose(far, whole, signed(_small_angle(t), y))


def _small_angle(t: Node) -> Node:
    """Return arctan t for |t| up to tan(pi/8)."""
    s = t * t
    series = economized(arctangent_series, math.tan(math.pi / 8) ** 2, EPS[t.graph.bits])
    return t + t * s * polynomial(s, series)


def _angle(y: Node, x: Node) -> Node:
    """Return the angle of any point (x, y)."""
    g, a, b = y.graph, size(y), size(x)
    low, high = g.make("min", a, b), g.make("max", a, b)
    # Two infinite sides are equal, and two zero sides have the angle 0.
    ratio = choose(g.make("eq", low, high), choose(g.make("eq", high, 0.0), 0.0, 1.0), low / high)
    # NaN equals nothing, so `low / high` preserves it. Beyond tan(pi/8) expanded about 1.
    far = _less(math.tan(math.pi / 8), ratio)
    angle = _small_angle(choose(far, (ratio - 1.0) / (ratio + 1.0), ratio))
    angle = choose(far, math.pi / 4 + angle, angle)
    rest = float(PI / 2 - Fraction(math.pi / 2))
    angle = choose(_less(b, a), math.pi / 2 - (angle - rest), angle)
    behind = _less(signed(g.constant(1.0), x), g.constant(0.0))
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


def cbrt(x: Node) -> Node:
    """Return the cube root of x."""
    # Subnormal numbers are scaled by a cube first, so that they have all digits.
    low = _less(size(x), x.graph.constant(2.0**-900 if x.graph.bits == 64 else 2.0**-96))
    a = choose(low, size(x) * 2.0**90, size(x))
    root = exp(log(a) / 3.0)
    # One step of Newton's method doubles the digits.
    better = root - (root * root * root - a) / (3.0 * root * root)
    regular = x.graph.make("and", _less(0.0, a), _less(a, x.graph.constant(math.inf)))
    result = choose(regular, better, a)
    return signed(choose(low, result * 2.0**-30, result), x)


def rsqrt(x: Node) -> Node:
    """Return 1 / sqrt(x), in a quarter of the time of a root and a quotient."""
    g = x.graph
    exact = 1.0 / g.make("sqrt", x)
    if x.op == "constant":
        return exact
    half, y = 0.5 * x, g.make("root_guess", x)
    # If x is 0, infinite, negative or subnormal, the guess is wrong.
    far = g.make("unlikely", _less(0.05, size((half * y) * y - 0.5)))
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
    """Return x^y; its relative error grows with |y ln x|."""
    g = x.graph
    if y.op == "constant":
        if y.value == 0.5:
            return g.make("sqrt", x)
        if y.value == round(y.value) and abs(y.value) <= 64:
            return integer_power(x, int(y.value))
    positive = exp(y * log(size(x)))
    whole = g.make("eq", g.make("floor", y), y)
    odd = g.make("ne", 2.0 * g.make("floor", 0.5 * y), y)
    minus = choose(whole, choose(odd, -positive, positive), math.nan)
    result = choose(_less(x, g.constant(0.0)), minus, positive)
    one = g.make("or", g.make("eq", y, 0.0), g.make("eq", x, 1.0))
    return choose(one, 1.0, result)


def erf(x: Node) -> Node:
    """Return the error function of x."""
    near, far = error_function_fits()
    a = x.graph.make("min", size(x), 6.5)
    inner = a * polynomial(a * a, near)
    outer = 1.0 - exp(-(a * a)) * polynomial((a - 3.0) / (a + 3.0), far)
    return signed(choose(_less(1.0, a), outer, inner), x)


def sign(x: Node) -> Node:
    """Return 1, -1, or x itself if it is 0 or NaN."""
    return choose(_less(0.0, x), 1.0, choose(_less(x, x.graph.constant(0.0)), -1.0, x))


def remainder(x: Node, y: Node) -> Node:
    """Return x - y trunc(x / y), exact while the quotient is small."""
    g = x.graph
    quotient = g.make("exact_div", x, y)
    rest = x - y * signed(g.make("floor", size(quotient)), quotient)
    # A quotient just below a whole number may be rounded to it; then one y too many is subtracted.
    beyond = _less(rest * signed(g.constant(1.0), x), g.constant(0.0))
    return choose(beyond, rest + signed(y, x), rest)


def round_half_away(x: Node) -> Node:
    """Return the nearest whole number, halves away from zero."""
    low = x.graph.make("floor", size(x))
    up = x.graph.make("le", 0.5, size(x) - low)
    return signed(choose(up, low + 1.0, low), x)
