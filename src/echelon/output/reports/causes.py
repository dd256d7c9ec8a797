"""Why a run was not as it should be, each cause with what to do about it."""

from collections.abc import Iterator

import numpy as np

from echelon.core.errors import Outcome
from echelon.core.statement import Cause, Hypothesis
from echelon.experiments.results.metrics import Metrics, formation_errors
from echelon.guarantees.promises.promise import Promise
from echelon.simulation.engine.result import Result
from echelon.simulation.step.meter import SETTLED

_LAG = 1e-6
"""A steady error above this, in the result's unit, is told as a lag."""
_SETTLES = float(np.log(100.0))
"""Time constants of the slowest mode in which a metre becomes a centimetre."""
_CHATTERS = 20
"""Alternations of an input between its limits above which it is told: a start has a few."""


def causes(result: Result, numbers: Metrics, found: Promise) -> Iterator[Cause]:
    """Yield why a run was not as it should be, each with what to do about it."""
    if len(result.times):
        settled = all(each.settling_time is not None for each in numbers.followers)
        lost = grows(result)
        if lost or not settled:
            yield from found.causes
        yield from beyond(float(result.saturated.max()), found) if lost else ()
        yield from () if lost or settled else _slow(result, found)
        yield from () if lost else _lag(result, numbers, found)
    yield from _offset(result, numbers, found)
    yield from _outside(result)
    yield from _chatter(result, found)


def beyond(limited: float, found: Promise) -> Iterator[Cause]:
    """Name what a promise leaves out, where there is one and the errors grow.

    A limit acted in this fraction of the steps of whom it acted on most.
    """
    if not found.promised:
        return
    remedy = "start nearer to the goals"
    left = "the starts were not near enough to the goals"
    if found.without:
        left, remedy = found.without, "leave it out to see what it costs"
    if limited:
        left = f"{left}; a limit acted in {100.0 * limited:.3g} % of the steps"
        remedy = f"{remedy}, or slow the reference"
    yield Cause(f"what is promised does not reach this run: {left}", remedy)


def _slow(result: Result, found: Promise) -> Iterator[Cause]:
    """Tell that the horizon is too short for the slowest mode."""
    what = "what is promised" if found.slowest is None else "the slowest mode"
    rate = found.rate if found.slowest is None else -found.slowest
    if found.promised and rate and result.settings.horizon * rate < _SETTLES:
        yield Cause(
            f"{what} takes {_SETTLES / rate:.3g} s to make a metre a centimetre, and the "
            f"horizon is {result.settings.horizon:g} s",
            "lengthen `simulation.horizon`, or let `echelon design` find a faster gain or edge",
        )


def _lag(result: Result, numbers: Metrics, found: Promise) -> Iterator[Cause]:
    """Tell how far followers stay behind a leader whose input they are not sent."""
    worst, matched = numbers.worst_steady, found.hypotheses[Hypothesis.MATCHED_MOTION]
    if worst is None or worst <= _LAG or not matched.fails or result.reference is None:
        return
    unit = "" if result.unit == "state" else f" {result.unit}"
    # Behind a leader at rest nobody lags; what is left then has another cause.
    if np.ptp(result.reference, axis=0).max() > 0.0:
        yield Cause(
            "without feed-forward the followers do not know the leader's motion and lag: "
            f"{worst:.3g}{unit} RMS over the last {numbers.steady_window:.3g} s for the worst",
            matched.remedy,
        )


def _offset(result: Result, numbers: Metrics, found: Promise) -> Iterator[Cause]:
    """Tell why a leader stays off its reference."""
    steady = numbers.leader.steady_rmse
    unknown = result.world.plant is not None or result.world.disturbance is not None
    if steady is None or steady <= SETTLED or _falls(result, steady):
        return
    if not (found.promised or unknown):
        return
    unit = "" if result.unit == "state" else f" {result.unit}"
    text = f"the leader stays {steady:.3g}{unit} off its reference"
    if unknown:
        text += ": no law has integral action against what it does not know"
        remedy = "give the model the plant's parameters, or the leader a stronger `leader.gain`"
    elif result.saturated[result.graph.leaders[0]] > 0.0:
        text += f": a limit acts in {100.0 * result.saturated[result.graph.leaders[0]]:.3g} % of "
        text, remedy = f"{text}its steps", "make the reference slower or smaller"
    else:
        remedy = "give `leader.gain` another method or weights, or the reference a slower path"
    yield Cause(text, remedy)


def _falls(result: Result, steady: float) -> bool:
    """Tell whether the first leader was still on its way to the reference at the end."""
    assert result.reference is not None
    first = result.graph.leaders[0]
    away = result.states[-1, first] - result.formation.offsets[first] - result.reference[-1]
    return float(np.linalg.norm(away[list(result.measured)])) < 0.5 * steady


def _outside(result: Result) -> Iterator[Cause]:
    if result.outcome is Outcome.LEFT_CHART:
        yield Cause(
            "the equations turn by angles that are no coordinates beyond that bound, and the gain "
            "is one of the trim",
            "start nearer to the trim, or slow the reference",
        )


def _chatter(result: Result, found: Promise) -> Iterator[Cause]:
    """Tell of inputs that a step too long throws from limit to limit."""
    agent = int(result.chatter.argmax())
    if result.chatter[agent] > _CHATTERS:
        yield Cause(
            f"the inputs of agent {agent} went from beyond one limit to beyond the other "
            f"{result.chatter[agent]:.0f} times from a step to the next: the gain is too strong "
            f"for the step `dt` = {result.settings.dt:g} s where the agents go",
            "halve `simulation.dt`, or weigh the inputs more (`R`) or the coupling less",
        )


# ---- how a run did ------------------------------------------------------------------------------


def sizes(result: Result) -> tuple[float, float]:
    """Return the root-mean-square error of the followers in the first and the last frame."""
    error = formation_errors(result)[:, list(result.graph.followers)]
    with np.errstate(over="ignore"):
        first, last = (float(np.sqrt((row**2).mean())) for row in (error[0], error[-1]))
    return first, last


def grows(result: Result) -> bool:
    """Tell whether a run was lost, or ends farther from its goals than it began."""
    if result.outcome is Outcome.DIVERGED:
        return True
    first, last = sizes(result)
    # Twice, since a last frame may catch an overshoot; and a start on the goals has rounding alone
    # to grow from.
    return last > 2.0 * first + 1e-9
