"""A rigorous lower bound of the smallest eigenvalue of a grounded Laplacian.

The matrix has no positive entry off its diagonal, so for any positive vector x its smallest
eigenvalue is at least min_i (L x)_i / x_i (Collatz and Wielandt). That quotient is computed in
exact arithmetic, or for a large network in floats less a bound of their rounding; only the x for
which the bound is sharp comes from floats. An eigenvalue computed in floats is wrong by as much as
the rounding of the largest weight, which a proof may not ignore.
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
"""Largest number of followers for which x is improved, in `_EFFORT` / n rounds: seconds at most."""
_EXACT = 2000
"""Largest number of followers for exact arithmetic, which takes a second."""
_UNIT, _LEAST = 2.0**-53, 2.0**-1073
_DIGITS = 60
_DECADES = 1e40
"""Largest ratio of weights for which the digits suffice."""
_SHARP = 1.0 - 1e-9


class Grounded(NamedTuple):
    """The weights of a grounded Laplacian.

    Attributes:
        pairs: (E, 2), the followers at the ends of each edge between followers.
        weights: (E,), of these edges.
        leader_edges: (K, 2), follower and weight of each edge to a leader.
        size: number of followers.
    """

    pairs: Array
    weights: Array
    leader_edges: Array
    size: int


def least_eigenvalue_bound(matrix: Grounded, vector: Array, near: float) -> float:
    """Return a lower bound of the smallest eigenvalue; 0 where no better one is found.

    Args:
        matrix: the grounded Laplacian.
        vector: (n,), near its eigenvector.
        near: the eigenvalue where floats resolve it, else infinite; a bound within 1e-9 of it is
            sharp enough.
    """
    positive = np.maximum(np.abs(vector), 1e-300)
    if matrix.size > _EXACT:
        return rounded_bound(matrix, positive)
    x = list(map(Fraction, positive.tolist()))
    best, above = _quotients(matrix, x)
    weights = np.concatenate([matrix.weights, matrix.leader_edges[:, 1]])
    if weights.max() > _DECADES * weights.min():
        return 0.0
    for _ in range(_EFFORT // matrix.size if matrix.size <= _FEW else 0):
        if best >= _SHARP * min(above, near) > 0:
            break
        # Inverse iteration: L^-1 has positive entries only, so x stays positive.
        x = _solve(matrix, x)
        best, above = _quotients(matrix, x)
    return float_below(best)


def rounded_bound(matrix: Grounded, x: Array) -> float:
    """Return a lower bound, 0 or more, of min_i (L x)_i / x_i for a positive x (n,)."""
    (i, j), near_leader = matrix.pairs.T, matrix.leader_edges[:, 0].astype(int)
    flow, inflow = matrix.weights * (x[i] - x[j]), matrix.leader_edges[:, 1] * x[near_leader]
    ends = np.concatenate([i, j, near_leader])
    terms = np.concatenate([flow, -flow, inflow])
    total, size, count = (
        np.bincount(ends, weights, matrix.size) for weights in (terms, np.abs(terms), None)
    )
    # A term has two roundings, and a sum of k terms k - 1 more of all their sizes (Higham, section
    # 3.1), or the smallest float; the remaining factors cover the rounding of this bound itself.
    lost = (count + 4.0) * (_UNIT * (1.0 + 1e-9) * size + _LEAST)
    least = (total - lost) / x * (1.0 - 8.0 * _UNIT)
    return max(0.0, float(least.min()))


def _quotients(matrix: Grounded, x: list[Fraction]) -> tuple[Fraction, Fraction]:
    """Return the smallest and the largest (L x)_i / x_i of a positive x, exactly.

    The eigenvalue lies between them.
    """
    quotients = [value / entry for value, entry in zip(_times(matrix, x), x, strict=True)]
    return min(quotients), max(quotients)


def _times(matrix: Grounded, x: list[Fraction]) -> list[Fraction]:
    """Return L x, exactly."""
    product = [Fraction(0)] * matrix.size
    for (i, j), weight in zip(matrix.pairs.tolist(), matrix.weights.tolist(), strict=True):
        flow = Fraction(weight) * (x[i] - x[j])
        product[i] += flow
        product[j] -= flow
    for i, weight in matrix.leader_edges.tolist():
        product[int(i)] += Fraction(weight) * x[int(i)]
    return product


def _solve(matrix: Grounded, right: list[Fraction]) -> list[Fraction]:
    """Return L^-1 b for b > 0 to about 60 digits, entry by entry.

    Eliminating a node links its neighbours to each other and to its leaders. Nothing is subtracted,
    so no digit is lost (Grassmann, Taksar and Heyman, 1985). Floats do not suffice, since small
    differences of nearly equal entries matter.
    """
    with localcontext(prec=_DIGITS):
        w = np.full((matrix.size, matrix.size), Decimal(0))
        v, b = np.full(matrix.size, Decimal(0)), _decimals(right)
        for (i, j), weight in zip(matrix.pairs.tolist(), matrix.weights.tolist(), strict=True):
            w[i, j] = w[j, i] = Decimal(weight)
        for i, weight in matrix.leader_edges.tolist():
            v[int(i)] += Decimal(weight)
        sums = np.full(matrix.size, Decimal(0))
        for k in range(matrix.size - 1, -1, -1):
            sums[k] = w[k, :k].sum() + v[k]
            share = w[:k, k] / sums[k]
            w[:k, :k] += np.outer(share, w[k, :k])
            v[:k] += share * v[k]
            b[:k] += share * b[k]
            # A link of a node to itself is none.
            w[range(k), range(k)] = Decimal(0)
        x = np.full(matrix.size, Decimal(0))
        for k in range(matrix.size):
            x[k] = (b[k] + (w[k, :k] * x[:k]).sum()) / sums[k]
        return [Fraction(value) for value in x.tolist()]


def _decimals(values: list[Fraction]) -> Array:
    return np.array([Decimal(x.numerator) / Decimal(x.denominator) for x in values], object)


def contraction_bound(L: sp.csr_array, x: Array, w: Array) -> float:
    """Return a float s >= 0 with W L + L'W >= 2 s W, W = diag(w), rounding included.

    The symmetric matrix on the left has no positive entry off its diagonal, so it has no negative
    eigenvalue if it takes a positive x (n,) to a vector without negative entries. L (n, n) is the
    grounded Laplacian of a directed graph, w (n,) is positive.
    """
    # Diagonals of L are sums of weights, rounded once an edge; the relative margin below covers it.
    direct, transposed = L @ x, L.T @ (w * x)
    size = abs(L) @ x
    sizes = w * size + abs(L.T) @ (w * x)
    degree = float(max(np.diff(L.indptr).max(), np.diff(L.tocsc().indptr).max(), 1))
    lost = 4.0 * (degree + 4.0) * _UNIT * sizes + _LEAST
    least = (w * direct + transposed - lost) / (2.0 * w * x) * (1.0 - 16.0 * _UNIT)
    return max(0.0, float(least.min()))
