"""Splines of degree 7 through timed points, or close to them, at rest or free at both ends."""

import math
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from echelon.core.errors import ReferenceError
from echelon.core.types import Array

_FIXED = {"rest": (1, 2, 3), "free": (4, 5, 6)}
"""The derivatives that are zero at both ends; of free ends as of the smoothest curve."""
ENDS = tuple(_FIXED)
_FEWEST = 4
"""Points that determine a spline of degree 7 with free ends; fewer have one polynomial."""
_DENSER = 1.3


class SplinePieces(NamedTuple):
    """A spline as polynomials between its knots.

    Attributes:
        knots: (P + 1,) increasing times, s.
        coefficients: (8, P, 4) over the time since the knot, highest power first.
    """

    knots: Float[Array, " P+1"]
    coefficients: Float[Array, "8 P 4"]


def resampled(
    times: Float[Array, " K"], points: Float[Array, "K 4"], step: float
) -> tuple[Float[Array, " k"], Float[Array, "k 4"]]:
    """Return points at equal steps of at most `step` (s), on straight lines between the given."""
    count = max(1, math.ceil((times[-1] - times[0]) / step - 1e-9))
    even = np.linspace(times[0], times[-1], count + 1)
    return even, np.stack([np.interp(even, times, column) for column in points.T], axis=1)


def through(times: Float[Array, " K"], points: Float[Array, "K 4"], ends: str) -> SplinePieces:
    """Return the spline through points; its first six derivatives are continuous."""
    # Imported here: splines load slowly, and only this reference needs them.
    from scipy.interpolate import make_interp_spline

    # K points leave six coefficients free: three conditions at each end. In units of the mean step
    # derivatives have sizes that can be compared.
    scale = (times[-1] - times[0]) / (len(times) - 1)
    fixed = [(order, np.zeros(4)) for order in _FIXED[ends]]
    at, few = (times - times[0]) / scale, ends == "free" and len(times) < _FEWEST
    degree, both = (len(times) - 1, None) if few else (7, (fixed, fixed))
    spline = make_interp_spline(at, points, k=degree, bc_type=both)
    return _pieces(spline, times, scale, points)


def near(
    times: Float[Array, " K"], points: Float[Array, "K 4"], ends: str, tolerance: float
) -> SplinePieces:
    """Return a spline with few pieces that stays within a tolerance (m, and rad) of all points.

    Each number of pieces has its least squares, and the first one within the tolerance is taken.

    Raises:
        ReferenceError: no spline with half as many numbers as points is within it.
    """
    from scipy.interpolate import BSpline

    scale = (times[-1] - times[0]) / (len(times) - 1)
    at, count = (times - times[0]) / scale, 1
    tied = 6 if ends == "rest" else 0
    while count + 7 - tied <= len(times) // 2:
        knots = at[np.linspace(0, len(at) - 1, count + 1).round().astype(int)]
        fit = BSpline(*_least_squares(at, points, knots, tied), 7)
        off = fit(at) - points
        away = max(float(np.linalg.norm(off[:, :3], axis=1).max()), float(np.abs(off[:, 3]).max()))
        if away <= tolerance:
            return _pieces(fit, times[0] + scale * knots, scale, points)
        count = math.ceil(_DENSER * count + 0.5)
    what = "no smooth curve stays within it of all points"
    if count == 1:
        what = f"it needs {2 * (8 - tied)} or more points, and there are {len(at)}"
    raise ReferenceError(
        f"`smooth` is {tolerance:g} m, and {what}; give a larger one, or leave it out."
    )


def _least_squares(
    at: Float[Array, " K"], points: Float[Array, "K 4"], knots: Array, tied: int
) -> tuple[Array, Array]:
    """Return the knots and coefficients of the spline with least squares of its distances."""
    from scipy.interpolate import BSpline
    from scipy.sparse import csr_array
    from scipy.sparse.linalg import spsolve

    whole = np.concatenate([[knots[0]] * 7, knots, [knots[-1]] * 7])
    n = len(whole) - 8
    # At rest where the first four coefficients, and the last four, are equal.
    column = np.clip(np.arange(n) - tied // 2, 0, n - tied - 1)
    ties = csr_array((np.ones(n), (np.arange(n), column)), shape=(n, n - tied))
    design: Any = csr_array(BSpline.design_matrix(at, whole, 7)) @ ties
    solved: Any = spsolve((design.T @ design).tocsc(), design.T @ points)
    return whole, ties @ np.reshape(solved, (-1, points.shape[1]))


def _pieces(spline: Any, times: Array, scale: float, points: Array) -> SplinePieces:
    """Return a spline over the time in units of `scale` since the first, as pieces in seconds."""
    # Taylor's coefficients at each knot, which JAX evaluates without SciPy.
    at = ((times - times[0]) / scale)[:-1]
    coefficients = np.zeros((8, len(at), points.shape[1]))
    for k in range(spline.k + 1):
        derivative = spline.derivative(k) if k else spline
        coefficients[7 - k] = derivative(at) / math.factorial(k) / scale**k
    # Rounding would let a constant coordinate move.
    constant = (points == points[0]).all(axis=0)
    coefficients[:-1, :, constant] = 0.0
    coefficients[-1, :, constant] = points[0, constant][:, None]
    return SplinePieces(times, coefficients)
