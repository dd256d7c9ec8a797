"""The paper's assumptions, lemmas and conditions on P, checked for given parts."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from echelon.agents.models.model import ControlAffine, position_unit
from echelon.agents.network.formation import Formation
from echelon.agents.network.graph import Graph
from echelon.agents.network.hearing import who_hears_whom
from echelon.agents.references.flatness import (
    ReferenceDemand,
    infeasible,
    reference_demand,
    too_fast,
)
from echelon.core.digits import about, at_least, at_most
from echelon.core.errors import GainError
from echelon.core.linear import check_definite, eigenvalue_text
from echelon.core.statement import Hypothesis, Statement, Topic, fails, holds, unneeded, vacuous
from echelon.core.types import Array
from echelon.core.words import Kind, Verdict, amount
from echelon.guarantees.promises.hypotheses import goal_drifts
from echelon.guarantees.promises.promise import Guarantee
from echelon.laws.law import Law, reference_of
from echelon.simulation.engine.parts import Parts
from echelon.simulation.step.drive import Controller
from echelon.simulation.step.settings import Settings
from echelon.synthesis.certificates.lmi import obstacle
from echelon.synthesis.gains.printed_lmi import printed_lmi

# ---- the finite condition on P -------------------------------------------------------------------
# At the goals alone it reads P >= I and (xi_i - xi_j)'P (f(xi_i) - f(xi_j)) <= 0 for all pairs of
# agents. The paper writes d_ij = xi_j - xi_i for the first factor, which turns the sign.

_ZERO = 1e-9  # relative rounding of f at symmetric goals
_MOST = 1000  # agents compared pair by pair; of more, this many spread over all
_ROWS = 128  # agents whose pairs are computed at once, to bound memory


class FiniteCondition(NamedTuple):
    """Whether a P meets the paper's finite condition.

    Attributes:
        verdict: vacuous where f is the same at all goals, so that every P >= I passes.
        largest: of (xi_i - xi_j)'P (f(xi_i) - f(xi_j)) over the pairs; at most 0 where it holds.
        least: smallest eigenvalue of P; at least 1 where it holds.
        agents: how many agents' goals were compared: all up to a thousand.
    """

    verdict: Verdict
    largest: float
    pair: tuple[int, int]
    least: float
    agents: int


def finite_condition(
    P: Float[Array, "n n"],
    model: ControlAffine,
    formation: Formation,
    law: Law | Controller | None = None,
) -> FiniteCondition:
    """Return whether P meets the finite condition at a formation's goals, the leaders' included.

    Except for P >= I it is homogeneous in P: if P fails only that part, a multiple passes. The
    condition concerns only the goals about the trim, no other states.

    Args:
        P: symmetric.
        model: its f, about the trim.
        formation: its goals.
        law: the followers' law or drive; its inner loop belongs to the drift.

    Raises:
        GainError: P is not symmetric positive definite, or has another number of states.
    """
    P, n = np.asarray(P, float), len(model.state_names)
    if P.shape != (n, n):
        raise GainError(f"`P` has shape {P.shape}, but `{type(model).__name__}` needs {(n, n)}.")
    check_definite("P", P)
    offsets = formation.offsets
    drifts = goal_drifts(model, offsets, law)
    # Relative to f; absolute where f is near 0, since it may be the difference of larger terms.
    size = max(1.0, float(np.abs(drifts).max()))
    least = float(np.linalg.eigvalsh(P)[0])
    if float(np.ptp(drifts, axis=0).max()) <= _ZERO * size:
        verdict = Verdict.VACUOUS if least >= 1.0 - _ZERO else Verdict.FAILS
        return FiniteCondition(verdict, 0.0, (0, 0), least, len(offsets))
    # Spread over all: neighbouring numbers mostly are neighbours in space, and the first thousand
    # would be one corner of the formation.
    some = np.unique(np.linspace(0, len(offsets) - 1, min(_MOST, len(offsets))).astype(int))
    largest, (i, j) = _largest(P, offsets[some], drifts[some])
    holds = largest <= _ZERO * size * float(np.abs(P).max()) and least >= 1.0 - _ZERO
    pair = (int(some[i]), int(some[j]))
    return FiniteCondition(Verdict.of(holds), largest, pair, least, len(some))


def pair_values(P: Array, d: Array, f: Array) -> Array:
    """Return d'P f for each pair, (...), from differences of goals and of drifts (..., n)."""
    return np.einsum("...a,ab,...b->...", d, P, f)


def _largest(
    P: Float[Array, "n n"], offsets: Float[Array, "N n"], drifts: Float[Array, "N n"]
) -> tuple[float, tuple[int, int]]:
    best, at = -np.inf, (0, 0)
    for start in range(0, len(offsets), _ROWS):
        rows = slice(start, start + _ROWS)
        values = pair_values(
            P, offsets[rows, None] - offsets[None], drifts[rows, None] - drifts[None]
        )
        # Exclude the pairs of an agent with itself.
        values[np.arange(len(values)), np.arange(start, start + len(values))] = -np.inf
        i, j = np.unravel_index(int(values.argmax()), values.shape)
        if values[i, j] > best:
            best, at = float(values[i, j]), (start + int(i), int(j))
    return best, at


