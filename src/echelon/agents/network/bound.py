"""A lower bound of the smallest eigenvalue of a grounded Laplacian that rounding cannot move.

The matrix has no positive entry off its diagonal, so for any positive vector x its smallest
eigenvalue is at least min_i (L x)_i / x_i (Collatz and Wielandt). That quotient is taken in exact
arithmetic, or of a large network in floats less all that they may have rounded; floats only find an
x for which it is sharp. An eigenvalue as floats find it may be off by the rounding of the largest
weight, and a proof may not.
"""

from decimal import Decimal, localcontext
from fractions import Fraction
from typing import NamedTuple

import numpy as np
import scipy.sparse as sp

from echelon.core.rational import float_below
from echelon.core.types import Array

_EFFORT = 1200
_FEW = 150
"""Up to so many followers the vector is sharpened, in `_EFFORT` / n rounds: seconds at most."""
_EXACT = 2000
"""Up to so many followers exact arithmetic takes a second."""
_UNIT, _LEAST = 2.0**-53, 2.0**-1073
_DIGITS = 60
_DECADES = 1e40
"""Of weights that lie farther apart so many digits tell nothing."""
_SHARP = 1.0 - 1e-9


class Grounded(NamedTuple):
    """A grounded Laplacian by its weights.

    Attributes:
        pairs: (E, 2), the followers at the ends of each edge between followers.
        weights: (E,), of these edges.
        held: (K, 2), follower and weight of each edge to a leader.
        size: how many followers.
    """

    pairs: Array
    weights: Array
    held: Array
    size: int


def least_eigenvalue_bound(matrix: Grounded, vector: Array, near: float) -> float:
    """Return a float that the smallest eigenvalue is not below; 0 where no better is found.

    Args:
        matrix: whose eigenvalue it is.
        vector: (n,), near its eigenvector.
        near: the eigenvalue where floats can know it, else infinite; what comes within 1e-9 of it
            is sharp enough.
    """
    positive = np.maximum(np.abs(vector), 1e-300)
    if matrix.size > _EXACT:
        return rounded_bound(matrix, positive)
    tried = list(map(Fraction, positive.tolist()))
    best, above = _quotients(matrix, tried)
    weights = np.concatenate([matrix.weights, matrix.held[:, 1]])
    if weights.max() > _DECADES * weights.min():
        return 0.0
    for _ in range(_EFFORT // matrix.size if matrix.size <= _FEW else 0):
        if best >= _SHARP * min(above, near) > 0:
            break
        # Inverse iteration: L^-1 has positive entries only, so x stays positive.
        tried = _solve(matrix, tried)
        best, above = _quotients(matrix, tried)
    return float_below(best)


def rounded_bound(matrix: Grounded, x: Array) -> float:
    """Return a float that min_i (L x)_i / x_i of a positive x (n,) is not below; 0 at least."""
    (i, j), held = matrix.pairs.T, matrix.held[:, 0].astype(int)
    flow, own = matrix.weights * (x[i] - x[j]), matrix.held[:, 1] * x[held]
    ends = np.concatenate([i, j, held])
    terms = np.concatenate([flow, -flow, own])
    total, size, count = (
        np.bincount(ends, each, matrix.size) for each in (terms, np.abs(terms), None)
    )
    # A term is off by two roundings, and a sum of k terms by k - 1 more of all their sizes (Higham,
    # section 3.1), or by the least of all numbers; the rest is for what is rounded here.
    lost = (count + 4.0) * (_UNIT * (1.0 + 1e-9) * size + _LEAST)
    least = (total - lost) / x * (1.0 - 8.0 * _UNIT)
    return max(0.0, float(least.min()))


def _quotients(matrix: Grounded, x: list[Fraction]) -> tuple[Fraction, Fraction]:
    """Return the least and the largest (L x)_i / x_i of a positive x, exactly.

    The eigenvalue lies between them.
    """
    found = [value / at for value, at in zip(_times(matrix, x), x, strict=True)]
    return min(found), max(found)


def _times(matrix: Grounded, x: list[Fraction]) -> list[Fraction]:
    """Return L x, exactly."""
    found = [Fraction(0)] * matrix.size
    for (i, j), weight in zip(matrix.pairs.tolist(), matrix.weights.tolist(), strict=True):
        flow = Fraction(weight) * (x[i] - x[j])
        found[i] += flow
        found[j] -= flow
    for i, weight in matrix.held.tolist():
        found[int(i)] += Fraction(weight) * x[int(i)]
    return found


def _solve(matrix: Grounded, right: list[Fraction]) -> list[Fraction]:
    """Return L^-1 b for b > 0 to about 60 digits, entry by entry.

    Eliminating a node links its neighbours among themselves and to what it was held by. Nothing is
    subtracted, so that no digit is lost (Grassmann, Taksar and Heyman, 1985); and floats would not
    do, since what matters are small differences of nearly equal entries.
    """
    with localcontext(prec=_DIGITS):
        w = np.full((matrix.size, matrix.size), Decimal(0))
        v, b = np.full(matrix.size, Decimal(0)), _decimals(right)
        for (i, j), weight in zip(matrix.pairs.tolist(), matrix.weights.tolist(), strict=True):
            w[i, j] = w[j, i] = Decimal(weight)
        for i, weight in matrix.held.tolist():
            v[int(i)] += Decimal(weight)
        sums = np.full(matrix.size, Decimal(0))
        for k in range(matrix.size - 1, -1, -1):
            sums[k] = w[k, :k].sum() + v[k]
            share = w[:k, k] / sums[k]
            w[:k, :k] += np.outer(share, w[k, :k])
            v[:k] += share * v[k]
            b[:k] += share * b[k]
            # A node's link to itself is no link.
            w[range(k), range(k)] = Decimal(0)
        x = np.full(matrix.size, Decimal(0))
        for k in range(matrix.size):
            x[k] = (b[k] + (w[k, :k] * x[:k]).sum()) / sums[k]
        return [Fraction(value) for value in x.tolist()]


def _decimals(values: list[Fraction]) -> Array:
    return np.array([Decimal(x.numerator) / Decimal(x.denominator) for x in values], object)


def held_sum(L: sp.csr_array, x: Array, w: Array) -> float:
    """Return a float s >= 0 that W L + L'W >= 2 s W holds with, W = diag(w), whatever is rounded.

    Off the diagonal the symmetric matrix on the left has no positive entry, so what takes a
    positive x (n,) to nothing negative has no negative eigenvalue. L (n, n) is the grounded
    Laplacian of a directed graph, w (n,) is positive.
    """
    # Diagonals of L are sums of weights, rounded once an edge; they count as they are stored, which
    # the relative margin below makes up for.
    own, back = L @ x, L.T @ (w * x)
    size = abs(L) @ x
    sizes = w * size + abs(L.T) @ (w * x)
    degree = float(max(np.diff(L.indptr).max(), np.diff(L.tocsc().indptr).max(), 1))
    lost = 4.0 * (degree + 4.0) * _UNIT * sizes + _LEAST
    least = (w * own + back - lost) / (2.0 * w * x) * (1.0 - 16.0 * _UNIT)
    return max(0.0, float(least.min()))
