"""The weights of states and inputs that quadratic methods share."""

import numpy as np

from echelon.agents.models.model import ControlAffine
from echelon.core.errors import GainError
from echelon.core.linear import Weight, as_matrix, check_definite, check_eigenvalues
from echelon.core.types import Array


def weights_of(
    model: ControlAffine, Q: Weight | None = None, R: Weight | None = None
) -> tuple[Array, Array]:
    """Return Q (n, n) of the states and R (m, m) of the normalized inputs.

    Args:
        model: its weights are the defaults.
        Q: n numbers (a diagonal) or (n, n).
        R: m numbers (a diagonal) or (m, m).

    Raises:
        GainError: one has another size, Q is not symmetric positive semidefinite, or R is not
            symmetric positive definite.
    """
    default_Q, default_R = model.weights
    Q = as_matrix("Q", default_Q if Q is None else Q, len(model.state_names))
    R = as_matrix("R", default_R if R is None else R, len(model.input_names))
    check_definite("R", R)
    # R is inverted, so it must be definite; Q may have zero weights for states that decay.
    _check_semidefinite(Q)
    return Q, R


def _check_semidefinite(Q: Array) -> None:
    if not np.isfinite(Q).all() or not np.allclose(Q, Q.T, rtol=1e-9, atol=0.0):
        raise GainError("`Q` must be a symmetric matrix of finite numbers.")
    # Rounding makes zero eigenvalues of a Q of lower rank, such as C'C, slightly negative.
    check_eigenvalues("Q", "positive semidefinite", Q, -1e-12 * len(Q))
