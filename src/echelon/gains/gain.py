"""What a synthesis returns: the gain that the law runs with.

It carries the certificate that says what it promises.
"""

import abc

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from echelon.certificates.certificate import Certificate
from echelon.core.errors import GainError
from echelon.core.linear import check_definite
from echelon.core.numerics import precision
from echelon.core.types import Array, Input, State
from echelon.models.check import check_model
from echelon.models.model import ControlAffine
from echelon.network.graph import Graph


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

    P: Array
    R: Array
    coupling: float
    method: str = eqx.field(static=True)
    certificate: Certificate
    R_inverse: Array
    inner: Array | None

    def __init__(
        self,
        P: Array,
        R: Array,
        coupling: float,
        method: str,
        certificate: Certificate,
        inner: Array | None = None,
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


def synthesize(model: ControlAffine, graph: Graph, method: Method) -> Gain:
    """Return the gain of the consensus law for agents `model` on `graph`, with its certificate.

    The computation is in float64.

    Raises:
        ModelError: the model is malformed.
        GainError: the method does not apply, with the reason.
    """
    if not isinstance(method, Method):
        got = f"the class `{method.__name__}`" if isinstance(method, type) else f"{method!r}"
        raise GainError(f"`method` is {got}, and must be a gain method such as `Riccati()`.")
    with precision("float64"):
        check_model(model)
        return method.solve(model, graph)
