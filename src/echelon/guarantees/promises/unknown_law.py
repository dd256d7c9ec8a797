"""The verdict on laws that echelon does not know: no guarantee is computed."""

import dataclasses
from types import MappingProxyType
from typing import final

from echelon.core.statement import Cause, Hypothesis, fails, unneeded
from echelon.core.words import Kind
from echelon.guarantees.promises.closed_loop import loop_of
from echelon.guarantees.promises.hypotheses import trim_line
from echelon.guarantees.promises.promise import REQUIRED, Guarantee, unknown_in
from echelon.simulation.engine.prepare import Prepared
from echelon.simulation.step.settings import Settings

_REASON = "echelon does not know this law; no guarantee is computed"
_REASON_MEMBERS = "echelon does not know all members of the step; no guarantee is computed"
_REMEDY_MEMBERS = "leave out `members` of the world"
_ASKED = (
    Hypothesis.TRIM_APPLIED,
    Hypothesis.TRIM_WITHIN_LIMITS,
    Hypothesis.EXACT_STATES,
    Hypothesis.LEADERS_AGREE,
    Hypothesis.DETECTABLE,
    Hypothesis.COUPLING,
    Hypothesis.ALONG_PATH,
    Hypothesis.REGION,
    Hypothesis.SET,
    Hypothesis.STARTS,
    *REQUIRED,
)
"""What a guarantee by linearization, or by a metric, has a line on."""
_REMEDY = "use a bundled law, or name a `prover` of your own"


@final
@dataclasses.dataclass(frozen=True, eq=False, kw_only=True)
class UnknownLaw(Guarantee):
    """What is said of a run under a law whose code is a user's own."""

    @classmethod
    def of(cls, prepared: Prepared, settings: Settings, brief: bool = False) -> "UnknownLaw":
        """Return that nothing is guaranteed, and what of the agents and the world is known."""
        parts = prepared.parts
        text = f"echelon does not know {unknown_in(parts)}"
        lines = {each: unneeded(each, Kind.LINEARIZATION, text) for each in _ASKED}
        lines[Hypothesis.TRIM_WITHIN_LIMITS] = trim_line(parts, settings)
        name, own = Hypothesis.DISAGREEMENT_DECAY, parts.drive.unknown
        remedy, reason = (_REMEDY, _REASON) if own else (_REMEDY_MEMBERS, _REASON_MEMBERS)
        lines[name] = fails(name, Kind.LINEARIZATION, text, remedy=remedy, reason=reason)
        return cls(
            loop=loop_of(parts), hypotheses=MappingProxyType(lines), without="", leader_mode=None
        )

    @property
    def governed(self) -> bool:
        """Whether the loop near the trim is known: it is not."""
        return False

    @property
    def ground(self) -> None:
        """What a theorem says: nothing."""

    @property
    def rate(self) -> None:
        """At what rate errors shrink: it is not known."""

    @property
    def slowest(self) -> None:
        """The slowest mode near the trim: it is not known."""

    @property
    def causes(self) -> tuple[Cause, ...]:
        """What explains that errors do not shrink: nothing is known."""
        return ()

    def longest_step(self, settings: Settings) -> float:
        """Return the longest step (s) with which modes decay: none is known."""
        return 0.0

    def guarantee(self) -> str:
        """Return what is guaranteed: nothing."""
        return ""

    def why_covered(self) -> str:
        """Return why a theorem covers a run: none does."""
        return ""
