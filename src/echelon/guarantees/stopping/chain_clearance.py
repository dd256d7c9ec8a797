"""Bounds on the inner states of an agent from a known start, in rationals (T5).

Each output obeys q(D) v = -k0 w for its speed v less the leader's, with |w| <= s whatever the other
agents do. From a start that is known, v^(order) at any time is what the start leaves plus what w
has made of it until then.
"""

import functools
from collections.abc import Callable, Sequence
from fractions import Fraction
from typing import NamedTuple

from echelon.core.rational import root_bounds
from echelon.guarantees.stopping.chain_response import (
    Chain,
    Poly,
    add,
    largest_between,
    spreads_on_pieces,
)

_HALVINGS = 6
"""Of 0 < x <= 1, that is of time, into pieces; bounds hold all over each."""


class Push(NamedTuple):
    """What moves a chain: the start (v, v', ..) that it has, and the bound s of |w|."""

    start: tuple[Fraction, ...]
    speed: Fraction


class Clearance(NamedTuple):
    """How far a derivative of outputs may go from that of the leader's path, at most.

    Attributes:
        fall: a bound of -v^(order), over all time; of several outputs, of the length of v^(order).
        steepest: |v(0)| that a start may have beyond the given ones, if v alone differs there.
    """

    fall: Fraction
    steepest: Fraction


def clearance_of(chain: Chain, order: int, pushes: Sequence[Push], allowed: Fraction) -> Clearance:
    """Return how far v^(order) falls under all pushes together, and the start that is left.

    Args:
        chain: of the output.
        order: below the chain's last.
        pushes: the leader's, and the agent's.
        allowed: how far it may fall.
    """
    left = [chain.derivative(chain.free(push.start), order) for push in pushes if push.start]
    free = add(*left) if left else Poly()
    speed = sum((push.speed for push in pushes), Fraction(0))
    still = not any(free.values())

    def fallen(low: Fraction, high: Fraction) -> Fraction:
        return Fraction(0) if still else largest_between(free, low, high, negative=True)

    return _clearance(chain, order, fallen, speed, allowed)


def length_clearance_of(
    chain: Chain,
    order: int,
    starts: Sequence[Sequence[Fraction]],
    speed: Fraction,
    allowed: Fraction,
) -> Clearance:
    """Return how long the vector of v^(order) gets, of outputs whose chains are alike.

    Args:
        chain: of each output.
        order: below the chain's last.
        starts: (v, v', ..) of each output, the leader's part in it; none for zero.
        speed: a bound of the length of the vector of w, of leader and agent together.
        allowed: how long it may get.
    """
    # |int h^(l) w| <= int |h^(l)| |w| in the plane as on a line.
    frees = [chain.derivative(chain.free(start), order) for start in starts if any(start)]

    def left(low: Fraction, high: Fraction) -> Fraction:
        return root_bounds(sum((_size(p, low, high) ** 2 for p in frees), Fraction(0)))[1]

    return _clearance(chain, order, left, speed, allowed)


def _size(p: Poly, low: Fraction, high: Fraction) -> Fraction:
    """Return a bound of |p| on [low, high]."""
    return max(largest_between(p, low, high, sign) for sign in (False, True))


def _clearance(
    chain: Chain,
    order: int,
    left: Callable[[Fraction, Fraction], Fraction],
    speed: Fraction,
    allowed: Fraction,
) -> Clearance:
    """Return the clearance, where `left` bounds what the starts leave on a piece of 0 < x <= 1."""
    fall, steepest = Fraction(0), None
    for low, high, moved, either in _pieces(chain, order):
        down = left(low, high) + speed * moved
        fall = max(fall, down)
        if either > 0:
            own = (allowed - down) / either
            steepest = own if steepest is None else min(steepest, own)
    return Clearance(fall, max(steepest or Fraction(0), Fraction(0)))


class _Piece(NamedTuple):
    """Of 0 < x <= 1, with what a push and a start of v = 1 make of v^(order) there, at most."""

    low: Fraction
    high: Fraction
    moved: Fraction
    either: Fraction


@functools.lru_cache(32)
def _pieces(chain: Chain, order: int) -> tuple[_Piece, ...]:
    """Return the pieces in the order of time, which goes on as x falls from 1 to 0."""
    only = [Fraction(1), *[Fraction(0)] * (len(chain.powers) - 1)]
    steep = chain.derivative(chain.free(only), order)
    spreads = spreads_on_pieces(chain.kernel(order), _HALVINGS)
    count, pieces, moved = 1 << _HALVINGS, list[_Piece](), Fraction(0)
    for k in range(count - 1, -1, -1):
        low, high = Fraction(k, count), Fraction(k + 1, count)
        moved += spreads[k]
        pieces.append(_Piece(low, high, moved, _size(steep, low, high)))
    return tuple(pieces)
