"""What followed each event of a run: how large errors became, and when all were small again."""

from typing import NamedTuple

import numpy as np

from echelon.core.types import JsonObject
from echelon.guarantees.promises.event_lines import events_in_words
from echelon.guarantees.promises.promise import promise
from echelon.simulation.engine.result import Result, finite_or_none
from echelon.simulation.step.meter import SETTLED


class EventOutcome(NamedTuple):
    """What followed an event, until the next one, in the stored frames.

    Attributes:
        at: when it happened, s.
        text: what happened, in words.
        peak: the largest error of a follower that is there; None without a frame.
        restored: from when on all of these stayed below 1 cm, s; None if they did not.
        until: of the last frame before the next event, s.
        unit: of errors.
        guarantee: what is guaranteed through it, in words.
    """

    at: float
    text: str
    peak: float | None
    restored: float | None
    until: float
    unit: str
    guarantee: str

    def as_mapping(self) -> JsonObject:
        """Return what was observed, ready for JSON."""
        names = ("at", "peak", "restored", "until")
        return {name: getattr(self, name) for name in names}

    def sentence(self) -> str:
        """Return it in a sentence or two."""
        text = f"{self.text[0].upper()}{self.text[1:]} at {self.at:g} s"
        if self.peak is None:
            return f"{text}, after which no frame is stored. {self.guarantee}"
        limit = f"{SETTLED:g} {self.unit}".rstrip()
        size = f"{self.peak:.3g} {self.unit}".rstrip()
        if self.peak <= SETTLED:
            seen = f"errors stay below {limit}, with a peak of {size}"
        elif self.restored is None:
            seen = f"errors reach {size}, and are not below {limit} by {self.until:.4g} s"
        else:
            seen = f"errors reach {size}, and stay below {limit} from {self.restored:.4g} s on"
        return f"{text}: {seen}. {self.guarantee}"


def event_outcomes(result: Result) -> tuple[EventOutcome, ...]:
    """Return what followed each event of a run that it reached, by time."""
    listed = events_in_words(result.parts, promise(result.parts, result.settings))
    ends = [*(event["at"] for event in listed), np.inf][1:]
    return tuple(
        _outcome(result, event, end)
        for event, end in zip(listed, ends, strict=True)
        if len(result.times) and event["at"] <= result.times[-1]
    )


def _outcome(result: Result, event: JsonObject, end: float) -> EventOutcome:
    """Return what followed an event until another time."""
    late, times = 0.5 * result.settings.dt, result.times
    # A change acts from the first step on that does not begin before it.
    frames = np.flatnonzero((times >= event["at"] - late) & (times < end - late))
    errors = result.goal_distances(frames)[:, list(result.graph.followers)]
    worst = errors.max(axis=1, initial=0.0)
    large = np.flatnonzero(~(worst <= SETTLED))
    first = int(large[-1]) + 1 if len(large) else 0
    restored = float(times[frames[first]]) if first < len(frames) else None
    return EventOutcome(
        at=event["at"],
        text=event["text"],
        peak=finite_or_none(worst.max()) if len(frames) else None,
        restored=restored,
        until=float(times[frames[-1]]) if len(frames) else event["at"],
        unit=result.length_unit,
        guarantee=event["guarantee"]["sentence"],
    )
