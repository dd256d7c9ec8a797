"""Numbers in sentences: rounded towards the side on which less is stated."""

import decimal
import math

from hypothesis import given
from hypothesis import strategies as st

from echelon.core.digits import about, at_least, at_most

FINITE = st.floats(-1e300, 1e300, allow_subnormal=False)
DIGITS = st.integers(1, 6)


def read(x):
    """The number that is stated or guaranteed: of a computed one twelve digits count."""
    return decimal.Decimal(f"{x:.12g}")


@given(FINITE, DIGITS)
def test_what_is_stated_is_on_the_safe_side_by_less_than_a_last_digit(x, digits):
    below, above = (decimal.Decimal(text(x, digits)) for text in (at_most, at_least))
    assert below <= read(x) <= above
    last = decimal.Decimal(1).scaleb(read(x).adjusted() - digits + 1) if x else 0
    assert above - below in (0, last)
    assert float(above) == -float(at_most(-x, digits))
    # Short numbers are stated as they are.
    assert (below == above) == (len(read(x).normalize().as_tuple().digits) <= digits)


def test_texts():
    assert math.copysign(1.0, float(at_most(0.0, 3))) == 1.0
    rows = [
        (0.99999, 3, "0.999", "1", "1"),
        (-0.5858, 3, "-0.586", "-0.586", "-0.585"),
        (4.2700000000000005, 3, "4.27", "4.27", "4.27"),
        (0.6 - 1e-15, 3, "0.6", "0.6", "0.6"),
        (1234567.0, 3, "1.23e+06", "1.23e+06", "1.24e+06"),
        (1.6e-7, 1, "1e-07", "2e-07", "2e-07"),
        (1.7e308, 1, "1e+308", "2e+308", "inf"),
        (math.inf, 3, "inf", "inf", "inf"),
        (-math.inf, 3, "-inf", "-inf", "-inf"),
        (math.nan, 3, "nan", "nan", "nan"),
    ]
    found = [(x, n, at_most(x, n), about(x, n), at_least(x, n)) for x, n, *_ in rows]
    assert list(map(str, found)) == list(map(str, rows))
