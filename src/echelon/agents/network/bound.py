"""A rigorous lower bound of the smallest eigenvalue of a grounded Laplacian.

The matrix has no positive entry off its diagonal, so for any positive vector x its smallest
eigenvalue is at least min_i (L x)_i / x_i (Collatz and Wielandt). That quotient is computed in
floats less a bound of their rounding. An eigenvalue computed in floats is wrong by as much as the
rounding of the largest weight, which a proof may not ignore.
"""

from typing import NamedTuple

import numpy as np
import scipy.sparse as sp

from echelon.core.types import Array

_FEW = 400
"""Largest number of followers for an elimination, which takes a tenth of a second."""
_EFFORT = 12_000
"""Rounds of inverse iteration times followers."""
_UNIT, _LEAST = 2.0**-53, 2.0**-1073
_DECADES = 1e40
"""Largest ratio of weights for an elimination."""
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
    best = rounded_bound(matrix, positive)
    if matrix.size > _FEW or best >= _SHARP * near:
        return best
    weights = np.concatenate([matrix.weights, matrix.leader_edges[:, 1]])
    if weights.max() > _DECADES * weights.min():
        return 0.0
    try:
        return max(best, _elimination_bound(matrix, positive, float(weights.max())))
    except FloatingPointError:
        return best


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


def _elimination_bound(matrix: Grounded, x: Array, heaviest: float) -> float:
    """Return min_i x_i / (L^-1 x)_i, rounded down, for an x > 0 improved by inverse iteration.

    For weights far apart, whose x has nearly equal entries with differences that floats do not
    have. Eliminating a node links its neighbours to each other and to its leaders. Nothing is
    subtracted (Grassmann, Taksar and Heyman, 1985), so that the network of k nodes that remains has
    relative errors of (k + 3) u. Determinant and cofactors of its matrix are polynomials of degree
    k at most in the weights, with positive coefficients (matrix tree theorem), so that these errors
    change no entry of L^-1 x by more than 2 k (k + 3) u, and the sum that returns to node k adds
    (2 k + 4) u. Over all k, with the sums of m edges to leaders, that is below (n + m + 4)^3 u.

    Raises:
        FloatingPointError: the weight of a link is too small for a float.
    """
    (i, j), n = matrix.pairs.T, matrix.size
    w, sums, best = np.zeros((n, n)), np.zeros(n), 0.0
    w[i, j] = w[j, i] = matrix.weights / heaviest
    led = matrix.leader_edges[:, 0].astype(int)
    ground = np.bincount(led, matrix.leader_edges[:, 1] / heaviest, n)
    with np.errstate(under="raise"):
        for k in reversed(range(n)):
            sums[k] = w[k, :k].sum() + ground[k]
            # Above the diagonal, the share of a link to node k in all links of that.
            w[:k, k] /= sums[k]
            w[:k, :k] += np.outer(w[:k, k], w[k, :k])
            ground[:k] += w[:k, k] * ground[k]
            # A link of a node to itself is none.
            w[range(k), range(k)] = 0.0
    for _ in range(_EFFORT // n):
        # Beside such entries, what is too small for a float is nothing.
        x = np.maximum(x / x.max(), 1e-100)
        y = x.copy()
        for k in reversed(range(n)):
            y[:k] += w[:k, k] * y[k]
        for k in range(n):
            y[k] = (y[k] + (w[k, :k] * y[:k]).sum()) / sums[k]
        quotients, x = x / y, y
        best = max(best, float(quotients.min()))
        if best >= _SHARP * quotients.max():
            break
    return best * heaviest * (1.0 - (n + int(np.bincount(led).max()) + 4.0) ** 3 * _UNIT)


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
