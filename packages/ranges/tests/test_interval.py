"""Intervals and arcs: every enclosure contains the exact values, also at the hardest places."""

import math
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from echelon_ranges.atoms import power_points, wave_points
from echelon_ranges.interval import ELEMENTARY, Interval, circle, outward, pi, point, wave

FRACTIONS = st.fractions(-50, 50, max_denominator=1000)
TURN = 2.0 * math.pi


@st.composite
def intervals(draw):
    return Interval(*sorted((draw(FRACTIONS), draw(FRACTIONS))))


@given(intervals(), intervals(), st.integers(0, 4), st.integers(0, 4))
def test_operations_hold_what_they_are_of_and_no_more(a, b, i, j):
    x, y = a.lo + (a.hi - a.lo) * i / 4, b.lo + (b.hi - b.lo) * j / 4
    assert (a + b).holds(x + y) and (a * b).holds(x * y) and a.union(b).holds(x)
    assert a.union(b).holds(y) and a.power(2).holds(x**2) and a.power(3).holds(x**3)
    # Every end is reached.
    ends = [u * v for u in (a.lo, a.hi) for v in (b.lo, b.hi)]
    assert {(a * b).lo, (a * b).hi} <= set(ends)
    assert (a + b).lo == a.lo + b.lo and (a + b).hi == a.hi + b.hi
    assert a.power(2).lo == (0 if a.holds(0) else min(a.lo**2, a.hi**2))
    assert a.power(2).hi == max(a.lo**2, a.hi**2) and a.power(3).lo == a.lo**3
    assert {a.union(b).lo, a.union(b).hi} <= {a.lo, a.hi, b.lo, b.hi}
    both = a.intersect(b)
    assert both.holds(x) == b.holds(x)
    assert not a.holds(a.lo - Fraction(1, 10**30)) and not a.holds(a.hi + Fraction(1, 10**30))


@given(FRACTIONS, st.integers(-300, 300))
def test_a_rounded_end_is_outside_by_little_and_short(x, exponent):
    x = x * Fraction(2) ** exponent
    found = outward(x, x)
    assert found.lo <= x <= found.hi
    assert found.hi - found.lo <= abs(x) / 2**94
    # What fits is not moved.
    short = Fraction(2) ** exponent * (2**90 + 1)
    assert outward(short, short) == point(short)
    for end in (found.lo, found.hi):
        assert end.denominator & (end.denominator - 1) == 0
        odd = abs(end.numerator) // max(1, end.numerator & -end.numerator)
        assert odd.bit_length() <= 98


def test_what_no_float_holds_is_called_infinite():
    far = Fraction(10) ** 400
    assert Interval(-far, far).text() == "[-inf, inf]"
    assert Interval(Fraction(1, 3), Fraction(5, 2)).text() == "[0.333333, 2.5]"


@given(st.floats(-40.0, 40.0), st.floats(0.0, TURN - 1e-6), st.booleans())
@example(-6.4, 6.2, False)
@example(50.0, 6.2, True)
def test_a_wave_reaches_its_extremes_where_they_are(start, width, sine):
    found = wave(Interval(Fraction(start), Fraction(start) + Fraction(width)), sine)
    shift, end = (math.pi / 2 if sine else 0.0), start + width
    values = [math.sin(t) if sine else math.cos(t) for t in (start, end)]
    # cos is 1 at whole turns and -1 half a turn later.
    for extreme, place in ((1.0, shift), (-1.0, shift + math.pi)):
        turns = (start - place) / TURN, (end - place) / TURN
        if math.floor(turns[1] - 1e-9) >= math.ceil(turns[0] + 1e-9):
            values.append(extreme)
        elif math.floor(turns[1] + 1e-9) >= math.ceil(turns[0] - 1e-9):
            return
    assert float(found.lo) == pytest.approx(min(values), abs=1e-12)
    assert float(found.hi) == pytest.approx(max(values), abs=1e-12)


def test_the_circle_is_exact_at_zero_alone():
    assert circle(Fraction(0)) == (point(1), point(0))
    for x in (Fraction(1), Fraction(-1), Fraction(1, 10**9)):
        cosine, sine = circle(x)
        assert cosine.lo < Fraction(math.cos(x)) + Fraction(1, 2**52) and cosine.lo < cosine.hi
        assert float(sine.lo) == pytest.approx(math.sin(x), rel=1e-14) and sine.lo < sine.hi


@pytest.mark.parametrize("turns", [0, 1, -3, 10**6, 10**40])
def test_a_place_on_the_circle_is_the_same_after_whole_turns(turns):
    x = Fraction(7, 5)
    there = Interval(x, x) + pi().scale(Fraction(2 * turns))
    for end in (there.lo, there.hi):
        for part, plain in zip(circle(end), (math.cos(1.4), math.sin(1.4)), strict=True):
            assert float(part.lo) == pytest.approx(plain, abs=1e-15)
            # Wide enough for its remainder, and no wider.
            assert Fraction(1, 2**100) < part.hi - part.lo < Fraction(1, 2**98)
    for place in (Fraction(1, 10**40), pi().lo, pi().lo / 2, -pi().lo / 2):
        assert all(-1 <= part.lo < part.hi <= 1 for part in circle(place))
    far = circle(Fraction(7) * 2**300)
    assert all((part.lo, part.hi) == (-1, 1) for part in far)


