"""Distance that agents keep from the borders of their flat coordinates (T5)."""

import functools
import math
from collections.abc import Callable, Iterable, Sequence
from fractions import Fraction
from typing import NamedTuple

import numpy as np

from echelon.agents.models.model import FlatBound
from echelon.core.cache import memoize
from echelon.core.errors import GainError, listing
from echelon.core.rational import float_below, root_bounds
from echelon.core.types import Array
from echelon.guarantees.stopping.chain_response import (
    Chain,
    Poly,
    add,
    largest_between,
    spreads_on_pieces,
)
from echelon.guarantees.stopping.path_bounds import least_on_path
from echelon.guarantees.stopping.stopping_run import StoppingRun, of_leaders

# ---- bounds on the inner states of an agent from a known start -----------------------------------
# Each output obeys q(D) v = -k0 w for its speed v less the leader's, with |w| <= s whatever the
# other agents do. From a start that is known, v^(order) at any time is what the start leaves plus
# what w has made of it until then.

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

    `order` is below the chain's last; `pushes` are the leader's, and the agent's.
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
@memoize
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


# ---- distances -----------------------------------------------------------------------------------

_ROUNDED = Fraction(1, 10**6)
"""Of a derivative of a flat output: a thousand times what floats leave of it at a start."""
_LEVEL = 1e-9
"""What floats leave of a level start, far below the slack of the clearance."""
_STARTS = 64
"""Starts of agents that are looked at one by one; those that differ in one speed alone are two."""


class Border(NamedTuple):
    """A border of the chart, and what is left to it.

    Attributes:
        left: how far agents stay from it, at least.
        steepest: how far the outputs' speed may be off the leader's at the start.
        path: what the leader's path takes the bounded derivative to, at least.
        fastest: the `speed` of each output at which agreement alone may lead to it.
        led: whether the leader starts on its path in these outputs, and so keeps to it.
        turn: by what angle (deg) a velocity as large as the leader's may be off it at the start;
            infinite where the bound is of no velocity.
        beside: whether offsets that change with time move agents in the bounded derivative.
    """

    bound: FlatBound
    left: Fraction
    steepest: float
    path: float
    fastest: float
    led: bool
    turn: float
    data: dict[str, object]
    beside: bool = False

    @property
    def many(self) -> bool:
        """Whether it is of the length of a vector."""
        return len(self.bound.outputs) > 1

    @property
    def outputs(self) -> str:
        """Its outputs, in words."""
        return listing(self.bound.outputs)

    @property
    def speeds(self) -> str:
        """Their first derivatives, in words."""
        each = ", ".join(f"`{name}'`" for name in self.bound.outputs)
        return f"({each})" if self.many else each

    def what(self) -> str:
        """Return what is bounded, in words."""
        each = ", ".join(name + "'" * self.bound.derivative for name in self.bound.outputs)
        return f"the length of ({each})" if self.many else each


def border_of(run: StoppingRun, bound: FlatBound) -> Border:
    """Return how near to a border the agents of a run may come.

    Raises:
        GainError: there are too many different starts, or roots have no common unit.
    """
    border, case = _ahead_of(run, bound)
    if case is None:
        return border
    clearances, starts = _along(run, case) if border.many else _upward(run, case)
    left = min(case.allowed - clearance.fall for clearance in clearances)
    return border._replace(left=left, data={**border.data, "left": float(left), **starts})


@of_leaders
def _ahead_of(run: StoppingRun, bound: FlatBound) -> "tuple[Border, _BorderCase | None]":
    """Return what no start of a follower changes, and of what the rest is computed.

    Nothing is where a speed is infinite.
    """
    chains, order = run.law.ready.chains, bound.derivative - 1
    places = [chains.outputs.index(name) for name in bound.outputs]
    chain = run.chain(places[0])
    least = least_on_path(run.leader, run.parts.model, run.settings.horizon, places, order + 1)
    beside = run.offset_size(order + 1, *places)
    # What followers stay near to is the path with their offsets.
    least = float_below(Fraction(least) - beside) if beside else least
    allowed = Fraction(least) - Fraction(bound.above) - _ROUNDED
    fastest = float(allowed / chain.gain(order)) / math.sqrt(len(places))
    speeds = [run.own_speed(k) for k in places]
    own, s = _together(speeds), _together(map(run.speed, places))
    led = max(speeds) < _LEVEL and _is_on_path(run, places)
    none = Fraction(-1), 0.0
    border = Border(bound, *none, least, fastest, led, math.inf, {}, bool(beside))
    if own is None or s is None:
        return border, None
    case = _BorderCase(bound, places, chain, own, s, allowed)
    # Said of agents behind a leader that keeps to the speed of its path.
    steepest = float(length_clearance_of(chain, order, (), s, allowed).steepest)
    roots = run.law.roots_for(len(chain.powers))
    data = {**_data(case, least, roots), "steepest": steepest}
    turn = _turn(run, places, steepest) if border.many and order == 0 else math.inf
    return border._replace(steepest=steepest, turn=turn, data=data), case


