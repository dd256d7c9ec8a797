"""Causes of a poor run, each with a remedy."""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from echelon.core.digits import at_least
from echelon.core.errors import Outcome
from echelon.core.statement import Cause, Hypothesis
from echelon.core.words import amount
from echelon.experiments.results.agent_metrics import Metrics
from echelon.experiments.results.silences import silences
from echelon.guarantees.promises.promise import Promise
from echelon.simulation.engine.result import Result
from echelon.simulation.step.meter import SETTLED

_LAG = 1e-6
"""A steady error above this, in the result's unit, is reported as a lag."""
_SETTLES = float(np.log(100.0))
"""Time constants in which an error of 1 m decays to 1 cm."""
_CHATTERS = 20
"""Alternations of an input between its limits that are reported; a start has a few."""


def causes(result: Result, numbers: Metrics, guarantee: Promise) -> Iterator[Cause]:
    """Yield the causes of large errors, each with a remedy."""
    alone = _alone(result)
    yield from () if alone is None else (alone.cause,)
    if len(result.times):
        settled = all(follower.settling_time is not None for follower in numbers.followers)
        lost = grows(result, guarantee)
        if lost or not settled:
            yield from guarantee.causes
        if lost:
            yield from beyond(float(result.saturated.max()), guarantee)
        else:
            yield from () if settled else _slow(result, guarantee)
            yield from _lag(result, numbers, guarantee)
    yield from _offset(result, numbers, guarantee)
    if result.outcome is Outcome.LEFT_CHART:
        yield Cause(
            "beyond that bound the angles of the equations are no coordinates, and the gain is "
            "that of the trim",
            "start closer to the trim, or slow the reference",
        )
    yield from _chatter(result, () if alone is None else alone.agents)


class _Alone(NamedTuple):
    """Followers whose errors did not shrink while no link led to them."""

    agents: tuple[int, ...]
    cause: Cause


def _alone(result: Result) -> _Alone | None:
    """Return which followers lost their way while nobody was linked to them; None without any."""
    away = result.formation_errors
    spans: dict[int, tuple[float, float]] = {}
    for agent, start, end in silences(result):
        frames = np.flatnonzero((result.times >= start) & (result.times <= end))
        errors = away[frames, agent]
        lost = len(frames) and not errors[-1] <= max(SETTLED, errors[0])
        before = spans.get(agent, (0.0, 0.0))
        if lost and end - start > before[1] - before[0]:
            spans[agent] = start, end
    if not spans:
        return None
    worst = max(spans, key=lambda agent: spans[agent][1] - spans[agent][0])
    more = f"; so did {amount(len(spans) - 1, 'other agent')} at some time" * (len(spans) > 1)
    start, end = spans[worst]
    text = f"agent {worst} received nothing from {start:g} s to {end:g} s, since no link led to it"
    remedy = "give it another link at that time"
    if result.drive.gain is not None:
        remedy += ", or use the law `stopping-point`, under which an agent alone remains stable"
    return _Alone(tuple(spans), Cause(text + more, remedy))


def beyond(saturated: float, guarantee: Promise) -> Iterator[Cause]:
    """Yield why a guarantee does not cover a run whose errors grow.

    `saturated` is the largest fraction of steps in which an agent's input was at a limit.
    """
    if not guarantee.promised:
        return
    reason, remedy = "the starts were too far from the goals", "start closer to the goals"
    if guarantee.without:
        reason, remedy = guarantee.without, "remove it to see its effect"
    if saturated:
        reason = f"{reason}; inputs were at a limit in {100.0 * saturated:.3g} % of the steps"
        remedy = f"{remedy}, or slow the reference"
    yield Cause(f"the guarantee does not cover this run: {reason}", remedy)


def _slow(result: Result, guarantee: Promise) -> Iterator[Cause]:
    """Yield that the horizon is too short for the slowest mode."""
    by_mode = guarantee.slowest is not None
    rate = -guarantee.slowest if guarantee.slowest is not None else guarantee.rate
    if guarantee.promised and rate and result.settings.horizon * rate < _SETTLES:
        span = "1 m to 1 cm" if result.length_unit else "1 to 0.01"
        yield Cause(
            f"{'the slowest mode' if by_mode else 'the guaranteed rate'} takes "
            f"{at_least(_SETTLES / rate)} s from {span}, and the horizon is "
            f"{result.settings.horizon:g} s",
            "lengthen `simulation.horizon`, or let `echelon design` find a faster gain",
        )


