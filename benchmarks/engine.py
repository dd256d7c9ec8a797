"""How fast agents are stepped: native code beside a yardstick in C, C++ of the same, and peers.

Run `python3 benchmarks/engine.py --yardstick FOLDER` (`steppers.Yardstick` says what is in it).
What is compared is timed in one process, turn by turn, in CPU time of one core (threads, and what
says so, in wall time), and the best of several turns is taken: what counts are the ratios. Groups
of measurements have a process each. It ends with 1 where a number is not as asked; what needs a
yardstick is left out without one. Environments of peers are made by pip where they are not there.
"""

import argparse
import json
import os
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any, TypeAlias

try:
    import jax
    import numpy as np
    import plain_c
    import steppers as made
except ImportError:
    # Not in the environment that `dev.py setup` makes.
    _PYTHON = Path(__file__).resolve().parents[1] / ".venv" / "bin" / "python"
    if not _PYTHON.exists() or _PYTHON == Path(sys.executable):
        raise
    os.execv(_PYTHON, [str(_PYTHON), *sys.argv])

from steppers import FORMATIONS, STEPS, Yardstick, flock, rate

import echelon as ech
from echelon.simulation.codegen import Code
from echelon.simulation.engine.batch import Batch
from echelon.simulation.engine.jax_stepper import JaxFormations
from echelon.simulation.native.kernel_cache import Kernels
from echelon.simulation.native.threads import ThreadPool

Row: TypeAlias = dict[str, float]
_TURNS = 4
_BITS = (32, 64)
_MILLION = 1_000_000

_AT_LEAST: Row = {
    **{f"ring of 10,000, float{bits}, to C": 0.85 for bits in _BITS},
    "a newcomer's model, float32, to C": 0.55,
    "a newcomer's model, float64, to C": 0.5,
    **{
        f"step of {name}, float{bits}, to the same in C++": 0.9
        for name in ("quadrotor", "newcomer's model")
        for bits in _BITS
    },
    **{f"formations of 4, float{bits}, shared gains to C": 0.8 for bits in _BITS},
    "formations of 4, float32, own gains to C": 0.5,
    "formations of 4, float64, own gains to C": 0.6,
    **{f"ring of Van der Pol, float{bits}, to plain C": 0.6 for bits in _BITS},
    **{f"ring of masses with drag, float{bits}, to plain C": 0.75 for bits in _BITS},
    "degree 6, 10,000, float32, to C": 1.5,
    "degree 6, 10,000, float64, to C": 1.0,
    **{f"ring of 1,000,000, float{bits}, to C": 0.75 for bits in _BITS},
    "echelon to crazyflow, bare plant": 8.0,
    "echelon to crazyflow, its controller": 35.0,
    "geometric graph of 1,000,000, float32, M/s": 25.0,
    "geometric graph of 1,000,000, float32, two threads to one": 1.6,
    **{f"formations of 4, float{bits}, two threads to one": 1.6 for bits in _BITS},
    "1,000 formations, float32, over a radio, M/s": 10.0,
    "1,000 formations, float32, radio to ideal": 0.25,
    "100,000 over a lossy radio, float32, M/s": 2.0,
    "1,000 formations, float64, wind and noise, to JAX": 5.0,
}
"""What each number must reach."""
_AT_MOST: Row = {
    "geometric graph of 1,000,000, float32, built and ordered, CPU s": 5.0,
    "geometric graph of 1,000,000, float32, peak GB": 3.0,
    "100,000 over a lossy radio, float32, peak GB": 2.0,
    "10,000 formations, 1,000 steps, cold, CPU s": 10.0,
    "10,000 formations, 1,000 steps, compiled, CPU s": 1.5,
    "10,000 runs of `paper` with dataset, reckoned, wall s": 180.0,
    **{f"every 20th state stored, float{bits}, to none": 1.15 for bits in _BITS},
    "a model traced and compiled, the slowest, CPU s": 1.0,
    "code of a model from the cache, the slowest, ms": 10.0,
    "`echelon run paper` warm, without figures, wall s": 3.0,
}
"""What each must not exceed."""


def turns(name: str, ways: dict[str, Callable[[], float]], count: int = _TURNS) -> Row:
    """Return the rates of some ways, taken in turn, in millions a second, and ratios to the first.

    Args:
        name: of what is stepped.
        ways: each returns the rate of one turn; the first is native code.
        count: turns of each.
    """
    found = {way: list[float]() for way in ways}
    for _ in range(count):
        for way, measure in ways.items():
            found[way].append(measure())
    best = {way: max(rates) for way, rates in found.items()}
    first, *others = best
    row = {f"{name}, {way}, M/s": round(value / 1e6, 2) for way, value in best.items()}
    return row | {f"{name}, to {way}": round(best[first] / best[way], 3) for way in others}


