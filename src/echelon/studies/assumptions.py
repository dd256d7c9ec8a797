"""The paper's own statements on a scenario: its assumptions, lemmas, and conditions on P."""

from collections.abc import Iterator

import numpy as np

from echelon.certificates.modes import obstacle
from echelon.core.linear import in_words
from echelon.core.words import Kind, Verdict
from echelon.gains.gain import Gain
from echelon.models.linearization import linearize
from echelon.promises.closed_loop import CheckedLoop
from echelon.studies.finite_condition import finite_condition, goal_drifts
from echelon.studies.lines import Line

ZERO = 1e-9


def graph_lines(loop: CheckedLoop) -> Iterator[Line]:
    """Yield what the paper asks of agents, graph and leader: Assumptions 1-4 and 6, Lemmas 1-3."""
    graph = loop.parts.graph
    low, high = graph.spectrum().low, graph.spectrum().high
    unit, holds, proof = bool((graph.weights == 1.0).all()), Verdict.HOLDS, Kind.PROOF
    edges = f"{graph.agents} agents, {len(graph.edges)} edges"
    yield _trim_line(loop)
    yield Line("Assumption 1, autonomous", holds, proof, "", "f and g depend on x alone")
    text = "connected and static" + ("" if unit else "; weights need not be 1")
    yield Line("Assumption 2, graph", holds, proof, edges, text)
    yield _exact_line(loop)
    yield _leader_line(loop)
    number = f"lambda_min {low:.6g}, lambda_max {high:.6g}"
    yield Line("Assumption 6, M L = I", holds, proof, number, "for the grounded Laplacian")
    yield Line("Lemma 1, L > 0", holds, proof, f"{low:.6g}", "grounded Laplacian")
    text = "the LMI is not used"
    yield Line("Lemma 2, Schur complement", Verdict.NOT_NEEDED, proof, "", text)
    rows = float(np.abs(graph.grounded_laplacian().sum(axis=1)).max())
    text = "true for rows that sum to zero; the grounded Laplacian's do not"
    yield Line("Lemma 3, sum over edges", Verdict.FAILS, proof, f"row sum {rows:.3g}", text)


def _trim_line(loop: CheckedLoop) -> Line:
    """Definition 1 wants f(0) = 0: about the trim it holds, if the law applies the trim input."""
    there = np.zeros_like(loop.parts.formation.offsets)
    size = float(np.abs(goal_drifts(loop.parts.model, there, loop.parts.drive)).max())
    number, text = f"|f + g u*| {size:.2g}", "about the trim, whose input the law applies"
    if not loop.trimmed:
        text = "the law leaves out the trim input; set `follower.trim: true`"
    verdict = Verdict.of(loop.trimmed)
    return Line("Definition 1, f(0) = 0", verdict, Kind.PROOF, number, text)


def _exact_line(loop: CheckedLoop) -> Line:
    """Assumption 3: states are known exactly, and nothing acts that no law asked for."""
    text = "states are known exactly, and nothing disturbs the agents"
    if loop.disturbed:
        text = f"{loop.disturbed}; what holds without is said, and how far it may push is below"
    verdict = Verdict.of(not loop.disturbed)
    return Line("Assumption 3, exact states", verdict, Kind.PROOF, "", text)


def _leader_line(loop: CheckedLoop) -> Line:
    """Assumption 4: the leader tracks its reference, by linearization."""
    statement = "Assumption 4, leader tracks"
    gain = getattr(getattr(loop.parts.drive, "leader", None), "gain", None)
    if not isinstance(gain, Gain):
        return Line(statement, Verdict.NOT_NEEDED, Kind.PROOF, "", "it follows nothing")
    A, B = linearize(loop.parts.model)
    K = np.linalg.solve(gain.R, B.T @ gain.P)
    slow = float(np.linalg.eigvals(A - gain.coupling * B @ K).real.max())
    verdict = Verdict.of(slow < -ZERO)
    text = "at the trim"
    if verdict is Verdict.FAILS:
        text = "the tracking error is not damped at the trim; give `leader.gain` another method"
    return Line(statement, verdict, Kind.LINEARIZATION, f"{slow:.3g} 1/s", text)


