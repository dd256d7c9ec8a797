"""One statement that was looked at: its verdict, by which kind of argument, and what would help."""

from typing import Any, NamedTuple

from echelon.core.words import Kind, Verdict, Word


class Hypothesis(Word):
    """What a promise rests on; the value is what tables call it."""

    TRIM_APPLIED = "Definition 1, f(0) = 0"
    TRIM_HELD = "trim within the limits"
    EXACT = "Assumption 3, exact states"
    AGREEMENT = "leaders agree"
    SYMMETRY = "offsets are symmetries"
    SMOOTH = "smooth at the trim"
    DETECTABLE = "detectability of (A, g'P)"
    MATCHED = "leader's motion is matched"
    COUPLED = "coupling"
    DECAYS = "disagreement decays"
    ALONG = "law along the leader's path"
    STEP = "step, input held"
    REGION = "region of the gain"
    SET = "certified set"
    STARTS = "starts in the certified set"
    CLAIMS = "claims of the gain"


class Statement(NamedTuple):
    """A hypothesis of a promise, or another line of a check.

    Attributes:
        statement: its name.
        verdict: whether it holds.
        kind: of the argument.
        number: behind the verdict; None where there is none.
        shown: the number as a table has it, with its unit.
        text: what was found, in words.
        remedy: what would be needed; empty where nothing is.
        reason: what the failure says against any promise; empty where it leaves one.
    """

    statement: Hypothesis | str
    verdict: Verdict
    kind: Kind
    number: float | None = None
    shown: str = ""
    text: str = ""
    remedy: str = ""
    reason: str = ""

    @property
    def name(self) -> str:
        """What tables call it."""
        return self.statement.value if isinstance(self.statement, Hypothesis) else self.statement

    @property
    def fails(self) -> bool:
        """Whether it was found false."""
        return self.verdict is Verdict.FAILS

    @property
    def explanation(self) -> str:
        """What was found and what would be needed."""
        return f"{self.text}; {self.remedy}" if self.remedy else self.text

    def as_mapping(self) -> dict[str, Any]:
        """Return it ready for JSON, where a number that is not finite is None."""
        finite = self.number is not None and abs(self.number) < float("inf")
        return {
            "statement": self.name,
            "verdict": str(self.verdict),
            "kind": str(self.kind),
            "number": self.number if finite else None,
            "shown": self.shown,
            "text": self.text,
            "remedy": self.remedy,
        }
