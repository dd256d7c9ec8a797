"""Enclosures of a function of time and its derivatives, by interval Taylor series.

Each entry of a trace is a series (`series.py`). The trace is that of the values: derivatives of JAX
are not used. A function with branches is enclosed where all of an interval is on one of them.
"""

import functools
import math
import operator
from collections.abc import Callable, Iterator, Sequence
from fractions import Fraction
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import JaxprEqn

from echelon.core.enclosure import rules
from echelon.core.enclosure.interval import Interval
from echelon.core.enclosure.piecewise import BRANCHES
from echelon.core.enclosure.series import (
    FUNCTIONS,
    Ends,
    Series,
    add_ends,
    down,
    interval_of,
    lifted,
    multiply_ends,
    number,
    power,
    reciprocal,
    scale_ends,
    up,
    whole,
    whole_power,
)
from echelon.core.errors import GainError
from echelon.core.jaxpr import Algebra, Params, Rule, dot, entrywise, map_entries, reduction, walk
from echelon.core.numerics import precision

_SHORT = Fraction(1, 10**4)
"""s; shorter pieces of time are not halved."""
_HALVED = 2000
"""Pieces that are looked at beside those asked for."""


class NoEnclosureError(GainError):
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
        GainError: the function has no enclosure there; the primitive is named.
    """
    with precision("float64"):
        closed = jax.make_jaxpr(function)(jnp.zeros(()))

    def derivatives(low: Fraction, high: Fraction, order: int) -> list[list[Ends]]:
        t = np.empty((), object)
        t[()] = Series(((down(low), up(high)), *[whole(k == 1) for k in range(1, order + 1)]))
        with precision("float64"):
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
    """Yield enclosures as `enclose_derivatives` does, of pieces halved where there are none.

    Raises:
        GainError: a piece of 0.1 ms has none, or so many pieces are not enough.
    """
    spans, count = list(zip(times, times[1:], strict=False))[::-1], 0
    while spans:
        low, high = spans.pop()
        count += 1
        try:
            [rows] = enclose_derivatives(function, (low, high), order)
        except NoEnclosureError:
            raise
        except GainError as error:
            if high - low < _SHORT or count > len(times) + _HALVED:
                why, span = str(error).rstrip("."), f"{float(low):.6g} and {float(high):.6g} s"
                raise GainError(f"{why}, between {span}.") from error
            spans += [((low + high) / 2, high), (low, (low + high) / 2)]
            continue
        yield EnclosedPiece(high, rows)


def _near(middle: Ends, all_over: Ends, slope: Ends, half: int) -> Interval:
    """Return the values on an interval from those at its midpoint (mean value theorem)."""
    low, high = add_ends(middle, multiply_ends((-half, half), slope))
    return interval_of((max(low, all_over[0]), min(high, all_over[1])))


def _scan(equation: JaxprEqn, operands: list[np.ndarray], algebra: Algebra) -> list[np.ndarray]:
    """Return the results of a loop of known length, one turn after the other."""
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
    """Return the algebra of series up to an order."""

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
