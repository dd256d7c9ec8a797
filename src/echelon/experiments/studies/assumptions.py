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
from echelon.core.statement import (
    Hypothesis,
    Statement,
    Topic,
    fails,
    holds,
    unneeded,
    vacuous,
)
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
_PROOF, _LINEAR = Kind.PROOF, Kind.LINEARIZATION
_BENT = "the model bends at the trim, and has no linearization there"


def graph_lines(parts: Parts) -> Iterator[Statement]:
    """Yield what the paper asks of agents and graph: Assumptions 1, 2 and 6, Lemmas 1 to 3."""
    graph = parts.graph
    low, high = graph.spectrum().low, graph.spectrum().high
    # A model is asked for f and g without a time, so that none can break it.
    yield holds(Topic.AUTONOMOUS, _PROOF, "f and g depend on x alone")
    other, size = _other_graph(graph), f"{graph.agents} agents, {len(graph.edges)} edges"
    remedy = "T7 and T8 of the theory page stand in its place"
    if other:
        yield fails(Topic.GRAPH, _PROOF, other, len(graph.edges), size, remedy=remedy)
    else:
        # The paper has unit weights; its lemmas need only that they are positive.
        unit = bool((graph.weights == 1.0).all())
        text = "connected and static" + ("" if unit else "; weights need not be 1")
        yield holds(Topic.GRAPH, _PROOF, text, len(graph.edges), size)
    followers, leaders = len(graph.followers), len(graph.leaders)
    roles = f"{leaders} leader{'s' * (leaders > 1)}, {followers} follower{'s' * (followers > 1)}"
    yield holds(Topic.PARENTS, _PROOF, who_hears_whom(graph), leaders, roles)
    extremes = f"lambda_min {low:.6g}, lambda_max {high:.6g}"
    yield holds(Topic.GROUNDED, _PROOF, "for the grounded Laplacian", low, extremes)
    if other:
        text = "no eigenvalue of any L has a smaller real part"
        yield fails(Topic.POSITIVE, _PROOF, text, low, f"{low:.6g}", remedy=remedy)
    else:
        yield holds(Topic.POSITIVE, _PROOF, "grounded Laplacian", low, f"{low:.6g}")
    yield unneeded(Topic.SCHUR, _PROOF, "the LMI is not used")
    # A follower beside a leader keeps the weight of that edge on its diagonal and loses the
    # leader's column, so its row sums to that weight.
    rows = float(np.abs(graph.grounded_laplacian().sum(axis=1)).max())
    text = "true for rows that sum to zero; the grounded Laplacian's do not"
    remedy = "nothing here rests on it: Lemma 1 serves instead"
    yield fails(Topic.EDGES, _PROOF, text, rows, f"row sum {rows:.3g}", remedy=remedy)


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
    if promise.paper_lines:
        yield from promise.paper_lines
        return
    monotone = _monotone_line(parts, promise)
    yield monotone
    both = not promise.hypotheses[Hypothesis.SYMMETRY].fails
    both = both and monotone.verdict is Verdict.HOLDS
    text, remedy = "needs Assumption 5 and symmetric offsets", "see Assumption 5 and the offsets"
    yield (
        holds(Topic.DRIFT_ALONG_Z, _LINEAR, text)
        if both
        else fails(Topic.DRIFT_ALONG_Z, _LINEAR, text, remedy=remedy)
    )
    yield _printed_line(parts, promise)
    yield _finite_line(parts, promise)


def _leader_line(promise: Promise) -> Statement:
    """Assumption 4: the leader tracks its reference, by linearization."""
    name, slow = Topic.LEADER_TRACKING, promise.leader_mode
    if slow is None:
        return unneeded(name, _PROOF, "it follows nothing")
    if not promise.linear:
        return vacuous(name, _LINEAR, _BENT)
    # NaN counts as not damped.
    if slow < -ZERO:
        return holds(name, _LINEAR, "at the trim", slow, f"{slow:.3g} 1/s")
    text = "the tracking error is not damped at the trim"
    remedy = "give `leader.gain` another method"
    return fails(name, _LINEAR, text, slow, f"{slow:.3g} 1/s", remedy=remedy)