# ---- lines of a check ----------------------------------------------------------------------------
# Hypotheses of a promise are checked by the promise, not here.

# Far above the rounding of an eigenvalue 0, and far below any useful rate: at 1e-9 1/s an error
# takes 30 years to decay to 1/e.
ZERO = 1e-9
_PROOF, _LINEAR = Kind.PROOF, Kind.LINEARIZATION
_NOT_SMOOTH = "the model is not smooth at the trim, and has no linearization there"


def graph_lines(parts: Parts) -> Iterator[Statement]:
    """Yield the paper's conditions on agents and graph: Assumptions 1, 2 and 6, Lemmas 1 to 3."""
    graph = parts.graph
    low, high = graph.spectrum().low, graph.spectrum().high
    # The interface of models has no time, so every model meets it.
    yield holds(Topic.AUTONOMOUS, _PROOF, "f and g depend on x alone")
    other, size = _other_graph(graph), f"{graph.agents} agents, {amount(len(graph.edges), 'edge')}"
    remedy = "T7 and T8 of the theory page apply instead"
    if other:
        yield fails(Topic.GRAPH, _PROOF, other, len(graph.edges), size, remedy=remedy)
    else:
        # The paper has unit weights, but its lemmas only need positive ones.
        unit = bool((graph.weights == 1.0).all())
        text = "connected and static" + ("" if unit else "; weights need not be 1")
        yield holds(Topic.GRAPH, _PROOF, text, len(graph.edges), size)
    followers, leaders = len(graph.followers), len(graph.leaders)
    roles = f"{amount(leaders, 'leader')}, {amount(followers, 'follower')}"
    yield holds(Topic.PARENTS, _PROOF, who_hears_whom(graph), leaders, roles)
    extremes = f"lambda_min {at_most(low, 6)}, lambda_max {at_least(high, 6)}"
    yield holds(Topic.GROUNDED, _PROOF, "for the grounded Laplacian", low, extremes)
    if other:
        text = "no eigenvalue of any L has a smaller real part"
        yield fails(Topic.POSITIVE, _PROOF, text, low, at_most(low, 6), remedy=remedy)
    else:
        yield holds(Topic.POSITIVE, _PROOF, "grounded Laplacian", low, at_most(low, 6))
    yield unneeded(Topic.SCHUR, _PROOF, "the LMI is not used")
    # A follower linked to a leader has the weight of that edge on its diagonal but not the leader's
    # column, so its row sums to that weight.
    rows = float(np.abs(graph.grounded_laplacian().sum(axis=1)).max())
    text = "true for rows that sum to zero; the grounded Laplacian's do not"
    remedy = "nothing here uses it: Lemma 1 suffices"
    yield fails(Topic.EDGES, _PROOF, text, rows, f"row sum {about(rows)}", remedy=remedy)


def _other_graph(graph: Graph) -> str:
    """Return how a graph differs from the paper's undirected, static one; empty if it does not."""
    texts = ["directed, with a path from a leader to every agent"] * graph.directed
    if graph.schedule is not None:
        times = ", ".join(f"{at:g}" for at in graph.schedule.starts[1:8])
        texts.append(f"switches at {times} s")
    return "; ".join(texts)


def drift_lines(parts: Parts, settings: Settings, promise: Guarantee) -> Iterator[Statement]:
    """Yield the conditions on leader and drift: Assumptions 4 and 5, Lemma 4, conditions on P."""
    reference = reference_of(getattr(parts.drive, "leader", parts.drive))
    yield _leader_line(promise, reference is not None)
    if reference is not None:
        demand = reference_demand(parts.model, reference, settings.horizon)
        yield _reference_line(parts.model, demand, settings)
    if promise.paper_lines:
        yield from promise.paper_lines
        return
    if not promise.governed:
        conditions = (Topic.MONOTONE, Topic.DRIFT_ALONG_Z, Topic.LMI_AS_PRINTED, Topic.FINITE)
        yield from (unneeded(name, _PROOF, "no P of the law is known") for name in conditions)
        return
    monotone = _monotone_line(parts, promise)
    yield monotone
    both = not promise.hypotheses[Hypothesis.SYMMETRY].fails
    both = both and monotone.verdict is Verdict.HOLDS
    text, remedy = "needs Assumption 5 and symmetric offsets", "see Assumption 5 and the offsets"
    if both:
        yield holds(Topic.DRIFT_ALONG_Z, _LINEAR, text)
    else:
        yield fails(Topic.DRIFT_ALONG_Z, _LINEAR, text, remedy=remedy)
    yield _printed_line(parts, promise)
    yield _finite_line(parts, promise)


def _leader_line(promise: Guarantee, follows: bool) -> Statement:
    """Assumption 4: the leader tracks its reference, by linearization."""
    name, slow = Topic.LEADER_TRACKING, promise.leader_mode
    if slow is None:
        text = "no mode of the leader is known" if follows else "there is no reference"
        return unneeded(name, _PROOF, text)
    if promise.hypotheses[Hypothesis.SMOOTH].fails:
        return vacuous(name, _LINEAR, _NOT_SMOOTH)
    # NaN counts as not damped.
    if slow < -ZERO:
        return holds(name, _LINEAR, "at the trim", slow, f"{at_least(slow)} 1/s")
    text = "the tracking error is not damped at the trim"
    remedy = "give `leader.gain` another method"
    return fails(name, _LINEAR, text, slow, f"{at_least(slow)} 1/s", remedy=remedy)


