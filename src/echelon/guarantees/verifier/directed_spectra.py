"""Spectra of directed graphs: eigenvalues, the smallest to all digits, what a sum is held by."""

from fractions import Fraction

import numpy as np

from echelon.core.types import Array
from echelon.guarantees.verifier import algebra, exact_minors
from echelon.guarantees.verifier.saved_gain import SavedGraph

_ROUNDS = 400
_EPS = float(np.finfo(float).eps)
_EXACT = 60
"""Followers up to which a bound is held to whole numbers."""


def directed_spectrum(graph: SavedGraph, edges: Array) -> tuple[Array, float, float]:
    """Return all eigenvalues of the grounded Laplacian (n,), the smallest, and its sum's bound.

    The smallest is 0 where an agent is not reached, and the bound where no sum is known.
    """
    W, selection = np.zeros((graph.agents, graph.agents)), algebra.followers(graph)
    # Of an arrow (i, j) j hears i.
    W[edges[:, 1].astype(int), edges[:, 0].astype(int)] = edges[:, 2]
    apart, led = W[np.ix_(selection, selection)], W[np.ix_(selection, graph.leaders)].sum(axis=1)
    L = np.diag(apart.sum(axis=1) + led) - apart
    if not _reached(apart > 0.0, led > 0.0).all():
        return np.zeros(len(L), complex), 0.0, 0.0
    values, low = list[Array](), np.inf
    for circle in _circles(apart > 0.0):
        values.append(np.linalg.eigvals(L[np.ix_(circle, circle)]).astype(complex))
        others = np.setdiff1d(np.arange(len(L)), circle)
        inside = apart[np.ix_(circle, circle)]
        outside = led[circle] + apart[np.ix_(circle, others)].sum(axis=1)
        low = min(low, _least(inside, outside))
    return np.concatenate(values), low, _held(graph, edges, L)


def _reached(hears: Array, led: Array) -> Array:
    """Return who hears a leader, through others or not, (n,)."""
    reached = led.copy()
    for _ in range(len(led)):
        reached = reached | (hears & reached).any(axis=1)
    return reached


def _circles(hears: Array) -> list[Array]:
    """Return the sets of agents that hear each other in circles: by powers of who hears whom."""
    ways = np.eye(len(hears), dtype=bool) | hears
    for _ in range(max(1, int(np.ceil(np.log2(max(2, len(hears))))))):
        ways = (ways.astype(np.float32) @ ways.astype(np.float32)) > 0.0
    both, visited, result = ways & ways.T, np.zeros(len(hears), bool), list[Array]()
    for k in range(len(hears)):
        if not visited[k]:
            result.append(np.flatnonzero(both[k]))
            visited[result[-1]] = True
    return result


def _least(inside: Array, outside: Array) -> float:
    """Return the smallest eigenvalue of diag(inside 1 + outside) - inside, of one circle.

    By inverse iteration in an elimination that only adds, between the least and the largest
    x / L^-1 x (Collatz, Wielandt).
    """
    steps = algebra.eliminated(inside, outside)
    if steps is None:
        return 0.0
    x, ends = np.ones(len(outside)), (0.0, 0.0)
    for _ in range(_ROUNDS):
        y = algebra.solved(*steps, x)
        ends = float((x / y).min()), float((x / y).max())
        x = np.maximum(y / y.max(), 1e-150)
        if ends[1] <= (1.0 + 1e-14 * len(x)) * ends[0]:
            break
    return 0.5 * (ends[0] + ends[1])


def _held(graph: SavedGraph, edges: Array, L: Array) -> float:
    """Return s with W L + L'W >= 2 s W for the weights W of the file; 0 where there are none."""
    if graph.sums is None:
        return 0.0
    root = np.sqrt(graph.sums)
    scaled = root[:, None] * L / root
    symmetric = 0.5 * (scaled + scaled.T)
    bound = float(np.linalg.eigvalsh(symmetric)[0])
    lost = 8.0 * len(L) * _EPS * float(np.abs(symmetric).sum(axis=1).max())
    bound = max(0.0, bound - lost) * (1.0 - 1e-10)
    return bound if len(L) > _EXACT or _proved(graph, edges, bound) else 0.0


def _proved(graph: SavedGraph, edges: Array, held: float) -> bool:
    """Tell whether W L + L'W - 2 s W is positive definite, by exact minors."""
    assert graph.sums is not None
    size, selection = graph.agents, algebra.followers(graph)
    L = [[Fraction(0)] * size for _ in range(size)]
    for i, j, weight in edges:
        L[int(j)][int(j)] += Fraction(float(weight))
        L[int(j)][int(i)] -= Fraction(float(weight))
    w = {agent: Fraction(float(x)) for agent, x in zip(selection, graph.sums, strict=True)}
    rows = [[w[i] * L[i][j] + w[j] * L[j][i] for j in selection] for i in selection]
    for k, agent in enumerate(selection):
        rows[k][k] -= 2 * Fraction(held) * w[agent]
    return exact_minors.is_positive_definite(rows)
