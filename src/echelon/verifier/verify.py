"""An independent check of a saved gain: every promise is recomputed from the file alone.

Nothing of the synthesis is used here: neither its matrices' algebra nor its exact arithmetic, its
hull or its graphs. What is shared is what both speak of, the equations of the bundled models.
"""

import warnings
from collections.abc import Iterator
from fractions import Fraction
from typing import NamedTuple

import numpy as np
import scipy.linalg

from echelon.core.types import Array, PathLike
from echelon.models.model import ControlAffine
from echelon.verifier import algebra as algebra
from echelon.verifier import equations as equations
from echelon.verifier import exact as exact
from echelon.verifier.file import SavedGain, SavedGraph, SavedRegion, read

_TIGHT = 1e-9
"""A number that was recomputed may differ by this part of itself, and by rounding."""
_ROUNDING = 1e-12
"""Rounding of eigenvalues, as a part of the largest of them."""
# Exact minors of n rows take n^3 products of integers that grow with n.
_EXACT_FOLLOWERS = 60
_SAMPLED = 0.02
"""New samples may be this part slower than a rate that samples promised."""
_EDGES = {"riccati": 0.5, "robust-lqr": 0.5, "inner-loop": 0.0, "monotone": 0.0}
"""c lambda_min from which each method calls the linearization stable."""


class Finding(NamedTuple):
    """A claim of the file, what was found, and `holds`, `refused` or `not checked`."""

    claim: str
    stored: str
    found: str
    verdict: str
    text: str


class Verified(NamedTuple):
    """All findings, whether nothing was refused, and that in a sentence."""

    findings: tuple[Finding, ...]
    holds: bool
    sentence: str


class _Facts(NamedTuple):
    """What was recomputed and later claims rest on."""

    saved: SavedGain
    eigenvalues: Array
    weighted: Array
    closed: Array

    @property
    def low(self) -> float:
        return float(self.eigenvalues[0])


def verify(path: PathLike, model: ControlAffine | None = None) -> Verified:
    """Recompute what a saved gain promises, from its file alone.

    Args:
        path: a file that `save_gain` wrote.
        model: the agents, where they are no bundled model; without them what rests on their
            equations is not checked.

    Raises:
        GainError: the file is no gain, or lacks a part.
    """
    saved, findings = read(path), list[Finding]()
    # Numbers of a false file may overflow: what is not finite fails the comparisons that follow.
    with np.errstate(all="ignore"), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            for finding in _findings(saved, model):
                findings.append(finding)
        except (ArithmeticError, TypeError, ValueError) as error:
            # Numbers at which an algorithm gives up are no certificate.
            findings.append(_said("all of it can be computed", False, text=str(error)))
    refused = [each.claim for each in findings if each.verdict == "refused"]
    return Verified(tuple(findings), not refused, _sentence(findings, refused))


def _findings(saved: SavedGain, model: ControlAffine | None) -> Iterator[Finding]:
    first = [*_definite(saved)]
    if all(each.verdict == "holds" for each in first):
        first += _graph(saved.graph, saved)
    yield from first
    # What follows rests on these.
    if all(each.verdict != "refused" for each in first):
        facts = _facts(saved)
        yield from _linearized(facts)
        yield from _regional(facts)
        yield from _equations(facts, model)


def _sentence(findings: list[Finding], refused: list[str]) -> str:
    if refused:
        does = "does" if len(refused) == 1 else "do"
        return f"Refused: {'; '.join(refused)} {does} not hold as stored."
    open_ = sum(each.verdict == "not checked" for each in findings)
    rest = f", and {open_} could not be checked" if open_ else ""
    return f"Verified: {len(findings) - open_} claims hold as stored{rest}."


def _said(
    claim: str, fine: bool, stored: object = "", found: object = "", text: str = ""
) -> Finding:
    return Finding(claim, _shown(stored), _shown(found), "holds" if fine else "refused", text)


def _shown(value: object) -> str:
    return f"{value:.10g}" if isinstance(value, float) else str(value)


def _same(claim: str, stored: float, found: float, slack: float = 0.0, text: str = "") -> Finding:
    """Compare two numbers, to a billionth of themselves and the slack of their rounding."""
    fine = abs(stored - found) <= _TIGHT * max(abs(stored), abs(found)) + slack
    return _said(claim, fine, stored, found, text)


