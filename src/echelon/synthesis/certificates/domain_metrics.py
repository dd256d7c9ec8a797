"""Metrics on a domain: what the methods with a guarantee on a domain share."""

from collections.abc import Mapping
from fractions import Fraction
from typing import NamedTuple

import numpy as np

from echelon.agents.models.model import ControlAffine
from echelon.agents.network.spectrum import Spectrum
from echelon.core.errors import GainError
from echelon.core.types import Array
from echelon.core.words import Kind, Theorem
from echelon.synthesis.certificates.certificate import RegionCertificate
from echelon.synthesis.certificates.domain import Bound, Domain
from echelon.synthesis.certificates.exact_proofs import prove_contraction
from echelon.synthesis.certificates.jacobians import (
    Jacobians,
    has_constant_input_map,
    jacobians,
    weighted_jacobians,
)
from echelon.synthesis.certificates.lmi import rate_of

# The exact proof uses a rate slightly below that of the eigenvalues, because of their rounding.
_SAFE = 1.0 - 1e-6


class DomainPairs(NamedTuple):
    """The matrices that a gain must contract on a domain.

    Attributes:
        jacobians: the Jacobians there, with their W to the right where g varies.
        A: (K, n, n), the Jacobians alone.
        W: (K, n, n), W_k = g S R^-1 (g S)' enclosed with A_k; None where g is constant.
    """

    domain: Domain
    jacobians: Jacobians
    A: Array
    W: Array | None


def the_domain(model: ControlAffine, bounds: Mapping[str, Bound] | Domain | None) -> Domain:
    """Return a method's domain for a model.

    Raises:
        GainError: there is none, or it does not fit the model.
    """
    if bounds is None:
        raise GainError(
            "this method needs a `domain`: half-widths by state, group or input, such as "
            "`{attitude: 0.35, thrust: 2.0}`."
        )
    return bounds if isinstance(bounds, Domain) else Domain.about(model, bounds)


def pairs_on(
    model: ControlAffine, bounds: Mapping[str, Bound] | Domain | None, R: Array
) -> DomainPairs:
    """Return the matrices that a gain must contract on a method's domain, with R (m, m).

    Raises:
        GainError: there is no domain, it does not fit the model, or it leaves unbounded a state
            that the Jacobians depend on.
    """
    domain = the_domain(model, bounds)
    # Slopes that no open angle changes are those of all of it, and a metric speaks of a part.
    part = domain.straight(model)
    if has_constant_input_map(model, domain):
        hull = jacobians(model, domain)
        return DomainPairs(part, hull, hull.matrices, None)
    hull = weighted_jacobians(model, domain, R)
    A, W = np.split(hull.matrices, 2, axis=2)
    return DomainPairs(part, hull, A, W)


def contracting_region(
    pairs: DomainPairs,
    P: Array,
    B: Array,
    R: Array,
    exact: bool,
    coupling: float,
    spectrum: Spectrum,
) -> RegionCertificate | None:
    """Return the guarantee of a metric on a domain; None where it contracts at no rate there.

    `exact` proves it in rationals (seconds), where a hull is at hand and g is constant.
    """
    domain, hull, A, W = pairs
    strength, constant = 2.0 * coupling * spectrum.proved, W is None
    if not strength > 0.0:
        return None
    # P A + A'P - strength P W P is affine in a pair, so the corners of the pairs' hull suffice.
    # With A - strength W P / 2 the drift's formula gives P A + A'P - strength P W P.
    rate = rate_of(P, A, B, R, strength) if W is None else rate_of(P, A - 0.5 * strength * W @ P)
    if rate <= 0.0:
        return None
    kind, why = hull.kind, hull.why
    if exact and constant and kind is Kind.VERTICES:
        proved_rate = float(Fraction(rate * _SAFE).limit_denominator(10**6))
        # B R^-1 B' as a product of a matrix with its own transpose, the form that the proof takes.
        weighted = B @ np.linalg.cholesky(np.linalg.inv(R))
        proof = prove_contraction(A, hull.error, weighted, P, strength, proved_rate)
        kind, rate = (Kind.PROOF, proved_rate) if proof.holds else (kind, rate)
        why = "" if proof.holds else f"exact arithmetic does not confirm corner {proof.failed}"
    return RegionCertificate(
        kind=kind,
        rate=rate,
        theorem=Theorem.T1 if constant else Theorem.T2,
        domain=domain,
        # Where g varies the guarantee holds for small errors only, not on a set.
        radius=radius(domain, P, spectrum.skew) if constant else None,
        strength=strength,
        hull=hull.matrices,
        error=hull.error,
        why=why,
    )


def drift_region(
    model: ControlAffine,
    domain: Domain,
    hull: Jacobians,
    P: Array,
    coupling: float,
    spectrum: Spectrum,
) -> RegionCertificate | None:
    """Return the guarantee of a metric (n, n) that the drift expands at none of its Jacobians.

    It is the same for every coupling; None where no sum of squares is nonincreasing on the graph.
    """
    varies = not has_constant_input_map(model, domain)
    if not spectrum.proved > 0.0 or (varies and not spectrum.symmetric):
        return None
    domain = domain.straight(model)
    reach = radius(domain, P, spectrum.skew)
    if reach is not None and varies:
        # Then S = sum delta_i'P delta_i may rise, V = delta'(L kron P) delta may not, and
        # lambda_min S <= V <= lambda_max S.
        reach *= float(np.sqrt(spectrum.proved / spectrum.high))
    return RegionCertificate(
        kind=hull.kind,
        rate=0.0,
        theorem=Theorem.A5,
        domain=domain,
        radius=reach,
        strength=0.0,
        hull=hull.matrices,
        error=hull.error,
        why=hull.why,
    )


def radius(domain: Domain, P: Array, skew: float = 1.0) -> float | None:
    """Return r with {delta'P delta <= r^2} inside the domain: r^2 = min_j margin_j^2 / W_jj.

    On a directed graph a weighted sum decreases, and the share of one agent may exceed it by the
    ratio of the weights.
    """
    # delta_j reaches r sqrt(W_jj) on {delta'P delta <= r^2}, by Cauchy and Schwarz in the metric P.
    margins, W = domain.margins(), np.linalg.inv(P)
    bounded = np.isfinite(margins)
    if not bounded.any():
        return None
    inside = (margins[bounded] ** 2 / np.diag(W)[bounded]).min()
    return float(np.sqrt(inside / skew))
