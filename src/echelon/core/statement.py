"""Statements of a check: the verdict, the kind of the argument, and a remedy."""

import dataclasses
import re
from typing import NamedTuple, TypeAlias, final

from echelon.core.digits import finite_or_none
from echelon.core.words import Kind, Verdict, Word


class Hypothesis(Word):
    """What a promise rests on; the value is what tables call it."""

    TRIM_APPLIED = "Definition 1, f(0) = 0"
    TRIM_WITHIN_LIMITS = "trim within the limits"
    EXACT_STATES = "Assumption 3, exact states"
    LEADERS_AGREE = "leaders agree"
    LEADER = "leader stays at its trim"
    SYMMETRY = "offsets are symmetries"
    REPEATS = "a step repeats"
    REST = "rest at the goals"
    SMOOTH = "smooth at the trim"
    DETECTABLE = "detectability of (A, g'P)"
    MATCHED_MOTION = "leader's motion is matched"
    MESSAGES = "late or lost messages"
    AGES = "messages of one age"
    OWN_STATE = "own state late, motors lag"
    COUPLING = "coupling"
    DISAGREEMENT_DECAY = "disagreement decays"
    ALONG_PATH = "law along the leader's path"
    HEADING_FRAME = "law turns with the heading"
    SPEEDS = "speeds of the path"
    SAMPLING = "step, input held"
    SWITCHING = "graphs that take turns"
    EVENTS = "events of the run"
    REGION = "region of the gain"
    SET = "certified set"
    STARTS = "starts in the certified set"
    SEPARATION = "distance between agents"
    LIMITS = "inputs within limits"
    HELD = "set, inputs held"
    CLAIMS = "claims of the gain"


class Topic(Word):
    """What else a check says; the value is what tables call it."""

    AUTONOMOUS = "Assumption 1, autonomous"
    GRAPH = "Assumption 2, graph"
    PARENTS = "who follows whom"
    GROUNDED = "Assumption 6, M L = I"
    POSITIVE = "Lemma 1, L > 0"
    SCHUR = "Lemma 2, Schur complement"
    EDGES = "Lemma 3, sum over edges"
    LEADER_TRACKING = "Assumption 4, leader tracks"
    REFERENCE_DEMAND = "reference, what it asks"
    MONOTONE = "Assumption 5, P-monotone drift"
    DRIFT_ALONG_Z = "Lemma 4, drift along z"
    LMI_AS_PRINTED = "LMI as printed"
    FINITE = "finite condition on P"
    MARGINS = "margins"
    GAIN = "gain margin"
    DELAY = "delay margin"
    EIGENVALUE_RATIO = "lambda_max by lambda_min"
    SCALING = "input scaling"
    DISTURBANCE_NETWORK = "disturbance, network"
    DISTURBANCE_MODE = "disturbance, one mode"
    STRING = "string gain"
    INTEGRAL = "integral action"


Line: TypeAlias = Hypothesis | Topic
"""What a line of a check is about."""


class Cause(NamedTuple):
    """Why nothing is guaranteed and what would be needed; neither is empty."""

    text: str
    remedy: str


_UNITS = {"1/s": ("1/s", 1.0), "ms": ("s", 1e-3), "s": ("s", 1.0), "m": ("m", 1.0), "N": ("N", 1.0)}
"""How a table writes a number's unit, the unit of the number itself, and the factor between."""
_UNIT = re.compile(r"^(?P<number>[-+.\de]+)(?: \.\. [-+.\de]+)? (?P<unit>1/s|ms|s|m|N)(?![\w/^])")


