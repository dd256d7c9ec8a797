"""What a gradient costs: native code beside the run forwards and beside JAX's reverse mode.

Run `python benchmarks/gradient.py [AGENTS ...]`: rings of quadrotors with motor limits behind a
leader on a circle, 200 steps, the slopes along P, R and the coupling of the sum of all squared
errors. All are timed in one process, turn by turn, in CPU time of one core, and the best of several
is taken; what checks the parts, 0.1 s before each of them, is left out. It ends with 1 where a
ratio is more than `_AT_MOST`.
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
from echelon.simulation.engine.differentiable_run import DifferentiableRun
from echelon.simulation.engine.jax_gradient import by_jax
from echelon.simulation.engine.native_gradient import Native
from echelon.simulation.engine.prepare import prepare
from echelon.simulation.engine.simulate import sample_reference
from echelon.simulation.native.stepper import NativeStepper
from echelon.simulation.step.loop import assemble
from echelon.simulation.step.meter import Sums

_DT, _STEPS, _TURNS = 0.005, 200, 5
_AT_MOST = {"native to forwards": 10.0, "native to JAX": 0.2}
"""What each ratio must not exceed."""


def squares(sums: Sums) -> Any:
    """Return the sum of all squared errors."""
    return sums.errors[0].sum()


def ways(agents: int) -> dict[str, Callable[[], Any]]:
    """Return the run forwards, and both ways back, of a ring."""
    prepared = prepare(flock(ech.Graph.ring(agents)), ech.Settings(horizon=_STEPS * _DT, dt=_DT))
    drive, problem = prepared.parts.drive, prepared.problem
    loop = assemble(problem, drive.leader, drive.follower)
    reference = sample_reference(prepared, 0, _STEPS + 1)
    stepper = NativeStepper([loop], problem.states, 64, None, threads=1)
    gain = drive.gain
    values = {"P": gain.P, "R": gain.R, "coupling": np.asarray(gain.coupling)}
    run = DifferentiableRun(
        loop, values, problem.states, None if reference is None else reference[:_STEPS]
    )
    count, native = np.array([_STEPS], np.int32), Native(run, _STEPS)
    return {
        "forwards": lambda: stepper.advance(stepper.start(), count, reference),
        "native": lambda: native.gradient(squares),
        "JAX": lambda: by_jax(run, _STEPS, squares),
    }


def seconds(work: Callable[[], object]) -> float:
    """Return the CPU time that something takes."""
    begin = time.process_time()
    work()
    return time.process_time() - begin


def measure(agents: int) -> dict[str, float]:
    """Return the best times of a ring, and their ratios."""
    with precision("float64"):
        work = ways(agents)
        first = {name: seconds(each) for name, each in work.items()}
        best = dict.fromkeys(work, np.inf)
        for _ in range(_TURNS):
            best |= {name: min(best[name], seconds(each)) for name, each in work.items()}
    row = {f"{name}, ms": round(1e3 * took, 2) for name, took in best.items()}
    row |= {f"{name}, the first time, s": round(took, 2) for name, took in first.items()}
    row |= {f"native to {name}": best["native"] / best[name] for name in ("forwards", "JAX")}
    return {name: round(value, 3) for name, value in row.items()}


def main() -> int:
    """Print the table, and return how the process ends."""
    ends = 0
    for agents in [int(word) for word in sys.argv[1:]] or [104, 1_000]:
        row = measure(agents)
        print(agents, json.dumps(row, indent=2))
        ends |= any(row[name] > most for name, most in _AT_MOST.items())
    return ends


if __name__ == "__main__":
    sys.exit(main())
