"""Runs with one planted cause each: is that cause named, and is a false one?

Each family takes a scenario whose agents arrive, plants one cause of a poor run, and draws its size
or the starts, and the seed; what would be compiled anew is the same in a family. Named are the
changes of `echelon causes` under "would not have happened": a name is right if it is the planted
one, and false if it is none of the family's. All 60 runs take half an hour of a processor.
Run it with `python benchmarks/causes.py [FAMILY ...]`.
"""

import sys
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from echelon.experiments.scenario.scenario import scenario_from_mapping
from echelon.experiments.studies.causes import CauseStudy, causes

RUNS, SECONDS = 5, 600.0
"""Runs of a family; no time limit, since the machine is not what is judged."""
ROOT = 3.0**0.5
P = [[ROOT, 0, 1, 0], [0, ROOT, 0, 1], [1, 0, ROOT, 0], [0, 1, 0, ROOT]]
BASE: dict[str, Any] = {
    "name": "planted",
    "model": {"name": "double-integrator", "parameters": {"dimension": 2}},
    "graph": {"name": "path", "agents": 3},
    "formation": {"name": "line"},
    "reference": {"name": "circle", "radius": 2.0, "rate": 0.5},
    "initial": {"spread": {"position": 0.3}},
    # The model's own gain, given, so that another one is not another kind of gain.
    "leader": {"gain": {"method": "given", "P": P, "R": [1.0, 1.0]}},
    "simulation": {"horizon": 15.0, "dt": 0.02, "store_every": 10},
}
STIFF = [[0, 1, 0], [0, -20, 400]]


class Planted(NamedTuple):
    """A family of runs.

    Attributes:
        right: the name of the planted cause.
        others: names that are true as well.
        keys: of the scenario, from a generator of random numbers.
    """

    right: str
    others: tuple[str, ...]
    keys: Callable[[np.random.Generator], dict[str, Any]]


def spread(random: np.random.Generator) -> dict[str, Any]:
    """A drawn spread of the starts; numbers of a path would be compiled anew."""
    return {"spread": {"position": float(random.uniform(0.1, 1.0))}}


def stiff(random: np.random.Generator) -> dict[str, Any]:
    """A motor's current, faster than a step of the integrator allows, and stable as it is held."""
    fast = float(random.uniform(2.2e3, 3.8e3))
    rows = [*STIFF, [0, -50, -fast]]
    names = {"names": ["angle", "rate", "current"]}
    parameters = {"A": rows, "B": [[0], [0], [fast / 50.0]], **names}
    return {
        "model": {"name": "linear", "parameters": parameters},
        "formation": {},
        "leader": {},
        "reference": None,
        "initial": {"spread": {"angle": 1.0}},
        "simulation": {"horizon": 12.0, "dt": 0.01, "store_every": 10},
    }


def fast_path(random: np.random.Generator) -> dict[str, Any]:
    """A quadrotor in a plane on a circle for which its motors are too weak."""
    return {
        "model": {"name": "planar-quadrotor"},
        "leader": {},
        "reference": {"name": "circle", "radius": 2.0, "rate": 3.0},
        "initial": {"spread": {"position": float(random.uniform(0.0, 0.3))}},
        "simulation": {"horizon": 8.0, "dt": 0.01, "store_every": 10},
    }


SLOWER = "a path of half the speed"
FAMILIES: dict[str, Planted] = {
    "late sensors": Planted(
        "exact sensors", (), lambda r: {"sensing": {"delay": 0.4}, "initial": spread(r)}
    ),
    "noisy sensors": Planted(
        "exact sensors",
        (),
        lambda r: {"sensing": {"noise": {"position": float(r.uniform(0.2, 0.5))}}},
    ),
    "actuator lag": Planted(
        "no actuator lag", (), lambda r: {"actuator": {"lag": float(r.uniform(0.7, 1.2))}}
    ),
    "constant wind": Planted(
        "no disturbance",
        (),
        lambda r: {"disturbance": {"constant": {"vx": float(r.uniform(0.3, 1.0))}}},
    ),
    "random wind": Planted(
        "no disturbance",
        (),
        lambda r: {"disturbance": {"rms": {"velocity": float(r.uniform(0.5, 1.0))}}},
    ),
    "network": Planted(
        "an ideal network",
        (),
        lambda r: {"network": {"messages": "state", "delay": 0.2}, "initial": spread(r)},
    ),
    "plant": Planted(
        "agents equal to the model",
        (),
        lambda r: {"plant": {"parameters": {"drag": float(r.uniform(0.3, 1.0))}}},
    ),
    "single precision": Planted(
        "float64",
        (),
        lambda r: {
            "reference": {**BASE["reference"], "center": [5e6, 0.0, 0.0]},
            "initial": spread(r),
            "simulation": {**BASE["simulation"], "precision": "float32"},
        },
    ),
    "stiff model": Planted("substeps", ("half the step `dt`",), stiff),
    "no feed-forward": Planted(
        "the leader's input relayed",
        (),
        lambda r: {
            "follower": {"feedforward": "none"},
            "initial": spread(r),
        },
    ),
    "fast path": Planted(SLOWER, ("no limits of the inputs",), fast_path),
    "a late agent": Planted(
        "no events",
        ("starts at the goals",),
        lambda r: {
            "initial": {"spread": {"position": float(r.uniform(1.5, 2.5))}},
            "events": [{"at": 14.2, "join": 2}],
        },
    ),
}


def planted(family: str, k: int) -> dict[str, Any]:
    """Return the scenario of a run of a family."""
    random = np.random.default_rng([len(family), k])
    keys = {**BASE, **FAMILIES[family].keys(random), "seed": k}
    return {key: value for key, value in keys.items() if value is not None}


def named(study: CauseStudy) -> set[str]:
    """Return the causes that are named, substeps without their number."""
    words = {trial.words for role in study.poor for trial in study.causes(role)}
    return {"substeps" if word.endswith(" substeps") else word for word in words}


def main(families: list[str]) -> None:
    """Print a line for each run, and the counts."""
    right = false = poor = runs = 0
    for family in families or FAMILIES:
        plan = FAMILIES[family]
        for k in range(RUNS):
            began = time.perf_counter()
            study = causes(scenario_from_mapping(planted(family, k)), SECONDS)
            names = named(study)
            wrong = names - {plan.right, *plan.others}
            runs, poor = runs + 1, poor + bool(study.poor)
            right, false = right + (plan.right in names), false + bool(wrong)
            helps = [x.words for x in study.trials if "explains" in [*x.effects.values()]]
            print(
                f"{family} {k}: {'+'.join(study.poor) or 'ARRIVED'}; named {sorted(names)}; "
                f"false {sorted(wrong)}; helps {helps}; {time.perf_counter() - began:.0f} s",
                flush=True,
            )
    print(f"{runs} runs, {poor} poor: right cause named {right}, false cause named {false}")


if __name__ == "__main__":
    main(sys.argv[1:])
