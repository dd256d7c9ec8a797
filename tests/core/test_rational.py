"""Rounding up, norms and bisection, compared with exact arithmetic."""

from fractions import Fraction

import pytest
from hypothesis import given
from hypothesis import strategies as st

from echelon.core.rational import bisect, norm_above, round_up

rationals = st.fractions(-(10**12), 10**12, max_denominator=10**12)
lengths = st.fractions(0, 10**6, max_denominator=10**9)


@given(rationals)
def test_a_rounded_rational_is_short_and_close_from_above(x):
    rounded = round_up(x)
    assert 0 <= rounded - x < Fraction(1, 1 << 64) and (1 << 64) % rounded.denominator == 0


@given(lengths, lengths, lengths)
def test_a_norm_is_bounded_from_above_and_closely(a, b, c):
    norm, square = norm_above(a, b, c), a * a + b * b + c * c
    below = max(Fraction(0), norm - Fraction(1, 1 << 63) - norm / (1 << 94))
    assert below * below <= square <= norm * norm
    assert norm_above(a, Fraction(0)) == norm_above(a) == round_up(a)


@pytest.mark.parametrize(("low", "high"), [(0.0, 8.0), (8.0, 0.0), (Fraction(0), Fraction(8))])
def test_bisection_ends_where_the_condition_holds_beside_its_border(low, high):
    ends = sorted((low, high))

    def holds(x):
        return x <= Fraction(10, 3) if low < high else x >= Fraction(10, 3)

    found = bisect(holds, low, high, 30)
    assert type(found) is type(low) and holds(found) and ends[0] <= found <= ends[1]
    assert abs(found - Fraction(10, 3)) <= Fraction(8, 1 << 30)
    assert bisect(lambda x: False, low, high, 40) == low
