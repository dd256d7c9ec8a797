"""How far the inner states of an agent go under the law `stopping-point`, in rationals (T5).

Each output obeys q(D) v = -k0 w for its speed v less the leader's, with |w| <= s whatever the other
agents do. From a start that is known, v^(order) at any time is what the start leaves plus what w
has made of it until then.
"""

from collections.abc import Sequence
from fractions import Fraction
from typing import NamedTuple

from echelon.certificates.responses import Chain, Poly, add, largest_between, spread_between

_SLICES = 64
"""Pieces of 0 < x <= 1, that is of time; bounds hold all over each."""


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
    kernel = chain.kernel(order)
    unit = chain.derivative(
        chain.free([Fraction(1), *[Fraction(0)] * (len(chain.powers) - 1)]), order
    )
    speed = sum((push.speed for push in pushes), Fraction(0))
    fall, steepest, moved = Fraction(0), None, Fraction(0)
    for k in range(_SLICES, 0, -1):
        # Time goes on as x falls from 1 to 0.
        low, high = Fraction(k - 1, _SLICES), Fraction(k, _SLICES)
        moved += spread_between(kernel, low, high)
        down = largest_between(free, low, high, negative=True) + speed * moved
        fall = max(fall, down)
        either = max(largest_between(unit, low, high, sign) for sign in (False, True))
        if either > 0:
            own = (allowed - down) / either
            steepest = own if steepest is None else min(steepest, own)
    return Room(fall, max(steepest or Fraction(0), Fraction(0)))
