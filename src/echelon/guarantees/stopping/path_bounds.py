"""Bounds on the derivatives of a leader's path, piece by piece of time."""

from collections.abc import Callable, Sequence
from fractions import Fraction
from typing import NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np

from echelon.agents.models.model import ControlAffine
from echelon.agents.references.guide import Guide
from echelon.agents.references.reference import COORDINATES, Reference
from echelon.core.enclosure.interval import Interval, point
from echelon.core.enclosure.over_time import enclose_derivatives
from echelon.core.errors import GainError
from echelon.core.memoize import memoize
from echelon.core.rational import float_below, root_bounds
from echelon.core.words import Kind
from echelon.laws.stopping_point import StoppingLeader

_PIECE, _MOST = Fraction(1, 20), 800
"""Of time, s, and how many there are at most."""
_EXACT = Fraction(1, 10**9)
"""Of the highest derivative; one that is known so well in one piece is constant."""
_SAMPLES = 10
"""In each piece, where the path has no enclosure."""


_Rows: TypeAlias = tuple[tuple[Interval, ...], ...]


class Pieces(NamedTuple):
    """What outputs of a path and their derivatives may be in pieces of time.

    Attributes:
        kind: of the argument.
        times: the borders of the pieces, s; the path is looked at until the last.
        values: [piece][order][output].
    """

    kind: Kind
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

    They are enclosed in rationals where the path has an enclosure, and else the range of samples. A
    leader without a reference stays where its trim is, and nothing of it moves.
    """
    if leader.reference is None:
        k = [leader.ready.chains.outputs.index(name) for name in outputs]
        there = np.asarray(leader.path(model, jnp.zeros(())))[0, k].tolist()
        rows = [[point(Fraction(x)) for x in there], *[[point(0)] * len(k)] * order]
        return Pieces(Kind.PROOF, (Fraction(0), Fraction(horizon)), (tuple(map(tuple, rows)),))
    return _pieces(leader.reference, horizon, tuple(outputs), order)


@memoize
def _pieces(reference: Guide, horizon: float, outputs: tuple[str, ...], order: int) -> Pieces:
    assert isinstance(reference, Reference)
    picked = np.array([COORDINATES.index(name) for name in outputs])
    count = min(_MOST, max(1, int(Fraction(horizon) / _PIECE)))
    times = tuple(Fraction(horizon) * k / count for k in range(count + 1))
    # Derivatives of another making than that of the path would be no part of the enclosure.
    if type(reference).derivatives is Reference.derivatives:
        try:
            return _enclosed(lambda t: reference(t)[picked], times, order)
        except GainError:
            pass
    fine = np.linspace(0.0, horizon, count * _SAMPLES + 1)
    every = jax.jit(jax.vmap(lambda t: reference.derivatives(t, order, outputs)))
    samples = np.asarray(every(jnp.asarray(fine)))
    cut = [samples[k * _SAMPLES : (k + 1) * _SAMPLES + 1] for k in range(count)]
    return Pieces(Kind.SAMPLES, times, tuple(map(_range_of, cut)))


def _enclosed(
    path: Callable[[jax.Array], jax.Array], times: tuple[Fraction, ...], order: int
) -> Pieces:
    """Return what a path is in pieces of time, or in one where that tells all.

    Raises:
        GainError: the path has no enclosure.
    """
    for cut in ((times[0], times[-1]), times):
        values = tuple(tuple(map(tuple, rows)) for rows in enclose_derivatives(path, cut, order))
        # What does not move is known at once.
        if all(x.hi - x.lo < _EXACT for rows in values for x in rows[-1]):
            break
    return Pieces(Kind.PROOF, cut, values)


def _range_of(values: np.ndarray) -> tuple[tuple[Interval, ...], ...]:
    """Return the range of samples (T, order + 1, m)."""
    both = np.stack([values.min(axis=0), values.max(axis=0)], axis=-1)
    return tuple(tuple(Interval(*map(Fraction, pair)) for pair in row) for row in both.tolist())


class Least(NamedTuple):
    """The least value, and by which kind of argument."""

    value: float
    kind: Kind


def least_on_path(
    leader: StoppingLeader,
    model: ControlAffine,
    horizon: float,
    outputs: Sequence[int],
    order: int,
) -> Least:
    """Return what a derivative on a leader's path is not below until the horizon.

    Of several outputs it is the length of the vector of their derivatives.
    """
    names = [leader.ready.chains.outputs[k] for k in outputs]
    pieces = pieces_of(leader, model, horizon, names, order)
    low = min(_least_of(rows[order]) for rows in pieces.values)
    return Least(float_below(low), pieces.kind)


def _least_of(row: Sequence[Interval]) -> Fraction:
    if len(row) == 1:
        return row[0].lo
    sizes = (Fraction(0) if x.holds(0) else min(abs(x.lo), abs(x.hi)) for x in row)
    return root_bounds(sum((size**2 for size in sizes), Fraction(0)))[0]
