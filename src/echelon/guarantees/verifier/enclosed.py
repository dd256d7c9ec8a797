"""Whether matrices, and what velocities differ by, lie in the hull that a file holds."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import scipy.optimize

from echelon.core.types import Array

_HALVINGS = 16
"""After so many a pair of states is as close as 10^-5 of what it was."""
_AT_ONCE = 256
"""Corners whose products with all pairs are held in memory together."""


def farthest_from_all(known: Array, samples: Array) -> float:
    """Return how far the worst sample is from the nearest of the known matrices, relative."""
    size = max(float(np.abs(known).max()), 1e-300)
    if not np.isfinite(samples).all():
        return np.inf
    gaps = [float(np.abs(known - sample).max(axis=(1, 2)).min()) for sample in samples]
    return max(gaps, default=0.0) / size


def farthest_outside(hull: Array, error: Array, samples: Array) -> float:
    """Return how far the worst sample is from every convex combination of the corners.

    Each entry is measured beyond `error`, in units of its range over the corners, or of a
    thousandth of its size where that is larger. Least squares with weights that are not negative
    decide (Lawson and Hanson); the weights are made to add to one before anything is measured.
    """
    if not np.isfinite(samples).all():
        return np.inf
    corners, target = hull.reshape(len(hull), -1), samples.reshape(len(samples), -1)
    low, spread = corners.min(axis=0), np.ptp(corners, axis=0)
    size = np.abs(corners).max(axis=0)
    # An entry that hardly varies is measured by its size, or rounding would look like distance.
    unit = np.where(size > 0.0, np.maximum(spread, 1e-3 * size), 1.0)
    corners, target, allowed = (corners - low) / unit, (target - low) / unit, error.ravel() / unit
    moving = spread > 0.0
    # The row of ones asks for weights that add to one.
    system = np.vstack([corners[:, moving].T, np.ones(len(corners))])
    worst = float((np.abs(target - corners[0]) - allowed)[:, ~moving].max(initial=0.0))
    for sample in target[:, moving]:
        weights, _ = scipy.optimize.nnls(system, np.append(sample, 1.0), maxiter=100 * len(corners))
        mixed = weights @ corners[:, moving] / weights.sum() if weights.any() else np.inf
        worst = max(worst, float((np.abs(mixed - sample) - allowed[moving]).max(initial=0.0)))
    return worst


class SupportBounds(NamedTuple):
    """What p'(v(x) - v(y)) may be at K pairs: from `low` to `high`, (K,); `size` of its terms."""

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
    """Return how far p'(v(x) - v(y)) leaves its bounds at the worst pair, in parts of its size.

    Each pair is halved again and again, and the half kept that is steeper: at a jump the slope
    grows twofold each time. What rounding can make is taken off.

    Args:
        velocity: states (K, n) to velocities (K, n) and what their rounding is, (K, n).
        x: states (K, n).
        y: states (K, n).
        normals: p (K, n).
        bounds: those of x - y.
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
        # What is not a number is outside of every bound.
        worst = max(worst, float(np.where(np.isfinite(result), result, np.inf).max()))
        middle, part = 0.5 * (x + y), 0.5 * part
        at, lost_at = velocity(middle)
        first = (excess(at_x, at) >= excess(at, at_y))[:, None]
        x, y = np.where(first, x, middle), np.where(first, middle, y)
        at_x, at_y = np.where(first, at_x, at), np.where(first, at, at_y)
        lost_x, lost_y = np.where(first, lost_x, lost_at), np.where(first, lost_at, lost_y)
    return worst
