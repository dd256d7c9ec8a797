"""Exact leading minors, and the proof of a convergence rate with them.

By Sylvester's criterion a symmetric matrix is positive definite exactly when its leading minors
are positive. Every float is a fraction; rows are multiplied by their denominators, and the minors
of integer matrices are computed without fractions (Bareiss).
"""

import math
from collections.abc import Iterable
from fractions import Fraction
from typing import TypeAlias

import numpy as np

from echelon.core.types import Array

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
    return [[_dot(row, column) for column in columns] for row in left]


def _dot(row: Iterable[Fraction], column: Iterable[Fraction]) -> Fraction:
    # Fractions are slow, and most entries of these matrices are zero.
    return sum((x * y for x, y in zip(row, column, strict=True) if x and y), Fraction(0))


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
    P: Array,
    B: Array,
    R: Array,
    hull: Array,
    error: Array,
    strength: Fraction,
    rate: float,
) -> int | None:
    """Return the first vertex A at which the rate is not proved, or None if all are.

    The inequality is P A + A'P - strength P B R^-1 B'P + 2 rate P < 0, also for every matrix
    within +- error of A. Such a change adds at most |P| error + its transpose, entry by entry; its
    row sums on the diagonal dominate it for any signs (Gershgorin).

    Args:
        P: (n, n), symmetric to the bit and positive definite.
        B: (n, m).
        R: (m, m), symmetric positive definite.
        hull: (K, n, n).
        error: (n, n).
        strength: a lower bound of 2 c lambda_min.
        rate: 1/s.
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
