"""What a check finds of a claim, and what was recomputed that claims rest on."""

from typing import NamedTuple

import numpy as np

from echelon.core.types import Array
from echelon.guarantees.verifier import algebra, exact_minors
from echelon.guarantees.verifier.directed_spectra import directed_spectrum
from echelon.guarantees.verifier.saved_gain import SavedGain

TIGHT = 1e-9
"""A number that was recomputed may differ by this part of itself, and by rounding."""
ROUNDING = 1e-12
"""Rounding of eigenvalues, as a part of the largest of them."""
DECIDED = 1e-6
"""Rounding beyond this part of a rate leaves the rate undecided, and is no credit."""


class Finding(NamedTuple):
    """A claim of the file, what was found, and `holds`, `refused` or `not checked`."""

    claim: str
    stored: str
    found: str
    verdict: str
    text: str


def said(
    claim: str, fine: bool, stored: object = "", found: object = "", text: str = ""
) -> Finding:
    """Return a finding that holds or is refused."""
    return Finding(claim, _shown(stored), _shown(found), "holds" if fine else "refused", text)


def unchecked(claim: str, stored: object, text: str) -> Finding:
    """Return a finding of what could not be checked."""
    return Finding(claim, _shown(stored), "", "not checked", text)


def _shown(value: object) -> str:
    return f"{value:.10g}" if isinstance(value, float) else str(value)


def same(claim: str, stored: float, found: float, slack: float = 0.0, text: str = "") -> Finding:
    """Compare two numbers, to a billionth of themselves and the slack of their rounding."""
    fine = abs(stored - found) <= TIGHT * max(abs(stored), abs(found)) + slack
    return said(claim, fine, stored, found, text)


class Facts(NamedTuple):
    """What was recomputed and later claims rest on.

    Attributes:
        saved: the file.
        eigenvalues: all of the grounded Laplacian, or those that a file without edges holds.
        bound: lambda_min is no less; of a directed graph, what its sum of squares is held by.
        pull: R^-1 B' (m, n), rounded once.
        weighted: B R^-1 B' (n, n), the same.
        feedback: B R^-1 B'P (n, n), the same.
        closed: A of the drift, its inner loop closed (n, n).
        speed: the size of its entries in units that make it small, 1/s.
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
        """Return lambda_max, the largest size of an eigenvalue."""
        return float(np.abs(self.eigenvalues).max())


def facts(saved: SavedGain) -> Facts:
    """Recompute what claims rest on."""
    graph, B = saved.graph, saved.model.B
    edges = None if graph.switches else graph.edges
    # What stands in the file, where nothing says otherwise; of graphs that take turns lambda_min is
    # none of their eigenvalues.
    low = saved.lambda_min if graph.switches else float(np.real(graph.spectrum[0]))
    values, bound = graph.spectrum, low
    if edges is not None and graph.directed:
        values, low, bound = directed_spectrum(graph, edges)
    elif edges is not None:
        values, bound = algebra.spectrum(graph, edges)
        low = float(values[0])
    closed = saved.model.A if saved.inner is None else saved.model.A - B @ saved.inner
    return Facts(
        saved,
        values,
        bound,
        *exact_minors.weighted(B, saved.R, saved.P),
        closed,
        algebra.size(closed),
        low,
    )
