"""Linear algebra of the verifier: spectra, ranks and growth rates with bounds of their rounding."""

from collections.abc import Callable
from fractions import Fraction
from typing import Any, NamedTuple, TypeAlias

import numpy as np
import scipy.linalg

from echelon.core.types import Array
from echelon.guarantees.verifier.saved_gain import SavedGraph

ALL_MODES = 400
"""Followers up to which all eigenvalues are checked; beyond, the two extreme ones."""
_ITERATIONS = 100
"""Iterations that refine the smallest eigenvalue, at most."""
_EPS = float(np.finfo(float).eps)


def followers(graph: SavedGraph) -> list[int]:
    """Return the agents that are not leaders."""
    return [k for k in range(graph.agents) if k not in graph.leaders]


def grounded_rows(graph: SavedGraph, edges: Array) -> list[list[Fraction]]:
    """Return the followers' block of the Laplacian, exactly."""
    rows = [[Fraction(0)] * graph.agents for _ in range(graph.agents)]
    for i, j, weight in edges:
        a, b, w = int(i), int(j), Fraction(float(weight))
        rows[a][a] += w
        rows[b][b] += w
        rows[a][b] -= w
        rows[b][a] -= w
    selection = followers(graph)
    return [[rows[i][j] for j in selection] for i in selection]


class CheckedSpectrum(NamedTuple):
    """Eigenvalues of the grounded Laplacian, ascending, and a lower bound of the smallest."""

    values: Array
    bound: float


def spectrum(graph: SavedGraph, edges: Array) -> CheckedSpectrum:
    """Return all eigenvalues of the grounded Laplacian; the first is 0 if an agent is cut off."""
    (i, j), weights, selection = edges[:, :2].astype(int).T, edges[:, 2], followers(graph)
    W = np.zeros((graph.agents, graph.agents))
    np.add.at(W, (np.append(i, j), np.append(j, i)), np.append(weights, weights))
    inner_weights, leader_weights = (
        W[np.ix_(selection, selection)],
        W[np.ix_(selection, graph.leaders)].sum(axis=1),
    )
    values = scipy.linalg.eigvalsh(
        np.diag(inner_weights.sum(axis=1) + leader_weights) - inner_weights
    )
    values[0], bound = _least(inner_weights, leader_weights)
    return CheckedSpectrum(values, bound)


def ends_of_many(values: Array) -> Array:
    """Return all eigenvalues, or only the two extreme ones of a large graph."""
    return values if len(values) <= ALL_MODES else values[[0, -1]]


def _least(inner_weights: Array, leader_weights: Array) -> tuple[float, float]:
    """Return the smallest eigenvalue of L = diag(apart 1 + led) - apart, and a lower bound of it.

    L^-1 has no negative entries. It is applied by an elimination without subtractions, which loses
    no digits for any range of weights (Grassmann, Taksar, Heyman). For every x > 0, no eigenvalue
    of L^-1 exceeds the largest entry of L^-1 x / x (Collatz, Wielandt).
    """
    steps = eliminate(inner_weights, leader_weights)
    if steps is None:
        return 0.0, 0.0
    # Iteration alone converges too slowly if the next eigenvalue is close, hence this start. Its
    # small entries must be too large: from above, y / x decreases to the eigenvalue at once.
    x = y = (
        np.abs(
            scipy.linalg.eigh(solve_by_elimination(*steps, np.eye(len(leader_weights))))[1][:, -1]
        )
        + 1e-8
    )
    for _ in range(_ITERATIONS):
        # Entries far from the slowest mode underflow, and the ratio y / x needs positive ones.
        x = np.maximum(y / np.linalg.norm(y), 1e-150)
        y = solve_by_elimination(*steps, x)
        if (y / x).max() * (x @ x) <= (1.0 + 1e-14 * len(x)) * (x @ y):
            break
    # Each addition rounds once; without subtractions relative errors only add up.
    return float(x @ x / (x @ y)), float((1.0 - 8.0 * _EPS * len(x)) / (y / x).max())


