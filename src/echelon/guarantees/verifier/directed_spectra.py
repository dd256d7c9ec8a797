"""Spectra of directed graphs: eigenvalues, an accurate smallest one, decay of weighted sums."""

from fractions import Fraction

import numpy as np

from echelon.core.types import Array
from echelon.guarantees.verifier import algebra, exact_minors
from echelon.guarantees.verifier.saved_gain import SavedGraph

_ITERATIONS = 400
_EPS = float(np.finfo(float).eps)
_EXACT = 60
"""Followers up to which a bound is proved in exact arithmetic."""


def directed_spectrum(graph: SavedGraph, edges: Array) -> tuple[Array, float, float]:
    """Return eigenvalues of the grounded Laplacian (n,), the smallest, and the bound of the sum.

    The smallest is 0 if an agent is cut off; the bound is 0 if the file has no weights of a sum.
    """
    W, selection = np.zeros((graph.agents, graph.agents)), algebra.followers(graph)
    # On an edge (i, j), j receives from i.
    W[edges[:, 1].astype(int), edges[:, 0].astype(int)] = edges[:, 2]
    inner_weights, leader_weights = (
        W[np.ix_(selection, selection)],
        W[np.ix_(selection, graph.leaders)].sum(axis=1),
    )
    L = np.diag(inner_weights.sum(axis=1) + leader_weights) - inner_weights
    if not _reachable(inner_weights > 0.0, leader_weights > 0.0).all():
        return np.zeros(len(L), complex), 0.0, 0.0
    values, low = list[Array](), np.inf
    for component in _strong_components(inner_weights > 0.0):
        values.append(np.linalg.eigvals(L[np.ix_(component, component)]).astype(complex))
        others = np.setdiff1d(np.arange(len(L)), component)
        inside = inner_weights[np.ix_(component, component)]
        outside = leader_weights[component] + inner_weights[np.ix_(component, others)].sum(axis=1)
        low = min(low, _least(inside, outside))
    return np.concatenate(values), low, _sum_bound(graph, edges, L)


def _reachable(is_neighbour: Array, leader_weights: Array) -> Array:
    """Return which agents a leader reaches, directly or through others, (n,)."""
    reached = leader_weights.copy()
    for _ in range(len(leader_weights)):
        reached = reached | (is_neighbour & reached).any(axis=1)
    return reached


def _strong_components(is_neighbour: Array) -> list[Array]:
    """Return the strongly connected components, by powers of the adjacency matrix."""
    ways = np.eye(len(is_neighbour), dtype=bool) | is_neighbour
    for _ in range(max(1, int(np.ceil(np.log2(max(2, len(is_neighbour))))))):
        ways = (ways.astype(np.float32) @ ways.astype(np.float32)) > 0.0
    both, visited, result = ways & ways.T, np.zeros(len(is_neighbour), bool), list[Array]()
    for k in range(len(is_neighbour)):
        if not visited[k]:
            result.append(np.flatnonzero(both[k]))
            visited[result[-1]] = True
    return result


def _least(inside: Array, outside: Array) -> float:
    """Return the smallest eigenvalue of diag(inside 1 + outside) - inside, of one component.

    Inverse iteration by an elimination without subtractions; the eigenvalue lies between the least
    and the largest x / L^-1 x (Collatz, Wielandt).
    """
    steps = algebra.eliminate(inside, outside)
    if steps is None:
        return 0.0
    x, ends = np.ones(len(outside)), (0.0, 0.0)
    for _ in range(_ITERATIONS):
        y = algebra.solve_by_elimination(*steps, x)
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
    size, selection = graph.agents, algebra.followers(graph)
    L = [[Fraction(0)] * size for _ in range(size)]
    for i, j, weight in edges:
        L[int(j)][int(j)] += Fraction(float(weight))
        L[int(j)][int(i)] -= Fraction(float(weight))
    w = {agent: Fraction(float(x)) for agent, x in zip(selection, graph.sums, strict=True)}
    rows = [[w[i] * L[i][j] + w[j] * L[j][i] for j in selection] for i in selection]
    for k, agent in enumerate(selection):
        rows[k][k] -= 2 * Fraction(bound) * w[agent]
    return exact_minors.is_positive_definite(rows)
