"""Functions with branches for Taylor series: absolute values, steps, comparisons and choices.

On an interval that is all on one branch each is smooth. At a common end of two intervals both are
on the same branch, since an edge belongs to one alone: intervals in a row that are each on one
branch are all on the same.
"""

import functools
import math
from collections.abc import Callable
from fractions import Fraction

import numpy as np

from echelon.core.enclosure.interval import pi
from echelon.core.enclosure.series import (
    FUNCTIONS,
    UNIT,
    Series,
    ends_of,
    lifted,
    number,
    reciprocal,
)
from echelon.core.errors import GainError
from echelon.core.jaxpr import Params, Rule, entrywise, map_entries


def _side(x: Series, name: str, edge: bool = True) -> bool:
    """Return whether x >= 0, or x > 0 without the edge, all over the interval.

    Raises:
        GainError: it changes there.
    """
    low, high = x.parts[0]
    if low >= 0 if edge else low > 0:
        return True
    if high < 0 if edge else high <= 0:
        return False
    raise _changes(name)


def _changes(name: str) -> GainError:
    what = f"`{name}`{_WRITTEN.get(name, '')}"
    return GainError(f"a path uses {what}, and passes from one branch of it to another.")


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
    """Return a function that rises in steps, on one of them."""

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
    raise GainError("a path uses `stop_gradient`, behind which its derivatives are not its own.")


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
