"""Checks of the graph: its spectrum, and a path from a leader to every follower."""

from collections.abc import Iterator

import numpy as np

from echelon.core.digits import at_least
from echelon.core.types import Array
from echelon.guarantees.verifier import algebra
from echelon.guarantees.verifier.findings import (
    ROUNDING,
    TIGHT,
    Facts,
    Finding,
    compare,
    decide,
    unchecked,
)
from echelon.guarantees.verifier.saved_gain import SavedGain

_LOOSE = 1e-6
"""Relative to the largest eigenvalue; those of a nonnormal L keep only half of their digits."""


def check_graph(saved: SavedGain) -> Iterator[Finding]:
    """Check the edges before the spectrum is computed."""
    graph = saved.graph
    followers = graph.agents - len(graph.leaders)
    whole = followers <= algebra.ALL_MODES or graph.directed
    count = followers if whole else 2
    # Each of several switching graphs has its own modes.
    count = len(graph.spectrum) if graph.switches else count
    fine = saved.modes == count == len(graph.spectrum)
    yield decide("number of modes", fine, saved.modes, count)
    # Fewer edges than followers cannot connect all; refused before a large matrix is allocated.
    if graph.edges is not None and (
        not _is_graph(graph.edges, graph.directed) or followers > len(graph.edges)
    ):
        text = "an edge connects an agent to itself, is repeated or not positive, or edges are"
        yield decide("graph", False, text=text + " missing")


def check_spectrum(facts: Facts) -> Iterator[Finding]:
    """Check the stored spectrum."""
    saved, stored = facts.saved, facts.saved.graph.spectrum
    result, claim = facts.eigenvalues, "graph spectrum"
    result = result if saved.graph.directed else algebra.ends_of_many(result)
    high = float(np.abs(result).max())
    if saved.graph.switches:
        text = "the graph switches, and the file stores no edges of the single graphs"
        yield unchecked(claim, facts.low, text)
    elif saved.graph.directed and saved.graph.edges is not None:
        yield _compare_complex(result, stored, high)
    elif saved.graph.edges is None:
        text = "the file stores no edges for a graph of this size"
        yield unchecked(claim, float(stored[0]), text)
    else:
        gap = float(np.abs(result - stored).max())
        yield decide(claim, gap <= TIGHT * high, "", f"{at_least(gap)} apart", "grounded Laplacian")
    text = "every follower has a path to a leader"
    yield decide("lambda_min is positive", facts.low > 0.0, value=facts.low, text=text)
    yield compare("lambda_min", saved.lambda_min, facts.low)
    if not saved.graph.switches:
        yield compare("lambda_min of the spectrum", float(np.real(stored[0])), facts.low)
    yield compare("lambda_max", saved.lambda_max, high, ROUNDING * high)


def _compare_complex(recomputed: Array, stored: Array, high: float) -> Finding:
    """Compare complex eigenvalues; each is paired with the nearest remaining one."""
    gap, left = 0.0, list(stored.astype(complex))
    for value in recomputed:
        at = int(np.argmin(np.abs(np.array(left) - value)))
        gap = max(gap, abs(left.pop(at) - value))
    return decide("graph spectrum", gap <= _LOOSE * high, "", f"{at_least(gap)} apart", "arrows")


def _is_graph(edges: Array, directed: bool) -> bool:
    pairs = edges[:, :2] if directed else np.sort(edges[:, :2], axis=1)
    apart = bool((pairs[:, 0] != pairs[:, 1]).all())
    return apart and len(np.unique(pairs, axis=0)) == len(pairs) and bool((edges[:, 2] > 0.0).all())
