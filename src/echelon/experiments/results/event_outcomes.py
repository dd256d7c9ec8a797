"""What followed each event of a run: how large errors became, and when all were small again."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Int

from echelon.core.digits import finite_or_none
from echelon.core.types import JsonObject
from echelon.guarantees.promises.hypotheses import events_in_words
from echelon.guarantees.promises.promise import guarantee
from echelon.simulation.engine.result import Result
from echelon.simulation.step.meter import SETTLED, event_steps


class EventOutcome(NamedTuple):
    """What followed an event, until the next one, over all steps.

    Attributes:
        at: when it happened, s.
        peak: the largest error of a follower that is there; None if it is not finite.
        restored: from when on all of these stayed below 1 cm, s; None if they did not.
        until: of the last step before the next event, s.
        leader: who leads from then on, and its largest distance from the path in the stored frames;
            None where that does not change, or nobody follows a path.
        near: the scaled distance to another agent at which one joins that keeps apart, m, where it
            is less than what they keep; else None.
        sampled: whether there are steps between these frames.
    """

    at: float
    text: str
    peak: float | None
    restored: float | None
    until: float
    unit: str
    leader: tuple[int, float] | None
    near: float | None
    guarantee: JsonObject
    sampled: bool = False

    def as_mapping(self) -> JsonObject:
        """Return what was observed, ready for JSON."""
        names = ("at", "peak", "restored", "until", "leader", "near")
        return {name: getattr(self, name) for name in names}

    def sentence(self) -> str:
        """Return it in a sentence or two."""
        text = f"{self.text[0].upper()}{self.text[1:]} at {self.at:g} s"
        if self.peak is None:
            return f"{text}, after which a state is not finite."
        limit = f"{SETTLED:g} {self.unit}".rstrip()
        size = f"{self.peak:.3g} {self.unit}".rstrip()
        if self.peak <= SETTLED:
            seen = f"errors stay below {limit}, with a peak of {size}"
        elif self.restored is None:
            seen = f"errors reach {size}, and are not below {limit} by {self.until:.4g} s"
        else:
            seen = f"errors reach {size}, and stay below {limit} from {self.restored:.4g} s on"
        if self.leader is not None:
            agent, off = self.leader
            away = f"{off:.3g} {self.unit}".rstrip()
            frames = " in the stored frames" * self.sampled
            seen += f"; agent {agent} leads, {away} off the path at most{frames}"
        if self.near is not None:
            seen += f"; it joins {self.near:.3g} m from another agent, nearer than hulls keep"
        return f"{text}: {seen}."


def event_outcomes(result: Result) -> tuple[EventOutcome, ...]:
    """Return what followed each event of a run that it reached, by time."""
    listed = events_in_words(result.parts, guarantee(result.parts, result.settings))
    starts = event_steps(result.graph, result.settings)
    steps, dt = int(result.sums.steps[0]), result.settings.dt
    ends = np.minimum([*starts[1:], steps], steps)
    # Events of one step have one span.
    spans = [int(np.searchsorted(starts, event["at"] / dt - 1e-6)) for event in listed]
    return tuple(
        _outcome(result, event, span, (int(starts[span]), int(ends[span])))
        for event, span in zip(listed, spans, strict=True)
        if starts[span] < steps
    )


def _outcome(result: Result, event: JsonObject, span: int, steps: tuple[int, int]) -> EventOutcome:
    """Return what followed an event from the first of two steps on, until before the other."""
    (first, end), dt, sums = steps, result.settings.dt, result.sums
    followers = list(result.graph.followers)
    peak = float(np.sqrt(sums.peaks[followers, span]).max(initial=0.0))
    late = int(sums.late[followers, span].max(initial=-1.0))
    settled = late < end - 1
    if end == sums.steps[0]:
        # The last state begins no step, and is a frame.
        last = result.goal_distances([-1])[0, followers].max(initial=0.0)
        peak, settled = max(peak, float(last)), bool(last <= SETTLED)
    until = (end if end == sums.steps[0] else end - 1) * dt
    frames = np.flatnonzero((result.times >= (first - 0.5) * dt) & (result.times <= until + 1e-9))
    return EventOutcome(
        at=event["at"],
        text=event["text"],
        peak=finite_or_none(peak),
        restored=max(late + 1, first) * dt if settled else None,
        until=until,
        unit=result.length_unit,
        leader=_new_leader(result, frames),
        near=_too_near(result, event, frames),
        guarantee=event["guarantee"],
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
