"""The paper's assumptions and lemmas on a scenario of one's own, and what is promised of it."""

from collections.abc import Iterator
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from echelon import _margins
from echelon._build import Parts
from echelon._certificates import Certificate, Kind, certify
from echelon._linearization import Linearization, linearize, trim_slopes
from echelon._lmi import obstacle
from echelon._numerics import in_words, precision
from echelon._types import Matrix, States
from echelon.gains.gain import Gain
from echelon.models.model import ControlAffine

_ZERO = 1e-9
_SHOWN = 200
"""More agents than these are not compared pair by pair; the first ones stand for all."""


class Line(NamedTuple):
    """One statement: its verdict, the kind of argument, the number behind it, what to change."""

    statement: str
    verdict: str
    kind: Kind | str
    number: str
    text: str


class Checked(NamedTuple):
    """All lines, whether the closed loop is promised anything, and the promise in a sentence."""

    lines: tuple[Line, ...]
    promised: bool
    promise: str


class _Loop(NamedTuple):
    """The closed loop near the trim: what every line reads."""

    parts: Parts
    linear: Linearization
    P: Matrix
    R: Matrix
    coupling: float
    eigenvalues: Matrix
    certificate: Certificate
    broken: dict[int, str]


def check(parts: Parts) -> Checked:
    """Walk through the paper's statements on built parts, and the margins of the linearization."""
    with precision("float64"):
        loop = _loop(parts)
        lines = (*_graph_lines(loop), *_drift_lines(loop), *_law_lines(loop), *_margin_lines(loop))
    promised = loop.certificate.stable and not loop.broken
    return Checked(lines, promised, _promise(loop) if promised else "Nothing is promised.")


def _promise(loop: _Loop) -> str:
    """Return what is promised, in a sentence, and no more than that."""
    condition = "" if _matched(loop.parts) else ", once the leader's input rests at its trim"
    return (
        "Promised, by linearization: followers that start near enough to their goals, with the "
        f"leader near enough to the trim, converge to them{condition}; no region is proved."
    )


def _matched(parts: Parts) -> bool:
    """Tell whether the followers are told the leader's input, or it has none beyond the trim."""
    moving = parts.leader.reference_states(parts.model, jnp.zeros(1)) is not None
    return parts.follower.asks() == "relay" or not moving


def _loop(parts: Parts) -> _Loop:
    model, graph = parts.model, parts.graph
    gain = getattr(parts.follower, "gain", None)
    n, m = len(model.state_names), len(model.input_names)
    A, B = linearize(model)
    P, R, c, edge = parts.follower.metric(model), np.eye(m), 1.0, None
    if isinstance(gain, Gain):
        R, c, edge = gain.R, gain.coupling, gain.certificate.edge
        A = A if gain.inner is None else A - B @ gain.inner
    linear, P = Linearization(A, B), np.eye(n) if P is None else P
    certificate = certify(linear, graph, P, R, c, edge)
    broken = parts.formation.broken_symmetries(model)
    return _Loop(parts, linear, P, R, c, graph.grounded_spectrum(), certificate, broken)


def _graph_lines(loop: _Loop) -> Iterator[Line]:
    graph, low = loop.parts.graph, loop.certificate.lambda_min
    unit = bool((graph.weights == 1.0).all())
    edges = f"{graph.agents} agents, {len(graph.edges)} edges"
    yield Line("Assumption 1, autonomous", "holds", "proof", "", "f and g depend on x alone")
    text = "connected and static" + ("" if unit else "; weights need not be 1")
    yield Line("Assumption 2, graph", "holds", "proof", edges, text)
    yield Line("Assumption 3, exact states", "holds", "proof", "", "no noise is simulated")
    yield _leader_line(loop)
    number = f"lambda_min {low:.6g}, lambda_max {loop.certificate.lambda_max:.6g}"
    yield Line("Assumption 6, M L = I", "holds", "proof", number, "for the grounded Laplacian")
    yield Line("Lemma 1, L > 0", "holds", "proof", f"{low:.6g}", "grounded Laplacian")
    yield Line("Lemma 2, Schur complement", "not needed", "proof", "", "the LMI is not used")
    rows = float(np.abs(graph.grounded_laplacian().sum(axis=1)).max())
    text = "true for rows that sum to zero; the grounded Laplacian's do not"
    yield Line("Lemma 3, sum over edges", "fails", "proof", f"row sum {rows:.3g}", text)