def _reference_line(model: ControlAffine, found: ReferenceDemand, settings: Settings) -> Statement:
    """Say what a leader must do to follow; no model here limits a speed but by its inputs."""
    limited = settings.limits and model.input_limits is not None
    sizes = ((found.speed, "m/s"), (found.acceleration, "m/s^2"))
    # Below a micrometre and the like are the differences' rounding.
    numbers = [f"{round(x, 5):.3g} {unit}" for x, unit in sizes if x is not None]
    numbers += [f"{100.0 * found.share:.3g} % of the limits' room"] if limited else []
    number = found.share, ", ".join(numbers)
    if not found.feasible:
        text, remedy = infeasible(model, found), "give knots that the model can move along"
        return fails(Topic.REFERENCE_DEMAND, Kind.SAMPLES, text, *number, remedy=remedy)
    if limited and found.share > 1.0:
        text, remedy = too_fast(model, found), "make it slower or smaller"
        return fails(Topic.REFERENCE_DEMAND, Kind.SAMPLES, text, *number, remedy=remedy)
    bound = "the limits alone bound what it may ask" if limited else "nothing here bounds it"
    text = f"at most, over {settings.horizon:g} s; {bound}"
    return holds(Topic.REFERENCE_DEMAND, Kind.SAMPLES, text, *number)


def _monotone_line(parts: Parts, promise: Promise) -> Statement:
    """Assumption 5 for the drift that the followers have, inner loop included, at the trim."""
    name = Topic.MONOTONE
    if not promise.linear:
        return vacuous(name, _LINEAR, _BENT)
    A, P = promise.loop.linear.A, promise.loop.closed.P
    slope = P @ A + A.T @ P
    worst = float(np.linalg.eigvalsh(slope)[-1])
    # Where a position does not enter the drift, A e = 0 and e'(P A + A'P) e = 0: the largest
    # eigenvalue is then 0 at best, and rounding must not make it fail.
    number = worst, f"{worst:.3g}"
    if worst <= ZERO * max(1.0, float(np.abs(slope).max())):
        return holds(name, _LINEAR, "the drift does not expand P", *number)
    found = obstacle(A[None])
    if found is None:
        remedy = "`monotone` or `inner-loop` find one, `riccati` does without"
        return fails(name, _LINEAR, "this P does not", *number, remedy=remedy)
    names = ", ".join(f"`{parts.model.state_names[k]}`" for k in found.states)
    text = f"no P > 0 can: mode at {eigenvalue_text(found.eigenvalue)} 1/s along {names}"
    remedy = "an `inner-loop` gain makes it hold, `riccati` does without"
    return fails(name, _LINEAR, text, *number, remedy=remedy)


def _printed_line(parts: Parts, promise: Promise) -> Statement:
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
    largest = float(np.linalg.eigvalsh(np.block([[0.0 * X, X], [X, 0.5 * (Y + Y.T)]]))[-1])
    text = "infeasible for every P > 0: its upper left block is zero"
    number, remedy = (largest, f"eigenvalue {largest:.3g} > 0"), "use the finite condition"
    return fails(Topic.LMI_AS_PRINTED, _PROOF, text, *number, remedy=remedy)


def _finite_line(parts: Parts, promise: Promise) -> Statement:
    """Return the condition (xi_i - xi_j)'P (f(xi_i) - f(xi_j)) <= 0 on pairs of goals."""
    P, name = promise.loop.closed.P, Topic.FINITE
    # Any multiple of P serves the law as well, with the coupling divided by it.
    P = P / float(np.linalg.eigvalsh(P)[0])
    found = finite_condition(P, parts.model, parts.formation, parts.drive)
    if found.verdict is Verdict.VACUOUS:
        text = "f is the same at all goals, so that every P passes: it says nothing"
        return vacuous(name, _PROOF, text, 0.0, "0 <= 0")
    every = found.agents == parts.graph.agents
    kind, number = _PROOF if every else Kind.SAMPLES, (found.largest, f"{found.largest:.3g}")
    if found.verdict is Verdict.FAILS:
        text = "goals of agents {} and {} drift apart in this P".format(*found.pair)
        return fails(name, kind, text, *number, remedy="choose other offsets or P")
    among = "" if every else f", for {found.agents} of {parts.graph.agents} agents"
    return holds(name, kind, f"at the goals only{among}; it says nothing of other states", *number)
