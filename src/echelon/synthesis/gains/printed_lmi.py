"""The first line of the paper's Algorithm 1, "solve (LMI)", with the proof that nothing solves it.

The LMI is K = [[0, X], [X, Y]] <= 0, with X = I kron P^(-1/2) and Y = -(Delta f) D', for P > 0.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from echelon.agents.models.linearization import Linearization
from echelon.agents.models.model import ControlAffine
from echelon.core.digits import about
from echelon.core.errors import GainError
from echelon.core.types import Array
from echelon.synthesis.gains.gain import Feedback, Method


class Witness(NamedTuple):
    """A unit vector w with w'K w > 0, which K <= 0 excludes; `value` is w'K w."""

    vector: Float[np.ndarray, " k"]
    value: float


def printed_lmi(
    P: Float[Array, "n n"], goals: Float[Array, "N n"], drifts: Float[Array, "N n"]
) -> Float[np.ndarray, "K K"]:
    """Return the symmetric part of the paper's K at a P > 0, for goals and f at them."""
    count, n = goals.shape
    values, vectors = np.linalg.eigh(P)
    # Of a P that rounding makes indefinite the eigenvalues are those that it may have.
    values = np.maximum(values, np.finfo(float).eps * np.abs(values).max())
    X = np.kron(np.eye(count), vectors @ np.diag(values**-0.5) @ vectors.T)
    D, F = np.zeros((2, count * n, count))
    for i in range(count):
        for j in range(count):
            D[i * n : (i + 1) * n, j] = goals[j] - goals[i]
            F[i * n : (i + 1) * n, j] = drifts[i] - drifts[j]
    Y = -F @ D.T
    return np.block([[0.0 * X, X], [X, 0.5 * (Y + Y.T)]])


def violation(K: Float[np.ndarray, "K K"]) -> Witness:
    """Return how [[0, X], [X, Y]] with X > 0 fails to be <= 0; there is one for every X and Y.

    Where X v = x v, K on the plane of (v, 0) and (0, v) is [[0, x], [x, y]], with y = v'Y v and
    the determinant -x^2 < 0. One of its two eigenvalues is therefore positive.
    """
    half = len(K) // 2
    x, v = (part[..., -1] for part in np.linalg.eigh(K[:half, half:]))
    y = v @ K[half:, half:] @ v
    values, vectors = np.linalg.eigh(np.array([[0.0, x], [x, y]]))
    return Witness(np.concatenate([vectors[0, -1] * v, vectors[1, -1] * v]), float(values[-1]))


class PrintedLMI(Method):
    """The first line of Algorithm 1 as printed; nothing solves it, and the refusal says why."""

    name = "printed-lmi"
    literal = True

    def feedback(self, model: ControlAffine, linear: Linearization) -> Feedback:
        """Refuse.

        Raises:
            GainError: always, with the proof that the printed LMI has no solution.
        """
        n = len(model.state_names)
        # The paper's P = I, of which it says that it solves the LMI. Of one goal Y is 0, as it is
        # of goals that differ in position alone.
        found = violation(printed_lmi(np.eye(n), np.zeros((1, n)), np.zeros((1, n))))
        raise GainError(
            "the printed LMI has no solution: at every P > 0 its largest eigenvalue is above 0, "
            f"and {about(found.value)} at the paper's P = I. "
            "Proof: where X v = x v, it is [[0, x], [x, y]] on (v, 0) and (0, v), with determinant "
            "-x^2 < 0. Use `riccati`, or `given` with `P: identity` as the paper does."
        )
