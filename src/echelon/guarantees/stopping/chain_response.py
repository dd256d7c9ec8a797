"""Bounds on the response of a chain of integrators under q(D) v = -k0 w, in rationals."""

import functools
import math
from collections.abc import Sequence
from fractions import Fraction
from typing import NamedTuple, final

from echelon.core.cache import memoize
from echelon.core.digits import about
from echelon.core.errors import GainError
from echelon.core.rational import round_up
from echelon_ranges import ELEMENTARY, point

_FINE = Fraction(1, 2**40)
"""Of the unit interval; what is not told apart on so short a piece is bounded by its size."""
_CLOSE = Fraction(1, 10**9)
_HIGHEST = 300
"""Degree in x; roots with a smaller common unit are refused."""

Poly = dict[int, Fraction]
"""Coefficients by power of x, none below 1: responses that end in zero."""


@final
class Chain(NamedTuple):
    """q by its roots.

    Attributes:
        powers: each root over the unit, ascending and distinct.
        unit: 1/s.
    """

    powers: tuple[int, ...]
    unit: Fraction

    @classmethod
    def of(cls, roots: Sequence[float]) -> "Chain":
        """Return the chain of roots (1/s), each as its shortest decimal says.

        Raises:
            GainError: they have no common unit that is large enough.
        """
        exact = [Fraction(repr(float(root))) for root in sorted(roots)]
        if not exact:
            return cls((), Fraction(1))
        scale = math.lcm(*(root.denominator for root in exact))
        unit = Fraction(math.gcd(*(int(root * scale) for root in exact)), scale)
        powers = tuple(int(root / unit) for root in exact)
        if powers[-1] > _HIGHEST:
            raise GainError(
                f"`roots` {list(map(float, exact))} are multiples of {about(float(unit))} alone, "
                f"and must be at most {_HIGHEST} times their common unit for a proof."
            )
        return cls(powers, unit)

    @property
    def stiffness(self) -> Fraction:
        """k0 = q(0)."""
        return math.prod((n * self.unit for n in self.powers), start=Fraction(1))

    def impulse(self) -> Poly:
        """Return h, the response of v to an impulse of -w; it is positive with integral 1."""
        response = Poly()
        for n in self.powers:
            apart = ((other - n) * self.unit for other in self.powers if other != n)
            response[n] = self.stiffness / math.prod(apart, start=Fraction(1))
        return response

    def free(self, start: Sequence[Fraction]) -> Poly:
        """Return v from (v, v', ...) at t = 0 without any w; the start is as long as the roots."""
        rows = [[(-n * self.unit) ** order for n in self.powers] for order in range(len(start))]
        return dict(zip(self.powers, _solve(rows, list(start)), strict=True))

    def rate(self, p: Poly) -> Poly:
        """Return the time derivative."""
        # x' = -unit x.
        return {n: -n * self.unit * c for n, c in p.items()}

    def derivative(self, p: Poly, order: int) -> Poly:
        """Return the derivative of an order."""
        for _ in range(order):
            p = self.rate(p)
        return p

    def kernel(self, order: int) -> Poly:
        """Return what h^(order) is the derivative of."""
        p = self.impulse()
        # Of order 0 its integral: x' = -unit x.
        first = {n: c / (-n * self.unit) for n, c in p.items()}
        return self.derivative(p, order - 1) if order else first

    def gain(self, order: int) -> Fraction:
        """Return a bound of sup |v^(order)| over sup |w|, from rest.

        It is the integral of |h^(order)|, which is how far h^(order - 1) goes up and down; of the
        highest order w itself adds k0.
        """
        return _gain(self, order)


@functools.lru_cache(128)
def _gain(chain: Chain, order: int) -> Fraction:
    # Remembered, since it is the same for all starts of a sweep.
    if order == 0:
        return Fraction(1)
    if not chain.powers:
        return Fraction(0)
    direct = chain.stiffness if order == len(chain.powers) else Fraction(0)
    return direct + spread_between(chain.kernel(order), Fraction(0), Fraction(1))


def _solve(rows: list[list[Fraction]], right: list[Fraction]) -> list[Fraction]:
    n = len(right)
    table = [[*row, b] for row, b in zip(rows, right, strict=True)]
    for k in range(n):
        best = next(i for i in range(k, n) if table[i][k])
        table[k], table[best] = table[best], table[k]
        table[k] = [entry / table[k][k] for entry in table[k]]
        for i in range(n):
            if i != k and table[i][k]:
                table[i] = [a - table[i][k] * b for a, b in zip(table[i], table[k], strict=True)]
    return [row[n] for row in table]