def measure_ring(
    agents: int, bits: int, yardstick: Yardstick | None, model: ech.ControlAffine | None = None
) -> Row:
    """Return the rates of a ring beside the yardstick's."""
    side = made.steppers(flock(ech.Graph.ring(agents), model), bits)
    # As many as a run takes between two looks at it.
    steps = side.native.longest
    name = "a newcomer's model" if model is not None else f"ring of {agents:,}"
    return turns(
        f"{name}, float{bits}",
        {"native": partial(rate, side.native, agents, [steps], side.reference, bits)}
        | _in_c(yardstick, agents, steps, lambda c: c.ring(agents, bits)),
    )


def _in_c(
    yardstick: Yardstick | None, agents: int, steps: int, make: Callable[[Yardstick], Any]
) -> dict[str, Callable[[], float]]:
    """Return the yardstick as a way to step, where there is one."""
    if yardstick is None:
        return {}
    return {"C": partial(yardstick.rate, make(yardstick), agents, steps)}


def measure_plain(name: str, bits: int, _: Yardstick | None) -> Row:
    """Return the rate of a ring of simple agents beside plain C without sums, if it compiles."""
    parts = plain_c.ring(name)
    side = made.steppers(parts, bits)
    ways = {"native": partial(rate, side.native, plain_c.AGENTS, [plain_c.STEPS], None, bits)}
    if plain_c.compiler() is not None:
        ways["plain C"] = plain_c.beside(name, side.native, bits)
    return turns(f"ring of {name}, float{bits}", ways)


def measure_degree(bits: int, yardstick: Yardstick | None) -> Row:
    """Return the rates of a graph of 10,000 agents with six neighbours each."""
    agents = 10_000
    if yardstick is None:
        return {}
    table = yardstick.problem.rand_regular(agents, 6)
    pairs = np.stack([np.repeat(np.arange(agents), 6), table.ravel()], axis=1)
    # Where two of its cycles share an edge, the kernel in C hears it twice.
    edges = np.unique(np.sort(pairs, axis=1), axis=0)
    side = made.steppers(flock(ech.Graph.from_edges(edges, agents=agents)), bits)
    steps = 100
    return turns(
        f"degree 6, 10,000, float{bits}",
        {"native": partial(rate, side.native, agents, [steps], side.reference, bits)}
        | _in_c(yardstick, agents, steps, lambda c: c.neighbours(agents, 6, bits)),
    )


def measure_stored(bits: int, _: Yardstick | None) -> Row:
    """Return what it costs to store every 20th state."""
    agents, some, never = 10_000, [20] * 10, [200]
    side = made.steppers(flock(ech.Graph.ring(agents)), bits)
    ways = {
        way: partial(rate, side.native, agents, counts, side.reference, bits)
        for way, counts in (("none", never), ("every 20th", some))
    }
    found = turns("", ways)[", to every 20th"]
    return {f"every 20th state stored, float{bits}, to none": found}


def measure_same(bits: int, _: Yardstick | None) -> Row:
    """Return how fast a follower's step is beside the same operations in C++."""
    from same_in_cpp import Follower

    row: Row = {}
    for name, model in (("quadrotor", None), ("newcomer's model", made.Newcomer())):
        side = made.steppers(flock(ech.Graph.ring(16), model), bits)
        follower = Follower(side.native, bits)
        ways = {"native": follower.native(), "the same in C++": follower.cpp()}
        start = follower.memory()
        ends = [follower.after(run, start, 20) for run in ways.values()]
        assert np.allclose(*ends, rtol=1e-3 if bits == 32 else 1e-9, atol=1e-6), "not the same"
        timed = {way: partial(follower.rate, run, start, 400) for way, run in ways.items()}
        row |= turns(f"step of {name}, float{bits}", timed)
    return row


