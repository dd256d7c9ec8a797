"""A gain of one's own; with P = I and c = 1 it is the paper's (literal)."""

from typing import Literal

import numpy as np

from echelon.agents.models.linearization import Linearization
from echelon.agents.models.model import ControlAffine
from echelon.core.errors import GainError
from echelon.core.linear import Weight, as_matrix
from echelon.synthesis.gains.gain import Feedback, Method


class FixedGain(Method):
    """The user's own P, with no promise beyond what its linearization shows.

    Args:
        P: n numbers (a diagonal), (n, n), or "identity".
        R: weight of the normalized input, m numbers or (m, m); the identity when left out.
        coupling: c > 0; 1 when left out.
    """

    name = "given"
    needs = ("P",)

    P: Weight | Literal["identity"] = "identity"
    R: Weight | None = None

    def feedback(self, model: ControlAffine, linear: Linearization) -> Feedback:
        """Return P and R as they were given.

        Raises:
            GainError: P or R has another size, or P is a word other than `identity`.
        """
        m = len(model.input_names)
        R = np.eye(m) if self.R is None else as_matrix("R", self.R, m)
        # No inequality stands behind this P, so that no coupling is known to be enough.
        return Feedback(self._matrix(len(model.state_names)), R, rho=None)

    def _matrix(self, n: int) -> np.ndarray:
        if isinstance(self.P, str):
            if self.P != "identity":
                raise GainError(
                    f"`P` is `{self.P}`, and must be a matrix, a diagonal or `identity`."
                )
            return np.eye(n)
        return as_matrix("P", self.P, n)