def _is_on_path(run: StoppingRun, places: list[int]) -> bool:
    """Tell whether leaders start as their path moves, in all that the inner loop lets go by."""
    leads, degree = list(run.parts.graph.leaders), run.law.ready.chains.degrees[places[0]]
    off = (run.flat[leads] - run.ahead)[:, 1:degree, places]
    return bool(np.abs(off).max(initial=0.0) < _LEVEL)


def _turn(run: StoppingRun, places: list[int], chord: float) -> float:
    """Return the angle (deg) between velocities of the leader's size that are a chord apart."""
    size = float(np.linalg.norm(run.ahead[1, places]))
    return math.degrees(2.0 * math.asin(min(1.0, 0.5 * chord / size))) if size > 0.0 else math.inf


class _BorderCase(NamedTuple):
    """A border with what it is computed of: bounds of |w| of leader and agent, what is allowed."""

    bound: FlatBound
    places: list[int]
    chain: Chain
    own: Fraction
    speed: Fraction
    allowed: Fraction


def _together(speeds: Iterable[float]) -> Fraction | None:
    """Return a bound of the length of a vector whose entries are within speeds; None for none."""
    each = list(speeds)
    if any(map(math.isinf, each)):
        return None
    exact = [Fraction(s) for s in each]
    return exact[0] if len(exact) == 1 else root_bounds(sum((s**2 for s in exact), Fraction(0)))[1]


def _data(case: _BorderCase, least: float, roots: Sequence[float]) -> dict[str, object]:
    chain, p = case.chain, len(case.chain.powers)
    return {
        "outputs": list(case.bound.outputs),
        "derivative": case.bound.derivative,
        "above": case.bound.above,
        "path": least,
        "roots": list(roots),
        "speed": float(case.speed),
        "leader_speed": float(case.own),
        "gains": [float(chain.gain(order)) for order in range(p + 1)],
    }


def _upward(run: StoppingRun, case: _BorderCase) -> tuple[list[Clearance], dict[str, object]]:
    """Return the clearances of one output, which may go far on its other side, and the starts."""
    [k], chain = case.places, case.chain
    leads, p = list(run.parts.graph.leaders), len(chain.powers)
    led = _few(run.flat[leads, :, k] - run.ahead[:, k])
    away = _few(run.flat[:, :, k] - run.flat[list(run.parts.graph.nearest_leader()), :, k])
    clearances = [
        clearance_of(
            chain,
            case.bound.derivative - 1,
            (Push(_exact(lead[1 : p + 1]), case.own), Push(_exact(start[1 : p + 1]), case.speed)),
            case.allowed,
        )
        for lead in led
        for start in away
    ]
    starts = {"starts": away, "leader_starts": led}
    return clearances, {name: flat[:, 1 : p + 1].tolist() for name, flat in starts.items()}


def _along(run: StoppingRun, case: _BorderCase) -> tuple[list[Clearance], dict[str, object]]:
    """Return the clearances of several outputs, and the starts against the leader's path."""
    p = len(case.chain.powers)
    away = (run.flat - run.ahead)[:, 1 : p + 1, case.places].swapaxes(1, 2)
    if p == 1:
        # A length that falls by itself: the longest stands for all.
        away = away[[int(np.linalg.norm(away[:, :, 0], axis=1).argmax())]]
    away = _distinct(away)
    order, total = case.bound.derivative - 1, case.own + case.speed
    clearances = [
        length_clearance_of(case.chain, order, list(map(_exact, start)), total, case.allowed)
        for start in away
    ]
    return clearances, {"starts": away.tolist()}


def _exact(values: Array) -> tuple[Fraction, ...]:
    return tuple(map(Fraction, values.tolist()))


def _few(starts: Array) -> Array:
    """Return starts (K, r) that stand for all: the extreme ones where the speed alone differs."""
    starts = starts.copy()
    starts[:, 0] = 0.0
    starts[np.abs(starts) < _LEVEL] = 0.0
    if not starts[:, 2:].any() and starts.shape[1] > 1:
        low, high = starts[:, 1].argmin(), starts[:, 1].argmax()
        return starts[sorted({int(low), int(high)})]
    return _distinct(starts)


def _distinct(starts: Array) -> Array:
    distinct = np.unique(starts, axis=0)
    if len(distinct) > _STARTS:
        raise GainError(
            f"{len(distinct)} starts differ in more than a speed, and {_STARTS} are tried."
        )
    return distinct
