"""Claims on a domain that need no model: the set, and the rate at the corners."""

from collections.abc import Iterator
from fractions import Fraction

import numpy as np
import scipy.linalg

from echelon.core.types import Array
from echelon.guarantees.verifier import algebra, exact_minors
from echelon.guarantees.verifier.findings import (
    DECIDED,
    ROUNDING,
    TIGHT,
    Facts,
    Finding,
    said,
    same,
)
from echelon.guarantees.verifier.saved_gain import SavedRegion

# Exact minors of n rows take n^3 products of integers that grow with n.
_EXACT_FOLLOWERS = 60


def regional(facts: Facts) -> Iterator[Finding]:
    """Check what is promised on a domain at the corners that the file holds."""
    saved, region = facts.saved, facts.saved.region
    if region is None:
        return
    if region.theorem == "A5":
        yield said("strength", region.strength == 0.0, region.strength, 0.0, "the drift alone")
    else:
        yield _strength(facts, region)
    fine = region.rate >= 0.0 if region.theorem == "A5" else region.rate > 0.0
    text = "V may rise" if region.theorem == "A5" else "errors need not shrink"
    # No set is certified either where V may grow.
    yield said("the rate is one of decay", fine, region.rate, text="" if fine else text)
    if saved.inner is not None:
        yield said("promise on a domain", False, text="none is known of a gain with an inner loop")
        return
    inside = (region.lower <= 0.0) & (region.upper >= 0.0)
    inputs_inside = (region.input_lower <= 0.0) & (region.input_upper >= 0.0)
    yield said("the domain holds the trim", bool(inside.all() and inputs_inside.all()))
    yield _radius(facts, region)
    yield from _rate(facts, region)


def _strength(facts: Facts, region: SavedRegion) -> Finding:
    """Compare with 2 c lambda_min, or on a directed graph with what its sum is held by."""
    saved = facts.saved
    if not saved.graph.directed:
        return same("strength", region.strength, 2.0 * saved.coupling * facts.low)
    most = 2.0 * saved.coupling * facts.bound
    fine = 0.0 < region.strength <= (1.0 + TIGHT) * most
    return said("strength", fine, region.strength, most, "no more than the weighted sum is held by")


def _skew(facts: Facts) -> float:
    """Return how far one agent's share of the sum may exceed what it weighs for another."""
    sums = facts.saved.graph.sums
    return 1.0 if sums is None else float(np.sqrt(sums.max() / sums.min()))


def needs_constant(facts: Facts, region: SavedRegion) -> bool:
    """Tell whether a promise holds for a constant g only."""
    if facts.saved.graph.directed and region.theorem == "A5":
        return True
    widest = _widest(facts.saved.P, region)
    cut = region.radius is not None and region.radius <= (1.0 + TIGHT) * _spread(facts) * widest
    return region.theorem == "T1" or region.theorem == "A5" and not cut


def slowest(facts: Facts, region: SavedRegion, As: Array, Ws: Array) -> tuple[float, float, bool]:
    """Return the slowest rate over matrices, what rounding may make of it, and if that is little.

    A drift that need only not expand has rate 0, and its own speed is what rounding is part of.
    """
    growth, slack = algebra.growth(facts.saved.P, As, Ws, region.strength)
    measure = abs(region.rate) if region.rate else facts.speed
    return -0.5 * growth, 0.5 * slack, 0.5 * slack <= DECIDED * measure


def _spread(facts: Facts) -> float:
    """Return what it costs the radius of a monotone drift that g may vary."""
    # sum delta_i'P delta_i is bounded by V = delta'(L kron P) delta over lambda_min, and V by
    # lambda_max.
    return float(np.sqrt(facts.low / facts.high))


