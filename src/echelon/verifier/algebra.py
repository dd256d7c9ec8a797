"""Linear algebra of the checker of saved gains: spectra, ranks and growth, and their rounding."""

from fractions import Fraction
from typing import Any

import numpy as np
import scipy.linalg

from echelon.core.types import Array
from echelon.verifier.file import SavedGraph

ALL_MODES = 400
"""On larger graphs two eigenvalues stand for all."""
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
    kept = followers(graph)
    return [[rows[i][j] for j in kept] for i in kept]


def spectrum(graph: SavedGraph, edges: Array) -> Array:
    """Return the eigenvalues of the grounded Laplacian, or the extreme two of many.

    The smallest is the Rayleigh quotient of its vector, summed over edges: all terms are positive,
    so that it keeps its digits where it is small.
    """
    (i, j), weights, kept = edges[:, :2].astype(int).T, edges[:, 2], followers(graph)
    L = np.zeros((graph.agents, graph.agents))
    for rows, columns, sign in ((i, i, 1.0), (j, j, 1.0), (i, j, -1.0), (j, i, -1.0)):
        np.add.at(L, (rows, columns), sign * weights)
    values, vectors = scipy.linalg.eigh(L[np.ix_(kept, kept)])
    mode = np.zeros(graph.agents)
    mode[kept] = vectors[:, 0]
    values[0] = weights @ (mode[i] - mode[j]) ** 2 / (mode @ mode)
    return values if len(values) <= ALL_MODES else values[[0, -1]]


def rightmost(matrix: Array) -> tuple[float, float]:
    """Return the largest real part of an eigenvalue, and what rounding may make of it."""
    # Without the units of the states, which would inflate the bound of the rounding.
    balanced = scipy.linalg.matrix_balance(matrix, permute=False)[0]
    found: Any = scipy.linalg.eig(balanced, left=True, right=True)
    values, left, right = found
    at = int(np.argmax(values.real))
    # A simple eigenvalue moves by the perturbation over the cosine of its two vectors (Wilkinson).
    cosine = abs(np.vdot(left[:, at], right[:, at]))
    rounding = 50.0 * _EPS * float(np.linalg.norm(balanced))
    # Near a Jordan block that says too much: one of four moves by about the fourth root.
    return float(values[at].real), min(rounding / max(cosine, 1e-300), 1e-2 * rounding**0.25)


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
    turned, held = P @ As, strength * P @ Ws @ P
    slope = root @ (turned + turned.swapaxes(1, 2) - held) @ root.T
    values = np.linalg.eigvalsh(0.5 * (slope + slope.swapaxes(1, 2)))[:, -1]
    # Rounding is of the terms before they cancel, hence absolute values throughout.
    parts = np.abs(P) @ np.abs(As) + 0.5 * np.abs(held)
    sizes = np.abs(root) @ (parts + parts.swapaxes(1, 2)) @ np.abs(root.T)
    whole = float(np.linalg.norm(sizes, axis=(1, 2)).max())
    return float(values.max()), 4.0 * _EPS * len(P) * whole
