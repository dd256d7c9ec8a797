"""An independent check of a saved gain: every promise is recomputed from the file alone.

Nothing of the synthesis is used here: neither its matrices' algebra nor its exact arithmetic, its
hull or its graphs. What is shared is what both speak of, the equations of the bundled models.
"""

import warnings
from collections.abc import Iterator
from typing import Literal, NamedTuple

import numpy as np

from echelon.agents.models.model import ControlAffine
from echelon.core.types import PathLike
from echelon.guarantees.verifier import exact_minors
from echelon.guarantees.verifier.agent_claims import equations
from echelon.guarantees.verifier.findings import Finding, facts, said
from echelon.guarantees.verifier.graph_claims import drawn, spanned
from echelon.guarantees.verifier.mode_claims import linearized
from echelon.guarantees.verifier.region_claims import regional
from echelon.guarantees.verifier.saved_gain import SavedGain, read
from echelon.guarantees.verifier.tube_claims import read_tube, tube_findings

# Rounding in the last digits of P, in units in which its diagonal is one.
_SKEW = 1e-12


class Verification(NamedTuple):
    """All findings, what they come to, and that in a sentence.

    Attributes:
        findings: one a claim.
        verdict: `refused` where a claim does not hold, `incomplete` where all that could be checked
            holds and something could not, else `verified`.
        sentence: the same for a person.
    """

    findings: tuple[Finding, ...]
    verdict: Literal["verified", "incomplete", "refused"]
    sentence: str

    @property
    def holds(self) -> bool:
        """Whether every claim was checked and holds."""
        return self.verdict == "verified"


def verify(path: PathLike, model: ControlAffine | None = None) -> Verification:
    """Recompute what a saved gain, or a run under the law `stopping-point`, promises.

    Args:
        path: a file that `save_gain` wrote; or the `summary.json` of a run, or what `check --json`
            printed, of which the tube of T5 is recomputed.
        model: the agents, where they are no bundled model; without them what rests on their
            equations is not checked, and the verdict is `incomplete`.

    Raises:
        GainError: the file is no gain, or lacks a part.
    """
    tube = read_tube(path)
    if tube is not None:
        return _verdict(_gathered(tube_findings(tube)))
    saved = read(path)
    result = _verdict(_gathered(_findings(saved, model)))
    return result._replace(sentence=result.sentence + _without_decay(saved))


def _gathered(found: Iterator[Finding]) -> tuple[Finding, ...]:
    findings = list[Finding]()
    # Numbers of a false file may overflow: what is not finite fails the comparisons that follow.
    with np.errstate(all="ignore"), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            for finding in found:
                findings.append(finding)
        except (ArithmeticError, LookupError, TypeError, ValueError) as error:
            # Numbers at which an algorithm gives up are no certificate.
            findings.append(said("all of it can be computed", False, text=str(error)))
    return tuple(findings)


def _findings(saved: SavedGain, model: ControlAffine | None) -> Iterator[Finding]:
    first = [*_definite(saved), *drawn(saved)]
    yield from first
    # What follows rests on these.
    if any(item.verdict == "refused" for item in first):
        return
    recomputed = facts(saved)
    first = [*spanned(recomputed)]
    yield from first
    if all(item.verdict != "refused" for item in first):
        yield from linearized(recomputed)
        yield from regional(recomputed)
        yield from equations(recomputed, model)


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


def _without_decay(saved: SavedGain) -> str:
    """Return what a file that tells the truth about a gain that promises nothing is told."""
    if saved.abscissa < 0.0:
        return ""
    return f" By them nothing decays: the slowest mode is {saved.abscissa:.3g} 1/s."


def _definite(saved: SavedGain) -> Iterator[Finding]:
    for name, matrix in (("P", saved.P), ("R", saved.R)):
        units = np.sqrt(np.abs(np.diag(matrix)))
        even = (np.abs(matrix - matrix.T) <= _SKEW * np.outer(units, units)).all()
        fine = bool(even) and exact_minors.is_positive_definite(
            exact_minors.rows_of(0.5 * (matrix + matrix.T))
        )
        yield said(f"{name} is symmetric and positive definite", fine, text="exact minors")
    yield said("the coupling is positive", saved.coupling > 0.0, saved.coupling)