@pytest.mark.parametrize("sign", [-1, 1])
def test_an_arc_too_far_off_to_be_placed_is_the_whole_circle(sign):
    start = Fraction(sign) * 2**201
    points = wave_points(Interval(start, start + Fraction(1, 10)), [1])
    corners = np.array([[float(corner[1, 0]), float(corner[1, 1])] for corner in points])
    t = np.linspace(0.0, TURN, 100)
    around = np.stack([np.cos(t), np.sin(t)])
    assert ((corners @ around).max(axis=0) >= 1.0).all()


# Each with an interval on which it is defined, ends included where they are.
FUNCTIONS = {
    "reciprocal": (np.reciprocal, (0.1, 50.0)),
    "exp": (np.exp, (-30.0, 30.0)),
    "expm1": (np.expm1, (-30.0, 30.0)),
    "log": (np.log, (1e-9, 1e9)),
    "log1p": (np.log1p, (-0.999, 1e9)),
    "sqrt": (np.sqrt, (0.0, 1e9)),
    "rsqrt": (lambda x: 1.0 / np.sqrt(x), (1e-9, 1e9)),
    "tan": (np.tan, (-1.57, 1.57)),
    "asin": (np.arcsin, (-1.0, 1.0)),
    "acos": (np.arccos, (-1.0, 1.0)),
    "atan": (np.arctan, (-1e3, 1e3)),
    "sinh": (np.sinh, (-30.0, 30.0)),
    "cosh": (np.cosh, (-30.0, 30.0)),
    "tanh": (np.tanh, (-30.0, 30.0)),
    "logistic": (lambda x: 1.0 / (1.0 + np.exp(-x)), (-30.0, 30.0)),
    "abs": (np.abs, (-30.0, 30.0)),
    "sign": (np.sign, (-30.0, 30.0)),
    "sin": (np.sin, (-9.0, 9.0)),
    "cos": (np.cos, (-9.0, 9.0)),
}


@pytest.mark.parametrize("name", ELEMENTARY)
def test_the_range_on_an_interval_is_that_of_its_points(name):
    plain, (least, most) = FUNCTIONS[name]
    random, span = np.random.default_rng(0), most - least
    drawn = [sorted(random.uniform(least, most, 2)) for _ in range(12)]
    # About 0, where some of them turn, and up to the ends of where they are defined.
    near = [(max(least, -a), min(most, b)) for a, b in ((0.5, 0.25), (0.25, 0.5), (3.0, 2.0))]
    near += [(max(least, a), min(most, b)) for a, b in ((1.0, 2.0), (0.5, 4.0), (-4.0, -1.0))]
    whole = [(least, most), (least, least + 0.1 * span), (most - 0.1 * span, most)]
    for low, high in [*drawn, *(pair for pair in near if pair[0] < pair[1]), *whole]:
        x = Interval(Fraction(low), Fraction(high))
        assert ELEMENTARY[name].defined(x)
        found = ELEMENTARY[name].range(x)
        points = np.append(np.linspace(low, high, 2001), [0.0] if low <= 0.0 <= high else [])
        values = plain(points)
        size = np.abs(values).max()
        assert found.lo <= values.min() + 1e-14 * size
        assert found.hi >= values.max() - 1e-14 * size
        assert float(found.lo) == pytest.approx(values.min(), rel=1e-13, abs=1e-4 * size)
        assert float(found.hi) == pytest.approx(values.max(), rel=1e-13, abs=1e-4 * size)


LITTLE = Fraction(1, 10**6)
OUTSIDE = {
    "reciprocal": [(0, 1), (-1, 1)],
    "exp": [(0, 2049)],
    "log": [(0, 1)],
    "log1p": [(-1, 1)],
    "sqrt": [(-LITTLE, 1)],
    "rsqrt": [(0, 1)],
    "tan": [(1, 2)],
    "asin": [(-1 - LITTLE, 0), (0, 1 + LITTLE)],
    "acos": [(0, 1 + LITTLE)],
    "sinh": [(-2049, 0)],
    "cosh": [(0, 2049)],
}


@pytest.mark.parametrize("name", OUTSIDE)
def test_a_function_is_defined_where_it_is(name):
    for low, high in OUTSIDE[name]:
        assert not ELEMENTARY[name].defined(Interval(Fraction(low), Fraction(high)))


def test_a_single_power_has_its_range_and_several_their_control_points():
    x = Interval(Fraction(-1), Fraction(2))
    assert power_points(x, [2]) == [{2: 0}, {2: 4}]
    assert power_points(x, [3]) == [{3: -1}, {3: 8}]
    # Of x^2 on [-1, 2]: the ends' squares, and their product between.
    assert power_points(x, [1, 2]) == [
        {1: -1, 2: 1},
        {1: Fraction(1, 2), 2: -2},
        {1: 2, 2: 4},
    ]


@given(st.fractions(-(10**12), 10**12, max_denominator=10**12))
def test_floats_around_a_rational_are_the_nearest_on_either_side(x):
    low, high = point(x).floats()
    assert Fraction(low) <= x <= Fraction(high)
    assert high in (low, math.nextafter(low, math.inf)) and (high == low) == (Fraction(low) == x)


@given(st.fractions(0, 10**6, max_denominator=10**9))
def test_a_root_lies_between_its_bounds_which_are_95_bits_apart_and_is_exact_of_a_square(x):
    root, square = ELEMENTARY["sqrt"].range(point(x)), ELEMENTARY["sqrt"].range(point(x * x))
    assert root.lo**2 <= x <= root.hi**2 and root.hi - root.lo <= root.hi / (1 << 94)
    assert square == point(x) or square.lo < x < square.hi
