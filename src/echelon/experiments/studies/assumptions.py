"""The paper's own statements on parts of one's own: its assumptions, lemmas, and conditions on P.

Those that are hypotheses of a promise stand with it and are not repeated here.
"""

from collections.abc import Iterator

import numpy as np

from echelon.agents.models.model import ControlAffine
from echelon.agents.network.graph import Graph
from echelon.agents.network.hearing import who_hears_whom
from echelon.agents.references.demand import (
    ReferenceDemand,
    infeasible,
    reference_demand,
    too_fast,
)
from echelon.core.linear import eigenvalue_text
from echelon.core.statement import Hypothesis, Statement, Topic
from echelon.core.words import Kind, Verdict
from echelon.experiments.studies.finite_condition import finite_condition
from echelon.guarantees.promises.hypotheses import goal_drifts
from echelon.guarantees.promises.promise import Promise
from echelon.laws.law import reference_of
from echelon.simulation.engine.parts import Parts
from echelon.simulation.step.settings import Settings
from echelon.synthesis.certificates.axis_modes import obstacle

# Far above what rounding makes of an eigenvalue 0, and far below any rate of use: at 1e-9 1/s an
# error takes 30 years to fall to 1/e.
ZERO = 1e-9
_HOLDS, _PROOF = Verdict.HOLDS, Kind.PROOF
_BENT = "the model bends at the trim, and has no linearization there"


def graph_lines(parts: Parts) -> Iterator[Statement]:
    """Yield what the paper asks of agents and graph: Assumptions 1, 2 and 6, Lemmas 1 to 3."""
    graph = parts.graph
    low, high = graph.spectrum().low, graph.spectrum().high
    # A model is asked for f and g without a time, so that none can break it.
    text = "f and g depend on x alone"
    yield Statement(Topic.AUTONOMOUS, _HOLDS, _PROOF, text=text)
    # The paper has unit weights; its lemmas need only that they are positive.
    unit, shown = bool((graph.weights == 1.0).all()), f"{graph.agents} agents"
    text = "connected and static" + ("" if unit else "; weights need not be 1")
    shown = f"{shown}, {len(graph.edges)} edges"
    other = _other_graph(graph)
    held = Verdict.of(not other)
    remedy = "T7 and T8 of the theory page stand in its place" if other else ""
    yield Statement(Topic.GRAPH, held, _PROOF, len(graph.edges), shown, other or text, remedy)
    followers, leaders = len(graph.followers), len(graph.leaders)
    shown = f"{leaders} leader{'s' * (leaders > 1)}, {followers} follower{'s' * (followers > 1)}"
    text = who_hears_whom(graph)
    yield Statement(Topic.PARENTS, _HOLDS, _PROOF, leaders, shown, text)
    shown, text = f"lambda_min {low:.6g}, lambda_max {high:.6g}", "for the grounded Laplacian"
    yield Statement(Topic.GROUNDED, _HOLDS, _PROOF, low, shown, text)
    text = "no eigenvalue of any L has a smaller real part" if other else "grounded Laplacian"
    yield Statement(Topic.POSITIVE, held, _PROOF, low, f"{low:.6g}", text, remedy)
    text = "the LMI is not used"
    yield Statement(Topic.SCHUR, Verdict.NOT_NEEDED, _PROOF, text=text)
    # A follower beside a leader keeps the weight of that edge on its diagonal and loses the
    # leader's column, so its row sums to that weight.
    rows = float(np.abs(graph.grounded_laplacian().sum(axis=1)).max())
    shown = f"row sum {rows:.3g}"
    text = "true for rows that sum to zero; the grounded Laplacian's do not"
    remedy = "nothing here rests on it: Lemma 1 serves instead"
    yield Statement(Topic.EDGES, Verdict.FAILS, _PROOF, rows, shown, text, remedy)


def _other_graph(graph: Graph) -> str:
    """Return in what a graph is not the paper's undirected and static one; empty where it is."""
    found = ["heard one way, along arrows by which a leader reaches everybody"] * graph.directed
    if graph.schedule is not None:
        times = ", ".join(f"{at:g}" for at in graph.schedule.starts[1:8])
        found.append(f"switches at {times} s")
    return "; ".join(found)


