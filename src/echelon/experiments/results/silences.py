"""When no link led to a follower, in a graph that switches."""

from collections.abc import Iterator

import numpy as np
from jaxtyping import Bool

from echelon.simulation.engine.result import Result


def silences(result: Result) -> Iterator[tuple[int, float, float]]:
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
