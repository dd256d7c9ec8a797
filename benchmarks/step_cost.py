"""Compare what a step costs in two versions of the code: `python benchmarks/step_cost.py BEFORE`.

BEFORE and AFTER are folders `src`; AFTER is that of this checkout unless given. A process of each
version compiles its loops once; then both step in turns, round after round, and the medians of the
times are compared. `--rounds` is 25 unless given.
"""

import argparse
import json
import os
import statistics
import subprocess
import sys
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
WORLDS = {
    "paper": ("paper", 0),
    "paper-global": ("paper-global", 0),
    "paper-radio": ("paper-radio", 0),
    "ring of 1,000": ("paper", 1000),
    "ring of 1,000, paper-global": ("paper-global", 1000),
    "ring of 1,000 over a radio": ("paper-radio", 1000),
}
STEPS = {0: 2000, 1000: 40}


def worker() -> None:
    """Step the world that each line names, with its engine, and answer with the seconds."""
    import echelon as ech

    def parts_of(name: str, agents: int) -> tuple[ech.Parts, ech.Settings]:
        parts, settings = ech.build(ech.load_scenario(name))
        if agents:
            graph = ech.Graph.ring(agents)
            parts = parts.replace(graph=graph, formation=ech.Formation.circle(parts.model, graph))
        return parts, settings

    for line in sys.stdin:
        name, agents, engine = json.loads(line)
        parts, settings = parts_of(name, agents)
        steps = STEPS[agents] * (20 if engine == "native" else 1)
        settings = settings._replace(
            horizon=steps * settings.dt, engine=engine, store_every=steps, steady_window=None
        )
        ech.simulate(parts, settings)
        for _ in sys.stdin:
            begin = time.process_time()
            ech.simulate(parts, settings)
            print(json.dumps(time.process_time() - begin), flush=True)
            if json.loads(_) == "last":
                break


def ask(process: subprocess.Popen[str], what: object) -> None:
    """Send a line to a process."""
    assert process.stdin is not None
    process.stdin.write(json.dumps(what) + "\n")
    process.stdin.flush()


def main() -> None:
    """Compare both."""
    if "--worker" in sys.argv:
        return worker()
    parser = argparse.ArgumentParser()
    parser.add_argument("before")
    parser.add_argument("after", nargs="?", default=str(ROOT / "src"))
    parser.add_argument("--rounds", type=int, default=25)
    args = parser.parse_args()
    both = []
    for source in (args.before, args.after):
        paths = [Path(source).resolve(), *Path(source).resolve().parent.glob("packages/*/src")]
        home = {**os.environ, "PYTHONPATH": os.pathsep.join(map(str, paths))}
        command = [sys.executable, __file__, "--worker"]
        pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
        both.append(subprocess.Popen(command, env=home, **pipes))
    for name, (scenario, agents) in WORLDS.items():
        for engine in ("jax", "native") if scenario != "paper-radio" else ("jax",):
            times = compare(both, [scenario, agents, engine], args.rounds)
            ratios = [after / before for before, after in zip(*times, strict=True)]
            a, b = map(statistics.median, times)
            quartiles = statistics.quantiles(ratios, n=4)
            print(
                f"{name}, {engine}: {1e3 * a:.0f} and {1e3 * b:.0f} ms, "
                f"ratio {statistics.median(ratios):.3f} [{quartiles[0]:.3f}, {quartiles[2]:.3f}]",
                flush=True,
            )
    return None


def compare(
    both: list[subprocess.Popen[str]], world: list[object], rounds: int
) -> tuple[list[float], list[float]]:
    """Return the seconds of both in turns."""
    times: tuple[list[float], list[float]] = ([], [])
    for process in both:
        ask(process, world)
    for number in range(rounds):
        order = (0, 1) if number % 2 else (1, 0)
        for k in order:
            ask(both[k], "last" if number == rounds - 1 else "next")
            assert both[k].stdout is not None
            times[k].append(json.loads(both[k].stdout.readline()))
    return times


if __name__ == "__main__":
    main()
