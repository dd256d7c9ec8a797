"""What shortens a slow formation: agents to make leaders, and edges to add.

The slowest disagreement follows the smallest eigenvalue lambda_min of the grounded Laplacian. One
more leader grounds one more agent, one more edge adds w (v_i - v_j)^2 to its Rayleigh quotient;
neither makes lambda_min smaller.
"""

import itertools
from collections.abc import Iterable, Sequence
from typing import NamedTuple, final

import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg as spla

from echelon.certificates.certificate import certify
from echelon.core.errors import GraphError
from echelon.core.numerics import precision
from echelon.core.types import Matrix
from echelon.gains.gain import Gain
from echelon.models.linearization import Linearization, linearize
from echelon.models.model import ControlAffine
from echelon.network.graph import Graph

_DENSE = 400
_ROUNDS = 30
_MOST_TRIED, _FEWEST_TRIED, _WORK = 300, 24, 100_000
"""Agents or pairs that are tried: as many as the work on a large graph allows, at most and least.
"""


class Shorter(NamedTuple):
    """How long the slowest disagreement lives, 1/|abscissa| in s, and what would shorten it.

    Attributes:
        now: on the graph as it is; infinite where a disagreement does not decay.
        leaders: agents to make leaders, and `with_leaders` the time with them.
        edges: pairs to link with weight 1, and `with_edges` the time with them.
    """

    now: float
    leaders: tuple[int, ...]
    with_leaders: float
    edges: tuple[tuple[int, int], ...]
    with_edges: float

    def sentence(self) -> str:
        """Return it as a sentence."""
        told = f"The slowest disagreement lives {self.now:.3g} s (1/lambda_min: N^2 on a line of N)"
        parts = []
        if self.leaders:
            named = ", ".join(map(str, self.leaders))
            as_ = "as a leader" if len(self.leaders) == 1 else "as leaders"
            agents = "agent" if len(self.leaders) == 1 else "agents"
            parts.append(f"{self.with_leaders:.3g} s with {agents} {named} {as_} too")
        if self.edges:
            named = ", ".join(f"{i}-{j}" for i, j in self.edges)
            edges = "edge" if len(self.edges) == 1 else "edges"
            parts.append(f"{self.with_edges:.3g} s with the {edges} {named} more")
        return f"{told}; {', '.join(parts)}." if parts else f"{told}."


def shorter(
    model: ControlAffine, graph: Graph, gain: Gain, leaders: int = 1, edges: int = 1
) -> Shorter:
    """Return the time constant of a gain's slowest disagreement, and what would shorten it.

    The coupling stays as it is, which suits an inner loop: any graph keeps it stable. What does not
    shorten it after all, since the slowest mode need not be that of lambda_min, is left out.

    Raises:
        GraphError: there are not so many followers to make leaders, or pairs to link.
    """
    led, linked = recommend_leaders(graph, leaders), recommend_edges(graph, edges)
    now = time_constant(model, graph, gain)
    with_leaders = time_constant(model, _with_leaders(graph, led), gain)
    with_edges = time_constant(model, _with_edges(graph, linked), gain)
    if not with_leaders < now:
        led, with_leaders = (), now
    if not with_edges < now:
        linked, with_edges = (), now
    return Shorter(now, led, with_leaders, linked, with_edges)


def time_constant(model: ControlAffine, graph: Graph, gain: Gain) -> float:
    """Return 1/|abscissa| of a gain on a graph, in s.

    In it the slowest disagreement falls to 1/e; it is infinite where one does not decay.
    """
    with precision("float64"):
        A, B = linearize(model)
    A = A if gain.inner is None else A - B @ gain.inner
    abscissa = certify(Linearization(A, B), graph, gain.P, gain.R, gain.coupling, None).abscissa
    return -1.0 / abscissa if abscissa < 0.0 else float("inf")


def recommend_leaders(graph: Graph, count: int = 1) -> tuple[int, ...]:
    """Return followers to make leaders too, one after the other, each raising lambda_min the most.

    Taken one at a time they need not be the best of all sets of `count`. On more than 400 followers
    an even choice is tried, ordered by how much the slowest mode moves them.

    Raises:
        GraphError: `count` is negative, or leaves no follower.
    """
    if not 0 <= count < len(graph.followers):
        raise GraphError(
            f"{count} more leaders are asked for, and from 0 to {len(graph.followers) - 1} of the "
            f"{len(graph.followers)} followers can become one."
        )
    chosen = list[int]()
    for _ in range(count):
        chosen.append(_best_leader(_with_leaders(graph, chosen)))
    return tuple(chosen)


