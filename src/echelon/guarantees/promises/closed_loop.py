"""Closed loop linearized at the trim, and the modes of the disagreement between agents."""

from typing import NamedTuple

import equinox as eqx
import numpy as np

from echelon.agents.models.linearization import Linearization, linearize
from echelon.agents.models.model import ControlAffine
from echelon.agents.network.graph import Graph
from echelon.agents.network.spectrum import Spectrum, in_order
from echelon.core.linear import discretize, longest_step, radius_between, spectral_radii
from echelon.core.rational import bisect
from echelon.core.types import Array
from echelon.core.words import Feedforward
from echelon.simulation.engine.parts import Parts
from echelon.simulation.step.drive import Controller
from echelon.simulation.step.settings import Settings
from echelon.synthesis.certificates.certificate import Certificate, certify
from echelon.synthesis.certificates.lmi import falls
from echelon.synthesis.certificates.margins import ClosedLoop, slowest_between
from echelon.synthesis.gains.gain import Gain

# ---- the loop and its modes ----------------------------------------------------------------------

SHOWN = 32
"""So many eigenvalues stand for an interval of them where numbers are shown."""
_DENSE = 400
"""Real eigenvalues beyond so many are judged as the interval that holds them."""
_HALVINGS = 20  # of a step that an interval of eigenvalues, or some graph, does not bear
_SLACK = 1e-9
"""Relative; what a solver leaves of the inequality behind an edge, which is often tight."""


class LinearLoop(NamedTuple):
    """The law near the trim, on the graph that runs.

    Attributes:
        linear: A (with the inner loop closed) and B at the trim.
        inner: (m, n), the inner loop K that is closed in A; zero without one.
        closed: the modes that margins are taken of: all of them, or an interval that holds them.
        where: which eigenvalues of the graph were looked at, in words.
        symmetric: whether they are of a symmetric matrix between followers' errors.
        every: whether the modes of all eigenvalues of the graph decay.
        slowest: real part of the slowest mode, 1/s; of an interval, of the modes looked at.
    """

    linear: Linearization
    inner: Array
    closed: ClosedLoop
    where: str
    symmetric: bool
    every: bool
    slowest: float
    certificate: Certificate

    @property
    def gains(self) -> Array:
        """What acts on the state in each mode, inner loop included, (K, m, n)."""
        return self.inner + self.closed.strengths[:, None, None] * self.closed.K

    @property
    def eigenvalues(self) -> Array:
        """Of the graph, (K,): those whose modes were looked at."""
        return self.closed.strengths / self.closed.coupling

    @property
    def poles(self) -> Array:
        """Of each mode looked at, (K, n)."""
        A, B = self.linear
        return np.linalg.eigvals(A - self.closed.strengths[:, None, None] * (B @ self.closed.K))

    def radius(self, settings: Settings, exact: bool = False) -> float:
        """Return the largest spectral radius of a step of the integrator, or of the exact flow.

        Of an interval of eigenvalues it is at least 1 unless all of them are shown to decay.
        """
        dt, integrator, substeps = settings.held
        F, G = discretize(*self.open, dt, None if exact else integrator, substeps)
        radius = float(spectral_radii(F - G @ self.gains).max())
        if not self.closed.between or not radius < 1.0:
            return radius
        real = np.real(self.closed.strengths[np.imag(self.closed.strengths) == 0.0])
        return max(radius, radius_between(F - G @ self.inner, G @ self.closed.K, *real[[0, -1]]))

    def longest_step(self, settings: Settings) -> float:
        """Return the longest step (s) of that integrator with which every mode decays."""
        step = longest_step(*self.open, self.gains, *settings.held[1:])
        if not self.closed.between or not np.isfinite(step):
            return step

        def decays(dt: float) -> bool:
            return self.radius(settings._replace(dt=dt)) < 1.0

        # No smaller number is stated than need be: rounding alone lies between this and the step.
        near = (1.0 - 1e-6) * step
        return near if decays(near) else float(bisect(decays, 0.0, near, _HALVINGS))

    @property
    def open(self) -> Linearization:
        """A and B without any loop."""
        return Linearization(self.linear.A + self.linear.B @ self.inner, self.linear.B)


class NetworkModes(NamedTuple):
    """What the disagreement splits by.

    Attributes:
        spectrum: the eigenvalues that the feed-forward leaves.
        symmetric: whether they are of the grounded Laplacian, which is.
        what: they are, in words.
    """

    spectrum: Spectrum
    symmetric: bool
    what: str = "eigenvalues"


