"""What a synthesis returns, the gain that the law runs with, and the interface of its methods.

A method knows one agent and finds P and R; the graph has a say in the coupling alone, by the
smallest eigenvalue of its spectrum.
"""

import abc
from collections.abc import Callable, Mapping
from typing import Any, ClassVar, NamedTuple, TypeAlias

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
from echelon.agents.network.reach import lost_at_times
from echelon.agents.network.spectrum import Spectrum
from echelon.core.errors import GainError, GraphError, check_kind
from echelon.core.linear import check_definite
from echelon.core.numerics import precision
from echelon.core.types import Array, Input, Scalar, State
from echelon.synthesis.certificates.certificate import Certificate, RegionCertificate, certify

Region: TypeAlias = Callable[[float, Spectrum], RegionCertificate | None]
"""From the coupling and the spectrum to what is promised on a domain."""


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
    # Kept, so that no step of a run solves with R, and a float32 run does not invert in float32.
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

    def inner_loop(self, model: ControlAffine, x: State, heading: Scalar | None = None) -> Input:
        """Return kappa(x) = -K (x - x*), the inner loop, about a heading; zero without one."""
        if self.inner is None:
            return jnp.zeros(len(model.input_names), x.dtype)
        rest, K = jnp.asarray(model.trim[0], x.dtype), jnp.asarray(self.inner, x.dtype)
        # About the trim, where the loop gives nothing: the trim input stays the law's to add.
        if heading is None:
            return -K @ model.difference(x, rest)
        # T x* - x turned back, and the input turned forth again.
        away = model.difference(x, rotate_state(model, rest, heading))
        return -input_turn(model)(K @ state_turn(model)(away, -heading), heading)

    def feedback(
        self, model: ControlAffine, x: State, error: State, heading: Scalar | None = None
    ) -> Input:
        """Return c R^-1 (g(x) S)'P error, a normalized input (m,), in the axes of a heading."""
        P, R_inverse = (jnp.asarray(part, x.dtype) for part in (self.P, self.R_inverse))
        if heading is None:
            # From the right: vectors only, and in the precision of the states.
            pulled = model.normalized_input_map(x).T @ (P @ error)
            return self.coupling * (R_inverse @ pulled)
        turn, turn_input = state_turn(model), input_turn(model)
        weighted = turn(P @ turn(error, -heading), heading)
        pulled = turn_input(model.normalized_input_map(x).T @ weighted, -heading)
        return self.coupling * turn_input(R_inverse @ pulled, heading)

    def turns(self, model: ControlAffine) -> bool:
        """Tell whether it is another one in the axes of another heading of the model."""
        if model.heading is None:
            return False
        G, E = state_turn(model).slope, input_turn(model).slope
        pairs = [(self.P, G, G), (self.R_inverse, E, E)]
        pairs += [] if self.inner is None else [(self.inner, E, G)]
        yaws = self.inner is not None and self.inner[:, heading_index(model)].any()
        return bool(yaws) or any((left @ K != K @ right).any() for K, left, right in pairs)


class Feedback(NamedTuple):
    """What a method finds for one agent: the law u = u_ff - c R^-1 g'P z, but for c.

    Attributes:
        P: (n, n) symmetric positive definite, acting on states.
        R: (m, m) symmetric positive definite, acting on normalized inputs.
        rho: the strength 2 c lambda_min from which on P A + A'P - rho P B R^-1 B'P <= 0 at the trim
            is guaranteed, so that the edge of the coupling is rho / (2 lambda_min); 0 where any
            coupling does, None where none is known.
        region: what is promised on a domain; None where nothing is.
        inner: (m, n) feedback K of an inner loop, closed in A; None without.
    """

    P: Array
    R: Array
    rho: float | None
    region: Region | None = None
    inner: Array | None = None


