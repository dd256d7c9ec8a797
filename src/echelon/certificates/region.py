"""What the methods that promise something on a domain have in common."""

from collections.abc import Mapping
from fractions import Fraction

import numpy as np

from echelon.certificates.certificate import RegionCertificate
from echelon.certificates.domain import Bound, Domain
from echelon.certificates.exact import prove_contraction
from echelon.certificates.jacobians import (
    Jacobians,
    has_constant_input_map,
    jacobians,
    weighted_jacobians,
)
from echelon.certificates.lmi import rate_of
from echelon.core.errors import GainError
from echelon.core.types import Array
from echelon.models.model import ControlAffine
from echelon.network.graph import Graph

# The exact proof is of a rate a little below the one that eigenvalues show, for their rounding.
_SAFE = 1.0 - 1e-6


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
    model: ControlAffine, domain: Domain, R: Array
) -> tuple[Jacobians, Array, Array | None]:
    """Return what a gain must contract: the Jacobians on a domain, and (A_k, W_k).

    W_k = g S R^-1 (g S)' is enclosed with A_k where g varies, and None where it is constant.

    Raises:
        GainError: they depend on a state that the domain leaves unbounded.
    """
    if has_constant_input_map(model, domain):
        found = jacobians(model, domain)
        return found, found.matrices, None
    found = weighted_jacobians(model, domain, R)
    A, W = np.split(found.matrices, 2, axis=2)
    return found, A, W


def contracting_region(
    domain: Domain,
    found: Jacobians,
    P: Array,
    B: Array,
    R: Array,
    strength: float,
    exact: bool,
) -> RegionCertificate | None:
    """Return what a metric promises on a domain; None where it contracts at no rate there.

    Args:
        domain: where.
        found: the Jacobians on the domain, beside their W where g varies.
        P: metric (n, n).
        B: input matrix at the trim (n, m).
        R: weight of the normalized input (m, m).
        strength: 2 c lambda_min.
        exact: whether to prove it in rational arithmetic (seconds), where a hull is at hand and g
            is constant.
    """
    constant = found.matrices.shape[2] == len(P)
    rate = (
        rate_of(P, found.matrices, B, R, strength)
        if constant
        else _rate_where_g_varies(P, found.matrices, strength)
    )
    if rate <= 0.0:
        return None
    kind, why = found.kind, found.why
    if exact and constant and kind == "vertices":
        shown = float(Fraction(rate * _SAFE).limit_denominator(10**6))
        weighted = B @ np.linalg.cholesky(np.linalg.inv(R))
        proof = prove_contraction(found.matrices, found.error, weighted, P, strength, shown)
        kind, rate = ("proof", shown) if proof.holds else (kind, rate)
        why = "" if proof.holds else f"exact arithmetic does not confirm corner {proof.failed}"
    return RegionCertificate(
        kind=kind,
        rate=rate,
        theorem="T1" if constant else "T2",
        domain=domain,
        # Where g varies the promise is of small errors, and none of a set.
        radius=radius(domain, P) if constant else None,
        strength=strength,
        hull=found.matrices,
        error=found.error,
        why=why,
    )


def _rate_where_g_varies(P: Array, pairs: Array, strength: float) -> float:
    """Return the rate over pairs [A, W] with W = g S R^-1 (g S)', (K, n, 2n).

    P A + A'P - strength P W P is affine in the pair, so the corners of its hull suffice.
    """
    A, W = np.split(pairs, 2, axis=2)
    return rate_of(P, A - 0.5 * strength * W @ P)


def drift_region(
    model: ControlAffine, domain: Domain, found: Jacobians, P: Array, graph: Graph
) -> RegionCertificate:
    """Return what a metric (n, n) promises that the drift expands at none of its Jacobians."""
    reach = radius(domain, P)
    if reach is not None and not has_constant_input_map(model, domain):
        # Then sum delta_i'P delta_i may rise; V = delta'(L kron P) delta may not.
        reach *= float(np.sqrt(np.divide(*graph.grounded_spectrum()[[0, -1]])))
    return RegionCertificate(
        kind=found.kind,
        rate=0.0,
        theorem="A5",
        domain=domain,
        radius=reach,
        strength=0.0,
        hull=found.matrices,
        error=found.error,
        why=found.why,
    )


def radius(domain: Domain, P: Array) -> float | None:
    """Return r with {delta'P delta <= r^2} inside the domain: r^2 = min_j margin_j^2 / W_jj."""
    margins, W = domain.margins(), np.linalg.inv(P)
    bounded = np.isfinite(margins)
    if not bounded.any():
        return None
    return float(np.sqrt((margins[bounded] ** 2 / np.diag(W)[bounded]).min()))