def _reference_line(model: ControlAffine, demand: ReferenceDemand, settings: Settings) -> Statement:
    limited = settings.limits and model.input_limits is not None
    unit = position_unit(model) or "1"
    sizes = ((demand.speed, f"{unit}/s"), (demand.acceleration, f"{unit}/s^2"))
    # Smaller numbers are rounding of differences.
    numbers = [f"{at_least(round(x, 5))} {unit}" for x, unit in sizes if x is not None]
    numbers += [f"{at_least(100.0 * demand.share)} % of the input range"] if limited else []
    number = demand.share, ", ".join(numbers)
    if not demand.feasible:
        text, remedy = infeasible(model, demand), "give knots that the model can follow"
        return fails(Topic.REFERENCE_DEMAND, Kind.SAMPLES, text, *number, remedy=remedy)
    if limited and demand.share > 1.0:
        text, remedy = too_fast(model, demand), "a path within the limits is needed"
        return fails(Topic.REFERENCE_DEMAND, Kind.SAMPLES, text, *number, remedy=remedy)
    bound = "only the input limits bound it" if limited else "there is no bound"
    text = f"at most, over {settings.horizon:g} s; {bound}"
    return holds(Topic.REFERENCE_DEMAND, Kind.SAMPLES, text, *number)


def _monotone_line(parts: Parts, promise: Guarantee) -> Statement:
    """Assumption 5 for the drift that the followers have, inner loop included, at the trim."""
    name = Topic.MONOTONE
    if not promise.linear:
        return vacuous(name, _LINEAR, _NOT_SMOOTH)
    A, P = promise.loop.linear.A, promise.loop.closed.P
    slope = P @ A + A.T @ P
    worst = float(np.linalg.eigvalsh(slope)[-1])
    # If the drift does not depend on a position, A e = 0 and e'(P A + A'P) e = 0: the largest
    # eigenvalue is then at least 0, which must pass despite rounding.
    number = worst, at_least(worst)
    if worst <= ZERO * max(1.0, float(np.abs(slope).max())):
        return holds(name, _LINEAR, "the drift does not expand P", *number)
    mode = obstacle(A[None])
    if mode is None:
        remedy = "`monotone` or `inner-loop` compute such a P, `riccati` does not need it"
        return fails(name, _LINEAR, "not for this P", *number, remedy=remedy)
    names = ", ".join(f"`{parts.model.state_names[k]}`" for k in mode.states)
    text = f"for no P > 0: mode at {eigenvalue_text(mode.eigenvalue)} 1/s along {names}"
    remedy = "an `inner-loop` gain makes it hold, `riccati` does not need it"
    return fails(name, _LINEAR, text, *number, remedy=remedy)


def _printed_line(parts: Parts, promise: Guarantee) -> Statement:
    """Return the largest eigenvalue of the paper's LMI at this P, for up to four followers."""
    # It fails at any size. Four followers suffice to show it, and the cost grows with the cube of
    # their number.
    some = list(parts.graph.followers[:4])
    goals = np.asarray(parts.model.trim[0]) + parts.formation.offsets[some]
    drifts = goal_drifts(parts.model, parts.formation.offsets, parts.drive)[some]
    largest = float(np.linalg.eigvalsh(printed_lmi(promise.loop.closed.P, goals, drifts))[-1])
    text = "infeasible for every P > 0: its upper left block is zero"
    number, remedy = (largest, f"eigenvalue {about(largest)} > 0"), "use the finite condition"
    return fails(Topic.LMI_AS_PRINTED, _PROOF, text, *number, remedy=remedy)


def _finite_line(parts: Parts, promise: Guarantee) -> Statement:
    """Return the condition (xi_i - xi_j)'P (f(xi_i) - f(xi_j)) <= 0 on pairs of goals."""
    P, name = promise.loop.closed.P, Topic.FINITE
    # The law is the same with a multiple of P and the coupling divided by it.
    P = P / float(np.linalg.eigvalsh(P)[0])
    condition = finite_condition(P, parts.model, parts.formation, parts.drive)
    if condition.verdict is Verdict.VACUOUS:
        text = "f is the same at all goals, so every P passes"
        return vacuous(name, _PROOF, text, 0.0, "0 <= 0")
    every = condition.agents == parts.graph.agents
    kind, largest = _PROOF if every else Kind.SAMPLES, condition.largest
    number = largest, at_least(largest)
    if condition.verdict is Verdict.FAILS:
        text = "goals of agents {} and {} drift apart in this P".format(*condition.pair)
        return fails(name, kind, text, *number, remedy="choose other offsets or P")
    among = "" if every else f", for {condition.agents} of {parts.graph.agents} agents"
    return holds(name, kind, f"only at the goals{among}, not in other states", *number)
