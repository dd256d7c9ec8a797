"""How fast agents are stepped: native code beside JAX, and beside a yardstick in C if one is given.

Run `python benchmarks/engine.py`, or with `--yardstick FOLDER`, a folder whose `limit.py` has
classes `Ring(x0, d, dtype, mode)` and `Batch(x0, d, dtype)`, of formations of 4, with `run(steps)`,
and a function `rate(kernel, agents, steps)`, and whose `problem.py` makes their starts. All are
timed in one process, turn by turn, in CPU time of one core (of threads in wall time), and the best
of several is taken: what counts are the ratios. With a yardstick it ends with 1 where a number of
`_ASKED` is missed.
"""

import argparse
import importlib
import json
import resource
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import numpy as np

import echelon as ech
from echelon.core.numerics import precision
from echelon.engine.by_jax import JaxStepper
from echelon.engine.crew import Crew
from echelon.engine.drive import Stepper
from echelon.engine.loop import Loop, assemble
from echelon.engine.many import Fleet
from echelon.engine.native import NativeStepper
from echelon.engine.prepare import prepare

_DT, _TURNS = 0.005, 5
_ASKED: dict[str, float] = {
    "ring of 10000, float32, to C": 0.85,
    "ring of 10000, float64, to C": 0.85,
    "ring of 1000000, float32, to C": 0.75,
    "ring of 1000000, float64, to C": 0.75,
    "formations of 4, float32, shared gains to C": 0.8,
    "formations of 4, float64, shared gains to C": 0.8,
    "formations of 4, float32, own gains to C": 0.5,
    "formations of 4, float64, own gains to C": 0.6,
    "formations of 4, float32, two threads to one": 1.6,
    "degree 6, float32, M/s": 25.0,
    "degree 6, float32, two threads to one": 1.6,
}
"""What each number must reach."""
_AT_MOST: dict[str, float] = {
    "degree 6, float32, graph, CPU s": 5.0,
    "peak GB": 3.0,
    "10,000 formations, 1,000 steps, cold, CPU s": 10.0,
    "10,000 formations, 1,000 steps, compiled, CPU s": 1.5,
}
"""What each must not exceed."""


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
        # From within a run: what is written once at its beginning is no step.
        now = stepper.advance(stepper.start(), np.array([1], np.int32), reference[:2]).now
        begin = time.process_time()
        stepper.advance(now, np.array([steps], np.int32), reference[: steps + 1])
        return agents * steps / (time.process_time() - begin)


