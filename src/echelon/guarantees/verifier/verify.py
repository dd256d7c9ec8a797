"""Independent verification of a saved gain: every claim is recomputed from the file alone.

No code of the synthesis is used: neither its matrix algebra nor its exact arithmetic, hulls or
graphs. The equations of the bundled models are the only shared part.
"""

import warnings
from collections.abc import Iterator
from typing import Literal, NamedTuple

import numpy as np

from echelon.agents.models.model import ControlAffine
from echelon.core.types import PathLike
from echelon.guarantees.verifier import exact_minors
from echelon.guarantees.verifier.agent_claims import check_equations
from echelon.guarantees.verifier.findings import Finding, decide, facts
from echelon.guarantees.verifier.graph_claims import check_graph, check_spectrum
from echelon.guarantees.verifier.mode_claims import check_linearization
from echelon.guarantees.verifier.region_claims import check_region
from echelon.guarantees.verifier.saved_gain import SavedGain, read
from echelon.guarantees.verifier.tube_claims import read_tube, tube_findings

# Allowed asymmetry of P after scaling its diagonal to one: rounding of its last digits.
_SKEW = 1e-12


class Verification(NamedTuple):
    """All findings with their overall verdict.

    Attributes:
        findings: one per claim.
        verdict: `refused` if a claim does not hold, `incomplete` if all checked claims hold and
            some could not be checked, otherwise `verified`.
        sentence: the verdict as text.
    """

    findings: tuple[Finding, ...]
    verdict: Literal["verified", "incomplete", "refused"]
    sentence: str

    @property
    def holds(self) -> bool:
        """Whether every claim was checked and holds."""
        return self.verdict == "verified"


def verify(path: PathLike, model: ControlAffine | None = None) -> Verification:
    """Recompute all claims of a saved gain, or of a run under the law `stopping-point`.

    Args:
        path: a file written by `save_gain`; or the `summary.json` of a run or the output of
            `check --json`, of which the tube of T5 is recomputed.
        model: the agents' model if it is not bundled. Without it, claims about its equations are
            not checked and the verdict is `incomplete`.

    Raises:
        GainError: the file is not a gain file, or a part is missing.
    """
    tube = read_tube(path)
    if tube is not None:
        return _verdict(_collect(tube_findings(tube)))
    saved = read(path)
    result = _verdict(_collect(_findings(saved, model)))
    return result._replace(sentence=result.sentence + _no_decay_sentence(saved))


def _collect(checks: Iterator[Finding]) -> tuple[Finding, ...]:
    findings = list[Finding]()
    # Numbers of a false file may overflow; comparisons with non-finite numbers then fail.
    with np.errstate(all="ignore"), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            for finding in checks:
                findings.append(finding)
        except (ArithmeticError, LookupError, TypeError, ValueError) as error:
            # A claim is refused if its computation fails: nothing was shown.
            findings.append(decide("all of it can be computed", False, text=str(error)))
    return tuple(findings)


def _findings(saved: SavedGain, model: ControlAffine | None) -> Iterator[Finding]:
    first = [*_check_definite(saved), *check_graph(saved)]
    yield from first
    # All later claims assume a valid graph and positive definite matrices.
    if any(item.verdict == "refused" for item in first):
        return
    recomputed = facts(saved)
    first = [*check_spectrum(recomputed)]
    yield from first
    if all(item.verdict != "refused" for item in first):
        yield from check_linearization(recomputed)
        yield from check_region(recomputed)
        yield from check_equations(recomputed, model)


def _verdict(findings: tuple[Finding, ...]) -> Verification:
    refused = [item.claim for item in findings if item.verdict == "refused"]
    open_ = [item.claim for item in findings if item.verdict == "not checked"]
    count = f"{len(findings) - len(open_)} claims hold as stored"
    if refused:
        does = "does" if len(refused) == 1 else "do"
        text = f"Refused: {'; '.join(refused)} {does} not hold as stored."
        return Verification(findings, "refused", text)
    if open_:
        text = f"Incomplete: {count}, and could not be checked: {'; '.join(open_)}."
        return Verification(findings, "incomplete", text)
    return Verification(findings, "verified", f"Verified: {count}.")


def _no_decay_sentence(saved: SavedGain) -> str:
    """Return the sentence that is added for a correct file whose gain is not stabilizing."""
    if saved.abscissa < 0.0:
        return ""
    return f" The gain guarantees no decay: the slowest mode is {saved.abscissa:.3g} 1/s."


def _check_definite(saved: SavedGain) -> Iterator[Finding]:
    for name, matrix in (("P", saved.P), ("R", saved.R)):
        units = np.sqrt(np.abs(np.diag(matrix)))
        even = (np.abs(matrix - matrix.T) <= _SKEW * np.outer(units, units)).all()
        fine = bool(even) and exact_minors.is_positive_definite(
            exact_minors.rows_of(0.5 * (matrix + matrix.T))
        )
        yield decide(f"{name} is symmetric and positive definite", fine, text="exact minors")
    yield decide("the coupling is positive", saved.coupling > 0.0, saved.coupling)