@final
@dataclasses.dataclass(frozen=True)
class Statement:
    """A hypothesis of a promise, or another line of a check; what fails has a remedy.

    Attributes:
        statement: its name.
        verdict: whether it holds.
        kind: of the argument.
        number: behind the verdict; None where there is none.
        number_text: the number as a table has it, with its unit.
        text: what was found, in words.
        remedy: what would be needed; empty where nothing fails.
        reason: what the failure says against any promise; empty where it leaves one.
        condition: what the claim is conditional on, since the failure leaves it to the run.
        limit: beside which the number stands, in its unit; None where there is none.
    """

    statement: Line
    verdict: Verdict
    kind: Kind
    number: float | None = None
    number_text: str = ""
    text: str = ""
    remedy: str = ""
    reason: str = ""
    condition: str = ""
    limit: float | None = None

    def __post_init__(self) -> None:
        """Hold that nobody is left with a failure and nothing to do."""
        assert self.remedy or not self.fails, f"`{self.name}` fails without a remedy"

    @property
    def cause(self) -> Cause:
        """What was found and what to do about it, of one that fails."""
        return Cause(self.text, self.remedy)

    @property
    def name(self) -> str:
        """What tables call it."""
        return self.statement.value

    @property
    def fails(self) -> bool:
        """Whether it was found false."""
        return self.verdict is Verdict.FAILS

    @property
    def unit(self) -> str:
        """The unit of the number, where a table begins with this number and a unit."""
        named = _UNIT.match(self.number_text)
        if named is None or self.number is None:
            return ""
        unit, factor = _UNITS[named["unit"]]
        shown = factor * float(named["number"])
        return unit if abs(shown - self.number) <= 0.02 * abs(self.number) else ""

    @property
    def shown_verdict(self) -> str:
        """The verdict of a table: what fails and is no condition of a guarantee is a note."""
        noted = self.fails and not isinstance(self.statement, Hypothesis)
        return "note" if noted else str(self.verdict)

    @property
    def explanation(self) -> str:
        """What was found and what would be needed."""
        return f"{self.text}; {self.remedy}" if self.remedy else self.text

    def as_mapping(self) -> dict[str, str | float | None]:
        """Return it ready for JSON, where a number that is not finite is None."""
        return {
            "name": self.name,
            "verdict": str(self.verdict),
            "kind": str(self.kind),
            "value": finite_or_none(self.number),
            "limit": finite_or_none(self.limit),
            "unit": self.unit,
            "shown": self.number_text,
            "text": self.text,
            "remedy": self.remedy,
            "reason": self.reason,
            "while": self.condition,
        }


def holds(
    statement: Line,
    kind: Kind,
    text: str,
    number: float | None = None,
    number_text: str = "",
    limit: float | None = None,
) -> Statement:
    """Return the line of what was found true."""
    return Statement(statement, Verdict.HOLDS, kind, number, number_text, text, limit=limit)


def fails(
    statement: Line,
    kind: Kind,
    text: str,
    number: float | None = None,
    number_text: str = "",
    limit: float | None = None,
    *,
    remedy: str,
    reason: str = "",
) -> Statement:
    """Return the line of what was found false; with a `reason` it rules out any guarantee."""
    numbers = number, number_text, text, remedy, reason
    return Statement(statement, Verdict.FAILS, kind, *numbers, limit=limit)


def unneeded(
    statement: Line, kind: Kind, text: str, number: float | None = None, number_text: str = ""
) -> Statement:
    """Return the line of what nothing else here rests on."""
    return Statement(statement, Verdict.NOT_NEEDED, kind, number, number_text, text)


def vacuous(
    statement: Line, kind: Kind, text: str, number: float | None = None, number_text: str = ""
) -> Statement:
    """Return the line of what has no meaning here."""
    return Statement(statement, Verdict.VACUOUS, kind, number, number_text, text)


NO_LIMIT = "no input of any agent is at a limit"
"""The condition of a claim that limits may break."""
_WITHOUT_LIMITS = "see whether a run is covered, or set `simulation.limits: false`"


def left_to_run(
    statement: Line,
    condition: str,
    text: str,
    number: float | None = None,
    number_text: str = "",
    remedy: str = _WITHOUT_LIMITS,
    kind: Kind = Kind.PROOF,
) -> Statement:
    """Return the line of a claim that holds only under a condition that a run shows, and why."""
    line = fails(statement, kind, text, number, number_text, remedy=remedy)
    return dataclasses.replace(line, condition=condition)
