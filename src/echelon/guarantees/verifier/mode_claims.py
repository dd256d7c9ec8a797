"""Claims by linearization: the slowest mode, the edge of the coupling, what the input sees."""

from collections.abc import Iterator

import numpy as np

from echelon.core.types import Array
from echelon.guarantees.verifier import algebra
from echelon.guarantees.verifier.findings import DECIDED, Facts, Finding, said, same

_EDGES = {"riccati": 0.5, "robust-lqr": 0.5, "inner-loop": 0.0, "monotone": 0.0}
"""c lambda_min from which each method calls the linearization stable."""
_BETWEEN = 64
"""Values between the extreme eigenvalues of a graph whose edges are not known."""
_LOOKED_AT = 16
"""So many of the slowest modes are asked how well they are known."""
# A double mode is known to half of the digits, so that a tighter bound would refuse honest ones.
_MODE_DECIDED = 1e-3


def linearized(facts: Facts) -> Iterator[Finding]:
    """Check what the file says of the system near its trim."""
    saved = facts.saved
    yield said("kind of the slowest mode", saved.kind == "linearization", saved.kind)
    result, slack = _slowest(facts, _looked_at(facts))
    if saved.abscissa < 0.0 and slack > _MODE_DECIDED * abs(result):
        text = f"rounding of {slack:.2g} leaves it undecided"
        yield said("slowest mode, 1/s", False, saved.abscissa, result, text)
    else:
        yield same("slowest mode, 1/s", saved.abscissa, result, slack)
    yield from _between(facts)
    yield from _edge(facts)
    rank = algebra.observable(facts.closed, saved.model.B.T @ saved.P)
    yield said("rank of what the input sees", saved.observable == rank, saved.observable, rank)


def _between(facts: Facts) -> Iterator[Finding]:
    """Check that modes decay which were not looked at, if those at the ends do."""
    values, followers = facts.eigenvalues, facts.saved.graph.agents - len(facts.saved.graph.leaders)
    every = followers <= algebra.ALL_MODES or facts.saved.graph.directed
    if every or facts.saved.graph.switches or facts.saved.abscissa >= 0.0:
        return
    values = (
        values[1:-1] if len(values) > 2 else np.geomspace(values[0], values[-1], _BETWEEN)[1:-1]
    )
    result, slack = _slowest(facts, values[1:-1])
    yield said("all modes between decay", result + slack < 0.0, "", result)


def _looked_at(facts: Facts) -> Array:
    """Return the eigenvalues whose modes the file speaks of."""
    graph = facts.saved.graph
    if graph.directed or graph.switches:
        return facts.eigenvalues
    return algebra.ends_of_many(facts.eigenvalues)


def _slowest(facts: Facts, values: Array) -> tuple[float, float]:
    """Return the slowest mode, 1/s, and what rounding may make of it."""
    K = facts.saved.coupling * facts.feedback
    modes = np.linalg.eigvals(facts.closed - values[:, None, None] * K).real.max(axis=1)
    result = [
        algebra.rightmost(facts.closed - x * K, _doubt(facts, K, abs(complex(x))))
        for x in values[np.argsort(modes)[-_LOOKED_AT:]]
    ]
    slowest = max(value for value, _ in result)
    # Of modes that are equally slow, but for rounding, the worst conditioned sets the slack.
    return slowest, max(slack for value, slack in result if value >= slowest - slack)


def _doubt(facts: Facts, K: Array, value: float) -> algebra.Doubt:
    """Return what solving with R in floating point, and an eigenvalue's rounding, leave open."""
    saved, eps = facts.saved, float(np.finfo(float).eps)
    # The smallest eigenvalue is known to all its digits, the others as parts of the largest.
    lost = 50.0 * eps * facts.high if value > facts.low else 0.0

    def bound(y: Array, x: Array) -> float:
        # A solver's R^-1 b is that of R + D with |D| <= 8 m eps |R|, D another for each b.
        left, right = np.abs(facts.pull @ y.conj()), np.abs(facts.pull @ saved.P) @ np.abs(x)
        solved = 8.0 * len(saved.R) * eps * left @ np.abs(saved.R) @ right
        return float(saved.coupling * value * solved + abs(np.vdot(y, K @ x)) * lost)

    return bound


def _edge(facts: Facts) -> Iterator[Finding]:
    """Check the coupling from which the linearization is called stable, and that it is."""
    saved, claim = facts.saved, "edge of the coupling"
    threshold = _EDGES.get(saved.method)
    if saved.edge is None:
        silent = threshold is None and saved.method != "contraction"
        yield said(claim, silent, "none", text="" if silent else "this method has one")
        return
    if saved.method == "given":
        yield said(claim, False, saved.edge, "none", "no edge is known of a given gain")
        return
    # The edge of `contraction` rests on the strength that it found, so only its inequality can be
    # checked.
    if threshold is not None:
        yield same(claim, saved.edge, threshold / facts.low)
    # The inequality is monotone in the coupling, so that at the edge speaks for all above it.
    strength = 2.0 * saved.edge * facts.low
    growth, slack = algebra.growth(saved.P, facts.closed[None], facts.weighted[None], strength)
    text = "largest eigenvalue of the inequality there, in the metric of P"
    fine = growth < -slack or growth <= slack <= DECIDED * facts.speed
    yield said("stable from the edge on", fine, "at most 0", growth, text)
