"""What the methods that promise something on a domain have in common."""

from collections.abc import Mapping
from fractions import Fraction

import numpy as np

from echelon._certificates import Region
from echelon._domain import Bound, Domain
from echelon._errors import GainError
from echelon._exact import prove_contraction
from echelon._jacobians import Jacobians, has_constant_input_map
from echelon._types import Matrix
from echelon.models.model import ControlAffine

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


def contracting_region(
    model: ControlAffine,
    domain: Domain,
    found: Jacobians,
    P: Matrix,
    B: Matrix,
    R: Matrix,
    strength: float,
    rate: float,
    exact: bool,
) -> tuple[Region, float]:
    """Return what a metric promises on a domain, and its rate there.

    Args:
        model: the agents.
        domain: where.
        found: the Jacobians on the domain.
        P: metric (n, n).
        B: input matrix at the trim (n, m).
        R: weight of the normalized input (m, m).
        strength: 2 c lambda_min.
        rate: alpha by eigenvalues, 1/s.
        exact: whether to prove it in rational arithmetic (seconds), where a hull is at hand.
    """
    constant = has_constant_input_map(model, domain)
    kind, shown = found.kind, rate
    if exact and constant and found.kind == "vertices" and rate > 0.0:
        shown = float(Fraction(rate * _SAFE).limit_denominator(10**6))
        weighted = B @ np.linalg.cholesky(np.linalg.inv(R))
        proof = prove_contraction(found.matrices, found.error, weighted, P, strength, shown)
        kind, shown = ("proof", shown) if proof.holds else (kind, rate)
    region = Region(
        kind=kind,
        rate=shown,
        theorem="T1" if constant else "T2",
        domain=in_words(model, domain),
        radius=radius(domain, P),
    )
    return region, shown


def radius(domain: Domain, P: Matrix) -> float | None:
    """Return r with {delta'P delta <= r^2} inside the domain: r^2 = min_j margin_j^2 / W_jj."""
    margins, W = domain.margins(), np.linalg.inv(P)
    bounded = np.isfinite(margins)
    if not bounded.any():
        return None
    return float(np.sqrt((margins[bounded] ** 2 / np.diag(W)[bounded]).min()))


def in_words(model: ControlAffine, domain: Domain) -> str:
    """Return the domain's bounds as text, deviations from the trim."""
    names = (*model.state_names, *model.input_names)
    lower = np.concatenate([domain.lower, domain.input_lower])
    upper = np.concatenate([domain.upper, domain.input_upper])
    told = [
        f"{name} in [{low:.4g}, {high:.4g}]"
        for name, low, high in zip(names, lower, upper, strict=True)
        if np.isfinite([low, high]).all() and low < high
    ]
    return ", ".join(told) or "all states"
