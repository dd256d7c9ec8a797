"""Recommended leaders and edges: the changes of a graph that speed up a formation most.

The slowest disagreement follows the smallest eigenvalue lambda_min of the grounded Laplacian. One
more leader grounds one more agent, one more edge adds w (v_i - v_j)^2 to its Rayleigh quotient;
neither makes lambda_min smaller.
"""

import itertools
from collections.abc import Sequence
from typing import final

import numpy as np
import scipy.sparse.linalg as spla

from echelon.agents.network.eigenvalues import factor_inverse
from echelon.agents.network.graph import Graph
from echelon.core.errors import GraphError
from echelon.core.types import Array

_DENSE = 400
_ROUNDS = 30
_MOST_TRIED, _FEWEST_TRIED, _WORK = 300, 24, 100_000
"""Largest and smallest number of agents or pairs that are tried, and the work that sets it."""


def recommend_leaders(graph: Graph, count: int = 1) -> tuple[int, ...]:
    """Return followers to make leaders, one after the other, each raising lambda_min the most.

    Chosen one at a time they need not be the best set of `count`. With more than 400 followers an
    even selection is tried, ordered by their amplitude in the slowest mode.

    Raises:
        GraphError: `count` is negative, or leaves no follower; the graph is directed or switches.
    """
    if not 0 <= count < len(graph.followers):
        raise GraphError(
            f"`count` is {count}, and must be from 0 to {len(graph.followers) - 1}, so that a "
            "follower remains."
        )
    _check_mutual(graph)
    chosen = list[int]()
    for _ in range(count):
        chosen.append(_best_leader(graph.with_leaders(chosen)))
    return tuple(chosen)


def recommend_edges(graph: Graph, count: int = 1) -> tuple[tuple[int, int], ...]:
    """Return pairs to link with weight 1, one after the other, each raising lambda_min the most.

    Of many pairs at most 300 are tried, those with the largest first-order effect (v_i - v_j)^2.

    Raises:
        GraphError: `count` is negative, or there are not so many pairs; the graph is directed or
            switches.
    """
    free = graph.agents * (graph.agents - 1) // 2 - len(graph.edges)
    if not 0 <= count <= free:
        raise GraphError(
            f"`count` is {count}, and must be from 0 to {free}, the pairs that are not linked yet."
        )
    _check_mutual(graph)
    chosen = list[tuple[int, int]]()
    for _ in range(count):
        chosen.append(_best_edge(graph.with_edges(chosen)))
    return tuple(chosen)


def _check_mutual(graph: Graph) -> None:
    # The ranking uses properties of a symmetric matrix: a mode's energy and its rank-one change.
    if graph.directed or graph.schedule is not None:
        raise GraphError(
            "leaders and edges are recommended for undirected graphs that do not switch."
        )


def _best_leader(graph: Graph) -> int:
    if len(graph.followers) <= _DENSE:
        # The lower number on a tie.
        return max(graph.followers, key=lambda k: (_lambda_min(graph.with_leaders([k])), -k))
    large = _Large(graph)
    order = np.argsort(-large.mode, kind="stable")
    tried = order[:: 1 + (len(order) - 1) // large.tries]
    values = [large.with_penalty([k], [1.0], 0.0) for k in tried]
    return graph.followers[tried[int(np.argmax(values))]]


def _best_edge(graph: Graph) -> tuple[int, int]:
    if len(graph.followers) <= _DENSE:
        tried = _rank_pairs(graph, _slowest_mode(graph), _MOST_TRIED)
        return max(tried, key=lambda pair: _lambda_min(graph.with_edges([pair])))
    large, mode = _Large(graph), np.zeros(graph.agents)
    # A leader does not move, so its entry of the mode is 0.
    mode[list(graph.followers)] = large.mode
    tried = _rank_pairs(graph, mode, large.tries)
    place = {agent: row for row, agent in enumerate(graph.followers)}
    values = []
    for pair in tried:
        # A leader's end of the edge is grounded, which takes its entry out of the vector.
        rows = [place[k] for k in pair if k in place]
        values.append(large.with_penalty(rows, [1.0, -1.0][: len(rows)], 1.0) if rows else 0.0)
    return tried[int(np.argmax(values))]


@final
class _Large:
    """A large grounded Laplacian, factored once, and its lambda_min after a change of rank one."""

    def __init__(self, graph: Graph) -> None:
        L = graph.grounded_laplacian()
        inverse = factor_inverse(L)
        self.solve = inverse.matvec
        self.mode = np.abs(spla.eigsh(L, k=1, sigma=0.0, OPinv=inverse)[1][:, 0])
        self.tries = max(_FEWEST_TRIED, min(_MOST_TRIED, _WORK // graph.agents))

    def with_penalty(self, rows: Sequence[int], entries: Sequence[float], slack: float) -> float:
        """Return about the least eigenvalue of L + a a' / slack, a given by its few entries.

        An edge of weight 1 has slack 1, and a leader, which may not move at all, has slack 0. It is
        the inverse (Sherman and Morrison) that is iterated.
        """
        a = np.zeros(len(self.mode))
        a[list(rows)] = entries
        # A change of rank one changes the mode little, so a few rounds from it are enough.
        far, x, value = self.solve(a), self.mode, 0.0
        for _ in range(_ROUNDS):
            # (L + a a'/s)^-1 = L^-1 - L^-1 a a'L^-1 / (s + a'L^-1 a).
            y = self.solve(x) - far * (far @ x) / (slack + a @ far)
            value = float(x @ x) / float(x @ y)
            x = y / np.linalg.norm(y)
        return value


def _rank_pairs(graph: Graph, mode: Array, count: int) -> list[tuple[int, int]]:
    """Return the pairs without an edge that raise lambda_min most in first order."""
    # The extremes of the mode form the best pairs, so few agents are enough on a large graph.
    order = np.argsort(mode, kind="stable")
    if len(order) > 2 * _MOST_TRIED:
        order = np.concatenate([order[:_MOST_TRIED], order[-_MOST_TRIED:]])
    order = np.sort(order)
    i, j = (order[part] for part in np.triu_indices(len(order), 1))
    linked = set(map(tuple, graph.edges.tolist()))
    # d lambda_min / dw = (v_i - v_j)^2 for a mode v of unit length.
    best = np.argsort(-np.abs(mode[i] - mode[j]), kind="stable")
    pairs = ((int(i[k]), int(j[k])) for k in best)
    return list(itertools.islice((pair for pair in pairs if pair not in linked), count))


def _slowest_mode(graph: Graph) -> Array:
    """Return the mode (N,) of lambda_min, not negative, zero at the leaders."""
    mode = np.zeros(graph.agents)
    vectors = np.linalg.eigh(graph.grounded_laplacian().toarray())[1]
    # The mode of lambda_min has one sign (Perron and Frobenius); `eigh` may return either.
    mode[list(graph.followers)] = np.abs(vectors[:, 0])
    return mode


def _lambda_min(graph: Graph) -> float:
    return graph.spectrum().low