def measure_formations(bits: int, yardstick: Yardstick | None) -> Row:
    """Return the rates of formations of 4, beside the yardstick's and on two threads."""
    agents, row = 4 * FORMATIONS, Row()
    shared, reference = made.formations(bits, False)
    own = made.formations(bits, True)[0]
    ways = {
        name: partial(rate, stepper, agents, [STEPS], reference, bits)
        for name, stepper in (("shared gains", shared), ("own gains", own))
    }
    ways |= _in_c(yardstick, agents, STEPS, lambda c: c.formations(bits))
    kind = f"formations of 4, float{bits}"
    found = turns(kind, ways)
    row |= {name: value for name, value in found.items() if name.endswith("M/s")}
    if yardstick is not None:
        for way in ("shared gains", "own gains"):
            rates = found[f"{kind}, {way}, M/s"], found[f"{kind}, C, M/s"]
            row[f"{kind}, {way} to C"] = round(rates[0] / rates[1], 3)
    both = {n: made.formations(bits, False, n)[0] for n in (1, 2)}
    told = agents, [STEPS], reference, bits, time.perf_counter
    flown = {n: partial(rate, stepper, *told) for n, stepper in both.items()}
    return row | {f"{kind}, two threads to one": _gained(flown[1], flown[2])}


def _gained(one: Callable[[], float], two: Callable[[], float]) -> float:
    """Return by how much faster one way is than another, taken in turn, in wall time."""
    pairs = [(one(), two()) for _ in range(_TURNS)]
    alone, shared = map(max, zip(*pairs, strict=True))
    return round(shared / alone, 2)


def scattered(agents: int) -> np.ndarray:
    """Return edges between points of a plane that are near, six for each in the mean, connected."""
    import scipy.sparse as sp
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import cKDTree

    points = np.random.default_rng(0).uniform(0.0, np.sqrt(agents), (agents, 2))
    edges = cKDTree(points).query_pairs(np.sqrt(6.0 / np.pi), output_type="ndarray")
    links = sp.coo_array((np.ones(len(edges), np.int8), edges.T), (agents, agents))
    label = connected_components(links.tocsr(), directed=False)[1]
    most = np.flatnonzero(label == np.bincount(label).argmax())
    place = np.full(agents, -1)
    place[most] = np.arange(len(most))
    return place[edges[label[edges[:, 0]] == label[most[0]]]]


def measure_geometric(bits: int, _: Yardstick | None) -> Row:
    """Return the rate of a large geometric graph, what it takes to build, and two threads."""
    from echelon.simulation.native.blocks import SwarmBlocks

    edges = scattered(_MILLION)
    agents, begin = int(edges.max()) + 1, time.process_time()
    graph = ech.Graph.from_edges(edges, agents=agents)
    built = time.process_time() - begin
    side = made.steppers(flock(graph), bits)
    begin = time.process_time()
    SwarmBlocks(side.native.loop, side.native.places.lanes)
    built += time.process_time() - begin
    crews = {n: ThreadPool(side.native.places, None, n) for n in (1, 2)}
    told = agents, [side.native.longest], side.reference, bits

    def fly(threads: int, clock: Callable[[], float] = time.perf_counter) -> float:
        side.native.threads = crews[threads]
        return rate(side.native, *told, clock)

    rates = [fly(1, time.process_time) for _ in range(2)]
    gained = _gained(partial(fly, 1), partial(fly, 2))
    name = f"geometric graph of 1,000,000, float{bits}"
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
    return {
        f"{name}, M/s": round(max(rates) / 1e6, 1),
        f"{name}, two threads to one": gained,
        f"{name}, built and ordered, CPU s": round(built, 2),
        f"{name}, peak GB": round(peak, 2),
    }


# ---- worlds that are not ideal ----


def measure_radio(_: Yardstick | None) -> Row:
    """Return the rates of formations over a radio, each with draws of its own, and without it."""
    radio = ech.build(ech.load_scenario("paper-radio"))[0]
    ways = dict[str, Callable[[], float]]()
    for way, parts in {"over a radio": radio, "ideal": radio.replace(world=ech.World())}.items():
        stepper, reference = made.seeded(parts, 32, 1_000)
        ways[way] = partial(rate, stepper, 4_000, [STEPS], reference, 32)
    found = turns("1,000 formations, float32", ways)
    best = [found.pop(f"1,000 formations, float32, {way}, M/s") for way in ways]
    return {
        "1,000 formations, float32, over a radio, M/s": best[0],
        "1,000 formations, float32, ideal, M/s": best[1],
        "1,000 formations, float32, radio to ideal": round(best[0] / best[1], 3),
    }