def recommend_edges(graph: Graph, count: int = 1) -> tuple[tuple[int, int], ...]:
    """Return pairs to link with weight 1, one after the other, each raising lambda_min the most.

    Of many pairs those are tried that promise most in first order, (v_i - v_j)^2, 300 at most.

    Raises:
        GraphError: `count` is negative, or there are not so many pairs.
    """
    free = graph.agents * (graph.agents - 1) // 2 - len(graph.edges)
    if not 0 <= count <= free:
        raise GraphError(
            f"{count} more edges are asked for, and from 0 to {free} pairs are not linked yet."
        )
    chosen = list[tuple[int, int]]()
    for _ in range(count):
        chosen.append(_best_edge(_with_edges(graph, chosen)))
    return tuple(chosen)


def _best_leader(graph: Graph) -> int:
    if len(graph.followers) <= _DENSE:
        return max(graph.followers, key=lambda k: (_lambda_min(_with_leaders(graph, [k])), -k))
    large = _Large(graph)
    order = np.argsort(-large.mode, kind="stable")
    tried = order[:: 1 + (len(order) - 1) // large.tries]
    values = [large.with_penalty([k], [1.0], 0.0) for k in tried]
    return graph.followers[tried[int(np.argmax(values))]]


def _best_edge(graph: Graph) -> tuple[int, int]:
    if len(graph.followers) <= _DENSE:
        tried = _promising(graph, _slowest(graph), _MOST_TRIED)
        return max(tried, key=lambda pair: _lambda_min(_with_edges(graph, [pair])))
    large, mode = _Large(graph), np.zeros(graph.agents)
    mode[list(graph.followers)] = large.mode
    tried = _promising(graph, mode, large.tries)
    place = {agent: row for row, agent in enumerate(graph.followers)}
    values = []
    for pair in tried:
        rows = [place[k] for k in pair if k in place]
        values.append(large.with_penalty(rows, [1.0, -1.0][: len(rows)], 1.0) if rows else 0.0)
    return tried[int(np.argmax(values))]


@final
class _Large:
    """A large grounded Laplacian, factored once, and its lambda_min after a change of rank one."""

    def __init__(self, graph: Graph) -> None:
        L = sp.csc_array(graph.grounded_laplacian())
        self.solve = spla.splu(L).solve
        self.mode = np.abs(spla.eigsh(L, k=1, sigma=0.0)[1][:, 0])
        self.tries = max(_FEWEST_TRIED, min(_MOST_TRIED, _WORK // graph.agents))

    def with_penalty(self, rows: Sequence[int], entries: Sequence[float], slack: float) -> float:
        """Return about the least eigenvalue of L + a a' / slack, a given by its few entries.

        An edge of weight 1 has slack 1, and a leader, which may not move at all, has slack 0. It is
        the inverse (Sherman and Morrison) that is iterated.
        """
        a = np.zeros(len(self.mode))
        a[list(rows)] = entries
        far, x, value = self.solve(a), self.mode, 0.0
        for _ in range(_ROUNDS):
            y = self.solve(x) - far * (far @ x) / (slack + a @ far)
            value = float(x @ x) / float(x @ y)
            x = y / np.linalg.norm(y)
        return value


def _promising(graph: Graph, mode: Matrix, count: int) -> list[tuple[int, int]]:
    """Return the pairs without an edge that raise lambda_min most in first order."""
    # The far ends of the mode make the best pairs, so few agents are enough on a large graph.
    order = np.argsort(mode, kind="stable")
    if len(order) > 2 * _MOST_TRIED:
        order = np.concatenate([order[:_MOST_TRIED], order[-_MOST_TRIED:]])
    order = np.sort(order)
    i, j = (order[part] for part in np.triu_indices(len(order), 1))
    linked = set(map(tuple, graph.edges.tolist()))
    best = np.argsort(-np.abs(mode[i] - mode[j]), kind="stable")
    pairs = ((int(i[k]), int(j[k])) for k in best)
    return list(itertools.islice((pair for pair in pairs if pair not in linked), count))


def _slowest(graph: Graph) -> Matrix:
    """Return the mode (N,) of lambda_min, not negative, zero at the leaders."""
    mode = np.zeros(graph.agents)
    vectors = np.linalg.eigh(graph.grounded_laplacian().toarray())[1]
    mode[list(graph.followers)] = np.abs(vectors[:, 0])
    return mode


def _lambda_min(graph: Graph) -> float:
    return float(graph.grounded_spectrum()[0])


def _with_leaders(graph: Graph, more: Iterable[int]) -> Graph:
    return Graph(_triples(graph), [*graph.leaders, *more], graph.agents)


def _with_edges(graph: Graph, more: Iterable[tuple[int, int]]) -> Graph:
    return Graph([*_triples(graph), *more], graph.leaders, graph.agents)


def _triples(graph: Graph) -> list[list[float]]:
    return np.column_stack([graph.edges, graph.weights]).tolist()
