"""What followed each event of a run: how large errors became, and when all were small again."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Int

from echelon.core.types import JsonObject
from echelon.guarantees.promises.hypotheses import events_in_words
from echelon.guarantees.promises.promise import guarantee
from echelon.simulation.engine.result import Result, finite_or_none
from echelon.simulation.step.meter import SETTLED


class EventOutcome(NamedTuple):
    """What followed an event, until the next one, in the stored frames.

    Attributes:
        at: when it happened, s.
        peak: the largest error of a follower that is there; None without a frame.
        restored: from when on all of these stayed below 1 cm, s; None if they did not.
        until: of the last frame before the next event, s.
        leader: who leads from then on, and its largest distance from the path; None where that does
            not change, or nobody follows a path.
        near: the scaled distance to another agent at which one joins that keeps apart, m, where it
            is less than what they keep; else None.
        sampled: whether there are steps between the frames.
    """

    at: float
    text: str
    peak: float | None
    restored: float | None
    until: float
    unit: str
    leader: tuple[int, float] | None
    near: float | None
    guarantee: str
    sampled: bool = False

    def as_mapping(self) -> JsonObject:
        """Return what was observed, ready for JSON."""
        names = ("at", "peak", "restored", "until", "leader", "near")
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
        seen = f"in the stored frames {seen}" if self.sampled else seen
        if self.leader is not None:
            agent, off = self.leader
            away = f"{off:.3g} {self.unit}".rstrip()
            seen += f"; agent {agent} leads, {away} off the path at most"
        if self.near is not None:
            seen += f"; it joins {self.near:.3g} m from another agent, nearer than hulls keep"
        return f"{text}: {seen}. {self.guarantee}"


def event_outcomes(result: Result) -> tuple[EventOutcome, ...]:
    """Return what followed each event of a run that it reached, by time."""
    listed = events_in_words(result.parts, guarantee(result.parts, result.settings))
    ends = [*(event["at"] for event in listed), np.inf][1:]
    return tuple(
        _outcome(result, event, end)
        for event, end in zip(listed, ends, strict=True)
        if len(result.times) and event["at"] <= result.times[-1]
    )


def _outcome(result: Result, event: JsonObject, end: float) -> EventOutcome:
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
        leader=_new_leader(result, frames),
        near=_too_near(result, event, frames),
        guarantee=event["guarantee"]["sentence"],
        sampled=result.settings.store_every > 1,
    )


def _new_leader(result: Result, frames: Int[np.ndarray, " F"]) -> tuple[int, float] | None:
    """Return who leads in frames but not before, and its largest distance from the path."""
    if result.presence is None or result.reference is None or not len(frames) or not frames[0]:
        return None
    old, new = (int(result.nearest_then[k, 0]) for k in (frames[0] - 1, frames[0]))
    if old == new:
        return None
    own = result.offsets_in(frames)[..., new, :]
    off = result.states[frames, new] - result.reference[frames] - own
    return new, float(np.linalg.norm(off[:, list(result.measured)], axis=1).max())


def _too_near(result: Result, event: JsonObject, frames: Int[np.ndarray, " F"]) -> float | None:
    safety, here = result.drive.safety, result.presence
    if safety is None or here is None or event["what"] != "join" or not len(frames):
        return None
    [agent], first = event["agents"], int(frames[0])
    places = result.states[first][:, list(result.position)] * safety.scales(result.model)
    others = here[first] & (np.arange(len(places)) != agent)
    least = np.linalg.norm(places[others] - places[agent], axis=1).min(initial=np.inf)
    return float(least) if least < safety.distance else None