def _definite(saved: SavedGain) -> Iterator[Finding]:
    for name, matrix in (("P", saved.P), ("R", saved.R)):
        skew = float(np.abs(matrix - matrix.T).max())
        fine = skew <= _TIGHT * float(np.abs(matrix).max()) and exact.is_positive_definite(
            exact.rows_of(0.5 * (matrix + matrix.T))
        )
        yield _said(f"{name} is symmetric and positive definite", fine, text="exact minors")
    yield _said("the coupling is positive", saved.coupling > 0.0, saved.coupling)


# ---- the graph ----


def _graph(graph: SavedGraph, saved: SavedGain) -> Iterator[Finding]:
    followers = graph.agents - len(graph.leaders)
    stored, count = graph.spectrum, followers if followers <= algebra.ALL_MODES else 2
    yield _said("modes looked at", saved.modes == count == len(stored), saved.modes, count)
    if graph.edges is None:
        text = "the file holds no edges of so large a graph"
        yield Finding("graph spectrum", _shown(float(stored[0])), "", "not checked", text)
    # Fewer edges than followers cannot reach all; said before a matrix of that size is made.
    elif not _is_graph(graph.edges) or followers > len(graph.edges):
        text = "an edge links no two agents, is given twice or has no positive weight, or some are"
        text += " missing"
        yield _said("graph", False, text=text)
        return
    found = stored if graph.edges is None else algebra.spectrum(graph, graph.edges)
    slack = _ROUNDING * float(found[-1])
    if graph.edges is not None and len(found) == len(stored):
        gap = float(np.abs(found - stored).max())
        fine = gap <= _TIGHT * float(found[-1])
        yield _said("graph spectrum", fine, "", f"{gap:.3g} apart", "grounded Laplacian")
    text = "every follower has a path to a leader"
    yield _said("lambda_min is positive", float(found[0]) > slack, found=float(found[0]), text=text)
    yield _same("lambda_min", saved.lambda_min, float(found[0]))
    yield _same("lambda_min of the spectrum", float(stored[0]), float(found[0]))
    yield _same("lambda_max", saved.lambda_max, float(found[-1]), slack)


def _is_graph(edges: Array) -> bool:
    pairs = np.sort(edges[:, :2], axis=1)
    apart = bool((pairs[:, 0] < pairs[:, 1]).all())
    return apart and len(np.unique(pairs, axis=0)) == len(pairs) and bool((edges[:, 2] > 0.0).all())


# ---- the linearization ----


def _facts(saved: SavedGain) -> _Facts:
    graph, B = saved.graph, saved.model.B
    return _Facts(
        saved,
        graph.spectrum if graph.edges is None else algebra.spectrum(graph, graph.edges),
        B @ scipy.linalg.solve(saved.R, B.T, assume_a="pos"),
        saved.model.A if saved.inner is None else saved.model.A - B @ saved.inner,
    )


def _linearized(facts: _Facts) -> Iterator[Finding]:
    saved = facts.saved
    yield _said("kind of the slowest mode", saved.kind == "linearization", saved.kind)
    K = saved.coupling * facts.weighted @ saved.P
    found = [algebra.rightmost(facts.closed - value * K) for value in facts.eigenvalues]
    slowest = max(value for value, _ in found)
    # Of modes that are equally slow, but for rounding, the worst conditioned sets the slack.
    slack = max(slack for value, slack in found if value >= slowest - slack)
    yield _same("slowest mode, 1/s", saved.abscissa, slowest, slack)
    yield from _edge(facts)
    rank = algebra.observable(facts.closed, saved.model.B.T @ saved.P)
    yield _said("rank of what the input sees", saved.observable == rank, saved.observable, rank)


def _edge(facts: _Facts) -> Iterator[Finding]:
    """Check the coupling from which the linearization is called stable, and that it is."""
    saved, claim = facts.saved, "edge of the coupling"
    known = _EDGES.get(saved.method)
    if saved.edge is None:
        silent = known is None and saved.method != "contraction"
        yield _said(claim, silent, "none", text="" if silent else "this method has one")
        return
    if saved.method == "given":
        yield _said(claim, False, saved.edge, "none", "no edge is known of a given gain")
        return
    # The edge of `contraction` rests on the strength that it found, so only its inequality can be
    # checked.
    if known is not None:
        yield _same(claim, saved.edge, known / facts.low)
    # The inequality is monotone in the coupling, so that at the edge speaks for all above it.
    strength = 2.0 * saved.edge * facts.low
    growth, slack = algebra.growth(saved.P, facts.closed[None], facts.weighted[None], strength)
    text = "largest eigenvalue of the inequality there, in the metric of P"
    yield _said("stable from the edge on", growth <= slack, "at most 0", growth, text)


# ---- the domain ----


