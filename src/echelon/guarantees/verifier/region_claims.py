"""Checks on a domain that need no model: the certified set and the rate at the vertices."""

from collections.abc import Iterator
from fractions import Fraction

import numpy as np
import scipy.linalg

from echelon.core.digits import at_least
from echelon.core.types import Array
from echelon.core.words import amount
from echelon.guarantees.verifier import algebra
from echelon.guarantees.verifier.findings import (
    DECIDED,
    ROUNDING,
    TIGHT,
    ClaimCheck,
    Recomputed,
    compare,
    decide,
)
from echelon.guarantees.verifier.saved_gain import SavedRegion

# Exact minors of n rows need n^3 products of integers whose length grows with n.
_EXACT_FOLLOWERS = 60


def check_region(facts: Recomputed) -> Iterator[ClaimCheck]:
    """Check the guarantee on a domain at the stored vertices."""
    saved, region = facts.saved, facts.saved.region
    if region is None:
        return
    if region.theorem == "A5":
        yield decide("strength", region.strength == 0.0, region.strength, 0.0, "the drift alone")
    else:
        yield _check_strength(facts, region)
    fine = region.rate >= 0.0 if region.theorem == "A5" else region.rate > 0.0
    text = "V may increase" if region.theorem == "A5" else "errors may grow"
    # A set is certified only if V decreases on it.
    yield decide("the rate is positive", fine, region.rate, text="" if fine else text)
    if saved.inner is not None:
        yield decide(
            "guarantee on a domain",
            False,
            text="no guarantee is known for a gain with an inner loop",
        )
        return
    inside = (region.lower <= 0.0) & (region.upper >= 0.0)
    inputs_inside = (region.input_lower <= 0.0) & (region.input_upper >= 0.0)
    yield decide("the trim lies in the domain", bool(inside.all() and inputs_inside.all()))
    yield _check_radius(facts, region)
    yield from _check_rate(facts, region)


def _check_strength(facts: Recomputed, region: SavedRegion) -> ClaimCheck:
    """Compare with 2 c lambda_min; for a directed graph with the bound of its weighted sum."""
    saved = facts.saved
    if not saved.graph.directed:
        return compare("strength", region.strength, 2.0 * saved.coupling * facts.low)
    most = 2.0 * saved.coupling * facts.bound
    fine = 0.0 < region.strength <= (1.0 + TIGHT) * most
    return decide("strength", fine, region.strength, most, "at most the bound of the weighted sum")


def needs_constant(facts: Recomputed, region: SavedRegion) -> bool:
    """Return whether the guarantee requires a constant g."""
    if facts.saved.graph.directed and region.theorem == "A5":
        return True
    widest = _widest(facts.saved.P, region)
    cut = region.radius is not None and region.radius <= (1.0 + TIGHT) * _spread(facts) * widest
    return region.theorem == "T1" or region.theorem == "A5" and not cut


def slowest(
    facts: Recomputed, region: SavedRegion, As: Array, Ws: Array
) -> tuple[float, float, bool]:
    """Return the slowest rate over matrices, its rounding, and whether that decides the claim.

    A monotone drift has rate 0; rounding is then compared with the speed of the drift.
    """
    growth, slack = algebra.growth(facts.saved.P, As, Ws, region.strength)
    measure = abs(region.rate) if region.rate else facts.speed
    return -0.5 * growth, 0.5 * slack, 0.5 * slack <= DECIDED * measure


def _spread(facts: Recomputed) -> float:
    """Return the factor by which a varying g reduces the radius of a monotone drift."""
    # sum delta_i'P delta_i is bounded by V = delta'(L kron P) delta over lambda_min, and V by
    # lambda_max.
    return float(np.sqrt(facts.low / facts.high))


