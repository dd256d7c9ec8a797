"""The finite condition on P that the paper's LMI was meant to state: linear in P, and often empty.

At the goals alone it reads P >= I and (xi_i - xi_j)'P (f(xi_i) - f(xi_j)) <= 0 for all pairs of
agents. The paper writes d_ij = xi_j - xi_i for the first factor, which turns the sign.
"""

from typing import NamedTuple

import numpy as np

from echelon.agents.models.model import ControlAffine
from echelon.agents.network.formation import Formation
from echelon.core.errors import GainError
from echelon.core.linear import check_definite
from echelon.core.types import Array
from echelon.core.words import Verdict
from echelon.guarantees.promises.hypotheses import goal_drifts
from echelon.laws.law import Law
from echelon.simulation.step.drive import Drive

_ZERO = 1e-9  # what rounding makes of f at goals that are symmetric
_MOST = 1000  # agents that are compared pair by pair; of more, so many spread over all
_ROWS = 128  # pairs are made by so many agents at a time, for memory


class FiniteCondition(NamedTuple):
    """What the paper's finite condition says of a P.

    Attributes:
        verdict: vacuous where f is the same at all goals, so that every P >= I passes.
        largest: of (xi_i - xi_j)'P (f(xi_i) - f(xi_j)) over the pairs; at most 0 where it holds.
        pair: the agents that give it.
        least: smallest eigenvalue of P; at least 1 where it holds.
        agents: how many agents' goals were compared: all up to a thousand.
    """

    verdict: Verdict
    largest: float
    pair: tuple[int, int]
    least: float
    agents: int


def finite_condition(
    P: Array, model: ControlAffine, formation: Formation, law: Law | Drive | None = None
) -> FiniteCondition:
    """Say whether P meets the finite condition at a formation's goals, the leaders' included.

    It is homogeneous in P but for P >= I: of a P that only that part refuses, a multiple passes.
    It says nothing of other states than the goals about the trim.

    Args:
        P: (n, n) symmetric.
        model: gives f, about the trim.
        formation: gives the goals.
        law: the followers' law, or what drives them; an inner loop belongs to the drift.

    Raises:
        GainError: P is not symmetric positive definite, or is made for another number of states.
    """
    P, n = np.asarray(P, float), len(model.state_names)
    if P.shape != (n, n):
        raise GainError(f"`P` has shape {P.shape}, and `{type(model).__name__}` needs {(n, n)}.")
    check_definite("P", P)
    offsets = formation.offsets
    drifts = goal_drifts(model, offsets, law)
    # Relative to f; absolute where f is near 0, since it may be the difference of larger terms.
    size = max(1.0, float(np.abs(drifts).max()))
    least = float(np.linalg.eigvalsh(P)[0])
    if float(np.ptp(drifts, axis=0).max()) <= _ZERO * size:
        verdict = Verdict.VACUOUS if least >= 1.0 - _ZERO else Verdict.FAILS
        return FiniteCondition(verdict, 0.0, (0, 0), least, len(offsets))
    # Spread over all: agents next to each other in number mostly are in space, and the first
    # thousand would be one corner of the formation.
    some = np.unique(np.linspace(0, len(offsets) - 1, min(_MOST, len(offsets))).astype(int))
    largest, (i, j) = _largest(P, offsets[some], drifts[some])
    holds = largest <= _ZERO * size * float(np.abs(P).max()) and least >= 1.0 - _ZERO
    pair = (int(some[i]), int(some[j]))
    return FiniteCondition(Verdict.of(holds), largest, pair, least, len(some))


def pair_values(P: Array, d: Array, f: Array) -> Array:
    """Return d'P f for each pair, (...), from differences of goals and of drifts (..., n)."""
    return np.einsum("...a,ab,...b->...", d, P, f)


def _largest(P: Array, offsets: Array, drifts: Array) -> tuple[float, tuple[int, int]]:
    """Return the largest value over all pairs, and the pair."""
    best, at = -np.inf, (0, 0)
    for start in range(0, len(offsets), _ROWS):
        rows = slice(start, start + _ROWS)
        values = pair_values(
            P, offsets[rows, None] - offsets[None], drifts[rows, None] - drifts[None]
        )
        # An agent and itself are no pair.
        values[np.arange(len(values)), np.arange(start, start + len(values))] = -np.inf
        i, j = np.unravel_index(int(values.argmax()), values.shape)
        if values[i, j] > best:
            best, at = float(values[i, j]), (start + int(i), int(j))
    return best, at
