"""Reading and checking the edges and leaders of a graph, and links between points that are near."""

import operator
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from echelon.core.errors import GraphError
from echelon.core.limits import LARGEST, excess_agents, excess_edges
from echelon.core.types import Array
from echelon.core.words import amount


def split_weights(edges: Iterable[Sequence[float]]) -> tuple[Array, Array]:
    """Return pairs (E, 2) of whole numbers and weights (E,)."""
    # Arrays come from the generators of large graphs, whose edges need no check one by one.
    if isinstance(edges, np.ndarray) and edges.ndim == 2 and edges.shape[1] == 2:
        return _whole(edges, "an edge is"), np.ones(len(edges))
    edges = [tuple(edge) for edge in edges]
    for edge in edges:
        if len(edge) not in (2, 3):
            raise GraphError(f"an edge is {list(edge)}, and must be [i, j] or [i, j, weight].")
    weights = np.array([edge[2] if len(edge) == 3 else 1.0 for edge in edges], dtype=np.float64)
    return _whole([edge[:2] for edge in edges], "an edge is").reshape(-1, 2), weights


def _whole(values: Sequence[Any] | Array, what: str) -> Array:
    if isinstance(values, np.ndarray) and np.issubdtype(values.dtype, np.signedinteger):
        return values.astype(np.int64)
    if not _are_whole(values):
        for value in values:
            if not _are_whole(value):
                text = list(value) if isinstance(value, tuple) else value
                raise GraphError(f"{what} {text}, and agents are whole numbers from 0 on.")
    # Through floats, so that the 1.0 of a file is agent 1.
    return np.array(values, dtype=np.float64).astype(np.int64)


def _are_whole(values: object) -> bool:
    try:
        numbers = np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError):
        return False
    return bool((numbers == np.round(numbers)).all() and np.isfinite(numbers).all())


def count_agents(pairs: Array, agents: int | None) -> int:
    """Return the number of agents, by default the largest number in an edge plus one."""
    named = int(pairs.max(initial=0)) + 1
    if agents is None:
        agents = named
    check_size(agents, 2, "graph", len(pairs))
    if named > agents:
        raise GraphError(
            f"an edge names agent {named - 1}, and with {agents} agents the last is {agents - 1}."
        )
    return agents


def check_edges(
    pairs: Array, weights: Array, agents: int, directed: bool = False
) -> tuple[Array, Array]:
    """Return the edges, undirected ones with the smaller agent first, and their weights."""
    edges = pairs if directed else _ascending(pairs)
    # Only the first fault is reported, here and below.
    for i, j in pairs[edges.min(axis=1, initial=0) < 0][:1]:
        raise GraphError(
            f"an edge is [{i}, {j}], and agents are whole numbers from 0 to {agents - 1}."
        )
    for i, j in edges[edges[:, 0] == edges[:, 1]][:1]:
        raise GraphError(
            f"edge [{i}, {j}] links agent {i} to itself, and an edge must link two agents."
        )
    for i, j in edges[_repeated(edges, agents)][:1]:
        raise GraphError(f"edge [{i}, {j}] is given twice, and may be given once.")
    # Negated, so that NaN, for which every comparison is false, is wrong too.
    wrong = ~((weights > 0.0) & (weights <= LARGEST))
    for (i, j), weight in zip(edges[wrong][:1], weights[wrong][:1], strict=True):
        raise GraphError(
            f"the weight of edge [{i}, {j}] is {weight:g}, and must be positive, at most "
            f"{LARGEST:g}."
        )
    return edges, weights


def links(i: Array | int, j: Array) -> Array:
    """Return edges (E, 2) from agents, or from one, to others."""
    return np.stack(np.broadcast_arrays(i, j), axis=1)


def _ascending(pairs: Array) -> Array:
    # Three times as fast as sorting each pair.
    i, j = pairs.T
    return np.stack([np.minimum(i, j), np.maximum(i, j)], axis=1)


def give_weights(edges: Iterable[Sequence[float]], weights: Sequence[float]) -> list[list[float]]:
    """Return edges (i, j, weight) from edges (i, j) and as many weights, else `GraphError`."""
    edges, weights = [list(edge) for edge in edges], list(weights)
    if len(edges) != len(weights):
        raise GraphError(
            f"got {amount(len(edges), 'edge')} and {amount(len(weights), 'weight')}; give one "
            "weight per edge."
        )
    for edge in edges:
        if len(edge) != 2:
            raise GraphError(
                f"an edge is {edge}, and must be [i, j] where `weights` are listed separately."
            )
    return [[*edge, float(weight)] for edge, weight in zip(edges, weights, strict=True)]


def _repeated(edges: Array, agents: int) -> Array:
    # One number per edge sorts ten times faster than rows, and large graphs have millions.
    number = edges[:, 0] * agents + edges[:, 1]
    ordered = np.sort(number)
    again = ordered[1:][ordered[1:] == ordered[:-1]]
    return np.flatnonzero(np.isin(number, again)) if len(again) else again