def drift_lines(parts: Parts, settings: Settings, promise: Promise) -> Iterator[Statement]:
    """Yield what the paper asks of leader and drift: Assumptions 4, 5, Lemma 4, conditions on P."""
    yield _leader_line(promise)
    reference = reference_of(getattr(parts.drive, "leader", parts.drive))
    if reference is not None:
        found = reference_demand(parts.model, reference, settings.horizon)
        yield _reference_line(parts.model, found, settings)
    if promise.hypotheses[Hypothesis.SMOOTH].verdict is Verdict.NOT_NEEDED:
        yield from _flat_lines()
        return
    monotone = _monotone_line(parts, promise)
    yield monotone
    both = not promise.hypotheses[Hypothesis.SYMMETRY].fails
    both = both and monotone.verdict is Verdict.HOLDS
    text, linear = "needs Assumption 5 and symmetric offsets", Kind.LINEARIZATION
    verdict, remedy = Verdict.of(both), "" if both else "see Assumption 5 and the offsets"
    yield Statement(Topic.DRIFT_ALONG_Z, verdict, linear, text=text, remedy=remedy)
    largest = _printed_lmi(parts, promise)
    shown, text = f"eigenvalue {largest:.3g} > 0", "infeasible for every P > 0: its upper left "
    text, remedy = f"{text}block is zero", "use the finite condition"
    yield Statement(Topic.LMI_AS_PRINTED, Verdict.FAILS, _PROOF, largest, shown, text, remedy)
    yield _finite_line(parts, promise)


def _leader_line(promise: Promise) -> Statement:
    """Assumption 4: the leader tracks its reference, by linearization."""
    name, slow = Topic.LEADER_TRACKING, promise.own
    if slow is None:
        return Statement(name, Verdict.NOT_NEEDED, _PROOF, text="it follows nothing")
    if not promise.linear:
        return Statement(name, Verdict.VACUOUS, Kind.LINEARIZATION, text=_BENT)
    text, remedy = "at the trim", ""
    # So asked that NaN counts as not damped.
    if not slow < -ZERO:
        text, remedy = "the tracking error is not damped at the trim", "give `leader.gain` another "
        remedy += "method"
    verdict, shown = Verdict.of(slow < -ZERO), f"{slow:.3g} 1/s"
    return Statement(name, verdict, Kind.LINEARIZATION, slow, shown, text, remedy)


def _reference_line(model: ControlAffine, found: ReferenceDemand, settings: Settings) -> Statement:
    """Say what a leader must do to follow; no model here limits a speed but by its inputs."""
    name, remedy = Topic.REFERENCE_DEMAND, ""
    limited = settings.limits and model.input_limits is not None
    sizes = ((found.speed, "m/s"), (found.acceleration, "m/s^2"))
    # Below a micrometre and the like are the differences' rounding.
    shown = [f"{round(x, 5):.3g} {unit}" for x, unit in sizes if x is not None]
    shown += [f"{100.0 * found.share:.3g} % of the limits' room"] if limited else []
    text = f"at most, over {settings.horizon:g} s; the limits alone bound what it may ask"
    text = text if limited else f"at most, over {settings.horizon:g} s; nothing here bounds it"
    fast = limited and found.share > 1.0
    if fast:
        text, remedy = too_fast(model, found), "make it slower or smaller"
    if not found.feasible:
        text, remedy = infeasible(model, found), "give knots that the model can move along"
    verdict = Verdict.of(found.feasible and not fast)
    return Statement(name, verdict, Kind.SAMPLES, found.share, ", ".join(shown), text, remedy)


