"""Tests whether Jacobians and secants of a model lie in the stored hull."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import scipy.optimize

from echelon.core.types import Array

_HALVINGS = 16
"""Halvings of a pair of states; its distance shrinks to 2^-16, about 1e-5."""
_AT_ONCE = 256
"""Hull vertices processed at once; bounds the memory."""


def farthest_from_all(known: Array, samples: Array) -> float:
    """Return the largest relative distance of a sample to its nearest known matrix."""
    size = max(float(np.abs(known).max()), 1e-300)
    if not np.isfinite(samples).all():
        return np.inf
    gaps = [float(np.abs(known - sample).max(axis=(1, 2)).min()) for sample in samples]
    return max(gaps, default=0.0) / size


def farthest_outside(hull: Array, error: Array, samples: Array) -> float:
    """Return the largest distance of a sample to the convex hull of the corners.

    Distances are measured entry by entry beyond `error`, relative to the range of the entry over
    the corners (at least 1e-3 of its absolute value). The convex combination is found by
    nonnegative least squares (Lawson and Hanson) and normalized before the distance is measured.
    """
    if not np.isfinite(samples).all():
        return np.inf
    corners, target = hull.reshape(len(hull), -1), samples.reshape(len(samples), -1)
    low, spread = corners.min(axis=0), np.ptp(corners, axis=0)
    size = np.abs(corners).max(axis=0)
    # Entries that hardly vary are scaled by their absolute value; else rounding would count.
    unit = np.where(size > 0.0, np.maximum(spread, 1e-3 * size), 1.0)
    corners, target, allowed = (corners - low) / unit, (target - low) / unit, error.ravel() / unit
    moving = spread > 0.0
    # The row of ones makes the weights of a convex combination sum to one.
    system = np.vstack([corners[:, moving].T, np.ones(len(corners))])
    worst = float((np.abs(target - corners[0]) - allowed)[:, ~moving].max(initial=0.0))
    for sample in target[:, moving]:
        weights, _ = scipy.optimize.nnls(system, np.append(sample, 1.0), maxiter=100 * len(corners))
        mixed = weights @ corners[:, moving] / weights.sum() if weights.any() else np.inf
        worst = max(worst, float((np.abs(mixed - sample) - allowed[moving]).max(initial=0.0)))
    return worst


class SupportBounds(NamedTuple):
    """Bounds (K,) of p'(v(x) - v(y)) at K pairs; `size` is the magnitude of its terms."""

    low: Array
    high: Array
    size: Array


def support(hull: Array, error: Array, normals: Array, steps: Array) -> SupportBounds:
    """Return the range of p'A d over a hull (H, n, n) up to an error, for normals p and steps d.

    A velocity v with Jacobians in the hull has v(x) - v(y) = A (x - y), A a mean of Jacobians.
    """
    spread = np.einsum("kn,nm,km->k", np.abs(normals), error, np.abs(steps))
    low, high = np.full(len(steps), np.inf), np.full(len(steps), -np.inf)
    for k in range(0, len(hull), _AT_ONCE):
        result = np.einsum("km,hnm->khn", steps, hull[k : k + _AT_ONCE], optimize=True)
        result = np.einsum("khn,kn->kh", result, normals)
        low, high = np.minimum(low, result.min(axis=1)), np.maximum(high, result.max(axis=1))
    size = np.einsum("kn,nm,km->k", np.abs(normals), np.abs(hull).max(axis=0), np.abs(steps))
    return SupportBounds(low - spread, high + spread, size)


def steepest(
    velocity: Callable[[Array], tuple[Array, Array]],
    x: Array,
    y: Array,
    normals: Array,
    bounds: SupportBounds,
) -> float:
    """Return the largest relative violation of the bounds of p'(v(x) - v(y)).

    Each pair is bisected repeatedly, and the steeper half is continued: at a jump the slope doubles
    each time. Rounding is subtracted.

    Args:
        velocity: maps states (K, n) to velocities (K, n) and their rounding (K, n).
        x: states (K, n).
        y: states (K, n).
        normals: p (K, n).
        bounds: for the pairs x, y.
    """
    unit = np.where(bounds.size > 0.0, bounds.size, 1.0)
    (at_x, lost_x), (at_y, lost_y) = velocity(x), velocity(y)
    part, worst = 1.0, -np.inf

    def excess(one: Array, other: Array) -> Array:
        slope = np.einsum("kn,kn->k", normals, one - other) / part
        return np.maximum(slope - bounds.high, bounds.low - slope)

    for _ in range(_HALVINGS):
        lost = np.einsum("kn,kn->k", np.abs(normals), lost_x + lost_y) / part
        result = (excess(at_x, at_y) - lost) / unit
        # NaN counts as a violation of every bound.
        worst = max(worst, float(np.where(np.isfinite(result), result, np.inf).max()))
        middle, part = 0.5 * (x + y), 0.5 * part
        at, lost_at = velocity(middle)
        first = (excess(at_x, at) >= excess(at, at_y))[:, None]
        x, y = np.where(first, x, middle), np.where(first, middle, y)
        at_x, at_y = np.where(first, at_x, at), np.where(first, at, at_y)
        lost_x, lost_y = np.where(first, lost_x, lost_at), np.where(first, lost_at, lost_y)
    return worst