def check_leaders(leaders: Iterable[int], agents: int) -> tuple[int, ...]:
    """Return the leaders, sorted, after checking that each is an agent."""
    if not isinstance(leaders, Iterable) or isinstance(leaders, str):
        raise GraphError(f"`leaders` is {leaders!r}, and must be a list of agents, such as [0].")
    chosen = tuple(sorted(set(_whole(list(leaders), "a leader is").tolist())))
    if not chosen:
        raise GraphError("the graph has no leader; name at least one agent in `leaders`.")
    for leader in chosen:
        if not 0 <= leader < agents:
            raise GraphError(
                f"leader {leader} is no agent; agents are numbered from 0 to {agents - 1}."
            )
    return chosen


def count_grid(rows: int, columns: int) -> int:
    """Return the number of agents of a grid, after checking it."""
    for side in (rows, columns):
        _check_whole(side)
    check_size(rows * columns, 2, "grid")
    return rows * columns


def check_size(agents: int, least: int, kind: str, edges: int = 0, share: float = 0) -> None:
    """Check that agents are enough, and that `edges` plus a `share` of all pairs fit memory."""
    _check_whole(agents)
    if agents < least:
        raise GraphError(f"a {kind} needs at least {least} agents, and has {agents}.")
    excess = excess_agents(agents) or excess_edges(edges + share * (agents * (agents - 1) // 2))
    if excess is not None:
        raise GraphError(f"the graph is too large: {excess}.")


def _check_whole(agents: int) -> None:
    try:
        operator.index(agents)
    except TypeError:
        raise GraphError(
            f"the number of agents is {agents!r}, and must be a whole number such as 4."
        ) from None


def name_agents(agents: np.ndarray) -> str:
    """Return a subject with its verb such as `agents 2, 3 have`, shortened when there are many."""
    numbers = ", ".join(str(agent) for agent in agents[:8]) + (", ..." if len(agents) > 8 else "")
    return f"agent {numbers} has" if len(agents) == 1 else f"agents {numbers} have"


def _square(matrix: ArrayLike) -> Array:
    try:
        weights = np.asarray(matrix, np.float64)
    except (TypeError, ValueError):
        raise GraphError(
            "the adjacency matrix must be a square matrix of numbers (agents, agents), with rows "
            "of one length."
        ) from None
    return weights


def _checked_square(weights: Any) -> Any:
    """Return a matrix, dense or sparse, after checking that it is square and finite."""
    if weights.ndim != 2 or weights.shape[0] != weights.shape[1]:
        raise GraphError(
            f"the adjacency matrix has shape {weights.shape}, and must be a square matrix of "
            "numbers (agents, agents)."
        )
    if not np.isfinite(weights.data if hasattr(weights, "tocoo") else weights).all():
        raise GraphError("the adjacency matrix has entries that are NaN or infinite.")
    return weights


def edges_of_matrix(
    matrix: ArrayLike, leaders: Iterable[int], directed: bool | None
) -> tuple[list[list[float]], Iterable[int], int, bool]:
    """Return edges, leaders, agents and whether directed, of an adjacency; else `GraphError`."""
    # Imported here: few graphs are matrices.
    from scipy.sparse import csr_array, triu

    weights = csr_array(matrix, dtype=np.float64) if hasattr(matrix, "tocoo") else _square(matrix)
    weights = csr_array(_checked_square(weights))
    weights.sum_duplicates()
    weights.eliminate_zeros()
    symmetric = (weights != weights.T).nnz == 0
    if directed is False and not symmetric:
        raise GraphError(
            "the adjacency matrix is not symmetric, and that of an undirected graph must be."
        )
    one_way = not symmetric if directed is None else directed
    # Row i receives from column j, and a directed edge leads from the sender to the receiver.
    chosen: Any = weights.tocoo() if one_way else triu(weights, format="coo")
    receivers, senders = chosen.coords
    edges = np.column_stack([senders, receivers, chosen.data])
    return edges.tolist(), leaders, chosen.shape[0], one_way


# ---- links between points closer than a radius ---------------------------------------------------

_MOST = 2000
"""Largest number of points whose distances are all computed, 32 MB."""


def pairs_within(points: Array, radius: float) -> Array:
    """Return the pairs (E, 2) of points (N, 2) that are closer than a radius, in order."""
    # Imported here: only random graphs need it.
    from scipy.spatial import KDTree

    pairs = KDTree(points).query_pairs(radius, output_type="ndarray")
    # The tree guarantees no order of the pairs; sorted, a seed gives the same graph everywhere. One
    # number for each pair sorts ten times faster than two.
    number = np.sort(pairs[:, 0] * len(points) + pairs[:, 1])
    return np.stack(np.divmod(number, len(points)), axis=1)


@contextmanager
def advising(points: Array, radius: float) -> Iterator[None]:
    """Add to the error of points (N, 2) that `radius` does not connect the radius that would."""
    try:
        yield
    except GraphError as error:
        raise GraphError(f"{str(error)[:-1]}{_advice(points, radius)}.") from error


def _advice(points: Array, radius: float) -> str:
    """Return the least connecting radius, the shortest tree's longest edge, as a clause."""
    if len(points) > _MOST:
        return ""
    from scipy.sparse.csgraph import minimum_spanning_tree
    from scipy.spatial.distance import pdist, squareform

    least = minimum_spanning_tree(squareform(pdist(points))).max()
    if least <= radius:
        return ""
    enough = np.ceil(least * 1000.0) / 1000.0
    return f"; a `radius` of {enough:g} connects these points, and another `seed` draws others"
