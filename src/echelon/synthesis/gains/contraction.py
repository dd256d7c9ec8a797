"""The weakest feedback that contracts at a required rate on a domain, with a constant metric."""

from collections.abc import Mapping
from functools import partial

import numpy as np

from echelon.agents.models.linearization import Linearization
from echelon.agents.models.model import ControlAffine
from echelon.synthesis.certificates.domain import Bound, Domain
from echelon.synthesis.certificates.domain_metrics import contracting_region, pairs_on
from echelon.synthesis.certificates.lmi import contraction
from echelon.synthesis.gains.gain import Feedback, Method


class Contraction(Method):
    """W = P^-1 with A W + W A' - rho B B' + 2 rate W <= 0 for every Jacobian A, least rho.

    The coupling is rho / (2 lambda_min), and R = I (theory page, T1).

    Args:
        domain: half-widths, or (lower, upper), by state, group or normalized input.
        rate: alpha, 1/s.
        coupling: c > 0; by default what the inequality needs, 1 where it needs none.
        exact: whether to prove the rate in exact arithmetic where g is constant (seconds).
    """

    name = "contraction"
    needs = ("domain", "rate")
    defaults = {"rate": 0.1}
    headroom = 1.0  # the method minimizes rho

    domain: Mapping[str, Bound] | Domain | None = None
    rate: float = defaults["rate"]
    exact: bool = True

    def feedback(self, model: ControlAffine, linear: Linearization) -> Feedback:
        """Return P and the least rho; needs the extra `certify`.

        Raises:
            GainError: there is no such metric, or the domain does not fit.
            MissingExtraError: the solver is not installed.
        """
        # The inequality does not weigh inputs against states; normalized inputs have similar size.
        R, B = np.eye(len(model.input_names)), linear.B
        pairs = pairs_on(model, self.domain, R)
        # The region measures the rate at the strength chosen, so the rate at rho is not needed.
        P, rho, *_ = contraction(pairs.A, B, self.rate, W=pairs.W)
        return Feedback(P, R, rho, partial(contracting_region, pairs, P, B, R, self.exact))
