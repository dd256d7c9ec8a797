"""The work of the solvers in a run whose inputs an optimization gives."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np


class SolverStats(NamedTuple):
    """The work of the solvers of all agents together.

    Attributes:
        method: what was solved: `optimization`, planned once, or `mpc`, over a receding horizon.
        solver: by CasADi's name.
        solves: how many plans were requested.
        failures: how often a solver ended without a solution; the run went on with another attempt
            or with the last plan.
        seconds: of all solving.
        median_ms, p99_ms, worst_ms: of the plans, each of one agent at one time.
        iterations_median, iterations_worst: the solver's (`optimization`) or the quadratic programs
            (`mpc`) of a plan.
        setup_seconds: of building the solvers, once.
    """

    method: str
    solver: str
    solves: int
    failures: int
    seconds: float
    median_ms: float
    p99_ms: float
    worst_ms: float
    iterations_median: float
    iterations_worst: int
    setup_seconds: float


def solver_stats(
    method: str,
    solver: str,
    seconds: Sequence[float],
    iterations: Sequence[int],
    failures: int,
    setup_seconds: float,
) -> SolverStats:
    """Return the figures of plans that took these seconds and iterations."""
    # A run that ended before its first plan has none, and zeros stand for it.
    ms = 1e3 * np.array(seconds) if len(seconds) else np.zeros(1)
    counts = np.array(iterations) if len(iterations) else np.zeros(1)
    return SolverStats(
        method,
        solver,
        len(seconds),
        failures,
        float(np.sum(seconds)),
        float(np.median(ms)),
        float(np.percentile(ms, 99.0)),
        float(ms.max()),
        float(np.median(counts)),
        int(counts.max()),
        setup_seconds,
    )
