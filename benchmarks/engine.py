"""How fast agents are stepped: native code beside JAX, and beside a yardstick in C if one is given.

Run `python benchmarks/engine.py`, or with `--yardstick FOLDER`, a folder whose `limit.py` has
classes `Ring(x0, d, dtype, mode)` and `Batch(x0, d, dtype)`, of formations of 4, with `run(steps)`,
and a function `rate(kernel, agents, steps)`, and whose `problem.py` makes their starts. All are
timed in one process, turn by turn, in CPU time of one core (of threads in wall time), and the best
of several is taken: what counts are the ratios.
"""

import argparse
import importlib
import json
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import numpy as np

import echelon as ech
from echelon.core.numerics import precision
from echelon.engine.by_jax import JaxStepper
from echelon.engine.drive import Stepper
from echelon.engine.loop import Loop, assemble
from echelon.engine.many import Fleet
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


# ---- many formations ---------------------------------------------------------------------------

_FORMATIONS, _STEPS = 2_560, 300


def formations(
    bits: int, own: bool, threads: int = 1, integrator: Any = "rk4"
) -> tuple[NativeStepper, np.ndarray]:
    """Return what steps 2,560 formations of 4 that all hear each other, and the reference.

    Each has a gain of its own where `own` is true: other numbers in P, R and c.
    """
    kind: Any = f"float{bits}"
    chosen = ech.Settings(horizon=50.0, dt=_DT, precision=kind, integrator=integrator)
    prepared = prepare(flock(ech.Graph.complete(4)), chosen)
    drive, draws = prepared.parts.drive, np.random.default_rng(0)
    with precision("float64"):
        loop = assemble(prepared.problem, drive.leader, drive.follower)
        states = prepared.problem.states + 0.02 * draws.uniform(-1, 1, (_FORMATIONS, 4, 12))
        times = _DT * jax.numpy.arange(_STEPS + 1)
        reference = np.asarray(drive.reference_states(prepared.parts.model, times))
        loops = [_regained(loop, draws) for _ in range(_FORMATIONS)] if own else None
    pool = ThreadPoolExecutor(threads) if threads > 1 else None
    with precision(f"float{bits}"):  # type: ignore[arg-type]
        loops = loops or [loop] * _FORMATIONS
        return NativeStepper(loops, states.reshape(-1, 12), bits, None, pool), reference


def _regained(loop: Loop, draws: np.random.Generator) -> Loop:
    """Return a loop with a gain a little other."""

    def numbers(loop: Loop) -> tuple[Any, ...]:
        gain = loop.follower.gain
        return gain.P, gain.R_inverse, gain.coupling

    P, R_inverse, coupling = numbers(loop)
    more = 1.0 + 0.01 * draws.uniform(-1, 1, P.shape)
    scales = draws.uniform(0.9, 1.1, 2)
    other = P * (more + more.T) / 2, R_inverse * scales[0], coupling * scales[1]
    return eqx.tree_at(numbers, loop, other)


def measure_formations(bits: int, yardstick: Path | None) -> dict[str, Any]:
    """Return the rates of formations of 4, in millions of agent-steps a second, and ratios."""
    agents = 4 * _FORMATIONS
    steppers = {"shared gains": formations(bits, False), "own gains": formations(bits, True)}
    threads = {count: formations(bits, False, count)[0] for count in (1, 2)}
    reference = steppers["shared gains"][1]
    found: dict[str, list[float]] = {name: [] for name in ("C", *steppers)}
    walls: dict[int, list[float]] = {1: [], 2: []}
    limit: Any = None
    if yardstick is not None:
        sys.path.insert(0, str(yardstick))
        limit, problem = (importlib.import_module(name) for name in ("limit", "problem"))
        starts = problem.problem(agents, problem.complete_blocks(_FORMATIONS))
        kernel = limit.Batch(*starts, np.float64 if bits == 64 else np.float32)
    for _ in range(_TURNS):
        if limit is not None:
            found["C"].append(limit.rate(kernel, agents, _STEPS, 1)[0])
        for name, (stepper, _) in steppers.items():
            found[name].append(rate(stepper, agents, _STEPS, reference, bits))
        for count, stepper in threads.items():
            begin = time.perf_counter()
            rate(stepper, agents, _STEPS, reference, bits)
            walls[count].append(time.perf_counter() - begin)
    best = {name: max(rates) for name, rates in found.items() if rates}
    row: dict[str, Any] = {"formations of 4": _FORMATIONS, "bits": bits}
    row |= {f"{name}, M/s": round(value / 1e6, 1) for name, value in best.items()}
    row["two threads to one"] = round(min(walls[1]) / min(walls[2]), 2)
    if "C" in best:
        row |= {f"{name} to C": round(best[name] / best["C"], 3) for name in steppers}
    return row


def measure_sweep(runs: int) -> dict[str, Any]:
    """Return the CPU seconds of 10,000 formations for 1,000 steps, and of a sweep of `paper`."""
    scenario = ech.load_scenario("paper", ["simulation.horizon=5", "report.steady_window=1"])
    parts, chosen = ech.build(scenario)
    chosen = chosen._replace(precision="float32", store_every=1_000)
    fleet, row = Fleet(1), dict[str, Any]()
    for name in ("cold", "compiled"):
        begin = time.process_time()
        for first in range(0, 10_000, 2_500):
            seeds = range(first, first + 2_500)
            flights = fleet.fly([(parts, chosen._replace(seed=k)) for k in seeds])
            assert all(each.outcome.reached for each in flights)
        row[f"10,000 formations, 1,000 steps, {name}, CPU s"] = round(
            time.process_time() - begin, 2
        )
    began, begin = time.perf_counter(), time.process_time()
    ech.sweep(ech.load_scenario("paper"), {"seed": range(runs)})
    row |= {"runs of `paper`": runs, "CPU s": round(time.process_time() - begin, 1)}
    return row | {"wall s": round(time.perf_counter() - began, 1)}


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--yardstick", type=Path, help="folder of the yardstick in C")
    parser.add_argument("--agents", type=int, nargs="+", default=[200, 10_000], help="of rings")
    parser.add_argument("--runs", type=int, default=10_000, help="of the sweep")
    parser.add_argument("--json", action="store_true", help="print JSON")
    asked = parser.parse_args()
    for agents in asked.agents:
        for bits in (64, 32):
            row = measure(agents, bits, asked.yardstick)
            said = json.dumps(row) if asked.json else ", ".join(f"{k} {v}" for k, v in row.items())
            print(said, flush=True)
    rows = [lambda bits=bits: measure_formations(bits, asked.yardstick) for bits in (64, 32)]
    for make in [*rows, lambda: measure_sweep(asked.runs)]:
        row = make()
        said = json.dumps(row) if asked.json else ", ".join(f"{k} {v}" for k, v in row.items())
        print(said, flush=True)


if __name__ == "__main__":
    main()