def measure_lossy_swarm(_: Yardstick | None) -> Row:
    """Return the rate of a swarm over a radio that loses messages, and the memory it takes."""
    edges, name = scattered(100_000), "100,000 over a lossy radio, float32"
    agents, parts = int(edges.max()) + 1, ech.build(ech.load_scenario("paper-radio"))[0]
    graph = ech.Graph.from_edges(edges, agents=agents)
    offsets = ech.Formation(np.zeros((agents, len(parts.model.state_names))))
    parts = parts.replace(graph=graph, formation=offsets, initial={"position": 1.0})
    side = made.steppers(parts, 32)
    ways = {"": partial(rate, side.native, agents, [20], side.reference, 32)}
    best = max(turns("", ways).values())
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
    return {f"{name}, M/s": best, f"{name}, peak GB": round(peak, 2)}


def measure_wind(_: Yardstick | None) -> Row:
    """Return the rates of formations in wind, that measure with noise, beside JAX's."""
    parts = ech.build(ech.load_scenario("paper-global"))[0]
    noise = ech.Sensing(noise={"position": 0.005, "velocity": 0.02})
    world = ech.World(sensing=noise, disturbance=ech.Disturbance(rms={"velocity": 1.0}))
    stepper, reference = made.seeded(parts.replace(world=world), 64, 1_000)
    by_jax = JaxFormations(stepper.loops, stepper.states, "")
    told = 4_000, [100], reference, 64
    both = {"native": partial(rate, stepper, *told), "JAX": partial(rate, by_jax, *told)}
    return {
        k.replace("float64, ", "float64, wind and noise, "): v
        for k, v in turns("1,000 formations, float64", both).items()
    }


# ---- whole runs ----------------------------------------------------------------------------------


def measure_fleet(_: Yardstick | None) -> Row:
    """Return the CPU seconds of 10,000 formations of `paper` for 1,000 steps."""
    scenario = ech.load_scenario("paper", ["simulation.horizon=5", "report.steady_window=1"])
    parts, chosen = ech.build(scenario)
    chosen = chosen._replace(precision="float32", store_every=1_000)
    fleet, row = Batch(1), Row()
    for name in ("cold", "compiled"):
        begin = time.process_time()
        for first in range(0, 10_000, 2_500):
            seeds = range(first, first + 2_500)
            flights = fleet.fly([(parts, chosen._replace(seed=k)) for k in seeds])
            assert all(isinstance(each, ech.Result) and each.outcome.reached for each in flights)
        told = f"10,000 formations, 1,000 steps, {name}, CPU s"
        row[told] = round(time.process_time() - begin, 2)
    return row


def measure_sweep(_: Yardstick | None) -> Row:
    """Return what a sweep of 10,000 runs of `paper` takes, reckoned from 20 and 1,000."""
    walls = list[float]()
    for runs in (20, 1_000):
        begin = time.perf_counter()
        ech.sweep(ech.load_scenario("paper"), {"seed": range(runs)})
        walls.append(time.perf_counter() - begin)
    whole = walls[0] + 10.0 * walls[1]
    return {"10,000 runs of `paper` with dataset, reckoned, wall s": round(whole, 1)}


def measure_models(_: Yardstick | None) -> Row:
    """Return what it takes to make native code of each bundled scenario's step."""
    makes, loads = Row(), Row()
    for name in ("van-der-pol", "unicycle", "planar-quadrotor", "paper"):
        side = made.steppers(ech.build(ech.load_scenario(name))[0], 64)
        # What JAX does once in a process is done.
        begin = time.process_time()
        kernel = Kernels().of(side.native.varying, 64, False, side.native.places.row_major)
        makes[name] = time.process_time() - begin
        loads[name] = min(_reloaded(kernel.made.text) for _ in range(3))
    return {
        "a model traced and compiled, the slowest, CPU s": round(max(makes.values()), 2),
        "code of a model from the cache, the slowest, ms": round(1e3 * max(loads.values()), 1),
    }


def measure_command(_: Yardstick | None) -> Row:
    """Return the wall time of `echelon run paper` when what it compiles is kept already."""
    walls = list[float]()
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "echelon", "run", "paper", "--no-figures", "--out"]
        around = {
            **os.environ,
            "ECHELON_CACHE": folder,
        }
        for k in range(2):
            begin = time.perf_counter()
            subprocess.run(
                [*command, f"{folder}/{k}"], env=around, check=True, stdout=subprocess.DEVNULL
            )
            walls.append(time.perf_counter() - begin)
    return {"`echelon run paper` warm, without figures, wall s": round(walls[1], 2)}


