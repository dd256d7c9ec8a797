"""The finite condition on P that the paper's LMI was meant to state: linear in P, and often empty.

At the goals alone it reads P >= I and (xi_i - xi_j)'P (f(xi_i) - f(xi_j)) <= 0 for all pairs of
agents. The paper writes d_ij = xi_j - xi_i for the first factor, which turns the sign.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from echelon.agents.models.model import ControlAffine
from echelon.agents.network.formation import Formation
from echelon.core.errors import GainError
from echelon.core.linear import check_definite
from echelon.core.types import Array
from echelon.core.words import Verdict
from echelon.guarantees.promises.hypotheses import goal_drifts
from echelon.laws.law import Law
from echelon.simulation.step.drive import Drive

_ZERO = 1e-9  # relative rounding of f at symmetric goals
_MOST = 1000  # agents compared pair by pair; of more, this many spread over all
_ROWS = 128  # agents whose pairs are computed at once, to bound memory


class FiniteCondition(NamedTuple):
    """Whether a P meets the paper's finite condition.

    Attributes:
        verdict: vacuous where f is the same at all goals, so that every P >= I passes.
        largest: of (xi_i - xi_j)'P (f(xi_i) - f(xi_j)) over the pairs; at most 0 where it holds.
        pair: the agents with that value.
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
    law: Law | Drive | None = None,
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
    """Return the largest value over all pairs, and the pair."""
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