def measure(agents: int, bits: int, yardstick: Path | None) -> dict[str, float]:
    """Return the rates of a ring, in millions of agent-steps a second, and their ratios."""
    native, by_jax, reference = steppers(ech.Graph.ring(agents), bits)
    few = agents <= 10_000
    steps, fewer = max(4, 2_000_000 // agents), max(2, 100_000 // agents)
    found: dict[str, list[float]] = {"native": [], **({"JAX": []} if few else {}), "C": []}
    limit: Any = None
    kernel: Any = None
    if yardstick is not None:
        limit, problem = yardstick_of(yardstick)
        starts = problem.problem(agents, problem.ring(agents))
        kernel = limit.Ring(*starts, np.float64 if bits == 64 else np.float32, mode=0)
    if few:
        rate(by_jax, agents, fewer, reference, bits)  # compiles
    for _ in range(_TURNS):
        if kernel is not None:
            found["C"].append(limit.rate(kernel, agents, steps, 1)[0])
        found["native"].append(rate(native, agents, steps, reference, bits))
        if few:
            found["JAX"].append(rate(by_jax, agents, fewer, reference, bits))
    best = {name: max(rates) for name, rates in found.items() if rates}
    name = f"ring of {agents}, float{bits}"
    row = {f"{name}, {kind}, M/s": round(value / 1e6, 3) for kind, value in best.items()}
    others = [kind for kind in best if kind != "native"]
    return row | {f"{name}, to {kind}": round(best["native"] / best[kind], 3) for kind in others}


def yardstick_of(folder: Path) -> tuple[Any, Any]:
    """Return the yardstick's modules `limit` and `problem`."""
    if str(folder) not in sys.path:
        sys.path.insert(0, str(folder))
    return importlib.import_module("limit"), importlib.import_module("problem")


def scattered(agents: int) -> np.ndarray:
    """Return the edges between points of a plane that are near, six for each in the mean."""
    from scipy.spatial import cKDTree

    points = np.random.default_rng(0).uniform(0.0, np.sqrt(agents), (agents, 2))
    return cKDTree(points).query_pairs(np.sqrt(6.0 / np.pi), output_type="ndarray")


def measure_degree(agents: int, bits: int) -> dict[str, float]:
    """Return the rate of a large graph of mean degree 6, what it takes to build, and of threads."""
    import scipy.sparse as sp
    from scipy.sparse.csgraph import connected_components

    edges = scattered(agents)
    links = sp.coo_array((np.ones(len(edges), np.int8), edges.T), (agents, agents))
    label = connected_components(links.tocsr(), directed=False)[1]
    most = np.flatnonzero(label == np.bincount(label).argmax())
    place = np.full(agents, -1)
    place[most] = np.arange(len(most))
    edges, agents = place[edges[label[edges[:, 0]] == label[most[0]]]], len(most)
    begin = time.process_time()
    graph = ech.Graph.from_edges(edges, agents=agents)
    built = time.process_time() - begin
    native, _, reference = steppers(graph, bits)
    walls, rates = dict[int, float](), list[float]()
    for threads in (1, 2) * _TURNS:
        native.crew = Crew(native.places, None, threads)  # type: ignore[attr-defined]
        begin = time.perf_counter()
        found = rate(native, agents, 4, reference, bits)
        walls[threads] = min(walls.get(threads, np.inf), time.perf_counter() - begin)
        rates += [found] * (threads == 1)
    name = f"degree 6, float{bits}"
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
    return {
        f"{name}, M/s": round(max(rates) / 1e6, 1),
        f"{name}, two threads to one": round(walls[1] / walls[2], 2),
        f"{name}, graph, CPU s": round(built, 2),
        "peak GB": round(peak, 2),
    }


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


def measure_formations(bits: int, yardstick: Path | None) -> dict[str, float]:
    """Return the rates of formations of 4, in millions of agent-steps a second, and ratios."""
    agents = 4 * _FORMATIONS
    steppers = {"shared gains": formations(bits, False), "own gains": formations(bits, True)}
    threads = {count: formations(bits, False, count)[0] for count in (1, 2)}
    reference = steppers["shared gains"][1]
    found: dict[str, list[float]] = {name: [] for name in ("C", *steppers)}
    walls: dict[int, list[float]] = {1: [], 2: []}
    limit: Any = None
    if yardstick is not None:
        limit, problem = yardstick_of(yardstick)
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
    kind = f"formations of 4, float{bits}"
    row = {f"{kind}, {name}, M/s": round(value / 1e6, 1) for name, value in best.items()}
    row[f"{kind}, two threads to one"] = round(min(walls[1]) / min(walls[2]), 2)
    if "C" in best:
        row |= {f"{kind}, {name} to C": round(best[name] / best["C"], 3) for name in steppers}
    return row


def measure_sweep(runs: int) -> dict[str, float]:
    """Return the CPU seconds of 10,000 formations for 1,000 steps, and of a sweep of `paper`."""
    scenario = ech.load_scenario("paper", ["simulation.horizon=5", "report.steady_window=1"])
    parts, chosen = ech.build(scenario)
    chosen = chosen._replace(precision="float32", store_every=1_000)
    fleet, row = Fleet(1), dict[str, float]()
    for name in ("cold", "compiled"):
        begin = time.process_time()
        for first in range(0, 10_000, 2_500):
            seeds = range(first, first + 2_500)
            flights = fleet.fly([(parts, chosen._replace(seed=k)) for k in seeds])
            assert all(each.outcome.reached for each in flights)
        row[f"10,000 formations, 1,000 steps, {name}, CPU s"] = round(
            time.process_time() - begin, 2
        )
    if runs:
        began, begin = time.perf_counter(), time.process_time()
        ech.sweep(ech.load_scenario("paper"), {"seed": range(runs)})
        row |= {f"{runs} runs of `paper`, CPU s": round(time.process_time() - begin, 1)}
        row |= {f"{runs} runs of `paper`, wall s": round(time.perf_counter() - began, 1)}
    return row


def missed(row: dict[str, float]) -> list[str]:
    """Return what of some numbers is not as asked, in words."""
    low = [f"{k} is {v}, asked {_ASKED[k]}" for k, v in row.items() if v < _ASKED.get(k, v)]
    high = [f"{k} is {v}, asked {_AT_MOST[k]}" for k, v in row.items() if v > _AT_MOST.get(k, v)]
    return low + high


def main() -> int:
    """Measure and print; return 1 where a number is missed."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--yardstick", type=Path, help="folder of the yardstick in C")
    rings = [200, 10_000, 1_000_000]
    parser.add_argument("--agents", type=int, nargs="*", default=rings, help="of rings")
    parser.add_argument("--large", type=int, default=1_000_000, help="agents of the graph")
    parser.add_argument("--runs", type=int, default=0, help="of the sweep")
    parser.add_argument("--json", action="store_true", help="print JSON")
    asked = parser.parse_args()
    makes = [partial(measure, n, bits, asked.yardstick) for n in asked.agents for bits in (64, 32)]
    makes += [partial(measure_formations, bits, asked.yardstick) for bits in (64, 32)]
    makes += [partial(measure_sweep, asked.runs)]
    makes += [partial(measure_degree, asked.large, 32)] * bool(asked.large)
    short = list[str]()
    for make in makes:
        row = make()
        said = json.dumps(row) if asked.json else "\n".join(f"{k} {v}" for k, v in row.items())
        print(said, flush=True)
        short += missed(row)
    print("\n".join(f"missed: {text}" for text in short), file=sys.stderr)
    return int(bool(short) and asked.yardstick is not None)


if __name__ == "__main__":
    sys.exit(main())
