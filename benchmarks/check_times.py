"""What `check` and its parts take on the paper's scenario, and how fast a hopeless P is refused.

Run `python benchmarks/check_times.py`. The command line is timed in a process of its own, imports
and compilation included; everything else in this process, the first call left out.
"""

import resource
import statistics
import subprocess
import sys
import time
from collections.abc import Callable

import numpy as np

import echelon as ech
from echelon.agents.models.linearization import linearize
from echelon.core.numerics import precision
from echelon.synthesis.certificates.margins import (
    ClosedLoop,
    invariant_ellipsoid,
    peak_gain,
    string_gain,
)

GRAPH = ech.Graph.from_edges([(0, 1), (1, 2), (1, 3)])


def milliseconds(act: Callable[[], object], times: int = 10) -> float:
    """Return the median of some calls, after one that compiles."""
    act()
    taken = []
    for _ in range(times):
        began = time.perf_counter()
        act()
        taken.append(1e3 * (time.perf_counter() - began))
    return statistics.median(taken)


def command(*arguments: str) -> str:
    """Return what a command line takes, of wall and of processor time."""
    before, began = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    call = [sys.executable, "-m", "echelon", *arguments]
    subprocess.run(call, capture_output=True, text=True, check=False)
    wall, after = time.perf_counter() - began, resource.getrusage(resource.RUSAGE_CHILDREN)
    spent = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return f"{wall:.2f} s of wall time, {spent:.2f} s of processor time"


def refused(model: ech.ControlAffine, **domain: float) -> Callable[[], object]:
    """Return an attempt at a P that there is none of."""

    def act() -> str:
        try:
            ech.synthesize(model, GRAPH, ech.gains.Monotone(domain))
        except ech.EchelonError as error:
            return str(error)
        raise AssertionError("a P was found")

    return act


def main() -> None:
    """Print one figure a line."""
    print(f"echelon check paper: {command('check', 'paper')}")
    agent = ech.models.Quadrotor()
    with precision("float64"):
        riccati = milliseconds(lambda: ech.gains.Riccati().solve(agent, GRAPH.spectrum()))
        gain, (A, B) = ech.gains.Riccati().solve(agent, GRAPH.spectrum()), linearize(agent)
    print(f"riccati: {riccati:.1f} ms")
    loop = ClosedLoop(A, B, gain.P, gain.R, gain.coupling, GRAPH.spectrum().eigenvalues)
    push = np.eye(len(A))[:, 3:6]
    for name, act in {
        "string gain": lambda: string_gain(loop),
        "disturbance, ellipsoid": lambda: invariant_ellipsoid(loop, push),
        "disturbance, exact L1": lambda: peak_gain(loop, push),
        "no P, double integrator": refused(ech.models.DoubleIntegrator()),
        "no P, quadrotor": refused(agent, attitude=0.35, rate=1.0, thrust=2.0),
    }.items():
        print(f"{name}: {milliseconds(act):.1f} ms")


if __name__ == "__main__":
    main()
