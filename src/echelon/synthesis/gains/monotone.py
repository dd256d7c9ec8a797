"""The paper's Assumption 5 as a semidefinite program: a P that the drift does not expand."""

from collections.abc import Mapping
from functools import partial

import numpy as np

from echelon.agents.models.linearization import Linearization
from echelon.agents.models.model import ControlAffine
from echelon.synthesis.certificates.domain import Bound, Domain
from echelon.synthesis.certificates.domain_metrics import drift_region, the_domain
from echelon.synthesis.certificates.jacobians import jacobians
from echelon.synthesis.certificates.lmi import monotone
from echelon.synthesis.gains.gain import Feedback, Method


class Monotone(Method):
    """P > 0 with P A(x) + A(x)'P <= 0 on a domain, A the Jacobian of the drift; least condition.

    It is the paper's Assumption 5 made finite. Many drifts have none: any with an unstable
    Jacobian, or one with a Jordan block on the imaginary axis, such as a double integrator.

    Args:
        domain: half-widths, or (lower, upper), by state or group.
        coupling: c > 0; V does not rise with any; 1 by default.
    """

    name = "monotone"
    needs = ("domain",)

    domain: Mapping[str, Bound] | Domain | None = None

    def feedback(self, model: ControlAffine, linear: Linearization) -> Feedback:
        """Return P, which needs no feedback; needs the extra `certify` unless eigenvalues decide.

        Raises:
            GainError: there is no such P (the mode is named where eigenvalues show it), or the
                domain does not fit.
            MissingExtraError: the solver is not installed.
        """
        domain = the_domain(model, self.domain)
        hull = jacobians(model, domain)
        # Vertices suffice: P A + A'P is affine in A, and the hull contains every Jacobian.
        P = monotone(hull.matrices, names=model.state_names).P
        region = partial(drift_region, model, domain, hull, P)
        # The feedback adds a negative square to V' for any c and R: rho = 0, R = I.
        return Feedback(P, np.eye(len(model.input_names)), 0.0, region)