def eliminate(inner_weights: Array, leader_weights: Array) -> tuple[Array, Array] | None:
    """Return weights (N, N) and pivots (N,) of an elimination; None if an agent is cut off."""
    W, leader_weights, pivots = (
        inner_weights.copy(),
        leader_weights.copy(),
        np.zeros(len(leader_weights)),
    )
    for k in range(len(W)):
        pivots[k] = leader_weights[k] + W[k, k + 1 :].sum()
        if not pivots[k] > 0.0:
            return None
        part = W[k + 1 :, k] / pivots[k]
        W[k + 1 :, k + 1 :] += np.outer(part, W[k, k + 1 :])
        leader_weights[k + 1 :] += part * leader_weights[k]
        # A self-loop through an eliminated agent cancels in the Laplacian.
        np.fill_diagonal(W[k + 1 :, k + 1 :], 0.0)
    return W, pivots


def solve_by_elimination(W: Array, pivots: Array, b: Array) -> Array:
    """Return L^-1 b, b (N,) or (N, K) not negative, by the steps of an elimination."""
    x = b.copy()
    for k in range(len(x)):
        x[k + 1 :] += np.multiply.outer(W[k + 1 :, k], x[k] / pivots[k])
    for k in reversed(range(len(x))):
        x[k] = (x[k] + W[k, k + 1 :] @ x[k + 1 :]) / pivots[k]
    return x


def size(matrix: Array) -> float:
    """Return the norm of a matrix after balancing (diagonal scaling of its states)."""
    return float(np.linalg.norm(scipy.linalg.matrix_balance(matrix, permute=False)[0]))


Doubt: TypeAlias = Callable[[Array, Array], float]
"""Bounds |y* D x| for vectors y, x of length n, where D is the uncertainty of a matrix."""


def rightmost(matrix: Array, doubt: Doubt = lambda y, x: 0.0) -> tuple[float, float]:
    """Return the largest real part of an eigenvalue, and its error by rounding and `doubt`."""
    # Balanced, since badly scaled states would inflate the bound of the rounding.
    balanced, (units, _) = scipy.linalg.matrix_balance(matrix, permute=False, separate=True)
    result: Any = scipy.linalg.eig(balanced, left=True, right=True)
    values, left, right = result
    at = int(np.argmax(values.real))
    y, x = left[:, at], right[:, at]
    # A simple eigenvalue moves by the perturbation over the cosine of its two vectors (Wilkinson).
    cosine = max(abs(np.vdot(y, x)), 1e-300)
    lost = 50.0 * _EPS * float(np.linalg.norm(balanced)) + doubt(y / units, units * x)
    # Near a Jordan block that bound is too large: a block of size 4 moves by the fourth root.
    return float(values[at].real), min(lost / cosine, 1e-2 * lost**0.25)


def observable(A: Array, C: Array) -> int:
    """Return the dimension of the span of C', A'C', A'A'C', ..., built block by block."""
    basis = np.zeros((len(A), 0))
    block = C.T
    while block.size and basis.shape[1] < len(A):
        # Normalized, so that one tolerance suits all powers of A.
        block = block / np.maximum(np.linalg.norm(block, axis=0), 1e-300)
        # Twice: a single Gram-Schmidt step leaves rounding errors of the size of the projection.
        for _ in range(2):
            block = block - basis @ (basis.T @ block)
        left, singular, _ = np.linalg.svd(block, full_matrices=False)
        new = left[:, singular > 1e-9]
        basis, block = np.hstack([basis, new]), A.T @ new
        block = block[:, np.linalg.norm(block, axis=0) > 1e-12 * np.linalg.norm(A)]
    return basis.shape[1]


def growth(P: Array, As: Array, Ws: Array, strength: float) -> tuple[float, float]:
    """Return the largest x with det(P A + A'P - strength P W P - x P) = 0, and its rounding.

    It is the largest over all A (K, n, n) and W (K, n, n) of a pair.
    """
    # With P = L L' the determinant vanishes at the eigenvalues of L^-1 (...) L^-T.
    root = scipy.linalg.solve_triangular(np.linalg.cholesky(P), np.eye(len(P)), lower=True)
    PA, feedback = P @ As, strength * P @ Ws @ P
    slope = root @ (PA + PA.swapaxes(1, 2) - feedback) @ root.T
    values = np.linalg.eigvalsh(0.5 * (slope + slope.swapaxes(1, 2)))[:, -1]
    # Rounding is relative to the terms before they cancel, hence absolute values.
    parts = np.abs(P) @ np.abs(As) + 0.5 * np.abs(feedback)
    sizes = np.abs(root) @ (parts + parts.swapaxes(1, 2)) @ np.abs(root.T)
    whole = float(np.linalg.norm(sizes, axis=(1, 2)).max())
    return float(values.max()), 4.0 * _EPS * len(P) * whole
