"""Bounds on a chain of integrators under q(D) v = -k0 w per slice of time, in rationals (T5).

What bounds them over all time adds up peaks that never meet: a start has died away when what is
asked for has built up. On a slice of x = exp(-unit t) each is bounded by itself.
"""

import functools
from collections.abc import Sequence
from fractions import Fraction
from typing import NamedTuple

from echelon.core.enclosure.interval import ELEMENTARY, point
from echelon.core.rational import round_up
from echelon.guarantees.stopping.chain_response import Chain, bounds_on_pieces, spreads_on_pieces

_HALVINGS = 7
"""Of 0 < x <= 1: 128 slices, 8 ms long at first if the unit is 1 1/s."""


class DerivativeBounds(NamedTuple):
    """How far the derivatives of v go on a slice.

    Attributes:
        free: [order][k], a bound of |v^(order)| from the start v^(k) = 1 alone.
        driven: [order], a bound of it over sup |w|, from rest.
    """

    free: tuple[tuple[Fraction, ...], ...]
    driven: tuple[Fraction, ...]

    def of(self, order: int, start: Sequence[Fraction], speed: Fraction) -> Fraction:
        """Return a bound of |v^(order)| from a start (v, v', ..), of which sizes are given."""
        row = zip(self.free[order], start, strict=False)
        left = sum((a * b for a, b in row if b), Fraction(0))
        return round_up(left + self.driven[order] * speed)


class TimeSlice(NamedTuple):
    """A slice of time from `begin` to `end` (s; None is for ever) and what chains do in it.

    Attributes:
        whole: of the chain.
        first: of the one with its first root alone.
    """

    begin: Fraction
    end: Fraction | None
    whole: DerivativeBounds
    first: DerivativeBounds


@functools.lru_cache(32)
def slices_of(chain: Chain) -> tuple[TimeSlice, ...]:
    """Return the slices of all time, for a chain of one root or more."""
    first = Chain(chain.powers[:1], chain.unit)
    count = 1 << _HALVINGS
    times = [_time(chain, Fraction(k, count)) for k in range(count, 0, -1)]
    ends = [high for _, high in times[1:]]
    begins = [low for low, _ in times]
    return tuple(map(TimeSlice, begins, [*ends, None], _reaches(chain), _reaches(first)))


def _time(chain: Chain, x: Fraction) -> tuple[Fraction, Fraction]:
    """Return between which times (s) exp(-unit t) is x."""
    log = ELEMENTARY["log"].range(point(x))
    return -log.hi / chain.unit, -log.lo / chain.unit


def _reaches(chain: Chain) -> list[DerivativeBounds]:
    """Return how far a chain goes on each slice, the first one in time first."""
    size, count = len(chain.powers), 1 << _HALVINGS
    orders = range(size + 1)
    units = [[Fraction(i == k) for i in range(size)] for k in range(size)]
    starts = [chain.free(unit) for unit in units]
    free = [
        [bounds_on_pieces(chain.derivative(p, order), _HALVINGS) for p in starts]
        for order in orders
    ]
    grown = [_grown(chain, order) for order in orders]
    return [
        DerivativeBounds(
            tuple(tuple(round_up(column[k]) for column in row) for row in free),
            tuple(row[k] for row in grown),
        )
        # Time goes on as x falls from 1 to 0.
        for k in range(count - 1, -1, -1)
    ]


def _grown(chain: Chain, order: int) -> list[Fraction]:
    """Return the integral of |h^(order)| until the end of each slice of x, the last one first."""
    total = chain.stiffness if order == len(chain.powers) else Fraction(0)
    bounds = list[Fraction]()
    for spread in reversed(spreads_on_pieces(chain.kernel(order), _HALVINGS)):
        total += spread
        bounds.append(round_up(total))
    return bounds[::-1]