def measure_peers(_: Yardstick | None) -> Row:
    """Return how much faster than crazyflow many formations are stepped, turn by turn."""
    import peers

    names = ["echelon, float32, RK4", "crazyflow, bare plant", "crazyflow, its controller"]
    started = {name: peers.start(name, peers.ROOT / "build" / "peers") for name in names}
    workers = {name: worker for name, worker in started.items() if worker is not None}
    rates = {name: list[float]() for name in workers}
    for _turn in range(_TURNS):
        for name, worker in workers.items():
            rates[name].append(peers.ask(worker))
    for worker in workers.values():
        worker.communicate()
    pairs = {name: zip(rates[names[0]], rates[name], strict=True) for name in [*rates][1:]}
    found = {name: statistics.median(a / b for a, b in both) for name, both in pairs.items()}
    return {f"echelon to {name}": round(value, 2) for name, value in found.items()}


# ---- all of it -----------------------------------------------------------------------------------

Measure: TypeAlias = Callable[[Yardstick | None], Row]
_EACH = {"degree": measure_degree, "stored": measure_stored, "same": measure_same}
_EACH |= {"formations": measure_formations}
GROUPS: dict[str, list[Measure]] = {
    "kernels": [
        *(partial(measure_ring, 10_000, bits) for bits in _BITS),
        *(partial(measure_ring, 10_000, bits, model=made.Newcomer()) for bits in _BITS),
        *(partial(measure_plain, name, bits) for name in plain_c.MODELS for bits in _BITS),
        *(partial(measure, bits) for measure in _EACH.values() for bits in _BITS),
    ],
    "million": [partial(measure_ring, _MILLION, bits) for bits in _BITS],
    "geometric": [partial(measure_geometric, 32)],
    "worlds": [measure_lossy_swarm, measure_radio, measure_wind],
    "fleet": [measure_fleet, measure_sweep],
    "models": [measure_models, measure_command],
    "peers": [measure_peers],
}


def _reloaded(text: str) -> float:
    """Return the CPU seconds in which code is there again that was kept."""
    with tempfile.TemporaryDirectory() as folder:
        before = jax.config.values["jax_compilation_cache_dir"]
        jax.config.update("jax_compilation_cache_dir", folder)
        Code(text)
        begin = time.process_time()
        Code(text)
        spent = time.process_time() - begin
        jax.config.update("jax_compilation_cache_dir", before)
        return spent


def missed(row: Row) -> list[str]:
    """Return what of some numbers is not as asked, or not there, in words."""
    told = [f"{k} is missing" for k in (*_AT_LEAST, *_AT_MOST) if k not in row]
    told += [f"{k} is {row[k]}, asked {v}" for k, v in _AT_LEAST.items() if row.get(k, v) < v]
    return told + [f"{k} is {row[k]}, asked {v}" for k, v in _AT_MOST.items() if row.get(k, v) > v]


def measured(groups: list[str], yardstick: Path | None) -> Iterator[Row]:
    """Yield what is measured, each group in a process of its own."""
    for group in groups:
        command = [sys.executable, __file__, "--group", group]
        command += ["--yardstick", str(yardstick)] * (yardstick is not None)
        done = subprocess.run(command, stdout=subprocess.PIPE, text=True)
        yield from (json.loads(line) for line in done.stdout.splitlines() if line[:1] == "{")


def main() -> int:
    """Measure and print; return 1 where a number is missed."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--yardstick", type=Path, help="folder of the yardstick in C")
    parser.add_argument("--group", choices=GROUPS, help="measure here, and nothing else")
    parser.add_argument("--json", action="store_true", help="print JSON")
    asked = parser.parse_args()
    if asked.group is not None:
        yardstick = None if asked.yardstick is None else Yardstick(asked.yardstick)
        for measure in GROUPS[asked.group]:
            print(json.dumps(measure(yardstick)), flush=True)
        return 0
    began, all_ = time.perf_counter(), Row()
    for row in measured([*GROUPS], asked.yardstick):
        all_ |= row
        said = json.dumps(row) if asked.json else "\n".join(f"{k} {v}" for k, v in row.items())
        print(said, flush=True)
    short = missed(all_)
    print("\n".join(f"missed: {text}" for text in short), file=sys.stderr)
    print(f"{time.perf_counter() - began:.0f} s of wall", file=sys.stderr)
    return int(bool(short) and asked.yardstick is not None)


if __name__ == "__main__":
    sys.exit(main())
