"""Roots and powers as operations of a graph."""

import math

from echelon.simulation.scalars.approximations import LN2, TINY, parts_of
from echelon.simulation.scalars.elementary import (
    choose,
    exp,
    less,
    log,
    logarithm_remainder,
    scaled_exponential,
    signed,
    size,
)
from echelon.simulation.scalars.scalar_graph import Node


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
    far = g.make("unlikely", less(0.05, size((half * y) * y - 0.5)))
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
    """Return ln x for x >= 0 as the sum of two numbers, the second a rounding error of the first.

    The logarithm of a large number is large, and a power needs as many digits behind its point.
    """
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
