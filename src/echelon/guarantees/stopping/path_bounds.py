"""Bounds on the derivatives of a leader's path, and whether it has those that T5 asks of it."""

import contextlib
import math
from collections.abc import Callable, Iterator, Sequence
from fractions import Fraction
from typing import NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np

from echelon.agents.models.chains import Chains
from echelon.agents.models.model import ControlAffine
from echelon.agents.references.reference import COORDINATES, LeaderPath, Reference
from echelon.core.cache import memoize
from echelon.core.digits import about
from echelon.core.errors import GainError
from echelon.core.numerics import derivatives, precision
from echelon.core.rational import float_above, float_below, root_bounds
from echelon.laws.stopping_point import StoppingLeader
from echelon_ranges import Interval, RangeError, enclose_derivatives, enclose_finely, point

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


@contextlib.contextmanager
def as_gain_error() -> Iterator[None]:
    """Raise the error of a path that has no enclosure as a `GainError`, in the same words."""
    try:
        yield
    except RangeError as error:
        raise GainError(str(error)) from error


def pieces_of(
    leader: StoppingLeader, model: ControlAffine, horizon: float, outputs: Sequence[str], order: int
) -> Pieces:
    """Return what outputs of a leader's path and their derivatives are until the horizon (s).

    They are enclosed in rationals. A leader without a reference stays where its trim is, and
    nothing of it moves.

    Raises:
        GainError: the path has no enclosure.
    """
    if leader.reference is None:
        k = [leader.ready.chains.outputs.index(name) for name in outputs]
        there = np.asarray(leader.path(model, jnp.zeros(())))[0, k].tolist()
        rows = [[point(Fraction(x)) for x in there], *[[point(0)] * len(k)] * order]
        return Pieces((Fraction(0), Fraction(horizon)), (tuple(map(tuple, rows)),))
    return _pieces(leader.reference, horizon, tuple(outputs), order)


@memoize
def _pieces(reference: LeaderPath, horizon: float, outputs: tuple[str, ...], order: int) -> Pieces:
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
            with as_gain_error():
                rows = list(enclose_finely(lambda t, path=path: path(t)[picked], ends, order))
            if all(x.hi - x.lo < _EXACT for piece in rows for x in piece.rows[-1]):
                break
        times += [piece.end for piece in rows]
        values += [tuple(map(tuple, piece.rows)) for piece in rows]
    return Pieces(tuple(times), tuple(values))


@memoize
def path_speed(
    leader: StoppingLeader,
    model: ControlAffine,
    horizon: float,
    output: int,
    until: float | None = None,
) -> float:
    """Return what |zeta_r'| of an output's path does not pass until a time (s), or the horizon.

    Raises:
        GainError: the path has no enclosure.
    """
    chains = leader.ready.chains
    pieces = pieces_of(leader, model, horizon, chains.outputs, max(chains.degrees))
    factors = list(map(Fraction, leader.ready.weights[:, output].tolist()))
    sums = (
        sum((rows[order + 1][output].scale(k) for order, k in enumerate(factors)), point(0))
        for rows in pieces.between(Fraction(0), None if until is None else Fraction(until))
    )
    return float_above(max(max(-each.lo, each.hi) for each in sums))


def least_on_path(
    leader: StoppingLeader, model: ControlAffine, horizon: float, outputs: Sequence[int], order: int
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


# ---- whether a path has derivatives --------------------------------------------------------------

_TIMES = 8
"""At which handwritten derivatives are compared."""
_SAME = 1e-6
"""Relative; far more than floats leave of a derivative."""


def path_fault(reference: LeaderPath | None, chains: Chains, horizon: float) -> str:
    """Return why a path is not known to have bounded derivatives; empty where it has.

    An output with a chain of r integrators needs r - 1 continuous derivatives until the horizon (s)
    and a bounded one more. A path has all of them if every function in its equations is smooth on
    the values that it takes there, which are enclosed, span by span.
    """
    if not isinstance(reference, Reference):
        return ""
    try:
        _check(reference, chains.outputs, max(chains.degrees), horizon)
    except GainError as error:
        name, order = type(reference).__name__, max(chains.degrees)
        why = str(error).rstrip(".")
        return f"`{name}` is not known to have {order} bounded derivatives, since {why}"
    return ""


@memoize
def _check(reference: Reference, outputs: tuple[str, ...], order: int, horizon: float) -> None:
    if type(reference).derivatives is not Reference.derivatives:
        raise GainError("a path replaces `derivatives`, which may be those of another path")
    picked = np.array([COORDINATES.index(name) for name in outputs])
    begin, parts = 0.0, reference.parts(horizon)
    if len(parts) > 1:
        _check_joints(reference, order)
    for until, part in parts:

        def path(t: jax.Array, part: Callable[[jax.Array], jax.Array] = part) -> jax.Array:
            return part(t)[picked]

        with as_gain_error():
            list(enclose_finely(path, (Fraction(begin), Fraction(until)), 0))
        compare_derivatives(path, order, begin, until)
        begin = until


def _check_joints(reference: Reference, order: int) -> None:
    """Check that the class of a path says that its parts fit together."""
    kinds = type(reference).__mro__
    joined, parts, path = (
        next(k for k, kind in enumerate(kinds) if name in vars(kind))
        for name in ("joined", "parts", "__call__")
    )
    if max(joined, parts) > path:
        raise GainError("a path is joined of parts of which nothing says how they fit together")
    if reference.joined < order - 1:
        raise GainError(
            f"its parts meet with {reference.joined} continuous derivatives, and {order - 1} are "
            "needed"
        )


def compare_derivatives(
    path: Callable[[jax.Array], jax.Array], order: int, begin: float, end: float
) -> None:
    """Check handwritten derivatives in a path, which the law uses, at a few times.

    Raises:
        GainError: they are not those of its values.
    """
    with precision("float64"):
        if "custom_" not in str(jax.make_jaxpr(path)(jnp.zeros(()))):
            return
        for t in np.linspace(begin, end, _TIMES):
            values = np.asarray(derivatives(path, jnp.asarray(t), order)).ravel().tolist()
            with as_gain_error():
                [rows] = enclose_derivatives(path, (Fraction(t), Fraction(t)), order)
            for x, value in zip(sum(rows, []), values, strict=True):
                slack = Fraction(_SAME) * (1 + max(abs(x.lo), abs(x.hi)))
                if not (np.isfinite(value) and x.lo - slack <= Fraction(value) <= x.hi + slack):
                    when = f"at {about(t)} s"
                    raise GainError(f"a path has a derivative {when} that is not of its values")