def _leader_line(loop: _Loop) -> Line:
    """Assumption 4: the leader tracks its reference, by linearization."""
    gain = getattr(loop.parts.leader, "gain", None)
    if not isinstance(gain, Gain):
        return Line("Assumption 4, leader tracks", "not needed", "proof", "", "it follows nothing")
    A, B = linearize(loop.parts.model)
    K = np.linalg.solve(gain.R, B.T @ gain.P)
    slow = float(np.linalg.eigvals(A - gain.coupling * B @ K).real.max())
    verdict = "holds" if slow < -_ZERO else "fails"
    text = "at the trim" if slow < -_ZERO else "the tracking error is not damped at the trim"
    return Line("Assumption 4, leader tracks", verdict, "linearization", f"{slow:.3g} 1/s", text)


def _drift_lines(loop: _Loop) -> Iterator[Line]:
    monotone = _monotone_line(loop)
    yield monotone
    symmetric = not loop.broken
    agent, reason = next(iter(loop.broken.items()), (0, ""))
    text = "f and g do not notice them" if symmetric else f"agent {agent}: {reason}"
    verdict = "holds" if symmetric else "fails"
    yield Line("offsets are symmetries", verdict, "samples", f"{len(loop.broken)} broken", text)
    both = symmetric and monotone.verdict == "holds"
    text = "needs Assumption 5 and symmetric offsets"
    yield Line("Lemma 4, drift along z", "holds" if both else "fails", "linearization", "", text)
    largest = _printed_lmi(loop)
    text = "infeasible for every P > 0: its upper left block is zero"
    yield Line("LMI as printed", "fails", "proof", f"eigenvalue {largest:.3g} > 0", text)
    yield _finite_condition(loop)


def _monotone_line(loop: _Loop) -> Line:
    """Assumption 5 for the drift that the followers have, inner loop included, at the trim."""
    A, P = loop.linear.A, loop.P
    slope = P @ A + A.T @ P
    worst = float(np.linalg.eigvalsh(slope)[-1])
    holds = worst <= _ZERO * max(1.0, float(np.abs(slope).max()))
    found = None if holds else obstacle(A[None])
    text = "the drift does not expand P"
    if found is not None:
        names = ", ".join(f"`{loop.parts.model.state_names[k]}`" for k in found.states)
        text = f"no P > 0 can: mode at {in_words(found.eigenvalue)} 1/s along {names}; "
        text += "an `inner-loop` gain makes it hold, `riccati` does without"
    elif not holds:
        text = "this P does not; `monotone` or `inner-loop` find one, `riccati` does without"
    verdict = "holds" if holds else "fails"
    return Line("Assumption 5, P-monotone drift", verdict, "linearization", f"{worst:.3g}", text)


def _goals(loop: _Loop) -> tuple[Matrix, Matrix]:
    """Return the followers' goals (about the trim) and the drift there."""
    followers = list(loop.parts.graph.followers[:_SHOWN])
    goals = np.asarray(loop.parts.model.trim[0]) + loop.parts.formation.offsets[followers]
    return goals, np.asarray(_drifts(loop.parts.model, jnp.asarray(goals)))


@eqx.filter_jit
def _drifts(model: ControlAffine, states: States) -> jax.Array:
    return jax.vmap(model.normalized_drift)(states)


def _printed_lmi(loop: _Loop) -> float:
    """Return the largest eigenvalue of the paper's LMI at this P, for up to four followers."""
    goals, drifts = (part[:4] for part in _goals(loop))
    count, n = goals.shape
    values, vectors = np.linalg.eigh(loop.P)
    X = np.kron(np.eye(count), vectors @ np.diag(values**-0.5) @ vectors.T)
    D, F = np.zeros((count * n, count)), np.zeros((count * n, count))
    for i in range(count):
        for j in range(count):
            D[i * n : (i + 1) * n, j] = goals[j] - goals[i]
            F[i * n : (i + 1) * n, j] = drifts[i] - drifts[j]
    Y = -F @ D.T
    return float(np.linalg.eigvalsh(np.block([[0.0 * X, X], [X, 0.5 * (Y + Y.T)]]))[-1])


