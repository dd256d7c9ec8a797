"""Measure the gentle design of the law `stopping-point`, whose motors are certified.

Run `python benchmarks/stopping.py` (some minutes; `--starts 100` is quicker). It counts how many of
the paper's starts lie inside the certificate with motors, flies them, and flies those of a few in
wind, with a false mass and in gusts. The tables stand in docs/theory/stopping_points.md.
"""

import argparse
import time
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

import echelon as ech
from echelon.core.numerics import precision
from echelon.core.types import Array
from echelon.experiments.results.metrics import metrics
from echelon.guarantees.stopping.motor_load import motor_load_of
from echelon.guarantees.stopping.stopping_run import stopping_run_of
from echelon.simulation.engine.batch import Batch
from echelon.simulation.engine.parts import Starts
from echelon.simulation.engine.prepare import prepare

GENTLE = (
    "follower.roots=[2, 2.5, 3]",
    "leader.roots=[2, 2.5, 3]",
    "follower.speed=[1.4, 1.4, 0.7, 0.3]",
    "leader.speed=[0.7, 0.7, 0.7, 0.3]",
)
WIND = (*GENTLE[:2], "follower.speed=[1.4, 1.4, 1.3, 0.3]", "leader.speed=[0.7, 0.7, 1.3, 0.3]")


def built(*changes: str) -> tuple[ech.Parts, ech.Settings]:
    """Return the paper's experiment under changes."""
    return ech.build(ech.load_scenario("paper-global", overrides=list(changes)))


def inside(count: int, *changes: str) -> int:
    """Return how many starts of a scenario are certified with motors."""
    parts, settings = built(*GENTLE, *changes)
    parts = prepare(parts, settings).parts
    with precision("float64"):
        starts = map(Starts(parts), range(count))
        runs = (stopping_run_of(parts, settings, states) for states in starts)
        return sum(motor_load_of(run)[0] is not None for run in runs)


def table_of_starts(count: int) -> None:
    """Print how many starts are inside, of the paper's, at rest and level, and at any phase."""
    began = time.process_time()
    print(f"paper's starts inside: {inside(count)} of {count}", flush=True)
    print(f"  ({time.process_time() - began:.3g} s of a processor)")
    level = [f"{k}: [{x}, {y}, 1.0, {', '.join(['0'] * 9)}]" for k, x, y in _PLACES]
    print(
        f"at rest and level: {inside(1, 'initial.states={' + ', '.join(level) + '}')} of 1",
        flush=True,
    )
    few, phases = max(1, count // 50), np.linspace(0.0, 2.0 * np.pi, 12, endpoint=False)
    for spread in (0.25, 0.3):
        change = f"initial.spread={{position: 1.0, attitude: {spread}}}"
        found = sum(inside(few, change, f"reference.phase={phase}") for phase in phases.tolist())
        print(f"at 12 phases, +-{spread} rad: {found} of {12 * few}")


_PLACES = ((1, 3.0, 0.5), (2, -2.0, 4.0), (3, 0.0, -3.0))


def flights(count: int, *changes: str) -> Iterator[dict[str, Any]]:
    """Yield what flights of a scenario come to."""
    parts, settings = built(*changes)
    runs = [(parts, settings._replace(seed=seed, store_every=10)) for seed in range(count)]
    for found in Batch().fly(runs):
        if isinstance(found, Exception):
            raise found
        numbers, errors = metrics(found), found.formation_errors
        late = np.flatnonzero((errors >= 0.01).any(axis=1))
        yield {
            "1 cm": float(found.times[min(late[-1] + 1, len(errors) - 1)]) if len(late) else 0.0,
            "followers": [one.steady_rmse for one in numbers.followers],
            "leader": numbers.leader.steady_rmse,
            "limited": float(found.saturated.max()),
        }


def column(rows: Sequence[dict[str, Any]], name: str) -> Array:
    """Return a number of all flights."""
    return np.array([row[name] for row in rows], float)


def table_of_flights(count: int) -> None:
    """Print how the paper's starts are flown."""
    rows = list(flights(count, *GENTLE))
    times, errors = column(rows, "1 cm"), column(rows, "followers")
    whole = np.sqrt((errors**2).mean(axis=1))
    print(f"1 cm: median {np.median(times):.3g} s, worst {times.max():.3g} s")
    print(f"RMSE 8..10 s: median {np.median(whole):.3g} m, worst {whole.max():.3g} m")
    print(f"steps at a limit: {column(rows, 'limited').max():.3g}")


def table_of_pushes(count: int) -> None:
    """Print followers' and leader's RMSE in the last 10 of 30 s."""
    long = ("simulation.horizon=30", "report.steady_window=10")
    kinds = {
        "wind 1 m/s^2 on all": ("disturbance.constant={vx: 1.0}",),
        "mass +10 % on all": ("plant.parameters={mass: 0.0308}",),
        "gusts 1 m/s^2 rms, 0.5 s": ("disturbance={rms: {velocity: 1.0}, hold: 0.5}",),
    }
    for name, changes in kinds.items():
        rows = list(flights(count, *WIND, *long, *changes))
        followers = np.sqrt((column(rows, "followers") ** 2).mean(axis=0))
        led = float(np.sqrt((column(rows, "leader") ** 2).mean()))
        shown = ", ".join(f"{x:.2g}" for x in followers.tolist())
        print(f"{name}: followers {shown} m; leader {led:.2g} m")


def main() -> None:
    """Print all tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--starts", type=int, default=1000)
    parser.add_argument("--pushed", type=int, default=8)
    parser.add_argument("--only", choices=["starts", "flights", "pushes"])
    asked = parser.parse_args()
    if asked.only in (None, "starts"):
        table_of_starts(asked.starts)
    if asked.only in (None, "flights"):
        table_of_flights(asked.starts)
    if asked.only in (None, "pushes"):
        table_of_pushes(asked.pushed)


if __name__ == "__main__":
    main()
