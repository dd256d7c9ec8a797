"""One Riccati-like gain for all Jacobians of a domain, by semidefinite programming."""

from collections.abc import Mapping
from functools import partial

from echelon.agents.models.linearization import Linearization
from echelon.agents.models.model import ControlAffine
from echelon.core.linear import Weight, check_definite
from echelon.synthesis.certificates.domain import Bound, Domain
from echelon.synthesis.certificates.domain_metrics import contracting_region, pairs_on
from echelon.synthesis.certificates.lmi import robust_lqr
from echelon.synthesis.gains.gain import Feedback, Method
from echelon.synthesis.gains.weights import weights_of


class RobustLQR(Method):
    """P with A'P + P A - P B R^-1 B'P + Q <= 0 for every Jacobian A of a domain, least trace.

    Where g varies, each A has its own B R^-1 B' (theory page, T2).

    Args:
        domain: half-widths, or (lower, upper), by state, group or normalized input.
        Q: state weight; by default the model's.
        R: weight of the normalized input; by default the model's.
        coupling: c > 0; by default 1/lambda_min, twice what the inequality needs.
        exact: whether to prove the rate in exact arithmetic where g is constant.
    """

    name = "robust-lqr"
    needs = ("domain",)

    domain: Mapping[str, Bound] | Domain | None = None
    Q: Weight | None = None
    R: Weight | None = None
    exact: bool = False

    def feedback(self, model: ControlAffine, linear: Linearization) -> Feedback:
        """Return P, whose inequality has strength 1; needs the extra `certify`.

        Raises:
            GainError: there is no such P, or the domain does not fit.
            MissingExtraError: the solver is not installed.
        """
        Q, R = weights_of(model, self.Q, self.R)
        # The rate is at least half the smallest eigenvalue of P^-1 Q, which a singular Q makes 0.
        check_definite("Q", Q)
        pairs = pairs_on(model, self.domain, R)
        # Where g varies, W replaces B R^-1 B' at each corner: with that of the trim the rate would
        # be too large.
        P = robust_lqr(pairs.A, linear.B, Q, R, pairs.W).P
        return Feedback(P, R, 1.0, partial(contracting_region, pairs, P, linear.B, R, self.exact))