def _check_radius(facts: Recomputed, region: SavedRegion) -> ClaimCheck:
    """Compare with the largest r for which {x'P x <= r^2} lies inside the bounds."""
    widest, sums = _widest(facts.saved.P, region), facts.saved.graph.sums
    widest = widest if sums is None else widest / float(np.sqrt(sums.max() / sums.min()))
    if region.theorem == "T2":
        text = "a local guarantee certifies no set"
        return decide("radius", region.radius is None, str(region.radius), text=text)
    if region.radius is None or np.isinf(widest):
        return decide("radius", region.radius is None and np.isinf(widest), str(region.radius))
    if region.theorem == "A5" and not needs_constant(facts, region):
        widest *= _spread(facts)
    return compare("radius", region.radius, widest)


def _widest(P: Array, region: SavedRegion) -> float:
    margins = np.minimum(region.upper, -region.lower)
    # For P = L L', the norm of column k of L^-1 is the maximum of |x_k| on x'P x = 1.
    reach = np.linalg.norm(
        scipy.linalg.solve_triangular(np.linalg.cholesky(P), np.eye(len(P)), lower=True), axis=0
    )
    return float((margins / reach).min())


def _check_rate(facts: Recomputed, region: SavedRegion) -> Iterator[ClaimCheck]:
    """Check the rate at every vertex: by exact minors for a proof, otherwise by eigenvalues."""
    result, slack, decided = slowest(facts, region, *_split_hull(facts, region.hull))
    claim = f"rate at {amount(len(region.hull), 'vertex', 'vertices')}, 1/s"
    if region.kind == "proof":
        yield decide(claim, result >= region.rate, region.rate, result, "eigenvalues")
        yield from _proof(facts, region)
        return
    if not decided:
        text = f"undecided: the rounding is {at_least(slack, 2)}"
        yield decide(claim, False, region.rate, result, text)
    elif region.theorem == "A5":
        fine = result >= region.rate - slack and region.rate == 0.0
        yield decide(claim, fine, region.rate, result, "the drift must not expand P")
    else:
        yield compare(claim, region.rate, result, slack, "eigenvalues")
    size, lost = np.abs(region.hull).max(axis=0), region.error
    # Samples are exact; vertices are exact values rounded to floats.
    allowed = ROUNDING * size.max() if region.kind == "vertices" else 0.0
    fine = bool((lost >= 0.0).all() and lost.max() <= allowed)
    yield decide("error of the vertices", fine, float(lost.max()), text="at most rounding")


def _split_hull(facts: Recomputed, hull: Array) -> tuple[Array, Array]:
    """Return A and g S R^-1 (g S)' of each vertex."""
    n = len(facts.saved.P)
    if hull.shape[2] == n:
        return hull, np.broadcast_to(facts.weighted, hull.shape)
    return hull[:, :, :n], hull[:, :, n:]


def _proof(facts: Recomputed, region: SavedRegion) -> Iterator[ClaimCheck]:
    saved, claim = facts.saved, "rate at the vertices, proved"
    if region.theorem == "T2" or not np.array_equal(saved.P, saved.P.T):
        text = "a proof requires a constant g and an exactly symmetric P"
        yield decide(claim, False, region.rate, text=text)
        return
    # Slightly below the computed eigenvalue, so that exact arithmetic can prove it.
    low = min(Fraction(facts.bound), Fraction(facts.low) * (1 - Fraction(1, 10**11)))
    graph, few = saved.graph, len(facts.eigenvalues) <= _EXACT_FOLLOWERS
    # For a directed graph `directed_spectrum` proves the bound.
    if graph.edges is not None and few and not graph.directed:
        rows = algebra.grounded_rows(graph, graph.edges)
        for k in range(len(rows)):
            # lambda_min > low exactly when L_g - low I is positive definite.
            rows[k][k] -= low
        fine = algebra.is_positive_definite(rows)
        yield decide("lambda_min, proved", fine, facts.low, float(low), "exact minors")
    strength = 0 * low if region.theorem == "A5" else 2 * Fraction(saved.coupling) * low
    numbers = (saved.P, saved.model.B, saved.R, region.hull, region.error, strength, region.rate)
    # A negative error would relax the inequality instead of tightening it.
    failed = None if (region.error >= 0.0).all() else 0
    failed = algebra.first_unproved(*numbers) if failed is None else failed
    text = "exact minors" if failed is None else f"vertex {failed} is not negative definite"
    yield decide(claim, failed is None, region.rate, text=text)