def loop_of(parts: Parts) -> LinearLoop:
    """Return the closed loop of prepared parts; without a known gain that of u = -g'z."""
    model, known = parts.model, not parts.drive.unknown
    n, m = len(model.state_names), len(model.input_names)
    gain, P = (parts.drive.gain, parts.drive.metric(model)) if known else (None, None)
    R, c, inner = np.eye(m), 1.0, None
    P = np.eye(n) if P is None else P
    if gain is not None:
        R, c, inner = gain.R, gain.coupling, gain.inner
    linear, modes = linearize(model).with_inner(inner), modes_of(parts)
    edge = None if gain is None else _edge(gain, linear, modes.spectrum.low)
    certificate = certify(linear, modes.spectrum, P, R, c, edge)
    values, between, where = _representatives(modes)
    closed, slowest = ClosedLoop(*linear, P, R, c, values, between), certificate.abscissa
    if between:
        slowest = max(slowest, slowest_between(closed))
    inner = np.zeros((m, n)) if inner is None else inner
    every = slowest < 0.0
    return LinearLoop(linear, inner, closed, where, modes.symmetric, every, slowest, certificate)


def modes_of(parts: Parts) -> NetworkModes:
    """Return what the disagreement of prepared parts splits by.

    Where the leaders obey the followers' law, nobody is grounded: the disagreement obeys the
    Laplacian of all agents, whose eigenvalues but 0 lie above the least of the grounded one and,
    by Anderson and Morley, below the largest sum of two neighbours' degrees. On a directed graph
    neither is known, and all are computed.
    """
    graph = parts.graph
    if parts.drive.feedforward is Feedforward.PARENT:
        return NetworkModes(graph.parent_spectrum(), False, "edges' weights")
    if not all_alike(parts.drive, parts.model):
        return NetworkModes(graph.spectrum(), not graph.directed and graph.schedule is None)
    if graph.directed:
        # All eigenvalues but for one 0; another 0 is a mode that never ends.
        values = np.linalg.eigvals(graph.laplacian().toarray()).astype(complex)
        values = in_order(np.delete(values, np.abs(values).argmin()))
        return NetworkModes(Spectrum(values, len(values), 0.0), False)
    if graph.agents <= _DENSE:
        whole = np.linalg.eigvalsh(graph.laplacian().toarray())[1:]
        return NetworkModes(Spectrum(whole, len(whole), graph.spectrum().proved), False)
    degrees = graph.laplacian().diagonal()
    ends = np.array([graph.spectrum().low, degrees[graph.edges].sum(axis=1).max()])
    return NetworkModes(Spectrum(ends, graph.agents - 1, graph.spectrum().proved), False)


def all_alike(drive: Controller, model: ControlAffine) -> bool:
    """Tell whether the leaders obey the followers' law, with nothing fed forward."""
    leader, follower = getattr(drive, "leader", None), getattr(drive, "follower", None)
    same = leader is not None and type(leader) is type(follower) and not drive.unknown
    silent = drive.feedforward is Feedforward.NONE and drive.metric(model) is not None
    return same and silent and bool(eqx.tree_equal(leader, follower))


def _edge(gain: Gain, linear: Linearization, low: float) -> float | None:
    """Return the coupling from which P A + A'P - rho P B R^-1 B'P <= 0 at the gain's own rho."""
    claim = gain.certificate
    if claim.edge is None or not low > 0.0:
        return None
    rho = 2.0 * claim.edge * claim.lambda_min
    if not np.isfinite(rho):
        return None
    closed = linear.A - 0.5 * rho * linear.B @ gain.R_inverse @ linear.B.T @ gain.P
    return 0.5 * rho / low if falls(gain.P, closed[None], _SLACK) else None


def grounded_slowest(gain: Gain, linear: Linearization, graph: Graph) -> float:
    """Return the slowest mode, 1/s, as a gain's own certificate has it."""
    return certify(linear, graph.spectrum(), gain.P, gain.R, gain.coupling, None).abscissa


def telling(values: Array, count: int) -> Array:
    """Return the places of so many eigenvalues (K,), spread evenly, and of those at an extreme.

    Of complex ones those count too that are the largest, lean the most, or are left the least
    delay, (pi/2 - |arg lambda|) / |lambda|: of each, the first few.
    """
    few = np.linspace(0, len(values) - 1, count).astype(int)
    if not np.iscomplexobj(values):
        return np.unique(few)
    size, lean = np.maximum(np.abs(values), 1e-300), np.abs(np.angle(values))
    marks = (-size, -np.abs(np.imag(values)), -lean, (0.5 * np.pi - lean) / size)
    return np.unique([*few, *(k for mark in marks for k in np.argsort(mark)[: count // 2])])


def _representatives(modes: NetworkModes) -> tuple[Array, bool, str]:
    """Return the eigenvalues that margins are taken of, if any between count too, and which."""
    (values, total, *_), _, what = modes
    # The modes of a conjugate pair mirror each other.
    which = f"all {what} of the graph"
    if np.iscomplexobj(values):
        values, which = values[np.imag(values) >= 0.0], f"{which}, one of each pair"
    known, values = len(values) >= total or np.iscomplexobj(values), np.unique(values)
    real = np.real(values[np.imag(values) == 0.0])
    if known and len(real) <= _DENSE:
        return values, False, which
    between = np.geomspace(real[0], real[-1], SHOWN)
    few = f"lambda_min, lambda_max and {SHOWN - 2} values between them"
    pairs = values[np.imag(values) != 0.0]
    if not len(pairs):
        return between, True, few
    return np.concatenate([between, pairs]), True, f"{few}, and all pairs of {what}"
