"""Findings of the verifier, and the recomputed quantities that several claims use."""

from typing import NamedTuple

import numpy as np

from echelon.core.types import Array
from echelon.guarantees.verifier import algebra
from echelon.guarantees.verifier.algebra import directed_spectrum
from echelon.guarantees.verifier.saved_gain import SavedGain

TIGHT = 1e-9
"""Relative difference allowed between a stored and a recomputed number, besides rounding."""
ROUNDING = 1e-12
"""Rounding of eigenvalues relative to the largest one."""
DECIDED = 1e-6
"""A rate is undecided if its rounding exceeds this fraction of it."""

VERDICTS = ("holds", "recomputed", "refused", "not checked")
"""Verified by code of its own; equal to what the code gives again that made it; false; open."""


class ClaimCheck(NamedTuple):
    """A claim of the file with its stored and recomputed value, and one of the `VERDICTS`.

    `by_scenario` is true of what was computed from a scenario, and not by independent code.
    """

    claim: str
    stored: str
    value: str
    verdict: str
    text: str
    by_scenario: bool = False

    @property
    def open(self) -> bool:
        """Whether the claim could not be checked."""
        return self.verdict == "not checked"

    def as_mapping(self) -> dict[str, str]:
        """Return the finding for JSON, where the recomputed value has the key `found`."""
        means = "scenario" if self.by_scenario else "independent code"
        return {
            "claim": self.claim,
            "stored": self.stored,
            "found": self.value,
            "verdict": self.verdict,
            "text": self.text,
            "means": means,
        }


def decide(
    claim: str, fine: bool, stored: object = "", value: object = "", text: str = ""
) -> ClaimCheck:
    """Return a finding with the verdict `holds` or `refused`."""
    return ClaimCheck(claim, _text(stored), _text(value), "holds" if fine else "refused", text)


def unchecked(claim: str, stored: object, text: str) -> ClaimCheck:
    """Return a finding for a claim that could not be checked."""
    return ClaimCheck(claim, _text(stored), "", "not checked", text)


def _text(value: object) -> str:
    return f"{value:.10g}" if isinstance(value, float) else str(value)


def compare(
    claim: str, stored: float, value: float, slack: float = 0.0, text: str = ""
) -> ClaimCheck:
    """Compare two numbers with the relative tolerance `TIGHT` plus their rounding `slack`."""
    fine = abs(stored - value) <= TIGHT * max(abs(stored), abs(value)) + slack
    return decide(claim, fine, stored, value, text)


class Recomputed(NamedTuple):
    """Recomputed quantities that several claims use.

    Attributes:
        eigenvalues: of the grounded Laplacian; the stored ones if the file has no edges.
        bound: a lower bound of lambda_min; for a directed graph, of the decay of its weighted sum.
        pull: R^-1 B' (m, n), rounded once.
        weighted: B R^-1 B' (n, n), rounded once.
        feedback: B R^-1 B'P (n, n), rounded once.
        closed: A with the inner loop closed, (n, n).
        speed: the norm of `closed` after balancing, 1/s.
        least: lambda_min.
    """

    saved: SavedGain
    eigenvalues: Array
    bound: float
    pull: Array
    weighted: Array
    feedback: Array
    closed: Array
    speed: float
    least: float

    @property
    def low(self) -> float:
        """Return lambda_min."""
        return self.least

    @property
    def high(self) -> float:
        """Return lambda_max, the largest absolute value of an eigenvalue."""
        return float(np.abs(self.eigenvalues).max())


def facts(saved: SavedGain) -> Recomputed:
    """Recompute the quantities that several claims use."""
    graph, B = saved.graph, saved.model.B
    edges = None if graph.switches else graph.edges
    # Stored values are used if there are no edges. For switching graphs lambda_min is a bound over
    # all graphs and no eigenvalue of the union.
    low = saved.lambda_min if graph.switches else float(np.real(graph.spectrum[0]))
    values, bound = graph.spectrum, low
    if edges is not None and graph.directed:
        values, low, bound = directed_spectrum(graph, edges)
    elif edges is not None:
        values, bound = algebra.spectrum(graph, edges)
        low = float(values[0])
    closed = saved.model.A if saved.inner is None else saved.model.A - B @ saved.inner
    return Recomputed(
        saved,
        values,
        bound,
        *algebra.weighted(B, saved.R, saved.P),
        closed,
        algebra.size(closed),
        low,
    )
