"""One Riccati-like gain for all Jacobians of a domain, by semidefinite programming."""

from collections.abc import Mapping

from echelon.certificates.certificate import certify
from echelon.certificates.domain import Bound, Domain
from echelon.certificates.lmi import robust_lqr
from echelon.certificates.region import contracting_region, pairs_on, the_domain
from echelon.core.linear import Weight, as_matrix, check_definite
from echelon.gains.gain import Gain, Method, check_coupling
from echelon.models.linearization import linearize
from echelon.models.model import ControlAffine
from echelon.network.graph import Graph


class RobustLQR(Method):
    """P with A'P + P A - P B R^-1 B'P + Q <= 0 for every Jacobian A of a domain, least trace.

    Where g varies, each A has its own B R^-1 B' (theory page, T2).

    Args:
        domain: half-widths, or (lower, upper), by state, group or normalized input.
        Q: state weight; the model's own when left out.
        R: weight of the normalized input; the model's own when left out.
        coupling: c; 1/lambda_min when left out, twice what the inequality needs.
        exact: whether to prove the rate in exact arithmetic where g is constant.
    """

    domain: Mapping[str, Bound] | Domain | None = None
    Q: Weight | None = None
    R: Weight | None = None
    coupling: float | None = None
    exact: bool = False

    def solve(self, model: ControlAffine, graph: Graph) -> Gain:
        """Return the gain; needs the extra `certify`.

        Raises:
            GainError: there is no such P, or the domain does not fit.
            MissingExtraError: the solver is not installed.
        """
        n, m = len(model.state_names), len(model.input_names)
        Q = as_matrix("Q", model.weights[0] if self.Q is None else self.Q, n)
        R = as_matrix("R", model.weights[1] if self.R is None else self.R, m)
        check_definite("Q", Q)
        check_definite("R", R)
        domain, linear = the_domain(model, self.domain), linearize(model)
        found, As, W = pairs_on(model, domain, R)
        P = robust_lqr(As, linear.B, Q, R, W).P
        low = float(graph.grounded_spectrum()[0])
        coupling = 1.0 / low if self.coupling is None else float(self.coupling)
        check_coupling(coupling)
        strength = 2.0 * coupling * low
        region = contracting_region(domain, found, P, linear.B, R, strength, self.exact)
        certificate = certify(linear, graph, P, R, coupling, edge=0.5 / low, region=region)
        return Gain(P, R, coupling, "robust-lqr", certificate)