def _lag(result: Result, numbers: Metrics, guarantee: Promise) -> Iterator[Cause]:
    """Yield the lag of followers that do not receive the leader's input."""
    worst, matched = numbers.worst_steady, guarantee.hypotheses[Hypothesis.MATCHED_MOTION]
    if worst is None or worst <= _LAG or not matched.fails or result.reference is None:
        return
    unit = f" {result.length_unit}".rstrip()
    # Nobody lags behind a leader at rest, so that a steady error has another cause there.
    if np.ptp(result.reference, axis=0).max() > 0.0:
        yield Cause(
            "without feed-forward the followers do not know the leader's motion and lag: "
            f"{worst:.3g}{unit} RMS over the last {numbers.steady_window:.3g} s for the worst",
            matched.remedy,
        )


def _offset(result: Result, numbers: Metrics, guarantee: Promise) -> Iterator[Cause]:
    """Yield why a leader keeps an error from its reference."""
    steady = numbers.leader.steady_rmse
    unknown = not result.world.ideal
    if steady is None or steady <= SETTLED or _falls(result, steady):
        return
    if not (guarantee.promised or unknown):
        return
    unit = f" {result.length_unit}".rstrip()
    text = f"the leader has a steady error of {steady:.3g}{unit} from its reference"
    saturated = 100.0 * result.saturated[result.graph.leaders[0]]
    if unknown:
        text += ", since no law has integral action against an unknown disturbance or plant"
        remedy = "give the model the plant's parameters, or the leader a stronger `leader.gain`"
    elif saturated > 0.0:
        text += f", with its inputs at a limit in {saturated:.3g} % of the steps"
        remedy = "make the reference slower or smaller"
    else:
        remedy = "choose another method or weights for `leader.gain`, or a slower reference"
    yield Cause(text, remedy)


def _falls(result: Result, steady: float) -> bool:
    """Return whether the first leader was still approaching its reference at the end."""
    assert result.reference is not None
    first = result.graph.leaders[0]
    away = result.states[-1, first] - result.offsets_in([-1])[..., first, :] - result.reference[-1]
    with np.errstate(over="ignore", invalid="ignore"):
        return float(np.linalg.norm(away[..., list(result.measured)])) < 0.5 * steady


def _chatter(result: Result, alone: Sequence[int]) -> Iterator[Cause]:
    """Yield that a step is so long that inputs alternate between their limits.

    Inputs of agents that tumbled `alone` do so at any step.
    """
    agent = int(result.chatter.argmax())
    if agent in alone:
        return
    if result.chatter[agent] > _CHATTERS:
        yield Cause(
            f"the inputs of agent {agent} jumped from one limit to the other "
            f"{result.chatter[agent]:.0f} times between two steps, since the gain is too strong "
            f"for the step `dt` = {result.settings.dt:g} s",
            "halve `simulation.dt`, increase the input weight `R`, or reduce the coupling",
        )


def sizes(result: Result) -> tuple[float, float]:
    """Return the root-mean-square error of the followers in the first and the last frame."""
    error = result.goal_distances([0, -1])[:, list(result.graph.followers)]
    with np.errstate(over="ignore"):
        first, last = (float(np.sqrt((row**2).mean())) for row in (error[0], error[-1]))
    return first, last


def grows(result: Result, guarantee: Promise) -> bool:
    """Return whether a run diverged, or its errors grew beyond what a guarantee allows for.

    Under one, errors that end below 1 cm are those of rounding and of inputs that are held.
    """
    if result.outcome is Outcome.DIVERGED or not guarantee.promised:
        return ends_farther(result)
    return ends_farther(result) and sizes(result)[1] >= SETTLED


def ends_farther(result: Result) -> bool:
    """Return whether a run diverged, or ends farther from its goals than it began."""
    if result.outcome is Outcome.DIVERGED:
        return True
    first, last = sizes(result)
    # Twice, since the last frame may be an overshoot; and after a start at the goals rounding
    # errors grow.
    return last > 2.0 * first + 1e-9
