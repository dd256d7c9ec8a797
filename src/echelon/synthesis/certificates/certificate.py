"""The certificate of a gain on a graph: spectrum, abscissa and observability at the trim."""

import equinox as eqx
import numpy as np

from echelon.agents.models.linearization import Linearization
from echelon.agents.network.spectrum import Spectrum
from echelon.core.linear import observability_rank
from echelon.core.types import Array
from echelon.core.words import Kind, Theorem
from echelon.synthesis.certificates.domain import Domain


class RegionCertificate(eqx.Module):
    """The guarantee of a gain on a domain.

    Attributes:
        kind: a proof (exact arithmetic on a hull of all Jacobians), vertices (the same in floating
            point) or samples.
        rate: alpha, 1/s: errors decay as e^(-alpha t) in the metric of P; 0 where they only do not
            grow.
        theorem: T1, nonlocal on the region since g is constant; T2, local about the leader's path;
            A5, the paper's Assumption 5 for the drift alone.
        domain: bounds that the states and inputs must respect.
        radius: r of the set {sum_i delta_i'P delta_i <= r^2} that cannot leave the domain while the
            leader stays at the trim; None where the domain bounds nothing, and for T2.
        strength: 2 c lambda_min, the weight of the feedback in the inequality; 0 for A5.
        hull: (K, n, n), the matrices for which the rate was computed: by kind, the corners of a
            hull of all Jacobians A, or samples of them. For T2, whose g varies, it is (K, n, 2n):
            each A with its g S R^-1 (g S)' to the right.
        error: one such matrix, a bound of the rounding of a corner, entry by entry.
        why: the reason for a weaker kind than a proof; empty without one, or if none was tried.
    """

    kind: Kind = eqx.field(static=True)
    rate: float
    theorem: Theorem = eqx.field(static=True)
    domain: Domain = eqx.field(static=True)
    radius: float | None
    strength: float
    hull: Array
    error: Array
    why: str = eqx.field(default="", static=True)


class Certificate(eqx.Module):
    """The guarantees of a gain: by linearization at the trim, and possibly on a region.

    Attributes:
        kind: the kind of argument behind the abscissa.
        lambda_min, lambda_max: extreme eigenvalues of the grounded Laplacian, or of the matrix that
            replaces it under a feed-forward.
        abscissa: largest real part of an eigenvalue of A - c lambda B R^-1 B'P, 1/s, over the
            eigenvalues lambda that were checked.
        modes: number of eigenvalues lambda checked: all, or on large graphs the extreme two.
        edge: smallest coupling for which the linearization is proved stable, or None where no bound
            is known.
        observable: rank of the observability matrix of (A, g'P), out of n; below n, disagreements
            exist that never enter the input.
    """

    kind: Kind = eqx.field(static=True)
    lambda_min: float
    lambda_max: float
    abscissa: float
    modes: int = eqx.field(static=True)
    edge: float | None
    observable: int = eqx.field(static=True)
    region: RegionCertificate | None = None

    @property
    def stable(self) -> bool:
        """Whether the linearized disagreement decays in every mode that was checked."""
        return self.abscissa < 0.0


def certify(
    linear: Linearization,
    spectrum: Spectrum,
    P: Array,
    R: Array,
    coupling: float,
    edge: float | None,
    region: RegionCertificate | None = None,
) -> Certificate:
    """Return the certificate by linearization at the trim of gain P, R and coupling c.

    With constant g the disagreement splits over the eigenvectors of the grounded Laplacian, or of
    the matrix that replaces it under a feed-forward, into modes A - c lambda B R^-1 B'P (theory
    page, T2).
    """
    feedback = linear.B @ np.linalg.solve(R, linear.B.T @ P)
    modes = linear.A - coupling * spectrum.eigenvalues[:, None, None] * feedback
    return Certificate(
        kind=Kind.LINEARIZATION,
        lambda_min=spectrum.low,
        lambda_max=spectrum.high,
        abscissa=float(np.linalg.eigvals(modes).real.max()),
        modes=len(spectrum.eigenvalues),
        edge=edge,
        observable=observability_rank(linear.A, linear.B.T @ P),
        region=region,
    )
