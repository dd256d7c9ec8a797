"""Checks of the graph, and of the modes at the linearization."""

from collections.abc import Iterator

import numpy as np

from echelon.core.digits import at_least
from echelon.core.types import Array
from echelon.guarantees.verifier import algebra
from echelon.guarantees.verifier.findings import (
    DECIDED,
    ROUNDING,
    TIGHT,
    ClaimCheck,
    Recomputed,
    compare,
    decide,
    unchecked,
)
from echelon.guarantees.verifier.saved_gain import SavedGain

# ---- the graph -----------------------------------------------------------------------------------

_LOOSE = 1e-6
"""Relative to the largest eigenvalue; those of a nonnormal L keep only half of their digits."""


def check_graph(saved: SavedGain) -> Iterator[ClaimCheck]:
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


def check_spectrum(facts: Recomputed) -> Iterator[ClaimCheck]:
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


def _compare_complex(recomputed: Array, stored: Array, high: float) -> ClaimCheck:
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


# ---- the linearization ---------------------------------------------------------------------------

_METHODS = ("given", "contraction")
_EDGES = {"riccati": 0.5, "robust-lqr": 0.5, "inner-loop": 0.0, "monotone": 0.0}
"""Smallest c lambda_min for which each method guarantees a stable linearization."""
_BETWEEN = 64
"""Values between the extreme eigenvalues of a graph without stored edges."""
_MOST_MODES = 16
"""Number of slowest modes whose rounding is bounded."""
# A double eigenvalue keeps half of its digits; a tighter bound would refuse correct files.
_MODE_DECIDED = 1e-3


def check_linearization(facts: Recomputed) -> Iterator[ClaimCheck]:
    """Check the claims about the linearization at the trim."""
    saved = facts.saved
    yield decide("kind of the slowest mode", saved.kind == "linearization", saved.kind)
    every = saved.graph.directed or saved.graph.switches
    values = facts.eigenvalues if every else algebra.ends_of_many(facts.eigenvalues)
    result, slack = _slowest(facts, values)
    if saved.abscissa < 0.0 and slack > _MODE_DECIDED * abs(result):
        text = f"undecided: the rounding is {at_least(slack, 2)}"
        yield decide("slowest mode, 1/s", False, saved.abscissa, result, text)
    else:
        yield compare("slowest mode, 1/s", saved.abscissa, result, slack)
    yield from _check_between(facts)
    yield from _check_edge(facts)
    if saved.method not in (*_EDGES, *_METHODS):
        yield unchecked("method", saved.method, "the file holds nothing of a method of one's own")
    rank = algebra.observable(facts.closed, saved.model.B.T @ saved.P)
    yield decide("observability rank", saved.observable == rank, saved.observable, rank)


def _check_between(facts: Recomputed) -> Iterator[ClaimCheck]:
    values, followers = facts.eigenvalues, facts.saved.graph.agents - len(facts.saved.graph.leaders)
    every = followers <= algebra.ALL_MODES or facts.saved.graph.directed
    if every or facts.saved.graph.switches or facts.saved.abscissa >= 0.0:
        return
    values = values if len(values) > 2 else np.geomspace(values[0], values[-1], _BETWEEN)
    result, slack = _slowest(facts, values[1:-1])
    yield decide("all modes between decay", result + slack < 0.0, "", result)


def _slowest(facts: Recomputed, values: Array) -> tuple[float, float]:
    """Return the slowest mode, 1/s, and its rounding."""
    K = facts.saved.coupling * facts.feedback
    modes = np.linalg.eigvals(facts.closed - values[:, None, None] * K).real.max(axis=1)
    result = [
        algebra.rightmost(facts.closed - x * K, _doubt(facts, K, abs(complex(x))))
        for x in values[np.argsort(modes)[-_MOST_MODES:]]
    ]
    slowest = max(value for value, _ in result)
    # Among modes equal up to rounding, the worst conditioned one sets the slack.
    return slowest, max(slack for value, slack in result if value >= slowest - slack)


def _doubt(facts: Recomputed, K: Array, value: float) -> algebra.Doubt:
    """Return a bound on the error of a mode due to solving with R and rounding of an eigenvalue."""
    saved, eps = facts.saved, float(np.finfo(float).eps)
    # The smallest eigenvalue is exact to all digits, the others relative to the largest.
    lost = 50.0 * eps * facts.high if value > facts.low else 0.0

    def bound(y: Array, x: Array) -> float:
        # Backward error: a computed R^-1 b solves (R + D) x = b with |D| <= 8 m eps |R|.
        left, right = np.abs(facts.pull @ y.conj()), np.abs(facts.pull @ saved.P) @ np.abs(x)
        solved = 8.0 * len(saved.R) * eps * left @ np.abs(saved.R) @ right
        return float(saved.coupling * value * solved + abs(np.vdot(y, K @ x)) * lost)

    return bound


def _check_edge(facts: Recomputed) -> Iterator[ClaimCheck]:
    """Check the smallest coupling with a guaranteed stable linearization."""
    saved, claim = facts.saved, "edge of the coupling"
    threshold = _EDGES.get(saved.method)
    if saved.edge is None:
        silent = threshold is None and saved.method != "contraction"
        yield decide(claim, silent, "none", text="" if silent else "this method has an edge")
        return
    if saved.method == "given":
        yield decide(claim, False, saved.edge, "none", "no edge is known for a user-supplied gain")
        return
    # `contraction` derives its edge from the strength that it optimized, so only the inequality can
    # be checked.
    if threshold is not None:
        yield compare(claim, saved.edge, threshold / facts.low)
    # The inequality is monotone in the coupling: if it holds at the edge, it holds above.
    strength = 2.0 * saved.edge * facts.low
    growth, slack = algebra.growth(saved.P, facts.closed[None], facts.weighted[None], strength)
    text = "largest eigenvalue of the inequality at the edge, in the metric of P"
    fine = growth < -slack or growth <= slack <= DECIDED * facts.speed
    yield decide("stable above the edge", fine, "at most 0", growth, text)