def drift_lines(loop: CheckedLoop) -> Iterator[Line]:
    """Yield what the paper asks of the drift: Assumption 5, Lemma 4, and its conditions on P."""
    monotone = _monotone_line(loop)
    yield monotone
    symmetric = not loop.broken
    agent, reason = next(iter(loop.broken.items()), (0, ""))
    text = "f and g do not notice them"
    if not symmetric:
        text = f"agent {agent}: {reason}; offset only states that f and g ignore"
    verdict = Verdict.of(symmetric)
    yield Line("offsets are symmetries", verdict, Kind.SAMPLES, f"{len(loop.broken)} broken", text)
    both = symmetric and monotone.verdict is Verdict.HOLDS
    text = "needs Assumption 5 and symmetric offsets"
    yield Line("Lemma 4, drift along z", Verdict.of(both), Kind.LINEARIZATION, "", text)
    largest = _printed_lmi(loop)
    text = "infeasible for every P > 0: its upper left block is zero; use the finite condition"
    yield Line("LMI as printed", Verdict.FAILS, Kind.PROOF, f"eigenvalue {largest:.3g} > 0", text)
    yield _finite_line(loop)


def _monotone_line(loop: CheckedLoop) -> Line:
    """Assumption 5 for the drift that the followers have, inner loop included, at the trim."""
    A, P = loop.linear.A, loop.closed.P
    slope = P @ A + A.T @ P
    worst = float(np.linalg.eigvalsh(slope)[-1])
    holds = worst <= ZERO * max(1.0, float(np.abs(slope).max()))
    found = None if holds else obstacle(A[None])
    text = "the drift does not expand P"
    if found is not None:
        names = ", ".join(f"`{loop.parts.model.state_names[k]}`" for k in found.states)
        text = f"no P > 0 can: mode at {in_words(found.eigenvalue)} 1/s along {names}; "
        text += "an `inner-loop` gain makes it hold, `riccati` does without"
    elif not holds:
        text = "this P does not; `monotone` or `inner-loop` find one, `riccati` does without"
    verdict = Verdict.of(holds)
    return Line("Assumption 5, P-monotone drift", verdict, Kind.LINEARIZATION, f"{worst:.3g}", text)


def _printed_lmi(loop: CheckedLoop) -> float:
    """Return the largest eigenvalue of the paper's LMI at this P, for up to four followers."""
    few = list(loop.parts.graph.followers[:4])
    goals = np.asarray(loop.parts.model.trim[0]) + loop.parts.formation.offsets[few]
    drifts = goal_drifts(loop.parts.model, loop.parts.formation.offsets, loop.parts.drive)[few]
    count, n = goals.shape
    values, vectors = np.linalg.eigh(loop.closed.P)
    X = np.kron(np.eye(count), vectors @ np.diag(values**-0.5) @ vectors.T)
    D, F = np.zeros((count * n, count)), np.zeros((count * n, count))
    for i in range(count):
        for j in range(count):
            D[i * n : (i + 1) * n, j] = goals[j] - goals[i]
            F[i * n : (i + 1) * n, j] = drifts[i] - drifts[j]
    Y = -F @ D.T
    return float(np.linalg.eigvalsh(np.block([[0.0 * X, X], [X, 0.5 * (Y + Y.T)]]))[-1])


def _finite_line(loop: CheckedLoop) -> Line:
    """Return the condition (xi_i - xi_j)'P (f(xi_i) - f(xi_j)) <= 0 on pairs of goals."""
    parts, P = loop.parts, loop.closed.P
    # Any multiple of P serves the law as well, with the coupling divided by it.
    P = P / float(np.linalg.eigvalsh(P)[0])
    found = finite_condition(P, parts.model, parts.formation, parts.drive)
    statement = "finite condition on P"
    if found.verdict is Verdict.VACUOUS:
        text = "f is the same at all goals, so that every P passes: it says nothing"
        return Line(statement, Verdict.VACUOUS, Kind.PROOF, "0 <= 0", text)
    every = found.agents == parts.graph.agents
    among = "" if every else f", for {found.agents} of {parts.graph.agents} agents"
    text = f"at the goals only{among}; it says nothing of other states"
    if found.verdict is Verdict.FAILS:
        i, j = found.pair
        text = f"goals of agents {i} and {j} drift apart in this P; choose other offsets or P"
    kind = Kind.PROOF if every else Kind.SAMPLES
    return Line(statement, found.verdict, kind, f"{found.largest:.3g}", text)
