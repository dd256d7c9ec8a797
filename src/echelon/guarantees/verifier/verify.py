"""Independent verification of a saved gain: every claim is recomputed from the file alone.

No code of the synthesis is used: neither its matrix algebra nor its exact arithmetic, hulls or
graphs. The equations of the bundled models are the only shared part.
"""

import warnings
from collections.abc import Iterator, Sequence
from typing import Literal, NamedTuple

import numpy as np

from echelon.agents.models.model import ControlAffine
from echelon.core.digits import about
from echelon.core.errors import GainError
from echelon.core.types import JsonObject, PathLike
from echelon.guarantees.verifier import algebra
from echelon.guarantees.verifier.agent_claims import MODEL as MODEL
from echelon.guarantees.verifier.agent_claims import check_equations
from echelon.guarantees.verifier.findings import VERDICTS, ClaimCheck, decide, facts, unchecked
from echelon.guarantees.verifier.mode_claims import check_graph, check_linearization, check_spectrum
from echelon.guarantees.verifier.region_claims import check_region
from echelon.guarantees.verifier.saved_gain import FORMAT, SavedGain, read, read_json
from echelon.guarantees.verifier.tube_claims import tube_findings, tube_of

# Allowed asymmetry of P after scaling its diagonal to one: rounding of its last digits.
_SKEW = 1e-12
STATED, CLAIMED = "guarantee", "guarantee."
"""Where files state the guarantee of a run, and how its claims begin."""


class Verification(NamedTuple):
    """All findings with their overall verdict.

    Attributes:
        verdict: `refused` if a claim is false, `incomplete` if all checked claims hold and some
            could not be checked, otherwise `verified`.
        note: the end of the sentence, on a correct gain that is not stabilizing.
    """

    findings: tuple[ClaimCheck, ...]
    verdict: Literal["verified", "incomplete", "refused"]
    sentence: str
    note: str = ""

    @property
    def holds(self) -> bool:
        """Whether every claim was checked and holds."""
        return self.verdict == "verified"


def verify(path: PathLike, model: ControlAffine | None = None) -> Verification:
    """Recompute all claims of a saved gain, or of the tube of T5 in a run's guarantee.

    Args:
        path: a file written by `save_gain`; or the `summary.json` of a run or the output of
            `check --json`. Of these two the verdict is at best `incomplete`: what is no part of a
            tube follows from the run's scenario alone, from which `echelon verify` computes it.
        model: the agents' model if it is not bundled. Without it, claims about its equations are
            not checked and the verdict is `incomplete`.

    Raises:
        GainError: the file is neither, or a part is missing or unknown.
    """
    document = read_json(path)
    if "promise" in document and STATED not in document:
        raise GainError(f"`{path}` was written by an earlier version of echelon; make it again.")
    if states_gain(document):
        saved = read(document, path)
        note = f" The gain guarantees no decay: the slowest mode is {about(saved.abscissa)} 1/s."
        return judge(_collect(_findings(saved, model)), "" if saved.abscissa < 0.0 else note)
    return judge(_collect(_guarantee_findings(document[STATED])))


def states_gain(document: JsonObject) -> bool:
    """Return whether a file is to be a gain file, and not one with the guarantee of a run."""
    # A gain first: no key that is added to one may lead to a check of something else.
    return document.get("format") == FORMAT or STATED not in document


def _guarantee_findings(stated: object) -> Iterator[ClaimCheck]:
    if not isinstance(stated, dict):
        yield decide(STATED, False, text="it must be a mapping")
        return
    tube = tube_of(stated)
    if tube is not None:
        yield from tube_findings(tube)
    for key in stated:
        from_ = "run itself" if key == "covered" else "run's scenario alone"
        yield unchecked(f"{CLAIMED}{key}", "", f"it follows from the {from_}")


def _collect(checks: Iterator[ClaimCheck]) -> tuple[ClaimCheck, ...]:
    findings = list[ClaimCheck]()
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


def _findings(saved: SavedGain, model: ControlAffine | None) -> Iterator[ClaimCheck]:
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


def judge(findings: Sequence[ClaimCheck], note: str = "") -> Verification:
    """Return the verdict on findings, with a note; of nothing at all it is `incomplete`."""
    claims = {name: [x.claim for x in findings if x.verdict == name] for name in VERDICTS}
    held = [f"{len(claims['holds'])} claims hold as stored"] if claims["holds"] else []
    agree = ["all values that follow from the scenario agree"] if claims["recomputed"] else []
    text = ", and ".join(held + agree) or "no claim was checked"
    false, open_ = claims["refused"], claims["not checked"]
    if false:
        does = "does" if len(false) == 1 else "do"
        text = f"Refused: {'; '.join(false)} {does} not hold as stored.{note}"
        return Verification(tuple(findings), "refused", text, note)
    if open_ or not findings:
        more = f" and {len(open_) - 3} more" if len(open_) > 4 else ""
        names = "; ".join(open_[:3] if more else open_) + more or "anything"
        text = f"Incomplete: {text}; not checked: {names}.{note}"
        return Verification(tuple(findings), "incomplete", text, note)
    return Verification(tuple(findings), "verified", f"Verified: {text}.{note}", note)


def _check_definite(saved: SavedGain) -> Iterator[ClaimCheck]:
    for name, matrix in (("P", saved.P), ("R", saved.R)):
        units = np.sqrt(np.abs(np.diag(matrix)))
        even = (np.abs(matrix - matrix.T) <= _SKEW * np.outer(units, units)).all()
        fine = bool(even) and algebra.is_positive_definite(
            algebra.rows_of(0.5 * (matrix + matrix.T))
        )
        yield decide(f"{name} is symmetric and positive definite", fine, text="exact minors")
    yield decide("the coupling is positive", saved.coupling > 0.0, saved.coupling)
