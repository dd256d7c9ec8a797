"""Linear algebra of the checker of saved gains: spectra, ranks and growth, and their rounding."""

from collections.abc import Callable
from fractions import Fraction
from typing import Any, NamedTuple, TypeAlias

import numpy as np
import scipy.linalg

from echelon.core.types import Array
from echelon.guarantees.verifier.saved_gain import SavedGraph

ALL_MODES = 400
"""On larger graphs two eigenvalues stand for all."""
_ITERATIONS = 100
"""Of a power iteration that starts where floating point ended."""
_EPS = float(np.finfo(float).eps)


def followers(graph: SavedGraph) -> list[int]:
    """Return the agents that lead not."""
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
    """Eigenvalues of the grounded Laplacian, ascending, and what the smallest is no less than."""

    values: Array
    bound: float


def spectrum(graph: SavedGraph, edges: Array) -> CheckedSpectrum:
    """Return all eigenvalues of the grounded Laplacian; 0 first where an agent is not reached."""
    (i, j), weights, selection = edges[:, :2].astype(int).T, edges[:, 2], followers(graph)
    W = np.zeros((graph.agents, graph.agents))
    np.add.at(W, (np.append(i, j), np.append(j, i)), np.append(weights, weights))
    apart, led = W[np.ix_(selection, selection)], W[np.ix_(selection, graph.leaders)].sum(axis=1)
    values = scipy.linalg.eigvalsh(np.diag(apart.sum(axis=1) + led) - apart)
    values[0], bound = _least(apart, led)
    return CheckedSpectrum(values, bound)


def ends_of_many(values: Array) -> Array:
    """Return eigenvalues, or the extreme two of many."""
    return values if len(values) <= ALL_MODES else values[[0, -1]]


def _least(apart: Array, led: Array) -> tuple[float, float]:
    """Return the smallest eigenvalue of L = diag(apart 1 + led) - apart, and a lower bound of it.

    L^-1 has no negative entry. It is applied by an elimination that only adds, so that no digit is
    lost whatever the range of the weights (Grassmann, Taksar, Heyman), and for every x > 0 no
    eigenvalue of it exceeds the largest entry of L^-1 x / x (Collatz, Wielandt).
    """
    steps = eliminated(apart, led)
    if steps is None:
        return 0.0, 0.0
    # Where the next eigenvalue is close, iterations alone would not leave it behind. Small entries
    # of the guess must be too large: from above, y / x comes down to the eigenvalue at once.
    x = y = np.abs(scipy.linalg.eigh(solved(*steps, np.eye(len(led))))[1][:, -1]) + 1e-8
    for _ in range(_ITERATIONS):
        # What is far from the slowest mode dies out, and must not become zero.
        x = np.maximum(y / np.linalg.norm(y), 1e-150)
        y = solved(*steps, x)
        if (y / x).max() * (x @ x) <= (1.0 + 1e-14 * len(x)) * (x @ y):
            break
    # Each of the additions rounds once.
    return float(x @ x / (x @ y)), float((1.0 - 8.0 * _EPS * len(x)) / (y / x).max())


def eliminated(apart: Array, led: Array) -> tuple[Array, Array] | None:
    """Return weights (N, N) and pivots (N,) of an elimination; None where one agent is cut off."""
    W, led, pivots = apart.copy(), led.copy(), np.zeros(len(led))
    for k in range(len(W)):
        pivots[k] = led[k] + W[k, k + 1 :].sum()
        if not pivots[k] > 0.0:
            return None
        part = W[k + 1 :, k] / pivots[k]
        W[k + 1 :, k + 1 :] += np.outer(part, W[k, k + 1 :])
        led[k + 1 :] += part * led[k]
        # What an agent hears of itself by way of another moves it nowhere.
        np.fill_diagonal(W[k + 1 :, k + 1 :], 0.0)
    return W, pivots


def solved(W: Array, pivots: Array, b: Array) -> Array:
    """Return L^-1 b, b (N,) or (N, K) not negative, by the steps of an elimination."""
    x = b.copy()
    for k in range(len(x)):
        x[k + 1 :] += np.multiply.outer(W[k + 1 :, k], x[k] / pivots[k])
    for k in reversed(range(len(x))):
        x[k] = (x[k] + W[k, k + 1 :] @ x[k + 1 :]) / pivots[k]
    return x


def size(matrix: Array) -> float:
    """Return the norm of a matrix in those units of its states that make it small."""
    return float(np.linalg.norm(scipy.linalg.matrix_balance(matrix, permute=False)[0]))


Doubt: TypeAlias = Callable[[Array, Array], float]
"""From vectors y, x of length n to a bound on |y* D x|, D what is not known of a matrix."""


def rightmost(matrix: Array, doubt: Doubt = lambda y, x: 0.0) -> tuple[float, float]:
    """Return the largest real part of an eigenvalue, and what rounding and a doubt make of it."""
    # Without the units of the states, which would inflate the bound of the rounding.
    balanced, (units, _) = scipy.linalg.matrix_balance(matrix, permute=False, separate=True)
    result: Any = scipy.linalg.eig(balanced, left=True, right=True)
    values, left, right = result
    at = int(np.argmax(values.real))
    y, x = left[:, at], right[:, at]
    # A simple eigenvalue moves by the perturbation over the cosine of its two vectors (Wilkinson).
    cosine = max(abs(np.vdot(y, x)), 1e-300)
    lost = 50.0 * _EPS * float(np.linalg.norm(balanced)) + doubt(y / units, units * x)
    # Near a Jordan block that says too much: one of four moves by about the fourth root.
    return float(values[at].real), min(lost / cosine, 1e-2 * lost**0.25)


def observable(A: Array, C: Array) -> int:
    """Return the dimension of the span of C', A'C', A'A'C', ..., grown one block at a time."""
    basis = np.zeros((len(A), 0))
    block = C.T
    while block.size and basis.shape[1] < len(A):
        # Columns of unit length, so that one tolerance does for all powers of A.
        block = block / np.maximum(np.linalg.norm(block, axis=0), 1e-300)
        # Twice, since once leaves rounding of the size of what was taken away.
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
    # Rounding is of the terms before they cancel, hence absolute values throughout.
    parts = np.abs(P) @ np.abs(As) + 0.5 * np.abs(feedback)
    sizes = np.abs(root) @ (parts + parts.swapaxes(1, 2)) @ np.abs(root.T)
    whole = float(np.linalg.norm(sizes, axis=(1, 2)).max())
    return float(values.max()), 4.0 * _EPS * len(P) * whole