def _radius(facts: Facts, region: SavedRegion) -> Finding:
    """Compare with the largest r of which {x'P x <= r^2} stays inside the bounds."""
    widest = _widest(facts.saved.P, region) / _skew(facts)
    if region.theorem == "T2":
        text = "a local promise certifies no set"
        return said("radius", region.radius is None, str(region.radius), text=text)
    if region.radius is None or np.isinf(widest):
        return said("radius", region.radius is None and np.isinf(widest), str(region.radius))
    if region.theorem == "A5" and not needs_constant(facts, region):
        widest *= _spread(facts)
    return same("radius", region.radius, widest)


def _widest(P: Array, region: SavedRegion) -> float:
    margins = np.minimum(region.upper, -region.lower)
    # A column of L^-1 for P = L L' has the length that its state reaches on x'P x = 1.
    reach = np.linalg.norm(
        scipy.linalg.solve_triangular(np.linalg.cholesky(P), np.eye(len(P)), lower=True), axis=0
    )
    return float((margins / reach).min())


def _rate(facts: Facts, region: SavedRegion) -> Iterator[Finding]:
    """Check the rate at every corner: by exact minors for a proof, else by eigenvalues."""
    result, slack, decided = slowest(facts, region, *_split(facts, region.hull))
    claim = f"rate at {len(region.hull)} corners, 1/s"
    if region.kind == "proof":
        yield said(claim, result >= region.rate, region.rate, result, "eigenvalues")
        yield from _proof(facts, region)
        return
    if not decided:
        text = f"rounding of {slack:.2g} leaves it undecided"
        yield said(claim, False, region.rate, result, text)
    elif region.theorem == "A5":
        fine = result >= region.rate - slack and region.rate == 0.0
        yield said(claim, fine, region.rate, result, "the drift must not expand P")
    else:
        yield same(claim, region.rate, result, slack, "eigenvalues")
    size, lost = np.abs(region.hull).max(axis=0), region.error
    # Samples are what they are; corners are rounded exact ones.
    allowed = ROUNDING * size.max() if region.kind == "vertices" else 0.0
    fine = bool((lost >= 0.0).all() and lost.max() <= allowed)
    yield said("error of the corners", fine, float(lost.max()), text="no more than rounding")


def _split(facts: Facts, hull: Array) -> tuple[Array, Array]:
    """Return A and g S R^-1 (g S)' of each corner."""
    n = len(facts.saved.P)
    if hull.shape[2] == n:
        return hull, np.broadcast_to(facts.weighted, hull.shape)
    return hull[:, :, :n], hull[:, :, n:]


def _proof(facts: Facts, region: SavedRegion) -> Iterator[Finding]:
    """Check a proof from the graph on: lambda_min, then the inequality, all in whole numbers."""
    saved, claim = facts.saved, "rate at the corners, proved"
    if region.theorem == "T2" or not np.array_equal(saved.P, saved.P.T):
        text = "a proof needs a constant g and a P that is symmetric to the bit"
        yield said(claim, False, region.rate, text=text)
        return
    # A little below the number that eigenvalues show, so that it can be proved.
    low = min(Fraction(facts.bound), Fraction(facts.low) * (1 - Fraction(1, 10**11)))
    graph, few = saved.graph, len(facts.eigenvalues) <= _EXACT_FOLLOWERS
    # Of a directed graph the bound is held to whole numbers where it is found.
    if graph.edges is not None and few and not graph.directed:
        rows = algebra.grounded_rows(graph, graph.edges)
        for k in range(len(rows)):
            # lambda_min > low exactly when L_g - low I is positive definite.
            rows[k][k] -= low
        fine = exact_minors.is_positive_definite(rows)
        yield said("lambda_min, proved", fine, facts.low, float(low), "exact minors")
    strength = 0 * low if region.theorem == "A5" else 2 * Fraction(saved.coupling) * low
    numbers = (saved.P, saved.model.B, saved.R, region.hull, region.error, strength, region.rate)
    # A negative error would relax the inequality instead of tightening it.
    failed = None if (region.error >= 0.0).all() else 0
    failed = exact_minors.first_unproved(*numbers) if failed is None else failed
    text = "exact minors" if failed is None else f"corner {failed} is not negative definite"
    yield said(claim, failed is None, region.rate, text=text)
