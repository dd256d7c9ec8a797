"""Bounds on the derivatives of a leader's path, piece by piece of time."""

import math
from collections.abc import Sequence
from fractions import Fraction
from typing import NamedTuple, TypeAlias

import jax.numpy as jnp
import numpy as np

from echelon.agents.models.model import ControlAffine
from echelon.agents.references.reference import COORDINATES, Guide, Reference
from echelon.core.enclosure.interval import Interval, point
from echelon.core.enclosure.taylor import enclose_finely
from echelon.core.memoize import memoize
from echelon.core.rational import float_below, root_bounds
from echelon.laws.stopping_point import StoppingLeader

_PIECE, _MOST = Fraction(1, 20), 800
"""Of time, s, and about how many there are."""
_FEW, _ALL = 20, 4000
"""Pieces of each part of a path that is joined of many, and about how many of all parts."""
_EXACT = Fraction(1, 10**9)
"""Of the highest derivative; one that is known so well in one piece is constant."""


_Rows: TypeAlias = tuple[tuple[Interval, ...], ...]


class Pieces(NamedTuple):
    """What outputs of a path and their derivatives may be in pieces of time.

    Attributes:
        times: the borders of the pieces, s; the path is looked at until the last.
        values: [piece][order][output].
    """

    times: tuple[Fraction, ...]
    values: tuple[_Rows, ...]

    def between(
        self, begin: Fraction, end: Fraction | None
    ) -> Sequence[Sequence[Sequence[Interval]]]:
        """Return the pieces that meet a stretch of time; the last one at least."""
        spans = zip(self.times, self.times[1:], self.values, strict=False)
        rows = [v for a, b, v in spans if b >= begin and (end is None or a <= end)]
        return rows or self.values[-1:]


def pieces_of(
    leader: StoppingLeader, model: ControlAffine, horizon: float, outputs: Sequence[str], order: int
) -> Pieces:
    """Return what outputs of a leader's path and their derivatives are until the horizon (s).

    They are enclosed in rationals. A leader without a reference stays where its trim is, and
    nothing of it moves.

    Raises:
        GainError: the path has no enclosure (`path_smoothness.py`).
    """
    if leader.reference is None:
        k = [leader.ready.chains.outputs.index(name) for name in outputs]
        there = np.asarray(leader.path(model, jnp.zeros(())))[0, k].tolist()
        rows = [[point(Fraction(x)) for x in there], *[[point(0)] * len(k)] * order]
        return Pieces((Fraction(0), Fraction(horizon)), (tuple(map(tuple, rows)),))
    return _pieces(leader.reference, horizon, tuple(outputs), order)


@memoize
def _pieces(reference: Guide, horizon: float, outputs: tuple[str, ...], order: int) -> Pieces:
    assert isinstance(reference, Reference)
    picked = np.array([COORDINATES.index(name) for name in outputs])
    times, values, parts = [Fraction(0)], list[_Rows](), reference.parts(horizon)
    most = max(1, min(max(_FEW, _MOST // len(parts)), _ALL // len(parts)))
    for until, path in parts:
        span = Fraction(until) - times[-1]
        count = min(most, math.ceil(span / _PIECE))
        # What does not move is known in one piece, and so is what has a constant derivative.
        for cut in (1, count):
            ends = [times[-1] + span * k / cut for k in range(cut + 1)]
            rows = list(enclose_finely(lambda t, path=path: path(t)[picked], ends, order))
            if all(x.hi - x.lo < _EXACT for piece in rows for x in piece.rows[-1]):
                break
        times += [piece.end for piece in rows]
        values += [tuple(map(tuple, piece.rows)) for piece in rows]
    return Pieces(tuple(times), tuple(values))


def least_on_path(
    leader: StoppingLeader,
    model: ControlAffine,
    horizon: float,
    outputs: Sequence[int],
    order: int,
) -> float:
    """Return what a derivative on a leader's path is not below until the horizon.

    Of several outputs it is the length of the vector of their derivatives.

    Raises:
        GainError: the path has no enclosure.
    """
    names = [leader.ready.chains.outputs[k] for k in outputs]
    pieces = pieces_of(leader, model, horizon, names, order)
    return float_below(min(_least_of(rows[order]) for rows in pieces.values))


def _least_of(row: Sequence[Interval]) -> Fraction:
    if len(row) == 1:
        return row[0].lo
    sizes = (Fraction(0) if x.holds(0) else min(abs(x.lo), abs(x.hi)) for x in row)
    return root_bounds(sum((size**2 for size in sizes), Fraction(0)))[0]
