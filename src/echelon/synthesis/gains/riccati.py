"""The Riccati gain at the trim (Zhang, Lewis and Das; the linear case of the paper's Remark 2)."""

import itertools

import numpy as np

from echelon.agents.models.linearization import Linearization
from echelon.agents.models.model import ControlAffine
from echelon.core.errors import GainError, listing
from echelon.core.linear import Weight, eigenvalue_text, riccati, uncontrollable_modes
from echelon.core.types import Array
from echelon.synthesis.gains.gain import Feedback, Method
from echelon.synthesis.gains.weights import weights_of


class Riccati(Method):
    """P from A'P + P A + Q - P B R^-1 B'P = 0 at the trim, in normalized inputs.

    Args:
        Q: state weight, n numbers or (n, n); by default the model's.
        R: weight of the normalized input, m numbers or (m, m); by default the model's.
        coupling: c > 0; by default 1/lambda_min, twice the smallest 1/(2 lambda_min) of the
            guarantee for linear agents.
    """

    name = "riccati"

    Q: Weight | None = None
    R: Weight | None = None

    def feedback(self, model: ControlAffine, linear: Linearization) -> Feedback:
        """Return P, whose equation leaves -Q at strength 1.

        Raises:
            GainError: a weight is not positive (semi)definite, or a mode cannot be stabilized
                (named).
        """
        Q, R = weights_of(model, self.Q, self.R)
        _check_stabilizable(model, linear, Q, R)
        # P A + A'P - s P B R^-1 B'P = -Q - (s - 1) P B R^-1 B'P, never positive for s >= rho = 1.
        return Feedback(riccati(*linear, Q, R), R, rho=1.0)


def _in_units(linear: Linearization, Q: Array, R: Array) -> tuple[Array, Array]:
    """Return A and B in units in which a state, or an input, of one has a weight of one."""
    x, u = (np.sqrt(np.where(np.diag(M) > 0.0, np.diag(M), 1.0)) for M in (Q, R))
    return x[:, None] * linear.A / x, x[:, None] * linear.B / u


def _check_stabilizable(model: ControlAffine, linear: Linearization, Q: Array, R: Array) -> None:
    """Name the first mode that no input can move and that does not decay by itself."""
    modes = uncontrollable_modes(*linear)
    if modes and not uncontrollable_modes(*_in_units(linear, Q, R)):
        # Only the units of the states make it seem so.
        return
    for eigenvalue, direction in modes:
        # A mode that decays needs no input: (A, B) need not be controllable.
        if eigenvalue.real >= 0.0:
            # The mode is a combination w'x; entries of the size of rounding are left out.
            used = np.abs(direction) > 0.1 * np.abs(direction).max()
            states = listing(itertools.compress(model.state_names, used))
            raise GainError(
                f"the linearization of `{type(model).__name__}` at its trim cannot be stabilized: "
                f"no input moves the mode at {eigenvalue_text(eigenvalue)} 1/s, which lies along "
                f"{states}; give the gain yourself (method `given`)."
            )