def _regional(facts: _Facts) -> Iterator[Finding]:
    saved, region = facts.saved, facts.saved.region
    if region is None:
        return
    if region.theorem == "A5":
        yield _said("strength", region.strength == 0.0, region.strength, 0.0, "the drift alone")
    else:
        yield _same("strength", region.strength, 2.0 * saved.coupling * facts.low)
    if saved.inner is not None:
        yield _said("promise on a domain", False, text="none is known of a gain with an inner loop")
        return
    inside = (region.lower <= 0.0) & (region.upper >= 0.0)
    held = (region.input_lower <= 0.0) & (region.input_upper >= 0.0)
    yield _said("the domain holds the trim", bool(inside.all() and held.all()))
    yield _radius(facts, region)
    yield from _rate(facts, region)


def _spread(facts: _Facts) -> float:
    """Return what it costs the radius of a monotone drift that g may vary."""
    # sum delta_i'P delta_i is bounded by V = delta'(L kron P) delta over lambda_min, and V by
    # lambda_max.
    return float(np.sqrt(facts.eigenvalues[0] / facts.eigenvalues[-1]))


def _needs_constant(facts: _Facts, region: SavedRegion) -> bool:
    """Tell whether a promise holds for a constant g only."""
    widest = _widest(facts.saved.P, region)
    cut = region.radius is not None and region.radius <= (1.0 + _TIGHT) * _spread(facts) * widest
    return region.theorem == "T1" or region.theorem == "A5" and not cut


def _radius(facts: _Facts, region: SavedRegion) -> Finding:
    """Compare with the largest r of which {x'P x <= r^2} stays inside the bounds."""
    widest = _widest(facts.saved.P, region)
    if region.theorem == "T2":
        text = "a local promise certifies no set"
        return _said("radius", region.radius is None, str(region.radius), text=text)
    if region.radius is None or np.isinf(widest):
        return _said("radius", region.radius is None and np.isinf(widest), str(region.radius))
    if region.theorem == "A5" and not _needs_constant(facts, region):
        widest *= _spread(facts)
    return _same("radius", region.radius, widest)


def _widest(P: Array, region: SavedRegion) -> float:
    margins = np.minimum(region.upper, -region.lower)
    # A column of L^-1 for P = L L' has the length that its state reaches on x'P x = 1.
    reach = np.linalg.norm(
        scipy.linalg.solve_triangular(np.linalg.cholesky(P), np.eye(len(P)), lower=True), axis=0
    )
    return float((margins / reach).min())


def _rate(facts: _Facts, region: SavedRegion) -> Iterator[Finding]:
    """Check the rate at every corner: by exact minors for a proof, else by eigenvalues."""
    found, slack = _rate_at(facts, region, *_split(facts, region.hull))
    claim = f"rate at {len(region.hull)} corners, 1/s"
    if region.kind == "proof":
        yield _said(claim, found >= region.rate, region.rate, found, "eigenvalues")
        yield from _proof(facts, region)
        return
    if region.theorem == "A5":
        fine = found >= region.rate - slack and region.rate == 0.0
        yield _said(claim, fine, region.rate, found, "the drift must not expand P")
    else:
        yield _same(claim, region.rate, found, slack, "eigenvalues")
    size, lost = np.abs(region.hull).max(axis=0), region.error
    # Samples are what they are; corners are rounded exact ones.
    allowed = _ROUNDING * size.max() if region.kind == "vertices" else 0.0
    fine = bool((lost >= 0.0).all() and lost.max() <= allowed)
    yield _said("error of the corners", fine, float(lost.max()), text="no more than rounding")


def _split(facts: _Facts, hull: Array) -> tuple[Array, Array]:
    """Return A and g S R^-1 (g S)' of each corner."""
    n = len(facts.saved.P)
    if hull.shape[2] == n:
        return hull, np.broadcast_to(facts.weighted, hull.shape)
    return hull[:, :, :n], hull[:, :, n:]


def _rate_at(facts: _Facts, region: SavedRegion, As: Array, Ws: Array) -> tuple[float, float]:
    """Return the slowest rate over matrices, and what rounding may make of it."""
    growth, slack = algebra.growth(facts.saved.P, As, Ws, region.strength)
    return -0.5 * growth, 0.5 * slack