def _monotone_line(parts: Parts, promise: Promise) -> Statement:
    """Assumption 5 for the drift that the followers have, inner loop included, at the trim."""
    name = Topic.MONOTONE
    if not promise.linear:
        return Statement(name, Verdict.VACUOUS, Kind.LINEARIZATION, text=_BENT)
    A, P = promise.loop.linear.A, promise.loop.closed.P
    slope = P @ A + A.T @ P
    worst = float(np.linalg.eigvalsh(slope)[-1])
    # Where a position does not enter the drift, A e = 0 and e'(P A + A'P) e = 0: the largest
    # eigenvalue is then 0 at best, and rounding must not make it fail.
    holds = worst <= ZERO * max(1.0, float(np.abs(slope).max()))
    found = None if holds else obstacle(A[None])
    text, remedy = "the drift does not expand P", ""
    if found is not None:
        names = ", ".join(f"`{parts.model.state_names[k]}`" for k in found.states)
        text = f"no P > 0 can: mode at {eigenvalue_text(found.eigenvalue)} 1/s along {names}"
        remedy = "an `inner-loop` gain makes it hold, `riccati` does without"
    elif not holds:
        text, remedy = "this P does not", "`monotone` or `inner-loop` find one, `riccati` does "
        remedy += "without"
    verdict, shown = Verdict.of(holds), f"{worst:.3g}"
    return Statement(name, verdict, Kind.LINEARIZATION, worst, shown, text, remedy)


def _flat_lines() -> Iterator[Statement]:
    """Assumption 5, Lemma 4 and the conditions on P where stopping points agree (T5)."""
    text = "in flat coordinates, with equality: zeta' = 0 in silence, P = T'T for zeta = T x"
    yield Statement(Topic.MONOTONE, Verdict.HOLDS, _PROOF, 0.0, "0", text)
    text = "for offsets of every flat output: they are symmetries of the chains"
    yield Statement(Topic.DRIFT_ALONG_Z, Verdict.HOLDS, _PROOF, text=text)
    for name in (Topic.LMI_AS_PRINTED, Topic.FINITE):
        yield Statement(name, Verdict.NOT_NEEDED, _PROOF, text="T5 asks nothing of a P")


def _printed_lmi(parts: Parts, promise: Promise) -> float:
    """Return the largest eigenvalue of the paper's LMI at this P, for up to four followers."""
    # It fails at any size for one reason: on (v, s X v) with a small s > 0, [[0, X], [X, Z]] is
    # 2 s |X v|^2 + O(s^2) > 0. Four followers show it, and eigenvalues cost the cube of their
    # number.
    few = list(parts.graph.followers[:4])
    goals = np.asarray(parts.model.trim[0]) + parts.formation.offsets[few]
    drifts = goal_drifts(parts.model, parts.formation.offsets, parts.drive)[few]
    count, n = goals.shape
    values, vectors = np.linalg.eigh(promise.loop.closed.P)
    X = np.kron(np.eye(count), vectors @ np.diag(values**-0.5) @ vectors.T)
    D, F = np.zeros((count * n, count)), np.zeros((count * n, count))
    for i in range(count):
        for j in range(count):
            D[i * n : (i + 1) * n, j] = goals[j] - goals[i]
            F[i * n : (i + 1) * n, j] = drifts[i] - drifts[j]
    Y = -F @ D.T
    return float(np.linalg.eigvalsh(np.block([[0.0 * X, X], [X, 0.5 * (Y + Y.T)]]))[-1])


def _finite_line(parts: Parts, promise: Promise) -> Statement:
    """Return the condition (xi_i - xi_j)'P (f(xi_i) - f(xi_j)) <= 0 on pairs of goals."""
    P, name = promise.loop.closed.P, Topic.FINITE
    # Any multiple of P serves the law as well, with the coupling divided by it.
    P = P / float(np.linalg.eigvalsh(P)[0])
    found = finite_condition(P, parts.model, parts.formation, parts.drive)
    if found.verdict is Verdict.VACUOUS:
        text = "f is the same at all goals, so that every P passes: it says nothing"
        return Statement(name, found.verdict, _PROOF, 0.0, "0 <= 0", text)
    every = found.agents == parts.graph.agents
    among = "" if every else f", for {found.agents} of {parts.graph.agents} agents"
    text, remedy = f"at the goals only{among}; it says nothing of other states", ""
    if found.verdict is Verdict.FAILS:
        i, j = found.pair
        text, remedy = f"goals of agents {i} and {j} drift apart in this P", "choose other offsets "
        remedy += "or P"
    kind, shown = _PROOF if every else Kind.SAMPLES, f"{found.largest:.3g}"
    return Statement(name, found.verdict, kind, found.largest, shown, text, remedy)