# ---- polynomials on the unit interval ------------------------------------------------------------


def value(p: Poly, x: Fraction) -> Fraction:
    """Return p(x)."""
    return sum((c * x**n for n, c in p.items()), Fraction(0))


def add(*some: Poly) -> Poly:
    """Return the sum of polynomials."""
    return {n: sum((p.get(n, Fraction(0)) for p in some), Fraction(0)) for p in some for n in p}


def largest_between(p: Poly, low: Fraction, high: Fraction, negative: bool = False) -> Fraction:
    """Return a bound that p, or -p, is not above on [low, high], too high by 1e-9 of it at most."""
    sign = -1 if negative else 1
    start = [sign * c for c in _bernstein(_moved(p, low, high))]
    best = max(start[0], start[-1])
    bound, pieces = best, [start]
    while pieces:
        piece = pieces.pop()
        best = max(best, piece[0], piece[-1])
        if max(piece) <= best + _CLOSE * (1 + abs(best)):
            bound = max(bound, *piece)
        else:
            pieces += _halved(piece)
    return bound


def spread_between(p: Poly, low: Fraction, high: Fraction) -> Fraction:
    """Return a bound of the total variation of p on [low, high]: how far it goes up and down."""
    p = _moved(p, low, high)
    slope = {n - 1: n * c for n, c in p.items() if n}
    total, pieces = Fraction(0), [(_bernstein(slope), Fraction(0), Fraction(1))]
    while pieces:
        piece, a, width = pieces.pop()
        if min(piece) >= 0 or max(piece) <= 0:
            # Of one sign, so that the integral of |p'| is the difference of p.
            total += abs(value(p, a + width) - value(p, a))
        elif width <= _FINE:
            total += width * max(map(abs, piece))
        else:
            left, right = _halved(piece)
            half = width / 2
            pieces += [(left, a, half), (right, a + half, half)]
    return total


def spreads_on_pieces(p: Poly, halvings: int) -> list[Fraction]:
    """Return a bound of the total variation of p on each of 2^halvings equal pieces of [0, 1]."""
    count, slope = 1 << halvings, {n - 1: n * c for n, c in p.items() if n}
    ends = [Fraction(k, count) for k in range(count + 1)]
    values = [value(p, x) for x in ends]
    return [
        # Of one sign, so that the integral of |p'| is the difference of p.
        abs(values[k + 1] - values[k])
        if min(piece) >= 0 or max(piece) <= 0
        else spread_between(p, ends[k], ends[k + 1])
        for k, piece in enumerate(_pieces(slope, halvings))
    ]


def _pieces(p: Poly, halvings: int) -> list[list[Fraction]]:
    """Return the coefficients of Bernstein on equal pieces of [0, 1]."""
    pieces = [_bernstein(p)]
    for _ in range(halvings):
        pieces = [half for piece in pieces for half in _halved(piece)]
    return pieces


def _moved(p: Poly, low: Fraction, high: Fraction) -> Poly:
    """Return p(low + (high - low) x)."""
    if (low, high) == (0, 1):
        return p
    coefficients, width = dict[int, Fraction](), high - low
    for n, c in p.items():
        for k in range(n + 1):
            more = c * math.comb(n, k) * low ** (n - k) * width**k
            coefficients[k] = coefficients.get(k, Fraction(0)) + more
    return coefficients


def _bernstein(p: Poly) -> list[Fraction]:
    """Return Bernstein's coefficients on [0, 1], between whose ends p lies."""
    degree = max(p, default=0)
    share = [p.get(n, Fraction(0)) / math.comb(degree, n) for n in range(degree + 1)]
    return [
        sum((math.comb(k, i) * share[i] for i in range(k + 1)), Fraction(0))
        for k in range(degree + 1)
    ]


def _halved(b: list[Fraction]) -> tuple[list[Fraction], list[Fraction]]:
    """Return the coefficients on both halves (de Casteljau)."""
    left, right, row = [b[0]], [b[-1]], b
    while len(row) > 1:
        row = [(p + q) / 2 for p, q in zip(row, row[1:])]
        left.append(row[0])
        right.append(row[-1])
    return left, right[::-1]


# ---- bounds per slice of time --------------------------------------------------------------------
# What bounds them over all time adds up peaks that never meet: a start has died away when what is
# asked for has built up. On a slice of x = exp(-unit t) each is bounded by itself.

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
@memoize
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
    pieces = [[_pieces(chain.derivative(p, order), _HALVINGS) for p in starts] for order in orders]
    free = [[[max(map(abs, piece)) for piece in each] for each in row] for row in pieces]
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
