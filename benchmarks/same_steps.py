"""Compare the steps of two versions of the code to the bit, over bundled and other worlds.

Run `python benchmarks/same_steps.py BEFORE [AFTER] [--only NAME ..]`, where both are folders `src`;
AFTER is that of this checkout unless given. Each world is run by JAX in a process of each version,
on the same machine, since the last bits depend on the processor. It prints for each world whether
states, inputs and all sums have the same bits, and the largest difference of the states.

`--store` writes the last states and inputs of BEFORE to `tests/simulation/steps.npz`, with which a
test compares later versions.
"""

import argparse
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
SHAPES = "formation.motion=[{reshape: {name: line, spacing: 0.7}, at: 0.3, over: 0.6}]"
RADIO = "network={rate: 50, delay: 0.02, loss: 0.1}"
WORLDS = {
    "paper": ("paper", 1.0, []),
    "paper in single precision": ("paper", 1.0, ["simulation.precision=float32"]),
    "paper-global": ("paper-global", 1.0, []),
    "paper-windy": ("paper-windy", 1.0, []),
    "paper-everything": ("paper-everything", 1.0, []),
    "paper-everything in single precision": (
        "paper-everything",
        1.0,
        ["simulation.precision=float32"],
    ),
    "paper-radio": ("paper-radio", 1.5, []),
    "paper-far": ("paper-far", 0.5, []),
    "paper-line": ("paper-line", 0.5, []),
    "paper-literal": ("paper-literal", 0.5, []),
    "reshape": ("reshape", 1.0, [SHAPES]),
    "crossing": ("crossing", 3.0, []),
    "chain-30": ("chain-30", 0.5, []),
    "line-10": ("line-10", 0.5, []),
    "unicycle": ("unicycle", 1.0, []),
    "planar-quadrotor": ("planar-quadrotor", 0.5, []),
    "van-der-pol": ("van-der-pol", 1.0, []),
    "integrators": ("integrators", 1.0, []),
    "yaw-turn": ("yaw-turn", 1.0, []),
    "leader-lost": ("leader-lost", 9.0, []),
    "leader lost early": ("leader-lost", 1.6, ["events=[{at: 0.6, lose: 0}]"]),
    "lost and returns, late": (
        "leader-lost",
        1.8,
        ["events=[{at: 0.4, lose: 0}, {at: 1.2, join: 0}]", "leadership.timeout=0.3"],
    ),
    "backups in the ideal network": (
        "leader-lost",
        1.5,
        ["network=null", "events=[{at: 0.4, lose: 0}, {at: 1.0, join: 0}]"],
    ),
    "follower lost": ("paper", 1.2, ["events=[{at: 0.3, lose: 3}, {at: 0.8, join: 3}]"]),
    "follower lost, stopping points": (
        "paper-global",
        1.2,
        ["events=[{at: 0.3, lose: 3}, {at: 0.8, join: 3}]"],
    ),
    "cut link": ("paper-global", 1.0, ["events=[{at: 0.3, cut: [1, 2], for: 0.4}]"]),
    "parent": ("paper", 1.0, ["follower.feedforward=parent"]),
    "rotating, consensus": ("paper", 0.8, ["formation.motion=[{rotate: 0.3}]"]),
    "packet": ("paper-radio", 1.0, ["network.prediction=packet"]),
    "packet, consensus": (
        "paper",
        0.8,
        ["network={rate: 50, delay: 0.02, loss: 0.2, prediction: packet}"],
    ),
    "states, leaderward": (
        "paper-radio",
        0.8,
        ["network.messages=state", "network.hears=leaderward"],
    ),
    "bursts, deviations leaderward": (
        "paper-radio",
        0.8,
        ["network.hears=leaderward", "network.bursts={share: 0.3, length: 0.2}"],
    ),
    "late, noisy, estimated": (
        "paper-global",
        0.8,
        [
            "sensing={delay: 0.02, noise: {position: 0.01}, estimator: constant-gain}",
            "simulation.substeps=2",
        ],
    ),
    "late states": ("paper", 0.8, ["sensing={delay: 0.01}"]),
    "crossing over a radio": ("crossing", 0.8, [RADIO]),
    "noise and wind, common, levels": (
        "paper-global",
        0.8,
        [
            "disturbance={rms: {velocity: 0.5}, input_rms: {thrust: 0.1}, common: true, "
            "hold: 0.1, constant: {velocity: 0.1}}",
            "actuator={levels: 256}",
        ],
    ),
    "gusts, air, lag": (
        "paper-global",
        0.8,
        [
            "disturbance={rms: {velocity: 0.5}, time: 0.3, air: [0.5, 0, 0], drag: 0.2}",
            "actuator={lag: 0.03}",
        ],
    ),
}
"""Name -> scenario, horizon (s), overrides."""
PARTS, STORED = ("states", "inputs"), ROOT / "tests" / "simulation" / "steps.npz"
"""What is stored of the last frame of each world, and where."""