class Method(eqx.Module):
    """A way to synthesize a gain; its arguments are its keys in a scenario.

    Args:
        coupling: c > 0; chosen by the edge when left out.
    """

    name: ClassVar[str] = ""
    """What scenarios, tables and files call it; every method must say it."""

    needs: ClassVar[tuple[str, ...]] = ()
    """Arguments that a scenario must give, though Python may have a default for them."""

    usual: ClassVar[Mapping[str, Any]] = {}
    """What `design` gives of these where the scenario does not."""

    headroom: ClassVar[float] = 2.0
    """Without a coupling it is so many times the edge: at twice, half of lambda_min may go."""

    free_coupling: ClassVar[float] = 1.0
    """What it is without one where any will do, or where no edge is known."""

    coupling: float | None = eqx.field(default=None, kw_only=True)

    @abc.abstractmethod
    def feedback(self, model: ControlAffine, linear: Linearization) -> Feedback:
        """Return what is found for one agent of a checked model, `linear` near its trim.

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
        # Every method works on the same A and B, of normalized inputs: entries of like size.
        linear = linearize(model)
        P, R, rho, region, inner = self._found(model, linear)
        # Before the certificate, which solves with R, and takes eigenvalues of what P makes.
        check_definite("P", P)
        check_definite("R", R)
        if not spectrum.low > 0.0:
            raise GainError(
                "the graph switches, and at some time no sum of errors' squares is held by it; use "
                "the law `stopping-point`, or graphs that reach everybody and are undirected."
            )
        # Re lambda >= lambda_min, so 2 c lambda_min >= rho is enough for every mode (theory, T7).
        edge = None if rho is None else rho / (2.0 * spectrum.low)
        # A coupling of zero was refused above, and an edge of zero means that any coupling does.
        coupling = self.coupling or self.headroom * (edge or 0.0) or self.free_coupling
        check_strength(coupling * spectrum.high, linear, P, R)
        promised = None if region is None else region(coupling, spectrum)
        # The consensus law acts on what the inner loop leaves: c scales no part of that loop.
        closed = linear.with_inner(inner)
        certificate = certify(closed, spectrum, P, R, coupling, edge, promised)
        return Gain(P, R, coupling, self.name, certificate, inner)

    def _found(self, model: ControlAffine, linear: Linearization) -> Feedback:
        """Return what the method finds, after checking that it is what a method returns."""
        found, name = self.feedback(model, linear), type(self).__name__
        if not isinstance(found, Feedback):
            raise GainError(
                f"`feedback` of `{name}` returns a `{type(found).__name__}`, and must return a "
                "`Feedback`."
            )
        n, m = linear.B.shape
        for what, shape in (("P", (n, n)), ("R", (m, m)), ("inner", (m, n))):
            matrix = getattr(found, what)
            if what == "inner" and matrix is None:
                continue
            if (got := np.shape(matrix)) != shape:  # type: ignore[arg-type]
                raise GainError(
                    f"`{what}` that `feedback` of `{name}` returns has shape {got}, "
                    f"and must have shape {shape}."
                )
        if found.rho is not None and not 0.0 <= found.rho < np.inf:
            raise GainError(
                f"`rho` that `feedback` of `{name}` returns is {found.rho}, and must be finite "
                "and not negative."
            )
        return found


def check_strength(strength: float, linear: Linearization, P: Array, R: Array) -> None:
    """Check that what is fed back at a strength c lambda can be computed with.

    Raises:
        GainError: it cannot.
    """
    with np.errstate(over="ignore", invalid="ignore"):
        fed_back = strength * (linear.B @ np.linalg.solve(R, linear.B.T @ P))
        # Norms square P B R^-1 B'P.
        known = np.isfinite((P @ fed_back) ** 2).all()
    if not known:
        size = f"{strength:.3g}" if strength < np.inf else "beyond all numbers"
        raise GainError(
            f"the feedback is too strong to compute with: the coupling times the graph's largest "
            f"eigenvalue is {size}, P goes up to {np.abs(P).max():.3g}; make `coupling`, "
            "the edges' weights or P smaller."
        )


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
    if not method.name:
        raise GainError(f"`{type(method).__name__}` has no `name`, and every gain method must.")
    # JAX would differentiate in float32, which no test of stabilizability at 1e-9 survives.
    check_kind("graph", graph, Graph, GraphError)
    lost = lost_at_times(graph)
    if lost:
        raise GainError(
            f"a gain needs a graph that reaches everybody at all times, and {lost}; add an edge "
            "there, or use the law `stopping-point`, which waits for it."
        )
    with precision("float64"):
        check_model(model)
        return method.solve(model, graph.spectrum())
