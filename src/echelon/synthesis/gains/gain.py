"""The gain of the consensus law, the interface of synthesis methods, and `synthesize`."""

import abc
from collections.abc import Callable, Mapping
from typing import Any, ClassVar, Literal, NamedTuple, TypeAlias

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from echelon.agents.models.heading_symmetry import (
    heading_index,
    input_turn,
    rotate_state,
    state_turn,
)
from echelon.agents.models.linearization import Linearization, linearize
from echelon.agents.models.model import ControlAffine
from echelon.agents.models.model_check import check_model
from echelon.agents.network.graph import Graph
from echelon.agents.network.matrices import lost_at_times
from echelon.agents.network.spectrum import Spectrum
from echelon.core.errors import GainError, GraphError, check_kind
from echelon.core.limits import LARGEST
from echelon.core.linear import Weight, as_matrix, check_definite
from echelon.core.numerics import precision
from echelon.core.trace import shared_traces
from echelon.core.types import Array, Declared, Input, Scalar, State
from echelon.core.words import amount
from echelon.synthesis.certificates.certificate import Certificate, RegionCertificate, certify

Region: TypeAlias = Callable[[float, Spectrum], RegionCertificate | None]
"""From the coupling and the spectrum to the guarantee on a domain."""


class Gain(eqx.Module):
    """The parameters of the consensus law u = u_ff - c R^-1 g'P z; float64 NumPy.

    Attributes:
        P: (n, n) symmetric positive definite, acting on states.
        R: (m, m) symmetric positive definite, acting on normalized inputs.
        coupling: c > 0.
        method: the name of the synthesis.
        certificate: what is guaranteed.
        inner: (m, n) feedback K of an inner loop, v = -K (x - x*) + the law above; None without.

    Raises:
        GainError: P or R is not symmetric positive definite, or c is not positive.
    """

    P: Array
    R: Array
    coupling: float
    method: str = eqx.field(static=True)
    certificate: Certificate
    # Stored, so that no step of a run solves with R, and a float32 run does not invert in float32.
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
        check_definite("P", P)
        check_definite("R", R)
        check_coupling(coupling)
        self.P, self.R, self.R_inverse = P, R, np.linalg.inv(R)
        self.coupling, self.method, self.certificate = float(coupling), method, certificate
        self.inner = inner

    def K(self, model: ControlAffine) -> Array:
        """Return K (m, n) of the law linearized at the trim, u = u* - K z, in physical inputs.

        K = S c R^-1 (g(x*) S)'P, z (n,) is the sum of a_ij (y_i - y_j) over neighbours; without the
        inner loop, which is `inner`.

        Raises:
            GainError: the gain is not of the states and inputs of this model.
        """
        B = linearize(model).B
        if self.P.shape[0] != B.shape[0] or self.R.shape[0] != B.shape[1]:
            raise GainError(
                f"the gain is of {amount(len(self.P), 'state')} and "
                f"{amount(len(self.R), 'input')}, and "
                f"`{type(model).__name__}` has {B.shape[0]} and {B.shape[1]}."
            )
        scale = np.asarray(model.input_scale, np.float64)
        return self.coupling * scale @ self.R_inverse @ B.T @ self.P

    def inner_loop(self, model: ControlAffine, x: State, heading: Scalar | None = None) -> Input:
        """Return kappa(x) = -K (x - x*), the inner loop, for a heading; zero without one."""
        if self.inner is None:
            return jnp.zeros(len(model.input_names), x.dtype)
        rest, K = jnp.asarray(model.trim[0], x.dtype), jnp.asarray(self.inner, x.dtype)
        # About the trim, where the loop returns 0: the law adds the trim input.
        if heading is None:
            return -K @ model.difference(x, rest)
        # The deviation is rotated into the axes of the trim, and the input back.
        away = model.difference(x, rotate_state(model, rest, heading))
        return -input_turn(model)(K @ state_turn(model)(away, -heading), heading)

    def feedback(
        self, model: ControlAffine, x: State, error: State, heading: Scalar | None = None
    ) -> Input:
        """Return c R^-1 (g(x) S)'P error, a normalized input (m,), in the axes of a heading."""
        P, R_inverse = (jnp.asarray(part, x.dtype) for part in (self.P, self.R_inverse))
        if heading is None:
            # Products from the right: vectors only, in the precision of the states.
            weighted_inputs = model.normalized_input_map(x).T @ (P @ error)
            return self.coupling * (R_inverse @ weighted_inputs)
        turn, turn_input = state_turn(model), input_turn(model)
        weighted = turn(P @ turn(error, -heading), heading)
        weighted_inputs = turn_input(model.normalized_input_map(x).T @ weighted, -heading)
        return self.coupling * turn_input(R_inverse @ weighted_inputs, heading)

    def turns(self, model: ControlAffine) -> bool:
        """Tell whether the gain depends on the heading in whose axes it acts."""
        if model.heading is None:
            return False
        G, E = state_turn(model).slope, input_turn(model).slope
        pairs = [(self.P, G, G), (self.R_inverse, E, E)]
        pairs += [] if self.inner is None else [(self.inner, E, G)]
        yaws = self.inner is not None and self.inner[:, heading_index(model)].any()
        return bool(yaws) or any((left @ K != K @ right).any() for K, left, right in pairs)


