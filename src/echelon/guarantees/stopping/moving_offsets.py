"""Bounds on the derivatives of offsets that change with time, and whether they have those of T5."""

import functools
import math
from collections.abc import Iterator, Sequence
from fractions import Fraction
from typing import NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np

from echelon.agents.network.formation_motion import (
    BLEND,
    ORDER,
    FormationMotion,
    OffsetMotion,
    Rotate,
    Scale,
    blend,
)
from echelon.core.cache import memoize
from echelon.core.errors import GainError
from echelon.core.rational import norm_above
from echelon.core.types import Array, JsonObject
from echelon.guarantees.stopping.chain_response import largest_between
from echelon.guarantees.stopping.path_bounds import as_gain_error, compare_derivatives
from echelon_ranges import enclose_finely

Sizes: TypeAlias = tuple[tuple[Fraction, ...], ...]
"""[order][coordinate]; under a rotation, of the first two together."""
_LARGEST = Fraction(10**300)
"""Of a size: products with it are to be floats."""
_ROUNDED = Fraction(1) + Fraction(1, 10**12)


@memoize
def offset_sizes(motion: FormationMotion) -> Sizes:
    """Return bounds of the sizes of offsets and of their derivatives, those of all agents.

    Raises:
        GainError: a motion is a user's, of which no bound is known.
    """
    if not motion.bundled:
        name = next(type(m).__name__ for m in motion.motions if type(m) not in (Rotate, Scale))
        raise GainError(f"no bound of the motion `{name}` is known.")
    lengths, ways = _lengths(motion)
    sizes = [lengths]
    for order in range(1, ORDER + 1):
        terms = [
            [blend_size(order) * x / Fraction(span) ** order for x in way]
            for way, span in zip(ways, motion.spans.tolist(), strict=True)
        ]
        sizes.append([max(column, default=Fraction(0)) for column in zip(*terms, strict=True)])
        sizes[-1] = sizes[-1] or [Fraction(0)] * len(lengths)
    for change in motion.motions:
        sizes = _after(change, sizes)
    if max(map(max, sizes)) > _LARGEST:
        raise GainError(f"derivatives of the offsets may be beyond {float(_LARGEST):g}.")
    return tuple(map(tuple, sizes))


def size_beside(
    motion: FormationMotion | None, position: Sequence[str], outputs: Sequence[str], order: int
) -> Fraction:
    """Return a bound of the length of some outputs' derivative of all offsets; 0 of constant ones.

    Raises:
        GainError: none is known.
    """
    if motion is None:
        return Fraction(0)
    sizes = offset_sizes(motion)[order]
    sides = [sizes[position.index(name)] for name in outputs if name in position]
    return norm_above(*sides) if sides else Fraction(0)


def _lengths(motion: FormationMotion) -> tuple[list[Fraction], list[list[Fraction]]]:
    """Return the largest places by coordinate, and the longest ways of each reshape."""
    turned = any(isinstance(m, Rotate) for m in motion.motions)

    def largest(rows: Array) -> list[Fraction]:
        sizes = np.abs(rows)
        if turned:
            sizes[..., :2] = np.linalg.norm(rows[..., :2], axis=-1, keepdims=True)
        each = sizes.reshape(-1, sizes.shape[-1]).max(axis=0)
        return [Fraction(x) * _ROUNDED for x in each.tolist()]

    ways = np.diff(motion.places, axis=1)
    return largest(motion.places), [largest(ways[:, k]) for k in range(ways.shape[1])]


def _after(motion: OffsetMotion, sizes: Sequence[Sequence[Fraction]]) -> list[list[Fraction]]:
    scales = isinstance(motion, Scale)
    assert isinstance(motion, Rotate | Scale)
    rate, amplitude = abs(Fraction(motion.rate)), abs(Fraction(getattr(motion, "amplitude", 1.0)))
    factors = [amplitude * rate**j for j in range(len(sizes))]
    factors[0] += scales
    still = [Fraction(j == 0) for j in range(len(sizes))]
    rows = list[list[Fraction]]()
    for order in range(len(sizes)):
        rows.append([])
        for axis in range(len(sizes[0])):
            own = factors if scales or axis < 2 else still
            terms = (
                math.comb(order, j) * own[j] * sizes[order - j][axis] for j in range(order + 1)
            )
            rows[-1].append(sum(terms, Fraction(0)))
    return rows


