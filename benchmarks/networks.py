"""Measure what a network, and plants that are not ideal, leave of a formation's error.

Run `python benchmarks/networks.py [SEEDS]` (some ten minutes on two cores for 8 seeds). Printed is
the largest error of a follower in the last 4 of 15 s of the worst seed, mm; of paper-everything
the root mean square of the worst follower, its mean over the seeds and the worst seed. The figures
stand on the page of networks.
"""

import sys

import numpy as np

import echelon as ech

ONE_WAY, TREE = "graph.directed=true", "graph.directed=false"
WINDOW = 4.0  # s
NEAR = 0.01  # m

LATE = "network={delay: 0.02, jitter: 0.03, loss: 0.2}"
LAG = "actuator={lag: 0.03}"
HELD = ("simulation.dt=0.01", "simulation.substeps=2", "simulation.store_every=5")
MASS = ", ".join(f"{k}: {{scale: {{mass: {m}}}}}" for k, m in enumerate((0.9, 1.2, 0.8, 1.1)))
ROLES = ("leader", "follower")
SCALE = tuple(f"{role}.observer={{push: 8, scale: 2}}" for role in ROLES)

CASES: dict[str, tuple[str, ...]] = {
    "50 Hz, 20 ms": ("paper-global", ONE_WAY, "network={delay: 0.02}"),
    "50 Hz, 20 to 50 ms, 20 % lost": ("paper-global", ONE_WAY, LATE),
    "10 Hz": ("paper-global", ONE_WAY, "network={rate: 10}"),
    "out a third of the time, for 0.5 s": (
        *("paper-global", ONE_WAY, "network={bursts: {share: 0.33, length: 0.5}}"),
    ),
    "300 ms": ("paper-global", ONE_WAY, "network={delay: 0.3}"),
    "300 ms, lag 30 ms": ("paper-global", ONE_WAY, "network={delay: 0.3}", LAG),
    "10 Hz, 1 s": ("paper-global", ONE_WAY, "network={rate: 10, delay: 1, forget: 1.5}"),
    "95 % lost": ("paper-global", ONE_WAY, "network={loss: 0.95}"),
    "tree, 20 ms": ("paper-global", TREE, "network={delay: 0.02}"),
    "tree, 300 ms": ("paper-global", TREE, "network={delay: 0.3}"),
    "Riccati, 20 to 50 ms, 20 % lost": ("paper", ONE_WAY, LATE),
    "lag 30 ms": ("paper-global", ONE_WAY, LAG),
    "lag 50 ms": ("paper-global", ONE_WAY, "actuator={lag: 0.05}"),
    "lag 30 ms, held at 100 Hz": ("paper-global", ONE_WAY, LAG, *HELD),
    "motors of 8 bits": ("paper-global", ONE_WAY, "actuator={levels: 256}"),
    "masses 20 % off, scale found": (
        *("paper-global", ONE_WAY, f"plant={{agents: {{{MASS}}}}}", *SCALE),
    ),
}
NO_ESTIMATOR = "sensing.estimator=none"
EVERYTHING: dict[str, tuple[str, ...]] = {
    "as it is": (),
    "without the estimator": (NO_ESTIMATOR,),
    "nor the scale": (NO_ESTIMATOR, *(f"{role}.observer={{push: 16}}" for role in ROLES)),
}


def flown(name: str, *overrides: str, seed: int) -> ech.Result:
    """Return a run of 15 s."""
    window = "simulation.horizon=15", f"report.steady_window={WINDOW}", f"seed={seed}"
    return ech.simulate(*ech.build(ech.load_scenario(name, [*window, *overrides])))


def largest(result: ech.Result) -> tuple[float, float]:
    """Return the largest error in the window (mm), and from when on all are within 1 cm (s)."""
    errors, times = result.formation_errors.max(axis=1), result.times
    far = np.flatnonzero(errors > NEAR)
    arrived = times[min(far[-1] + 1, len(times) - 1)] if len(far) else 0.0
    return 1e3 * float(errors[times >= times[-1] - WINDOW].max()), float(arrived)


def main() -> None:
    """Print the tables."""
    seeds = range(int(sys.argv[1]) if sys.argv[1:] else 8)
    for case, (name, *overrides) in CASES.items():
        rows = [largest(flown(name, *overrides, seed=seed)) for seed in seeds]
        worst, last = np.max(rows, axis=0)
        print(f"{case}: {worst:.3g} mm, within 1 cm after {last:.2f} s", flush=True)
    for case, overrides in EVERYTHING.items():
        runs = (flown("paper-everything", *overrides, seed=seed) for seed in seeds)
        values = [1e3 * (ech.metrics(run).worst_steady or np.nan) for run in runs]
        print(f"everything, {case}: mean {np.mean(values):.3g}, worst {max(values):.3g} mm")


if __name__ == "__main__":
    main()
