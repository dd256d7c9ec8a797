"""The weakest feedback that contracts at a wanted rate on a domain, with one constant metric."""

from collections.abc import Mapping

import numpy as np

from echelon.certificates.certificate import certify
from echelon.certificates.domain import Bound, Domain
from echelon.certificates.lmi import contraction
from echelon.certificates.region import contracting_region, pairs_on, the_domain
from echelon.gains.gain import Gain, Method, check_coupling
from echelon.models.linearization import linearize
from echelon.models.model import ControlAffine
from echelon.network.graph import Graph


class Contraction(Method):
    """W = P^-1 with A W + W A' - rho B B' + 2 rate W <= 0 for every Jacobian A, least rho.

    The coupling is rho / (2 lambda_min), and R = I (theory page, T1).

    Args:
        domain: half-widths, or (lower, upper), by state, group or normalized input.
        rate: alpha, 1/s.
        coupling: c; what the inequality needs when left out, 1 where it needs none.
        exact: whether to prove the rate in exact arithmetic where g is constant (seconds).
    """

    domain: Mapping[str, Bound] | Domain | None = None
    rate: float = 0.1
    coupling: float | None = None
    exact: bool = True

    def solve(self, model: ControlAffine, graph: Graph) -> Gain:
        """Return the gain; needs the extra `certify`.

        Raises:
            GainError: there is no such metric, or the domain does not fit.
            MissingExtraError: the solver is not installed.
        """
        domain, linear = the_domain(model, self.domain), linearize(model)
        R = np.eye(len(model.input_names))
        found, As, W = pairs_on(model, domain, R)
        metric = contraction(As, linear.B, self.rate, W=W)
        low = float(graph.grounded_spectrum()[0])
        edge = metric.rho / (2.0 * low)
        # A drift that contracts by itself needs no feedback, and takes any.
        coupling = (edge or 1.0) if self.coupling is None else float(self.coupling)
        check_coupling(coupling)
        strength = 2.0 * coupling * low
        region = contracting_region(domain, found, metric.P, linear.B, R, strength, self.exact)
        certificate = certify(linear, graph, metric.P, R, coupling, edge=edge, region=region)
        return Gain(metric.P, R, coupling, "contraction", certificate)