def arrays_of(name: str) -> dict[str, np.ndarray]:
    """Return states, inputs and sums of a world, as this process's version of the code has them."""
    from echelon.experiments.scenario.build import build, run
    from echelon.experiments.scenario.scenario import load_scenario

    scenario, horizon, overrides = WORLDS[name]
    fixed = ["simulation.engine=jax", f"simulation.horizon={horizon}", "simulation.store_every=2"]
    loaded = load_scenario(scenario, [*fixed, "report.steady_window=0.2", *overrides])
    result = run(loaded, built=build(loaded))
    sums = {f"sum {key}": np.asarray(x) for key, x in result.sums._asdict().items()}
    return {"states": np.asarray(result.states), "inputs": np.asarray(result.inputs), **sums}


def main() -> int:
    """Compare the worlds, and return 1 where one differs."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("before", type=Path)
    parser.add_argument("after", type=Path, nargs="?", default=ROOT / "src")
    parser.add_argument("--only", nargs="*", default=list(WORLDS))
    parser.add_argument("--store", action="store_true", help="write the values of the test")
    parser.add_argument("--write", type=Path, help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.write:
        for name in given.only:
            try:
                np.savez(given.write / f"{name}.npz", **arrays_of(name))
            except Exception as error:
                (given.write / f"{name}.error").write_text(repr(error))
        return 0
    if given.store:
        stored = {name: arrays_of(name) for name in WORLDS}
        rows = {f"{k} {part}": x[part][-1] for k, x in stored.items() for part in PARTS}
        np.savez_compressed(STORED, **rows)
        return 0
    differ = 0
    with tempfile.TemporaryDirectory() as folder:
        places = [Path(folder) / "before", Path(folder) / "after"]
        for place, source in zip(places, (given.before, given.after), strict=True):
            place.mkdir()
            call = [sys.executable, __file__, str(source), "--write", str(place), "--only"]
            paths = [source.resolve(), *source.resolve().parent.glob("packages/*/src")]
            env = {"PYTHONPATH": ":".join(map(str, paths)), "ECHELON_CACHE": "off", "PATH": ""}
            subprocess.run([*call, *given.only], env=env, check=True)
        for name in given.only:
            same, text = compared(*(place / f"{name}.npz" for place in places))
            differ += not same
            print(f"{name:40s} {text}")
    return int(differ > 0)


def compared(before: Path, after: Path) -> tuple[bool, str]:
    """Return whether two stored worlds have the same bits, and what differs in words."""
    for place in (before, after):
        if not place.exists():
            return False, f"{place.parent.name}: {place.with_suffix('.error').read_text()}"
    one, two = np.load(before), np.load(after)
    names = [k for k in one if not np.array_equal(one[k], two[k], equal_nan=True)]
    if not names:
        return True, "same bits"
    change = float(np.nanmax(np.abs(one["states"] - two["states"])))
    return False, f"states differ by {change:.2g}; other bits: {', '.join(names)}"


if __name__ == "__main__":
    sys.exit(main())
