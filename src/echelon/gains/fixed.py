"""A gain of one's own; with P = I and c = 1 it is the paper's (literal)."""

from typing import Literal

import numpy as np

from echelon.certificates.certificate import certify
from echelon.core.errors import GainError
from echelon.core.linear import Weight, as_matrix, check_definite
from echelon.gains.gain import Gain, Method, check_coupling
from echelon.models.linearization import linearize
from echelon.models.model import ControlAffine
from echelon.network.graph import Graph


class FixedGain(Method):
    """The user's own P, with no promise beyond what its linearization shows.

    Args:
        P: n numbers (a diagonal), (n, n), or "identity".
        R: weight of the normalized input, m numbers or (m, m); the identity when left out.
        coupling: c.
    """

    P: Weight | Literal["identity"] = "identity"
    R: Weight | None = None
    coupling: float = 1.0

    def solve(self, model: ControlAffine, graph: Graph) -> Gain:
        """Return the gain.

        Raises:
            GainError: P or R is not symmetric positive definite, or the coupling is not positive.
        """
        n, m = len(model.state_names), len(model.input_names)
        P = self._matrix(n)
        R = np.eye(m) if self.R is None else as_matrix("R", self.R, m)
        for name, matrix in (("P", P), ("R", R)):
            check_definite(name, matrix)
        check_coupling(self.coupling)
        certificate = certify(linearize(model), graph, P, R, self.coupling, edge=None)
        return Gain(
            P=P, R=R, coupling=float(self.coupling), method="given", certificate=certificate
        )

    def _matrix(self, n: int) -> np.ndarray:
        if isinstance(self.P, str):
            if self.P != "identity":
                raise GainError(
                    f"`P` is `{self.P}`, and must be a matrix, a diagonal or `identity`."
                )
            return np.eye(n)
        return as_matrix("P", self.P, n)
