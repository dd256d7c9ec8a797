"""A gain from the user's matrices; with P = I and c = 1 it is the paper's (literal)."""

from typing import Literal

import numpy as np

from echelon.agents.models.linearization import Linearization
from echelon.agents.models.model import ControlAffine
from echelon.core.errors import GainError
from echelon.core.linear import Weight, as_matrix
from echelon.synthesis.gains.gain import Feedback, Method


class FixedGain(Method):
    """The user's P, with no guarantee beyond that of its linearization.

    Args:
        P: n numbers (a diagonal), (n, n), or "identity".
        R: weight of the normalized input, m numbers or (m, m); the identity by default.
        coupling: c > 0; 1 by default.
    """

    name = "given"
    needs = ("P",)

    P: Weight | Literal["identity"] = "identity"
    R: Weight | None = None

    def feedback(self, model: ControlAffine, linear: Linearization) -> Feedback:
        """Return the user's P and R.

        Raises:
            GainError: P or R has another size, or P is a word other than `identity`.
        """
        m = len(model.input_names)
        R = np.eye(m) if self.R is None else as_matrix("R", self.R, m)
        # No inequality holds for this P in general, so no coupling is known to suffice.
        return Feedback(self._matrix(len(model.state_names)), R, rho=None)

    def _matrix(self, n: int) -> np.ndarray:
        if isinstance(self.P, str):
            if self.P != "identity":
                raise GainError(
                    f"`P` is `{self.P}`, and must be a matrix, a diagonal or `identity`."
                )
            return np.eye(n)
        return as_matrix("P", self.P, n)
