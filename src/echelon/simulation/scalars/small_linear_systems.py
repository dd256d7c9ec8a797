"""Small systems of linear equations as scalar operations: elimination, factors, triangles."""

import numpy as np
from jax.extend.core import JaxprEqn

from echelon.core.jaxpr import Algebra, walk
from echelon.simulation.scalars.scalar_graph import Node, ScalarGraph
from echelon.simulation.scalars.traced_entries import (
    LARGEST,
    Arrays,
    Missing,
    Params,
    Unsupported,
    missing,
    nodes,
    select,
    where,
)


def solve(graph: ScalarGraph, algebra: Algebra, equation: JaxprEqn, operands: Arrays) -> Arrays:
    """Return the solution of linear equations; images of unit vectors are the matrix's columns."""
    jaxprs, lengths = equation.params["jaxprs"], equation.params["const_lengths"]
    matvec, count = jaxprs.matvec, lengths.matvec
    total = sum(lengths)
    consts, b = operands[:count], operands[total:]
    if len(b) != 1:
        raise Unsupported(f"`custom_linear_solve` of several vectors{where(equation)}")
    [right] = b
    columns = []
    for k in range(right.size):
        unit = np.zeros(right.size)
        unit[k] = 1.0
        [image] = walk(matvec.jaxpr, matvec.consts, [*consts, unit.reshape(right.shape)], algebra)
        columns.append(nodes(graph, image))
    rows = np.array(columns, object).T
    solved = np.empty(right.size, object)
    for part in _parts(rows):
        if len(part) > LARGEST:
            raise Unsupported(f"a system of {len(part)} equations{where(equation)}")
        rhs = np.array(nodes(graph, right), object)[part]
        solved[part] = _eliminate(graph, rows[np.ix_(part, part)], rhs)
    return [solved.reshape(right.shape)]


def _parts(rows: np.ndarray) -> list[list[int]]:
    """Return the sets of unknowns that share no equation with others."""
    from scipy.sparse.csgraph import connected_components

    nonzero = np.vectorize(lambda e: not (e.op == "constant" and e.value == 0.0))(rows)
    count, label = connected_components(nonzero, directed=False)
    return [np.flatnonzero(label == k).tolist() for k in range(count)]


def _eliminate(graph: ScalarGraph, matrix: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Return the solution by Gauss's method."""
    both, n = np.column_stack([matrix, right]), len(matrix)
    for k in range(n):
        _pivot(graph, both, k, n)
        for i in range(k + 1, n):
            factor = both[i, k] / both[k, k]
            both[i, k:] = [p - factor * q for p, q in zip(both[i, k:], both[k, k:], strict=True)]
    return _by_triangle(both[:, :n], both[:, n], lower=False, unit=False)


def _pivot(graph: ScalarGraph, rows: np.ndarray, k: int, n: int) -> Node:
    """Exchange row k for that of the largest entry below, and return the index of that row."""
    largest, place = graph.make("abs", rows[k, k]), graph.constant(float(k))
    for i in range(k + 1, n):
        size = graph.make("abs", rows[i, k])
        larger = graph.make("lt", largest, size)
        largest, place = select(graph, larger, size, largest), select(graph, larger, i, place)
    here = rows[k].copy()
    for i in range(k + 1, n):
        it = graph.make("eq", place, float(i))
        rows[k] = [select(graph, it, p, q) for p, q in zip(rows[i], rows[k], strict=True)]
        rows[i] = [select(graph, it, q, p) for p, q in zip(rows[i], here, strict=True)]
    return place


def _by_triangle(A: np.ndarray, right: np.ndarray, lower: bool, unit: bool) -> np.ndarray:
    """Return the solution of equations whose matrix is triangular."""
    b, n = right.copy(), len(A)
    for k in range(n) if lower else reversed(range(n)):
        for j in range(k) if lower else range(k + 1, n):
            b[k] = b[k] - A[k, j] * b[j]
        b[k] = b[k] if unit else b[k] / A[k, k]
    return b


def cholesky(graph: ScalarGraph, params: Params, matrix: np.ndarray) -> np.ndarray:
    """Return the L with L L' = matrix."""
    n = matrix.shape[-1]
    if matrix.ndim != 2 or n > LARGEST:
        raise Unsupported(f"`cholesky` of shape {matrix.shape}")
    L = np.full((n, n), 0.0, object)
    for j in range(n):
        rest = matrix[j, j] - sum((L[j, k] * L[j, k] for k in range(j)), 0.0)
        L[j, j] = graph.make("sqrt", rest)
        for i in range(j + 1, n):
            rest = matrix[i, j] - sum((L[i, k] * L[j, k] for k in range(j)), 0.0)
            L[i, j] = rest / L[j, j]
    return L


def triangle(graph: ScalarGraph, algebra: Algebra, equation: JaxprEqn, operands: Arrays) -> Arrays:
    """Return the solution X of A X = B, or of X A = B, for a triangular A."""
    A, B = (np.asarray(x, object) for x in operands)
    if any(isinstance(e, Missing) for x in (A, B) for e in x.flat):
        return missing(equation)
    if A.ndim != 2 or len(A) > LARGEST:
        raise Unsupported(f"`triangular_solve` of shape {A.shape}{where(equation)}")
    params = equation.params
    left, lower = params["left_side"], params["lower"]
    if params["transpose_a"] == left:
        A, lower = A.T, not lower
    rows = np.array(nodes(graph, A), object).reshape(A.shape)
    columns = B.T if left else B
    solved = [_by_triangle(rows, column, lower, params["unit_diagonal"]) for column in columns]
    return [np.array(solved, object).reshape(columns.shape).T if left else np.stack(solved)]


def lu(graph: ScalarGraph, algebra: Algebra, equation: JaxprEqn, operands: Arrays) -> Arrays:
    """Return L and U in one matrix, the pivot row of each step, and the order of the rows.

    If they are computed for a system of equations, nothing reads them: `solve` eliminates itself.
    """
    [matrix] = operands
    n = matrix.shape[-1]
    if matrix.shape != (n, n) or n > LARGEST:
        return missing(equation)
    order = np.array([graph.constant(float(k)) for k in range(n)])
    rows = np.column_stack([np.array(nodes(graph, matrix), object).reshape(n, n), order])
    pivots = []
    for k in range(n):
        pivots.append(_pivot(graph, rows, k, n))
        for i in range(k + 1, n):
            rows[i, k] = factor = rows[i, k] / rows[k, k]
            later = zip(rows[i, k + 1 : n], rows[k, k + 1 : n], strict=True)
            rows[i, k + 1 : n] = [p - factor * q for p, q in later]
    return [rows[:, :n], np.array(pivots, object), rows[:, n]]