class Feedback(NamedTuple):
    """The result of a method for one agent: the law u = u_ff - c R^-1 g'P z without c.

    Attributes:
        P: (n, n) symmetric positive definite, acting on states.
        R: (m, m) symmetric positive definite, acting on normalized inputs.
        rho: the strength 2 c lambda_min from which on P A + A'P - rho P B R^-1 B'P <= 0 at the trim
            is guaranteed, so that the smallest coupling is rho / (2 lambda_min); 0 where any
            coupling suffices, None where no bound is known.
        inner: (m, n) feedback K of an inner loop, closed in A; None without.
    """

    P: Array
    R: Array
    rho: float | None
    region: Region | None = None
    inner: Array | None = None


class Method(Declared):
    """A synthesis method; its arguments are its keys in a scenario.

    Args:
        coupling: c > 0; by default a multiple of the smallest coupling that is guaranteed.
    """

    name: ClassVar[str] = ""
    """Its name in scenarios, tables and files; required of every method."""

    needs: ClassVar[tuple[str, ...]] = ()
    """Arguments that a scenario must set, even where Python has a default."""

    defaults: ClassVar[Mapping[str, Any]] = {}
    """Their values in `design` where the scenario does not set them."""

    headroom: ClassVar[float] = 2.0
    """Default coupling as a multiple of the smallest; with 2, half of lambda_min may be lost."""

    free_coupling: ClassVar[float] = 1.0
    """Default coupling where any one suffices, or where no bound is known."""

    literal: ClassVar[bool] = False
    """Whether it is a line of the paper that cannot work, which `design` leaves out."""

    coupling: float | None = eqx.field(default=None, kw_only=True)

    @abc.abstractmethod
    def feedback(self, model: ControlAffine, linear: Linearization) -> Feedback:
        """Return the gain of one agent of a checked model, `linear` near its trim.

        Raises:
            GainError: the method does not apply, with the reason.
        """

    def solve(self, model: ControlAffine, spectrum: Spectrum) -> Gain:
        """Return the gain for a checked model in a network of these eigenvalues.

        Raises:
            GainError: the coupling is not positive, P or R is not symmetric positive definite, or
                the method does not apply, with the reason.
        """
        if self.coupling is not None:
            check_coupling(self.coupling)
        # Every method uses the same A and B, of normalized inputs: entries of similar size.
        linear = linearize(model)
        P, R, rho, region, inner = self._checked_feedback(model, linear)
        # Before the certificate, which solves with R and needs eigenvalues of products with P.
        check_definite("P", P)
        check_definite("R", R)
        if not spectrum.low > 0.0:
            raise GainError(
                "the graph switches, and at some time no sum of errors' squares decreases; use the "
                "law `stopping-point`, or undirected graphs in which leaders reach all agents."
            )
        # Re lambda >= lambda_min, so 2 c lambda_min >= rho is enough for every mode (theory, T7).
        edge = None if rho is None else rho / (2.0 * spectrum.low)
        # A coupling of zero was rejected above; an edge of zero means that any coupling suffices.
        coupling = self.coupling or self.headroom * (edge or 0.0) or self.free_coupling
        guarantee = None if region is None else region(coupling, spectrum)
        # The consensus law acts around the inner loop, which c does not scale.
        closed = linear.with_inner(inner)
        certificate = certify(closed, spectrum, P, R, coupling, edge, guarantee)
        return Gain(P, R, coupling, self.name, certificate, inner)

    def _checked_feedback(self, model: ControlAffine, linear: Linearization) -> Feedback:
        result, name = self.feedback(model, linear), type(self).__name__
        if not isinstance(result, Feedback):
            raise GainError(
                f"`feedback` of `{name}` returns a `{type(result).__name__}`, and must return a "
                "`Feedback`."
            )
        n, m = linear.B.shape
        for what, shape in (("P", (n, n)), ("R", (m, m)), ("inner", (m, n))):
            matrix = getattr(result, what)
            if what == "inner" and matrix is None:
                continue
            if (got := np.shape(matrix)) != shape:  # type: ignore[arg-type]
                raise GainError(
                    f"`{what}` that `feedback` of `{name}` returns has shape {got}, "
                    f"and must have shape {shape}."
                )
        if result.rho is not None and not 0.0 <= result.rho < np.inf:
            raise GainError(
                f"`rho` that `feedback` of `{name}` returns is {result.rho}, and must be finite "
                "and not negative."
            )
        return result


def check_coupling(coupling: float) -> None:
    """Check that a coupling is positive and not too large.

    Raises:
        GainError: it is not.
    """
    if not 0.0 < float(coupling) <= LARGEST:
        raise GainError(f"`coupling` is {coupling}, and must be positive, at most {LARGEST:g}.")


@shared_traces()
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
    if not method.name:
        raise GainError(f"`{type(method).__name__}` has no `name`, and every gain method must.")
    check_kind("graph", graph, Graph, GraphError)
    lost = lost_at_times(graph)
    if lost:
        raise GainError(
            f"a gain needs a graph in which leaders reach all agents at all times, and {lost}; add "
            "an edge there, or use the law `stopping-point`, which does not need it."
        )
    # In float32 derivatives are too coarse for a test of stabilizability at 1e-9.
    with precision("float64"):
        check_model(model)
        return method.solve(model, graph.spectrum())


# ---- a gain from the user's matrices -------------------------------------------------------------


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
