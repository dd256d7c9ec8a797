"""The paper's Assumption 5 as a semidefinite program: a P that the drift does not expand."""

from collections.abc import Mapping

import numpy as np

from echelon.certificates.certificate import certify
from echelon.certificates.domain import Bound, Domain
from echelon.certificates.jacobians import jacobians
from echelon.certificates.lmi import monotone
from echelon.certificates.region import drift_region, the_domain
from echelon.gains.gain import Gain, Method, check_coupling
from echelon.models.linearization import linearize
from echelon.models.model import ControlAffine
from echelon.network.graph import Graph


class Monotone(Method):
    """P > 0 with P A(x) + A(x)'P <= 0 on a domain, A the Jacobian of the drift; least condition.

    It is the paper's Assumption 5 made finite. Many drifts have none: any with an unstable
    Jacobian, or one with a Jordan block on the imaginary axis, such as a double integrator.

    Args:
        domain: half-widths, or (lower, upper), by state or group.
        coupling: c; any positive number keeps V from rising.
    """

    domain: Mapping[str, Bound] | Domain | None = None
    coupling: float = 1.0

    def solve(self, model: ControlAffine, graph: Graph) -> Gain:
        """Return the gain; needs the extra `certify` unless eigenvalues decide.

        Raises:
            GainError: there is no such P (the mode is named where eigenvalues show it), or the
                domain does not fit.
            MissingExtraError: the solver is not installed.
        """
        check_coupling(self.coupling)
        domain, linear = the_domain(model, self.domain), linearize(model)
        found = jacobians(model, domain)
        P = monotone(found.matrices, names=model.state_names).P
        R, region = np.eye(len(model.input_names)), drift_region(model, domain, found, P, graph)
        certificate = certify(linear, graph, P, R, self.coupling, edge=0.0, region=region)
        return Gain(P, R, self.coupling, "monotone", certificate)
