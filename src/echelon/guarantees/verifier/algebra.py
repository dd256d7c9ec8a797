"""Linear algebra of the verifier: in floats with bounds of their rounding, and exactly."""

import math
from collections.abc import Callable
from fractions import Fraction
from typing import Any, NamedTuple, TypeAlias

import numpy as np
import scipy.linalg

from echelon.core.types import Array
from echelon.guarantees.verifier.saved_gain import SavedGraph

# ---- spectra, ranks and growth rates -------------------------------------------------------------

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
    inner_weights = W[np.ix_(selection, selection)]
    leader_weights = W[np.ix_(selection, graph.leaders)].sum(axis=1)
    L = np.diag(inner_weights.sum(axis=1) + leader_weights) - inner_weights
    values = scipy.linalg.eigvalsh(L)
    values[0], bound = _least(inner_weights, leader_weights)
    return CheckedSpectrum(values, bound)


def ends_of_many(values: Array) -> Array:
    """Return all eigenvalues, or only the two extreme ones of a large graph."""
    return values if len(values) <= ALL_MODES else values[[0, -1]]


def _least(inner_weights: Array, leader_weights: Array) -> tuple[float, float]:
    """Return lambda_min of L = diag(apart 1 + led) - apart and 1 / max(L^-1 x / x) <= it."""
    steps = eliminate(inner_weights, leader_weights)
    if steps is None:
        return 0.0, 0.0
    # Iteration alone converges too slowly if the next eigenvalue is close, hence this start. Its
    # small entries must be too large: from above, y / x decreases to the eigenvalue at once.
    whole = solve_by_elimination(*steps, np.eye(len(leader_weights)))
    x = y = np.abs(scipy.linalg.eigh(whole)[1][:, -1]) + 1e-8
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
    W, leader_weights = inner_weights.copy(), leader_weights.copy()
    pivots = np.zeros(len(leader_weights))
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


# ---- exact leading minors ------------------------------------------------------------------------
# By Sylvester's criterion a symmetric matrix is positive definite exactly when its leading minors
# are positive. Every float is a fraction; rows are multiplied by their denominators, and the minors
# of integer matrices are computed without fractions (Bareiss).

Rows: TypeAlias = list[list[Fraction]]


def rows_of(matrix: Array) -> Rows:
    """Return a matrix of floats as the fractions that they are."""
    return [[Fraction(float(x)) for x in row] for row in matrix]