@functools.cache
def blend_size(order: int) -> Fraction:
    """Return a bound of a derivative, up to the fifth, of a reshape's blend on [0, 1]."""
    p = {power: Fraction(c) for power, c in enumerate(BLEND, 6)}
    for _ in range(order):
        p = {power - 1: power * c for power, c in p.items()}
    ends = Fraction(0), Fraction(1)
    return max(largest_between(p, *ends, negative=sign) for sign in (False, True))


def offsets_mapping(motion: FormationMotion) -> JsonObject:
    """Return what was claimed of offsets, and what of, ready for JSON."""
    lengths, ways = _lengths(motion)
    return {
        "sizes": [list(map(float, row)) for row in offset_sizes(motion)]
        if motion.bundled
        else None,
        "lengths": list(map(float, lengths)),
        "ways": [list(map(float, way)) for way in ways],
        "begins": motion.begins.tolist(),
        "over": motion.spans.tolist(),
        "motions": [
            {"kind": type(m).__name__, **{k: float(v) for k, v in vars(m).items()}}
            if isinstance(m, Rotate | Scale)
            else {"kind": type(m).__name__}
            for m in motion.motions
        ],
    }


# ---- whether offsets have derivatives ------------------------------------------------------------

_MOST_PLACES = 256
"""Different rows of places that are looked at."""


def offset_fault(motion: FormationMotion | None, order: int, horizon: float) -> str:
    """Return why offsets are not known to have bounded derivatives; empty where they have.

    As of a path, every function in a user's motion must be smooth on the values that it takes until
    the horizon (s), from each place and along each way of a reshape.
    """
    if motion is None:
        return ""
    if len(motion.begins) and order > ORDER + 1:
        return f"a reshape has {ORDER} continuous derivatives, and {order - 1} are needed"
    if motion.bundled:
        return ""
    try:
        _check(motion, order, horizon)
    except GainError as error:
        name = next(type(m).__name__ for m in motion.motions if type(m) not in (Rotate, Scale))
        why = str(error).rstrip(".").replace("a path", "it")
        return f"the motion `{name}` is not known to have {order} bounded derivatives, since {why}"
    return ""


@memoize
def _check(motion: FormationMotion, order: int, horizon: float) -> None:
    rows = np.unique(motion.places, axis=0)
    if len(rows) > _MOST_PLACES:
        raise GainError(f"{len(rows)} places are different, and {_MOST_PLACES} are looked at")
    for piece in _pieces(motion, rows, horizon):
        span = Fraction(piece.begin), Fraction(piece.end)
        with as_gain_error():
            list(enclose_finely(piece, span, 0))
        compare_derivatives(piece, order, piece.begin, piece.end)


class _Stretch(NamedTuple):
    """The offsets from a time until another one (s), between which at most one reshape goes on."""

    motion: FormationMotion
    rows: Array
    begin: float
    end: float

    def __call__(self, t: jax.Array) -> jax.Array:
        """Return all offsets (K d,) at a time: as the law computes them, without its clipping."""
        begins, spans = self.motion.begins, self.motion.spans
        after = (self.begin >= begins + spans).astype(float)
        under_way = (self.begin >= begins) & (after == 0.0)
        places = self.rows[:, 0] + np.tensordot(np.diff(self.rows, axis=1), after, (1, 0))
        places = jnp.asarray(places)
        for k in np.flatnonzero(under_way).tolist():
            way = self.rows[:, k + 1] - self.rows[:, k]
            places = places + blend((t - begins[k]) / spans[k]) * way
        for change in self.motion.motions:
            places = jnp.stack([change(place, t) for place in places])
        return places.ravel()


def _pieces(motion: FormationMotion, rows: Array, horizon: float) -> Iterator[_Stretch]:
    ends = {*motion.begins.tolist(), *(motion.begins + motion.spans).tolist()}
    times = [0.0, *sorted(end for end in ends if 0.0 < end < horizon), horizon]
    for begin, end in zip(times, times[1:], strict=False):
        yield _Stretch(motion, rows, begin, end)
