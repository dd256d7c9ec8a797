"""What was observed in a poor run."""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool

from echelon.core.digits import at_least
from echelon.core.errors import Outcome
from echelon.core.words import amount
from echelon.experiments.results.run_numbers import Metrics
from echelon.guarantees.promises.promise import Promise
from echelon.simulation.engine.result import Result
from echelon.simulation.step.meter import SETTLED

_SETTLES = float(np.log(100.0))
"""Time constants in which an error of 1 m decays to 1 cm."""
_CHATTERS = 20
"""Alternations of an input between its limits that are reported; a start has a few."""


def observations(result: Result, numbers: Metrics, guarantee: Promise) -> Iterator[str]:
    """Yield what was observed of large errors, in sentences; no cause, since none was tried."""
    alone = _alone(result)
    yield from () if alone is None else (alone.text,)
    if len(result.times):
        settled = all(follower.settling_time is not None for follower in numbers.followers)
        if grows(result, guarantee):
            yield from beyond(float(result.saturated.max()), guarantee)
        else:
            yield from () if settled else _slow(result, guarantee)
    yield from _offset(result, numbers)
    yield from _chatter(result, () if alone is None else alone.agents)


class _Alone(NamedTuple):
    """Followers whose errors did not shrink while no link led to them."""

    agents: tuple[int, ...]
    text: str


def _alone(result: Result) -> _Alone | None:
    """Return which followers lost their way while nobody was linked to them; None without any."""
    away = result.formation_errors
    spans: dict[int, tuple[float, float]] = {}
    for agent, start, end in _silences(result):
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
    text = f"Agent {worst} received nothing from {start:g} s to {end:g} s, since no link led to it"
    return _Alone(tuple(spans), f"{text}, and its error grew{more}.")


def _silences(result: Result) -> Iterator[tuple[int, float, float]]:
    """Yield each follower that was there without a link to receive from, from when until when (s).

    Nothing of a graph that never switches, in which everybody has a path from a leader.
    """
    schedule, dt = result.schedule, result.settings.dt
    if schedule is None or not len(result.times):
        return
    last = float(result.times[-1])
    steps, rows = schedule.switches(dt, last)
    within = steps * dt < last
    starts, ends = steps[within] * dt, np.append(steps[within][1:] * dt, last)
    silent = _silent(result)[rows[within]]
    for agent in np.flatnonzero(silent.any(axis=0)).tolist():
        edges = np.diff(np.concatenate([[0], silent[:, agent].astype(np.int8), [0]]))
        for first, beyond in zip(np.flatnonzero(edges > 0), np.flatnonzero(edges < 0), strict=True):
            yield agent, float(starts[first]), float(ends[beyond - 1])


def _silent(result: Result) -> Bool[np.ndarray, "S N"]:
    """Return which followers have no link to receive from in each row of the schedule."""
    schedule, agents = result.schedule, result.graph.agents
    assert schedule is not None
    heard = np.zeros((len(schedule.weights), agents), bool)
    row, edge = np.nonzero(schedule.weights > 0.0)
    for end in (0, 1):
        receives = result.parts.receives[edge, end]
        heard[row[receives], result.graph.edges[edge[receives], end]] = True
    here = True if schedule.present is None else np.asarray(schedule.present)
    leads = np.isin(np.arange(agents), result.graph.leaders)
    if schedule.nearest is not None:
        leads = schedule.nearest == np.arange(agents)
    return ~heard & here & ~leads


def beyond(saturated: float, guarantee: Promise) -> Iterator[str]:
    """Yield that a guarantee does not cover a run whose errors grow.

    `saturated` is the largest fraction of steps in which an agent's input was at a limit.
    """
    # With a theorem, `coverage` says more.
    acts = guarantee.without or saturated
    if not guarantee.promised or guarantee.theorem is not None or not acts:
        return
    text = "The guarantee does not cover this run"
    text += f": {guarantee.without}" if guarantee.without else ""
    limited = f"; inputs were at a limit in {100.0 * saturated:.3g} % of the steps"
    yield f"{text}{limited if saturated else ''}."


def _slow(result: Result, guarantee: Promise) -> Iterator[str]:
    """Yield that the horizon is too short for the slowest mode."""
    by_mode = guarantee.slowest is not None
    rate = -guarantee.slowest if guarantee.slowest is not None else guarantee.rate
    if guarantee.promised and rate and result.settings.horizon * rate < _SETTLES:
        span = "1 m to 1 cm" if result.length_unit else "1 to 0.01"
        yield (
            f"{'The slowest mode' if by_mode else 'The guaranteed rate'} takes "
            f"{at_least(_SETTLES / rate)} s from {span}, and the horizon is "
            f"{result.settings.horizon:g} s."
        )


def _offset(result: Result, numbers: Metrics) -> Iterator[str]:
    """Yield that a leader keeps an error from its reference."""
    steady = numbers.leader.steady_rmse
    if steady is None or steady <= SETTLED or _falls(result, steady):
        return
    unit = f" {result.length_unit}".rstrip()
    text = f"The leader has a steady error of {steady:.3g}{unit} from its reference"
    saturated = 100.0 * result.saturated[result.graph.leaders[0]]
    limited = f", with its inputs at a limit in {saturated:.3g} % of the steps"
    yield f"{text}{limited if saturated else ''}."


def _falls(result: Result, steady: float) -> bool:
    """Return whether the first leader was still approaching its reference at the end."""
    assert result.reference is not None
    first = result.graph.leaders[0]
    away = result.states[-1, first] - result.offsets_in([-1])[..., first, :] - result.reference[-1]
    with np.errstate(over="ignore", invalid="ignore"):
        return float(np.linalg.norm(away[..., list(result.measured)])) < 0.5 * steady


def _chatter(result: Result, alone: Sequence[int]) -> Iterator[str]:
    """Yield that inputs alternate between their limits, but of agents that tumbled `alone`."""
    agent = int(result.chatter.argmax())
    if agent not in alone and result.chatter[agent] > _CHATTERS:
        yield (
            f"The inputs of agent {agent} jumped from one limit to the opposite one "
            f"{result.chatter[agent]:.0f} times between two steps of {result.settings.dt:g} s."
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