def is_positive_definite(matrix: Rows) -> bool:
    """Tell exactly whether a symmetric matrix is positive definite."""
    # Sylvester's criterion speaks of symmetric matrices alone.
    if any(matrix[i][j] != matrix[j][i] for i in range(len(matrix)) for j in range(i)):
        return False
    # A positive factor on a row changes the sign of no minor.
    rest, last = [_whole(row) for row in matrix], 1
    while rest:
        (pivot, *tail), *below = rest
        if pivot <= 0:
            return False
        # Bareiss: the remaining entries are minors, divisible by the previous pivot.
        rest = [
            [(pivot * x - row[0] * y) // last for x, y in zip(row[1:], tail, strict=True)]
            for row in below
        ]
        last = pivot
    return True


def _whole(row: list[Fraction]) -> list[int]:
    shared = math.lcm(*(x.denominator for x in row))
    return [x.numerator * (shared // x.denominator) for x in row]


def product(left: Rows, right: Rows) -> Rows:
    """Return the matrix product, exactly."""
    columns = list(zip(*right, strict=True))
    # Fractions are slow, and most entries of these matrices are zero.
    return [
        [sum((x * y for x, y in zip(a, b, strict=True) if x and y), Fraction(0)) for b in columns]
        for a in left
    ]


def transpose(matrix: Rows) -> Rows:
    """Return the transpose."""
    return [list(column) for column in zip(*matrix, strict=True)]


def inverse(matrix: Rows) -> Rows:
    """Return the inverse of a positive definite matrix, exactly (Gauss and Jordan)."""
    size = len(matrix)
    work = [[*row, *(Fraction(i == j) for j in range(size))] for i, row in enumerate(matrix)]
    for k in range(size):
        # The pivots of a positive definite matrix are positive, so no rows are exchanged.
        work[k] = [x / work[k][k] for x in work[k]]
        for i in range(size):
            if i != k and work[i][k]:
                work[i] = [x - work[i][k] * y for x, y in zip(work[i], work[k], strict=True)]
    return [row[size:] for row in work]


def weighted(B: Array, R: Array, P: Array) -> tuple[Array, Array, Array]:
    """Return R^-1 B' (m, n), B R^-1 B' (n, n) and B R^-1 B'P (n, n), each rounded once."""
    pull = product(inverse(rows_of(R)), transpose(rows_of(B)))
    both = product(rows_of(B), pull)
    return _to_floats(pull), _to_floats(both), _to_floats(product(both, rows_of(P)))


def _to_floats(matrix: Rows) -> Array:
    return np.array([[float(x) for x in row] for row in matrix])


def first_unproved(
    P: Array, B: Array, R: Array, hull: Array, error: Array, strength: Fraction, rate: float
) -> int | None:
    """Return the first vertex A at which the rate is not proved, or None if all are.

    The inequality is P A + A'P - strength P B R^-1 B'P + 2 rate P < 0, also for every matrix
    within +- error of A. Such a change adds at most |P| error + its transpose, entry by entry; its
    row sums on the diagonal dominate it for any signs (Gershgorin).

    `hull` is (K, n, n), `error` (n, n); P must be symmetric to the bit, `strength` from below.
    """
    metric, change = rows_of(P), rows_of(abs(error))
    pull = product(metric, rows_of(B))
    feedback = product(product(pull, inverse(rows_of(R))), transpose(pull))
    # |P dA| <= |P| error for every dA within +- error.
    spread = product(rows_of(abs(P)), change)
    fixed = [
        [strength * feedback[i][j] - 2 * Fraction(rate) * metric[i][j] for j in range(len(metric))]
        for i in range(len(metric))
    ]
    for i, row in enumerate(spread):
        fixed[i][i] -= sum(row) + sum(other[i] for other in spread)
    for number, corner in enumerate(hull):
        PA = product(metric, rows_of(corner))
        slope = [
            [fixed[i][j] - PA[i][j] - PA[j][i] for j in range(len(fixed))]
            for i in range(len(fixed))
        ]
        if not is_positive_definite(slope):
            return number
    return None


# ---- spectra of directed graphs ------------------------------------------------------------------

_DIRECTED_ITERATIONS = 400
_EXACT = 60
"""Followers up to which a bound is proved in exact arithmetic."""


def directed_spectrum(graph: SavedGraph, edges: Array) -> tuple[Array, float, float]:
    """Return eigenvalues of the grounded Laplacian (n,), the smallest, and the bound of the sum.

    The smallest is 0 if an agent is cut off; the bound is 0 if the file has no weights of a sum.
    """
    W, selection = np.zeros((graph.agents, graph.agents)), followers(graph)
    # On an edge (i, j), j receives from i.
    W[edges[:, 1].astype(int), edges[:, 0].astype(int)] = edges[:, 2]
    inner_weights = W[np.ix_(selection, selection)]
    leader_weights = W[np.ix_(selection, graph.leaders)].sum(axis=1)
    L = np.diag(inner_weights.sum(axis=1) + leader_weights) - inner_weights
    if not _reachable(inner_weights > 0.0, leader_weights > 0.0).all():
        return np.zeros(len(L), complex), 0.0, 0.0
    values, low = list[Array](), np.inf
    for component in _strong_components(inner_weights > 0.0):
        values.append(np.linalg.eigvals(L[np.ix_(component, component)]).astype(complex))
        others = np.setdiff1d(np.arange(len(L)), component)
        inside = inner_weights[np.ix_(component, component)]
        outside = leader_weights[component] + inner_weights[np.ix_(component, others)].sum(axis=1)
        low = min(low, _least_of_block(inside, outside))
    return np.concatenate(values), low, _sum_bound(graph, edges, L)


def _reachable(is_neighbour: Array, leader_weights: Array) -> Array:
    reached = leader_weights.copy()
    for _ in range(len(leader_weights)):
        reached = reached | (is_neighbour & reached).any(axis=1)
    return reached


def _strong_components(is_neighbour: Array) -> list[Array]:
    ways = np.eye(len(is_neighbour), dtype=bool) | is_neighbour
    for _ in range(max(1, int(np.ceil(np.log2(max(2, len(is_neighbour))))))):
        ways = (ways.astype(np.float32) @ ways.astype(np.float32)) > 0.0
    both, visited, result = ways & ways.T, np.zeros(len(is_neighbour), bool), list[Array]()
    for k in range(len(is_neighbour)):
        if not visited[k]:
            result.append(np.flatnonzero(both[k]))
            visited[result[-1]] = True
    return result


def _least_of_block(inside: Array, outside: Array) -> float:
    """Inverse iteration: it is between the least and largest x / L^-1 x (Collatz, Wielandt)."""
    steps = eliminate(inside, outside)
    if steps is None:
        return 0.0
    x, ends = np.ones(len(outside)), (0.0, 0.0)
    for _ in range(_DIRECTED_ITERATIONS):
        y = solve_by_elimination(*steps, x)
        ends = float((x / y).min()), float((x / y).max())
        x = np.maximum(y / y.max(), 1e-150)
        if ends[1] <= (1.0 + 1e-14 * len(x)) * ends[0]:
            break
    return 0.5 * (ends[0] + ends[1])


def _sum_bound(graph: SavedGraph, edges: Array, L: Array) -> float:
    """Return s with W L + L'W >= 2 s W for the weights W of the file; 0 if there are none."""
    if graph.sums is None:
        return 0.0
    root = np.sqrt(graph.sums)
    scaled = root[:, None] * L / root
    symmetric = 0.5 * (scaled + scaled.T)
    bound = float(np.linalg.eigvalsh(symmetric)[0])
    lost = 8.0 * len(L) * _EPS * float(np.abs(symmetric).sum(axis=1).max())
    bound = max(0.0, bound - lost) * (1.0 - 1e-10)
    return bound if len(L) > _EXACT or _is_bound_proved(graph, edges, bound) else 0.0


def _is_bound_proved(graph: SavedGraph, edges: Array, bound: float) -> bool:
    """Tell whether W L + L'W - 2 s W is positive definite, by exact minors."""
    assert graph.sums is not None
    size, selection = graph.agents, followers(graph)
    L = [[Fraction(0)] * size for _ in range(size)]
    for i, j, weight in edges:
        L[int(j)][int(j)] += Fraction(float(weight))
        L[int(j)][int(i)] -= Fraction(float(weight))
    w = {agent: Fraction(float(x)) for agent, x in zip(selection, graph.sums, strict=True)}
    rows = [[w[i] * L[i][j] + w[j] * L[j][i] for j in selection] for i in selection]
    for k, agent in enumerate(selection):
        rows[k][k] -= 2 * Fraction(bound) * w[agent]
    return is_positive_definite(rows)
