"""How fast agents are stepped: native code beside JAX, and beside a yardstick in C if one is given.

Run `python benchmarks/engine.py`, or with `--yardstick FOLDER`, a folder whose `limit.py` has a
class `Ring(x0, d, dtype, mode)` with `run(steps)` and a function `rate(kernel, agents, steps)`, and
whose `problem.py` makes its starts. All are timed in one process, turn by turn, in CPU time of one
core, and the best of several is taken: what counts are the ratios.
"""

import argparse
import importlib
import json
import sys
import time
from pathlib import Path
from typing import Any

import jax
import numpy as np

import echelon as ech
from echelon.core.numerics import precision
from echelon.engine.by_jax import JaxStepper
from echelon.engine.drive import Stepper
from echelon.engine.loop import assemble
from echelon.engine.native import NativeStepper
from echelon.engine.prepare import prepare

_DT, _TURNS = 0.005, 5


def flock(graph: ech.Graph) -> ech.Parts:
    """Return quadrotors behind a leader on a circle, by a gain that the step bears."""
    model = ech.models.Quadrotor()
    gain = ech.synthesize(model, ech.Graph.ring(20), ech.gains.Riccati(coupling=0.25))
    drive = ech.Laws(
        ech.laws.Tracking(ech.references.Circle(radius=1.0, rate=0.3)),
        ech.laws.Consensus(gain, feedforward="relay"),
    )
    formation = ech.Formation(np.zeros((graph.agents, 12)))
    return ech.Parts(model, graph, formation, drive, initial={"position": 0.02})


def steppers(graph: ech.Graph, bits: int) -> tuple[Stepper, Stepper, np.ndarray]:
    """Return the native stepper, JAX's and the reference of 10,000 steps."""
    chosen = ech.Settings(horizon=50.0, dt=_DT, precision=f"float{bits}")  # type: ignore[arg-type]
    prepared = prepare(flock(graph), chosen)
    problem, drive = prepared.problem, prepared.parts.drive
    with precision("float64"):
        loop = assemble(problem, drive.leader, drive.follower)
        by_jax = JaxStepper(loop, problem.states)
        native = NativeStepper([loop], problem.states, bits, by_jax)
        times = _DT * jax.numpy.arange(10_001)
        reference = np.asarray(drive.reference_states(prepared.parts.model, times))
    return native, by_jax, reference


def rate(stepper: Stepper, agents: int, steps: int, reference: np.ndarray, bits: int) -> float:
    """Return agent-steps per second of CPU time, of one turn."""
    with precision(f"float{bits}"):  # type: ignore[arg-type]
        now, counts = stepper.start(), np.array([steps], np.int32)
        begin = time.process_time()
        stepper.advance(now, counts, reference[: steps + 1])
        return agents * steps / (time.process_time() - begin)


def measure(agents: int, bits: int, yardstick: Path | None) -> dict[str, Any]:
    """Return the rates of a ring, in millions of agent-steps a second, and their ratios."""
    native, by_jax, reference = steppers(ech.Graph.ring(agents), bits)
    steps, few = max(4, 2_000_000 // agents), max(2, 100_000 // agents)
    found: dict[str, list[float]] = {"native": [], "JAX": [], "C": []}
    limit: Any = None
    kernel: Any = None
    if yardstick is not None:
        sys.path.insert(0, str(yardstick))
        limit, problem = (importlib.import_module(name) for name in ("limit", "problem"))
        starts = problem.problem(agents, problem.ring(agents))
        kernel = limit.Ring(*starts, np.float64 if bits == 64 else np.float32, mode=0)
    rate(by_jax, agents, few, reference, bits)  # compiles
    for _ in range(_TURNS):
        if kernel is not None:
            found["C"].append(limit.rate(kernel, agents, steps, 1)[0])
        found["native"].append(rate(native, agents, steps, reference, bits))
        found["JAX"].append(rate(by_jax, agents, few, reference, bits))
    best = {name: max(rates) for name, rates in found.items() if rates}
    row: dict[str, Any] = {"agents": agents, "bits": bits}
    row |= {f"{name}, M/s": round(value / 1e6, 3) for name, value in best.items()}
    others = [name for name in best if name != "native"]
    return row | {f"to {name}": round(best["native"] / best[name], 3) for name in others}


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--yardstick", type=Path, help="folder of the yardstick in C")
    parser.add_argument("--agents", type=int, nargs="+", default=[200, 10_000], help="of rings")
    parser.add_argument("--json", action="store_true", help="print JSON")
    asked = parser.parse_args()
    for agents in asked.agents:
        for bits in (64, 32):
            row = measure(agents, bits, asked.yardstick)
            said = json.dumps(row) if asked.json else ", ".join(f"{k} {v}" for k, v in row.items())
            print(said, flush=True)


if __name__ == "__main__":
    main()