def _proof(facts: _Facts, region: SavedRegion) -> Iterator[Finding]:
    """Check a proof from the graph on: lambda_min, then the inequality, all in whole numbers."""
    saved, claim = facts.saved, "rate at the corners, proved"
    if region.theorem == "T2" or not np.array_equal(saved.P, saved.P.T):
        text = "a proof needs a constant g and a P that is symmetric to the bit"
        yield _said(claim, False, region.rate, text=text)
        return
    # A little below the number that eigenvalues show, so that it can be proved.
    low = Fraction(facts.low) * (1 - Fraction(1, 10**11))
    graph, few = saved.graph, len(facts.eigenvalues) <= _EXACT_FOLLOWERS
    if graph.edges is not None and few:
        rows = algebra.grounded_rows(graph, graph.edges)
        for k in range(len(rows)):
            # lambda_min > low exactly when L_g - low I is positive definite.
            rows[k][k] -= low
        fine = exact.is_positive_definite(rows)
        yield _said("lambda_min, proved", fine, facts.low, float(low), "exact minors")
    strength = 0 * low if region.theorem == "A5" else 2 * Fraction(saved.coupling) * low
    numbers = (saved.P, saved.model.B, saved.R, region.hull, region.error, strength, region.rate)
    # A negative error would relax the inequality instead of tightening it.
    failed = None if (region.error >= 0.0).all() else 0
    failed = exact.first_unproved(*numbers) if failed is None else failed
    text = "exact minors" if failed is None else f"corner {failed} is not negative definite"
    yield _said(claim, failed is None, region.rate, text=text)


# ---- the equations ----


def _equations(facts: _Facts, given: ControlAffine | None) -> Iterator[Finding]:
    """Check what rests on the model: its trim, its slopes there, and those on the domain."""
    saved, claim = facts.saved, "equations of the model"
    model = equations.model_of(saved.model) if given is None else given
    if isinstance(model, equations.NoModel):
        verdict = "refused" if model.broken else "not checked"
        yield Finding(claim, saved.model.path, "", verdict, model.reason)
        return
    names = (tuple(model.state_names), tuple(model.input_names))
    if names != (saved.model.state_names, saved.model.input_names):
        yield _said(claim, False, saved.model.path, type(model).__name__, "names differ")
        return
    rest = float(np.abs(equations.velocity_at_trim(model, saved.model)).max())
    yield _said("the trim is an equilibrium", rest <= 1e-9, "at most 1e-09", rest)
    still = np.zeros((1, len(saved.P))), np.zeros((1, len(saved.R)))
    at = equations.slopes(model, saved.model, *still)
    for name, stored, found in (
        ("A at the trim", saved.model.A, at.jacobians[0]),
        ("B at the trim", saved.model.B, at.maps[0]),
    ):
        gap, size = float(np.abs(stored - found).max()), float(np.abs(found).max())
        yield _said(name, gap <= _TIGHT * size, "", f"{gap:.3g} apart")
    if saved.region is not None:
        yield from _on_the_domain(facts, saved.region, model)


def _on_the_domain(facts: _Facts, region: SavedRegion, model: ControlAffine) -> Iterator[Finding]:
    """Try to contradict the promise at states of the domain."""
    saved = facts.saved
    points = equations.points(saved, region)
    found = equations.slopes(model, saved.model, points.states, points.inputs)
    count = f"{len(found.jacobians)} states"
    weighted = found.maps @ np.linalg.solve(saved.R, found.maps.swapaxes(1, 2))
    if _needs_constant(facts, region):
        gap = float(np.abs(found.maps - saved.model.B).max())
        fine = gap <= _ROUNDING * float(np.abs(saved.model.B).max())
        yield _said(f"g is constant ({region.theorem})", fine, "", f"{gap:.3g} apart", count)
    # Under T2 the hull is of pairs, since A and g turn together.
    pairs = [found.jacobians, weighted] if region.theorem == "T2" else [found.jacobians]
    if region.kind == "samples":
        gap = equations.farthest_from_all(region.hull, np.dstack(pairs)[: points.corners])
        text = f"{points.corners} corners of the domain"
        yield _said("samples reach the corners", gap <= _TIGHT, "", f"{gap:.3g} apart", text)
    else:
        outside = equations.farthest_outside(region.hull, region.error, np.dstack(pairs))
        text = f"of {count}, in ranges of the entries"
        yield _said("Jacobians lie in the hull", outside <= _TIGHT, "0", outside, text)
    rate, slack = _rate_at(facts, region, found.jacobians, weighted)
    # Samples promise nothing between them, and new ones may be a little worse.
    slower = _SAMPLED * abs(region.rate) if region.kind == "samples" else 0.0
    least = region.rate * (1.0 - _TIGHT) - slack - slower
    yield _said(f"rate at {count}, 1/s", rate >= least, region.rate, rate, "with their own g")