def _finite_condition(loop: _Loop) -> Line:
    """Return the condition (xi_i - xi_j)'P (f(xi_i) - f(xi_j)) <= 0 on all pairs of goals."""
    goals, drifts = _goals(loop)
    d, f = goals[:, None] - goals[None], drifts[:, None] - drifts[None]
    worst = float(np.einsum("ija,ab,ijb->ij", d, loop.P, f).max(initial=0.0))
    if float(np.abs(f).max(initial=0.0)) <= _ZERO:
        text = "f is the same at all goals, so that every P passes: it says nothing"
        return Line("finite condition on P", "vacuous", "proof", "0 <= 0", text)
    verdict = "holds" if worst <= _ZERO else "fails"
    text = "at the goals only; it says nothing of other states"
    return Line("finite condition on P", verdict, "proof", f"{worst:.3g}", text)


def _law_lines(loop: _Loop) -> Iterator[Line]:
    model, certificate = loop.parts.model, loop.certificate
    n, rank = len(model.state_names), certificate.observable
    hidden = _margins.detectability(loop.linear.A, loop.linear.B.T @ loop.P)
    names = sorted({k for mode in hidden for k in np.flatnonzero(np.abs(mode.direction) > 0.1)})
    along = ", ".join(f"`{model.state_names[k]}`" for k in names)
    text = f"never felt by the input: {along}; choose another P" if hidden else "z = 0 is reached"
    verdict = "fails" if hidden else "holds"
    yield Line("detectability of (A, g'P)", verdict, "linearization", f"rank {rank} of {n}", text)
    relay = loop.parts.follower.asks() == "relay"
    text = "the leader's input reaches every follower, which the paper's network does not give"
    if not relay:
        text = "followers lag behind a moving leader; `feedforward: relay` removes it"
    verdict = "holds" if _matched(loop.parts) else "fails"
    yield Line("leader's motion is matched", verdict, "proof", "", text)
    edge = certificate.edge
    text = "guaranteed for linear agents from the edge on" if edge is not None else "no edge known"
    number = f"c {loop.coupling:.4g}" + ("" if edge is None else f", edge {edge:.4g}")
    fine = edge is None or loop.coupling >= edge
    yield Line("coupling", "holds" if fine else "fails", "proof", number, text)
    verdict = "holds" if certificate.stable else "fails"
    text = f"over {certificate.modes} eigenvalues of the graph"
    if not certificate.stable:
        text += "; raise `coupling`, or use `riccati` or `inner-loop`"
    number = f"{certificate.abscissa:.3g} 1/s"
    yield Line("disagreement decays", verdict, "linearization", number, text)


def _margin_lines(loop: _Loop) -> Iterator[Line]:
    if not loop.certificate.stable:
        yield Line("margins", "not needed", "linearization", "", "there is nothing to lose")
        return
    A, B = loop.linear
    given = (A, B, loop.P, loop.R, loop.coupling, loop.eigenvalues)
    factors, delay = _margins.gain_margin(*given), _margins.delay_margin(*given)
    number = f"{factors.low:.3g} to {factors.high:.3g}"
    yield Line("gain margin", "holds", "linearization", number, "factors on the coupling")
    number = f"{1e3 * delay.delay:.3g} ms" if np.isfinite(delay.delay) else "any"
    text = f"uniform delay of z, lost at lambda = {delay.eigenvalue:.3g}"
    yield Line("delay margin", "holds", "linearization", number, text)
    # The trim input, and an inner loop's, weaken with the rest.
    slopes, gain = trim_slopes(loop.parts.model), getattr(loop.parts.follower, "gain", None)
    if isinstance(gain, Gain) and gain.inner is not None:
        slopes = slopes - B.T[:, :, None] * gain.inner[:, None, :]
    worst = _margins.input_scaling(*given, slopes=slopes)
    verdict = "holds" if worst.abscissa < 0.0 else "fails"
    text = "inputs 30 % weaker or stronger, as by a wrong mass or inertia"
    yield Line("input scaling", verdict, "linearization", f"{worst.abscissa:.3g} 1/s", text)
