"""How far the inner states of an agent go under the law `stopping-point`, in rationals (T5).

Each output obeys q(D) v = -k0 w for its speed v less the leader's, with |w| <= s whatever the other
agents do. From a start that is known, v^(order) at any time is what the start leaves plus what w
has made of it until then.
"""

import functools
from collections.abc import Sequence
from fractions import Fraction
from typing import NamedTuple

from echelon.certificates.responses import Chain, Poly, add, largest_between, spreads_on_pieces

_HALVINGS = 6
"""Of 0 < x <= 1, that is of time, into pieces; bounds hold all over each."""


class Push(NamedTuple):
    """What moves a chain: the start (v, v', ..) that it has, and the bound s of |w|."""

    start: tuple[Fraction, ...]
    speed: Fraction


class Room(NamedTuple):
    """How far a derivative of an output may fall below that of the leader's path, at most.

    Attributes:
        fall: a bound of -v^(order), over all time.
        steepest: |v(0)| that a start may have beyond the given ones, if v alone differs there.
    """

    fall: Fraction
    steepest: Fraction


def room_of(chain: Chain, order: int, pushes: Sequence[Push], allowed: Fraction) -> Room:
    """Return how far v^(order) falls under all pushes together, and the start that is left.

    Args:
        chain: of the output.
        order: at least 1, below the chain's last.
        pushes: the leader's, and the agent's.
        allowed: how far it may fall.
    """
    left = [chain.derivative(chain.free(push.start), order) for push in pushes if push.start]
    free = add(*left) if left else Poly()
    speed = sum((push.speed for push in pushes), Fraction(0))
    fall, steepest, still = Fraction(0), None, not any(free.values())
    for low, high, moved, either in _pieces(chain, order):
        left_over = Fraction(0) if still else largest_between(free, low, high, negative=True)
        down = left_over + speed * moved
        fall = max(fall, down)
        if either > 0:
            own = (allowed - down) / either
            steepest = own if steepest is None else min(steepest, own)
    return Room(fall, max(steepest or Fraction(0), Fraction(0)))


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
    count, found, moved = 1 << _HALVINGS, list[_Piece](), Fraction(0)
    for k in range(count - 1, -1, -1):
        low, high = Fraction(k, count), Fraction(k + 1, count)
        moved += spreads[k]
        either = max(largest_between(steep, low, high, sign) for sign in (False, True))
        found.append(_Piece(low, high, moved, either))
    return tuple(found)
