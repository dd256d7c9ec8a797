"""Gains with a guarantee on a domain, by semidefinite programming."""

from collections.abc import Mapping
from functools import partial

import numpy as np

from echelon.agents.models.linearization import Linearization
from echelon.agents.models.model import ControlAffine
from echelon.core.linear import Weight, check_definite
from echelon.synthesis.certificates.domain import Bound, Domain
from echelon.synthesis.certificates.domain_metrics import (
    contracting_region,
    drift_region,
    pairs_on,
    the_domain,
)
from echelon.synthesis.certificates.jacobians import jacobians
from echelon.synthesis.certificates.lmi import contraction, monotone, robust_lqr
from echelon.synthesis.gains.gain import Feedback, Method
from echelon.synthesis.gains.riccati import weights_of

# ---- the paper's Assumption 5 --------------------------------------------------------------------


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


# ---- one gain for all Jacobians of a domain ------------------------------------------------------


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


# ---- the weakest feedback that contracts at a required rate --------------------------------------


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
