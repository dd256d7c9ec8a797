"""What a gradient costs: native code beside the run forwards and beside JAX's reverse mode.

Run `python benchmarks/gradient.py [AGENTS ...]`: rings of quadrotors with motor limits behind a
leader on a circle, 200 steps, the slopes along P, R and the coupling of the sum of all squared
errors. All are timed in one process, turn by turn, in CPU time, and the best of several is taken.
"""

import json
import sys
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from engine import flock

import echelon as ech
from echelon.core.numerics import precision
from echelon.engine.loop import assemble
from echelon.engine.native import NativeStepper
from echelon.engine.prepare import prepare
from echelon.engine.simulate import sample_reference
from echelon.engine.sums import Sums

_DT, _STEPS, _TURNS = 0.005, 200, 5


def squares(sums: Sums) -> Any:
    """Return the sum of all squared errors."""
    return sums.errors[0].sum()


def forwards(parts: ech.Parts, settings: ech.Settings) -> Callable[[], object]:
    """Return what takes the steps of a run, compiled."""
    prepared = prepare(parts, settings)
    drive, problem = prepared.parts.drive, prepared.problem
    with precision("float64"):
        loop = assemble(problem, drive.leader, drive.follower)
        stepper = NativeStepper([loop], problem.states, 64, None, threads=1)
        reference = sample_reference(prepared, 0, _STEPS + 1)

    def fly() -> object:
        with precision("float64"):
            return stepper.advance(stepper.start(), np.array([_STEPS], np.int32), reference)

    return fly


def seconds(work: Callable[[], object]) -> float:
    """Return the CPU time that something takes."""
    begin = time.process_time()
    work()
    return time.process_time() - begin


def measure(agents: int) -> dict[str, float]:
    """Return the best times of a ring, and their ratios."""
    parts = flock(ech.Graph.ring(agents))
    settings = ech.Settings(horizon=_STEPS * _DT, dt=_DT)

    def pull(engine: str) -> Callable[[], object]:
        asked = settings._replace(engine=engine)
        return lambda: ech.gradient(parts, asked, squares, ("P", "R", "coupling"))

    whole = settings._replace(engine="native", store_every=_STEPS)
    work = {"forwards": forwards(parts, settings), "whole run": lambda: ech.simulate(parts, whole)}
    work |= {"native": pull("native"), "JAX": pull("jax")}
    first = {name: seconds(each) for name, each in work.items()}
    best = dict.fromkeys(work, np.inf)
    for _ in range(_TURNS):
        best |= {name: min(best[name], seconds(each)) for name, each in work.items()}
    row: dict[str, float] = {f"{name}, ms": round(1e3 * took, 2) for name, took in best.items()}
    row |= {f"{name}, the first time, s": round(took, 2) for name, took in first.items()}
    row["native to forwards"] = round(best["native"] / best["forwards"], 2)
    row["native to a whole run"] = round(best["native"] / best["whole run"], 2)
    row["native to JAX"] = round(best["native"] / best["JAX"], 3)
    return row


if __name__ == "__main__":
    for agents in [int(word) for word in sys.argv[1:]] or [104, 1_000]:
        print(agents, json.dumps(measure(agents), indent=2))
