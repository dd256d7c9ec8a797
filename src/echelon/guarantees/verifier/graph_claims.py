"""Claims of the graph: its spectrum, and that every follower is reached."""

from collections.abc import Iterator

import numpy as np

from echelon.core.types import Array
from echelon.guarantees.verifier import algebra
from echelon.guarantees.verifier.findings import (
    ROUNDING,
    TIGHT,
    Facts,
    Finding,
    said,
    same,
    unchecked,
)
from echelon.guarantees.verifier.saved_gain import SavedGain

_LOOSE = 1e-6
"""Of the largest eigenvalue: where L is not normal the others are known to half their digits."""


def drawn(saved: SavedGain) -> Iterator[Finding]:
    """Check that there is a graph, before its spectrum is computed."""
    graph = saved.graph
    followers = graph.agents - len(graph.leaders)
    whole = followers <= algebra.ALL_MODES or graph.directed
    count = followers if whole else 2
    # Graphs that take turns have modes of their own each.
    count = len(graph.spectrum) if graph.switches else count
    fine = saved.modes == count == len(graph.spectrum)
    yield said("modes looked at", fine, saved.modes, count)
    # Fewer edges than followers cannot reach all; said before a matrix of that size is made.
    if graph.edges is not None and (
        not _is_graph(graph.edges, graph.directed) or followers > len(graph.edges)
    ):
        text = "an edge links no two agents, is given twice or has no positive weight, or some are"
        yield said("graph", False, text=text + " missing")


def spanned(facts: Facts) -> Iterator[Finding]:
    """Check the spectrum that the file states."""
    saved, stored = facts.saved, facts.saved.graph.spectrum
    result, claim = facts.eigenvalues, "graph spectrum"
    result = result if saved.graph.directed else algebra.ends_of_many(result)
    high = float(np.abs(result).max())
    if saved.graph.switches:
        text = "the graph switches, and the file holds no edges of any one time"
        yield unchecked(claim, facts.low, text)
    elif saved.graph.directed and saved.graph.edges is not None:
        yield _all_found(result, stored, high)
    elif saved.graph.edges is None:
        text = "the file holds no edges of so large a graph"
        yield unchecked(claim, float(stored[0]), text)
    else:
        gap = float(np.abs(result - stored).max())
        yield said(claim, gap <= TIGHT * high, "", f"{gap:.3g} apart", "grounded Laplacian")
    text = "every follower has a path to a leader"
    yield said("lambda_min is positive", facts.low > 0.0, found=facts.low, text=text)
    yield same("lambda_min", saved.lambda_min, facts.low)
    if not saved.graph.switches:
        yield same("lambda_min of the spectrum", float(np.real(stored[0])), facts.low)
    yield same("lambda_max", saved.lambda_max, high, ROUNDING * high)


def _all_found(found: Array, stored: Array, high: float) -> Finding:
    """Compare complex eigenvalues, each with the nearest that is left."""
    gap, left = 0.0, list(stored.astype(complex))
    for value in found:
        at = int(np.argmin(np.abs(np.array(left) - value)))
        gap = max(gap, abs(left.pop(at) - value))
    return said("graph spectrum", gap <= _LOOSE * high, "", f"{gap:.3g} apart", "arrows")


def _is_graph(edges: Array, directed: bool) -> bool:
    pairs = edges[:, :2] if directed else np.sort(edges[:, :2], axis=1)
    apart = bool((pairs[:, 0] != pairs[:, 1]).all())
    return apart and len(np.unique(pairs, axis=0)) == len(pairs) and bool((edges[:, 2] > 0.0).all())
