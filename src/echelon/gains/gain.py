"""What a synthesis returns: the gain that the law runs with.

It carries the certificate that says what it promises.
"""

import abc
from collections.abc import Sequence
from typing import TypeAlias

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from echelon.certificates.certificate import Certificate
from echelon.core.errors import GainError
from echelon.core.types import Input, Matrix, State
from echelon.models.model import ControlAffine
from echelon.network.graph import Graph

Weight: TypeAlias = Sequence[float] | Sequence[Sequence[float]] | Matrix


class Gain(eqx.Module):
    """Everything that the consensus law u = u_ff - c R^-1 g'P z needs; float64 NumPy.

    Attributes:
        P: (n, n) symmetric positive definite, acting on states.
        R: (m, m) symmetric positive definite, acting on normalized inputs.
        coupling: c > 0.
        method: the name of the synthesis.
        certificate: what is promised.
        inner: (m, n) feedback K of an inner loop, v = -K (x - x*) + the law above; None without.

    Raises:
        GainError: P or R is not symmetric positive definite, or c is not positive.
    """

    P: Matrix
    R: Matrix
    coupling: float
    method: str = eqx.field(static=True)
    certificate: Certificate
    R_inverse: Matrix
    inner: Matrix | None

    def __init__(
        self,
        P: Matrix,
        R: Matrix,
        coupling: float,
        method: str,
        certificate: Certificate,
        inner: Matrix | None = None,
    ) -> None:
        """Refuse P or R not symmetric positive definite, and a coupling that is not positive."""
        check_definite("P", P)
        check_definite("R", R)
        check_coupling(coupling)
        self.P, self.R, self.R_inverse = P, R, np.linalg.inv(R)
        self.coupling, self.method, self.certificate = float(coupling), method, certificate
        self.inner = inner

    def inner_loop(self, model: ControlAffine, x: State) -> Input:
        """Return kappa(x) = -K (x - x*), the inner loop; zero without one."""
        if self.inner is None:
            return jnp.zeros(len(model.input_names), x.dtype)
        return -jnp.asarray(self.inner, x.dtype) @ (x - jnp.asarray(model.trim[0], x.dtype))


class Method(eqx.Module):
    """A way to synthesize a gain."""

    @abc.abstractmethod
    def solve(self, model: ControlAffine, graph: Graph) -> Gain:
        """Return the gain for a checked model on a graph.

        Raises:
            GainError: the method does not apply, with the reason.
        """


def check_coupling(coupling: float) -> None:
    """Check that a coupling is positive and finite.

    Raises:
        GainError: it is not.
    """
    if not 0.0 < coupling < float("inf"):
        raise GainError(f"`coupling` is {coupling}, and must be positive and finite.")


def check_definite(name: str, matrix: np.ndarray) -> None:
    """Check that a matrix is finite, symmetric (to 1e-9 of its size) and positive definite.

    Raises:
        GainError: it is not.
    """
    if matrix.ndim != 2 or matrix.shape[0] != matrix.shape[1]:
        raise GainError(f"`{name}` has shape {matrix.shape}, and must be square.")
    if not np.isfinite(matrix).all():
        raise GainError(f"`{name}` holds a number that is not finite.")
    gap = np.abs(matrix - matrix.T)
    if gap.max() > 1e-9 * np.abs(matrix).max():
        i, j = np.unravel_index(np.argmax(gap), gap.shape)
        raise GainError(
            f"`{name}` is not symmetric: entry [{i}, {j}] is {matrix[i, j]:.6g} "
            f"and entry [{j}, {i}] is {matrix[j, i]:.6g}."
        )
    least = float(np.linalg.eigvalsh(matrix)[0])
    if least <= 0.0:
        raise GainError(
            f"`{name}` is not positive definite: its smallest eigenvalue is {least:.6g}."
        )


def as_matrix(name: str, value: Weight, size: int) -> Matrix:
    """Return a weight as a square matrix; a plain list of numbers is a diagonal.

    Raises:
        GainError: it is neither `size` numbers nor a `size` x `size` matrix.
    """
    try:
        array = np.array(value, dtype=np.float64)
    except (TypeError, ValueError):
        raise GainError(
            f"`{name}` is {value}, and must be {size} numbers or {size} x {size}."
        ) from None
    if array.shape == (size,):
        array = np.diag(array)
    if array.shape != (size, size):
        raise GainError(
            f"`{name}` has shape {array.shape}, and must be {size} numbers or {size} x {size}."
        )
    return array
