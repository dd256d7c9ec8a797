"""The Riccati gain at the trim (Zhang, Lewis and Das; the linear case of the paper's Remark 2)."""

import numpy as np

from echelon.certificates.certificate import certify
from echelon.core.errors import GainError
from echelon.core.linear import (
    Weight,
    as_matrix,
    check_definite,
    in_words,
    riccati,
    uncontrollable_modes,
)
from echelon.gains.gain import Gain, Method, check_coupling
from echelon.models.linearization import Linearization, linearize
from echelon.models.model import ControlAffine
from echelon.network.graph import Graph


class Riccati(Method):
    """P from A'P + P A + Q - P B R^-1 B'P = 0 at the trim, in normalized inputs.

    Args:
        Q: state weight, n numbers or (n, n); the model's own when left out.
        R: weight of the normalized input, m numbers or (m, m); the model's own when left out.
        coupling: c; 1/lambda_min when left out, twice the edge 1/(2 lambda_min) of the guarantee
            for linear agents.
    """

    Q: Weight | None = None
    R: Weight | None = None
    coupling: float | None = None

    def solve(self, model: ControlAffine, graph: Graph) -> Gain:
        """Return the gain.

        Raises:
            GainError: a weight is not positive (semi)definite, or a mode cannot be stabilized
                (named).
        """
        default_Q, default_R = model.weights
        n, m = len(model.state_names), len(model.input_names)
        Q = as_matrix("Q", default_Q if self.Q is None else self.Q, n)
        R = as_matrix("R", default_R if self.R is None else self.R, m)
        check_definite("R", R)
        _check_semidefinite(Q)
        linear = linearize(model)
        _check_stabilizable(model, linear)
        P = riccati(*linear, Q, R)
        low = float(graph.grounded_spectrum()[0])
        coupling = 1.0 / low if self.coupling is None else float(self.coupling)
        check_coupling(coupling)
        certificate = certify(linear, graph, P, R, coupling, edge=0.5 / low)
        return Gain(P=P, R=R, coupling=coupling, method="riccati", certificate=certificate)


def _check_semidefinite(Q: np.ndarray) -> None:
    if not np.isfinite(Q).all() or not np.allclose(Q, Q.T, rtol=1e-9, atol=0.0):
        raise GainError("`Q` must be a symmetric matrix of finite numbers.")
    least = float(np.linalg.eigvalsh(Q)[0])
    if least < -1e-12 * max(1.0, float(np.abs(Q).max())):
        raise GainError(
            f"`Q` is not positive semidefinite: its smallest eigenvalue is {least:.6g}."
        )


def _check_stabilizable(model: ControlAffine, linear: Linearization) -> None:
    """Name the first mode that no input can move and that does not decay by itself."""
    for eigenvalue, direction in uncontrollable_modes(*linear):
        if eigenvalue.real >= 0.0:
            largest = np.abs(direction) > 0.1 * np.abs(direction).max()
            states = ", ".join(
                f"`{name}`" for name, used in zip(model.state_names, largest, strict=True) if used
            )
            raise GainError(
                f"the linearization of `{type(model).__name__}` at its trim cannot be stabilized: "
                f"no input moves the mode at {in_words(eigenvalue)} 1/s, which lies along "
                f"{states}; "
                "give the gain yourself (method `given`) or choose another model of the vehicle."
            )
