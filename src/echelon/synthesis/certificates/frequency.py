"""Frequency responses: sweeps that resolve resonances, and their peaks."""

from collections.abc import Callable
from typing import Any

import numpy as np

from echelon.core.types import Array


def resolvent(A: Array, w: Array, B: Array) -> Array:
    """Return (i w I - A)^-1 B for each frequency, (N, n, m)."""
    return np.linalg.solve(1j * w[:, None, None] * np.eye(len(A)) - A, B[None].astype(complex))


def frequencies(matrices: list[Array]) -> Array:
    """Return frequencies up to the largest norm of the matrices, denser about their resonances."""
    # |w| <= |A - k B K z| for |z| = 1, which is at most twice the norm of A and that of A - k B K.
    top = 3.0 * max(float(np.linalg.norm(M, 2)) for M in matrices) or 1.0
    poles = np.concatenate([np.linalg.eigvals(M) for M in matrices])
    width = np.maximum(np.abs(poles.real), 1e-6 * np.abs(poles))
    steps = np.geomspace(0.05, 20.0, 12)
    near = np.abs(poles.imag)[:, None] + width[:, None] * np.concatenate([-steps, steps])
    # 400 frequencies a decade.
    sweep = np.geomspace(1e-9 * top, top, 3600)
    grid = np.union1d(sweep, near[near > sweep[0]])
    # Between two points that differ by rounding, so does all that is computed there.
    return grid[np.append(True, np.diff(grid) > 1e-9 * grid[1:])]


def peaks(f: Callable[[float], float], grid: Array, values: Array) -> Array:
    """Return the local maxima of f between the points of a grid where it has these values."""
    middle, left, right = values[1:-1], values[:-2], values[2:]
    # A flat stretch has maxima by rounding, which are no peaks, nor is what hardly exceeds them.
    tops = (middle >= left) & (middle >= right) & (middle > (1.0 + 1e-7) * np.minimum(left, right))
    around = [(grid[k - 1], grid[k + 1]) for k in np.flatnonzero(tops) + 1]
    return np.array([lowest(lambda w: -f(w), *ends).x for ends in around])


def lowest(f: Callable[[float], float], low: float, high: float) -> Any:
    """Return SciPy's account of the least f between two points, where it has one minimum."""
    from scipy.optimize import minimize_scalar

    sharp = {"xatol": 1e-7 * (high - low)}
    return minimize_scalar(f, None, (low, high), (), "bounded", options=sharp)
