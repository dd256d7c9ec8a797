"""Feed the command line nonsense: no crash, no hang, no silence; `python3 dev.py fuzz [SECONDS]`.

Scenario files, `--set`, gain files, folders of runs, whole command lines and experiments far too
large are drawn by a seeded grammar: sound ones with a few things spoiled. What must hold of each:
it ends within its time, with an exit code that the help lists, without a traceback or a library's
warning, and if it refuses, then in whole sentences.

A process forks after the libraries are imported and before JAX begins, and runs a few hundred
cases one after another, so that what is refused costs milliseconds and what is compiled is compiled
once. A hang, a crash or a hunger for memory ends it, and the next one goes on behind that case.
What looks faulty is repeated in a process of its own, as all cases are with `--alone`.
"""

import argparse
import contextlib
import copy
import gc
import json
import math
import multiprocessing
import os
import random
import re
import resource
import signal
import sys
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, NamedTuple

ALLOWED = {0, 1, 2, 3, 4, 5}
"""Exit codes: done, not promised, bad input, diverged, an optional part is missing, incomplete."""
CPU = 20
"""Seconds of computing after which a case hangs; compiling takes some 5 of them."""
REFUSING = 10
"""Seconds of computing after which what is refused should have been refused."""
MEMORY = 4 << 30
"""Bytes of resident memory that no case of these needs."""
BATCH = 1000
"""Cases that one process runs; what JAX keeps of each adds up."""

BASES: list[dict[str, Any]] = [
    {
        "name": "carts",
        "model": {"name": "double-integrator", "parameters": {"dimension": 2, "drag": 0.1}},
        "graph": {"edges": [[0, 1], [1, 2, 0.5]], "leaders": [0]},
        "formation": {"offsets": {1: [1.0, 0.0], 2: [2.0, 0.0]}},
        "reference": {"name": "circle", "radius": 1.0, "rate": 0.5, "center": [0, 0, 1]},
        "leader": {"law": "tracking", "reacts": False, "start_error": {"x": 0.1}},
        "follower": {
            "law": "consensus",
            "gain": {"method": "riccati", "Q": [1, 1, 1, 1], "coupling": 1.5},
            "feedforward": "relay",
        },
        "initial": {"spread": {"position": 0.5}},
        "disturbance": {"rms": {"velocity": 0.1}, "hold": 0.1},
        "simulation": {"horizon": 0.2, "dt": 0.02, "store_every": 2},
        "report": {"steady_window": 0.05},
        "seed": 3,
    },
    {
        "name": "ring",
        "model": {"name": "van-der-pol", "parameters": {"damping": 1.0}},
        "plant": {"scale": {"damping": 1.1}},
        "graph": {"name": "ring", "agents": 4, "leaders": [0]},
        "follower": {"gain": {"method": "given", "P": [2, 1], "coupling": 2.0}},
        "initial": {"states": {1: [0.5, 0.0], 2: [0.0, 0.5]}},
        "simulation": {"horizon": 0.1, "dt": 0.02, "integrator": "euler"},
    },
    {
        "name": "points",
        "model": {"name": "single-integrator", "parameters": {"dimension": 2}},
        "graph": {"name": "grid", "rows": 2, "columns": 2},
        "formation": {"name": "grid", "spacing": 0.5, "columns": 2},
        "leader": {"law": "agreement"},
        "follower": {"law": "agreement"},
        "simulation": {"horizon": 0.1, "dt": 0.05, "limits": False, "precision": "float32"},
    },
    {
        "name": "radio",
        "model": {"name": "double-integrator", "parameters": {"dimension": 2}},
        "graph": {"edges": [[0, 1], [1, 2], [1, 3]], "directed": True, "leaders": [0]},
        "formation": {"offsets": {1: [1.0, 0.0], 2: [2.0, 0.0], 3: [2.0, 1.0]}},
        "reference": {"name": "circle", "radius": 1.0, "rate": 0.5, "center": [0, 0, 1]},
        "leader": {"law": "stopping-point", "speed": 1.0},
        "follower": {"law": "stopping-point", "rate": 4.0, "speed": [1.0, 0.8]},
        "network": {
            "rate": 25.0,
            "delay": 0.04,
            "jitter": 0.02,
            "loss": 0.1,
            "bursts": {"share": 0.1, "length": 0.2},
            "forget": 0.6,
        },
        "sensing": {"delay": 0.02, "noise": {"position": 0.01}},
        "actuator": {"lag": 0.03},
        "initial": {"spread": {"position": 0.5}},
        "simulation": {"horizon": 0.2, "dt": 0.02},
    },
    {
        "name": "apart",
        "model": {"name": "double-integrator", "parameters": {"dimension": 2}},
        "graph": {
            "edges": [[0, 1], [1, 2]],
            "schedule": [{"at": 0.1, "edges": [[0, 2], [1, 2, 0.5]]}],
            "period": 0.2,
            "leaders": [0],
        },
        "formation": {"offsets": {1: [1.0, 0.0], 2: [2.0, 0.0]}},
        "leader": {"law": "stopping-point"},
        "follower": {"law": "stopping-point", "rate": 3.0, "coupling": 4.0, "observer": False},
        "safety": {"radii": [0.1, 0.1, 0.3], "gain": 4.0, "margin": 0.02, "reach": 4.0},
        "initial": {"states": {1: [0.5, 0.5, 0.0, 0.0]}},
        "simulation": {"horizon": 0.2, "dt": 0.02},
    },
]
CHANGING: list[dict[str, Any]] = [
    {
        "name": "dance",
        "model": {"name": "double-integrator", "parameters": {"dimension": 3}},
        "graph": {"edges": [[0, 1], [1, 2], [0, 3]], "leaders": [0]},
        "formation": {
            "name": "wedge",
            "spacing": 1.5,
            "motion": [
                {"rotate": 0.4},
                {"scale": 0.2, "rate": 0.5},
                {
                    "reshape": {"name": "line", "spacing": 1.5},
                    "at": 0.04,
                    "over": 0.1,
                    "assign": "nearest",
                },
            ],
        },
        "reference": {"name": "circle", "radius": 1.0, "rate": 0.5},
        "leader": {"law": "stopping-point"},
        "follower": {"law": "stopping-point", "speed": 1.0},
        "safety": {
            "radii": [0.1, 0.1, 0.3],
            "gain": 3.0,
            "swirl": 0.4,
            "margin": 0.03,
            "reach": 6.0,
        },
        "simulation": {"horizon": 0.2, "dt": 0.02},
    },
    {
        "name": "places",
        "model": {"name": "double-integrator"},
        "graph": {"name": "path", "agents": 4},
        "formation": {
            "name": "circle",
            "spacing": 1.0,
            "assign": "nearest",
            "motion": [
                {"reshape": {"offsets": {1: [1, 0], 2: [2, 0], 3: [3, 0]}}, "at": 0.1, "over": 0.2},
                {"reshape": {"name": "grid", "columns": 2}, "at": 0.4, "over": 0.5},
            ],
        },
        "follower": {"gain": {"method": "riccati"}},
        "initial": {"states": {1: [0.5, 0, 0, 0], 2: [1, 1, 0, 0], 3: [0, 1, 0, 0.1]}},
        "simulation": {"horizon": 0.6, "dt": 0.02},
    },
    {
        "name": "losses",
        "model": {"name": "double-integrator", "parameters": {"dimension": 2}},
        "graph": {"edges": [[0, 1], [1, 2], [2, 3], [0, 3]], "leaders": [0]},
        "formation": {"offsets": {1: [1.0, 0.0], 2: [2.0, 0.0], 3: [1.0, 1.0]}},
        "reference": {"name": "circle", "radius": 1.0, "rate": 0.5},
        "leader": {"law": "stopping-point"},
        "follower": {"law": "stopping-point", "rate": 3.0},
        "events": [
            {"at": 0.06, "lose": 0},
            {"at": 0.1, "cut": [2, 3], "for": 0.04},
            {"at": 0.12, "lose": 3},
            {"at": 0.16, "join": 3},
        ],
        "leadership": {"backups": [1, 2], "timeout": 0.06},
        "network": {"rate": 50.0, "delay": 0.02, "loss": 0.1},
        "initial": {"spread": {"position": 0.5}},
        "simulation": {"horizon": 0.2, "dt": 0.02},
    },
    {
        "name": "crazyflies",
        "model": {"name": "quadrotor", "parameters": "crazyflie"},
        "graph": {"edges": [[0, 1], [0, 2], [1, 2]], "leaders": [0]},
        "formation": {"name": "triangle", "motion": [{"rotate": 0.3}]},
        "reference": {"name": "circle", "radius": 1.0, "rate": 0.5},
        "leader": {"law": "stopping-point"},
        "follower": {"law": "stopping-point"},
        "safety": {"gain": 2.0, "reach": 8.0},
        "events": [{"at": 0.1, "cut": [1, 2]}, {"at": 0.12, "lose": 2}],
        "simulation": {"horizon": 0.2, "dt": 0.02},
    },
]
"""With collision avoidance, formations that change, and events."""
BASES += CHANGING

ODD: list[Any] = [
    None,
    True,
    -1,
    0,
    1,
    2,
    0.5,
    -0.0,
    1e-300,
    1e300,
    1e23,
    10**23,
    2**63,
    float("nan"),
    float("inf"),
    "",
    "x",
    "1",
    "nan",
    "Ü\U0001f680",
    "a\nb",
    "riccati",
    "../..",
    [],
    [1],
    [[1, 2], [3]],
    [None],
    {},
    {"x": 1},
    {1: [0, 0]},
]
FACTORS = [-1, 0, 2, 3, 0.5, 0.9, 1.1, 1e-9, 1e9, 1e200]
SIZES: list[Any] = [10**7, 10**9, 10**12, 10**18, 10**23, 1e7, 1e9, 1e12, 1e18, 1e23]
SIZES += [2**31 - 1, 2**31, 2**32, 2**63 - 1, 2**63, 2**64]
"""All are too large for what is counted or kept, and those of time may be anything."""
SIZED = ["graph.agents", "graph.rows", "graph.columns", "graph.leaders.0", "graph.edges.0.1"]
SIZED += ["model.parameters.dimension", "formation.columns", "simulation.horizon", "simulation.dt"]
SIZED += ["simulation.store_every", "disturbance.hold", "report.steady_window", "seed"]
SIZED += ["formation.spacing", "reference.rate", "follower.gain.coupling", "graph.edges.1.2"]
SIZED += ["network.delay", "network.jitter", "network.forget", "network.rate", "sensing.delay"]
SIZED += ["actuator.lag", "safety.reach", "follower.rate", "follower.coupling", "graph.period"]
SIZED += ["safety.gain", "safety.margin", "safety.swirl", "events.0.at"]
SIZED += ["formation.motion.0.rotate"]
SIZED += ["formation.motion.1.rate", "formation.motion.2.at", "formation.motion.2.over"]
SIZED += ["events.0.lose", "events.1.for", "leadership.timeout", "leadership.backups.0"]
NUMBERS = [0, 1, 2, 3, 0.1, 1e-8, 1e-300, 1e16, 1e155, 1.7e308]
MARKS = [b"{", b"]", b": ", b"\n", b"&a ", b"*a", b"\xff", b"- ", b"!!x "]
WORDS = ["dt", "horizon", "gain", "name", "python", "file", "set", "0", "x", "position", "é", "*"]


class Case(NamedTuple):
    """A command line, and the files that lie where it runs."""

    arguments: list[str]
    files: dict[str, bytes]


class Ending(NamedTuple):
    """How a case ended: exit code, negative for a signal; what it printed; what is wrong."""

    code: int
    out: str
    err: str
    seconds: float
    faults: tuple[str, ...]


# ---- the grammar ---------------------------------------------------------------------------------


def places(data: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """Return the paths of all values in plain data."""
    found = [path] if path else []
    if not isinstance(data, dict | list):
        return found
    for key, value in data.items() if isinstance(data, dict) else enumerate(data):
        found += places(value, (*path, key))
    return found


def spoil(rng: random.Random, data: Any) -> Any:
    """Return plain data with one thing changed: replaced, left out, added, doubled or renamed."""
    data = copy.deepcopy(data)
    *above, key = rng.choice(places(data))
    part = data
    for step in above:
        part = part[step]
    how = rng.choice(["replace", "replace", "drop", "add", "wrap"])
    # A number is mostly made another one, so that more than types is tried.
    if isinstance(part[key], int | float) and rng.random() < 0.7:
        how = "scale"
    if how == "drop":
        del part[key]
    elif how == "add" and isinstance(part, dict):
        part[rng.choice(WORDS)] = rng.choice(ODD)
    elif how == "scale":
        part[key] = rng.choice([part[key] * by for by in FACTORS] + NUMBERS)
    elif how == "wrap":
        part[key] = rng.choice([[part[key]], {"x": part[key]}, str(part[key])])
    else:
        part[key] = rng.choice(ODD)
    return data


def torn(rng: random.Random, text: bytes) -> bytes:
    """Return bytes of which a few are lost, doubled or others."""
    found = bytearray(text)
    for _ in range(rng.randint(1, 4)):
        at = rng.randrange(len(found) + 1)
        how = rng.randrange(4)
        if how == 0:
            del found[at : at + rng.randint(1, 20)]
        elif how == 1:
            found[at:at] = rng.choice(MARKS)
        elif how == 2:
            found[at:at] = found[at : at + 30]
        else:
            found[at : at + 1] = bytes([rng.randrange(256)])
    return bytes(found)


def harmless(data: Any) -> bool:
    """Tell whether a scenario, if it runs, runs for a moment: long or large ones are no fault."""
    if not isinstance(data, dict):
        return True
    simulation, graph = (data.get(name) for name in ("simulation", "graph"))
    if isinstance(graph, dict):
        sizes = [graph.get(key) for key in ("agents", "rows", "columns")]
        edges = [end for edge in _rows(graph.get("edges")) for end in _rows(edge)[:2]]
        if any(isinstance(size, int) and size > 100 for size in sizes + edges):
            return False
    if not isinstance(simulation, dict):
        return True
    horizon, dt = simulation.get("horizon"), simulation.get("dt")
    if not all(isinstance(value, int | float) for value in (horizon, dt)) or not dt:
        return True
    return not 2000 < horizon / dt


def _rows(value: Any) -> list[Any]:
    return value if isinstance(value, list) else []


def scenario(rng: random.Random, bases: Sequence[Any] = BASES) -> Any:
    """Return a scenario with up to three things spoiled, as plain data."""
    while True:
        data = rng.choice(bases)
        for _ in range(rng.choice([0, 1, 1, 1, 2, 3])):
            data = spoil(rng, data) if places(data) else data
        if harmless(data):
            return data


def as_yaml(data: Any) -> bytes:
    """Return plain data as YAML."""
    from echelon.experiments.scenario.yaml import dump_yaml

    return dump_yaml(data).encode("utf-8", "surrogatepass")


def large(value: Any) -> bool:
    """Tell whether a number is too large for a quick run."""
    return isinstance(value, int | float) and value > 100


def setting(rng: random.Random, data: Any) -> str:
    """Return a `--set` of something that is there, or is not."""
    path = [*rng.choice(places(data))]
    value = rng.choice(ODD if rng.random() < 0.5 else NUMBERS)
    if rng.random() < 0.3:
        path[rng.randrange(len(path))] = rng.choice(WORDS)
    elif rng.random() < 0.5:
        path, value = rng.choice(figures(data))
        value *= rng.choice(FACTORS)
    # Long runs and large graphs are no fault.
    if path[-1] in ("horizon", "agents", "rows", "columns") and large(value):
        value = -1
    if path[-1] == "dt" and not large(value) and isinstance(value, int | float):
        value = max(value, 1e-3) if value > 0 else value
    from echelon.experiments.scenario.yaml import inline_yaml

    broken = ["{", "[1, 2", "*a", "", "3 # three"]
    text = rng.choice(broken) if rng.random() < 0.2 else inline_yaml(value)
    return f"{'.'.join(map(str, path))}{rng.choice(['=', '=', '=', '=', ''])}{text}"


def figures(data: Any) -> list[tuple[list[Any], float]]:
    """Return the paths of all numbers in plain data, and the numbers."""
    found = []
    for path in places(data):
        part = data
        for step in path:
            part = part[step]
        if isinstance(part, int | float) and not isinstance(part, bool):
            found.append(([*path], part))
    return found


def put(data: Any, path: str, value: Any) -> bool:
    """Put a value where a path leads in plain data, and tell whether it leads anywhere."""
    *above, key = [int(each) if each.isdigit() else each for each in path.split(".")]
    for step in above:
        if isinstance(step, str) and isinstance(data, dict) and step in data:
            data = data[step]
        elif isinstance(step, int) and isinstance(data, list) and step < len(data):
            data = data[step]
        else:
            return False
    # A setting that is left out may be given.
    fits = isinstance(data, dict) if isinstance(key, str) else isinstance(data, list)
    if fits and (isinstance(key, str) or key < len(data)):
        data[key] = value
        return True
    return False


def options(rng: random.Random, verb: str) -> list[str]:
    """Return options that a verb has, and now and then one that it has not."""
    some = {
        "run": [["--no-figures"], ["--json"], ["--out", "out"], ["--out", "s.yaml"], ["--force"]],
        "check": [["--json"]],
        "design": [["--json"], ["--method", "riccati"], ["--method", "x"], ["--out", "no/g.json"]],
        "verify": [["--json"]],
        "export": [["--out", "e"], ["--out", "s.yaml"], ["--force"], ["--set", "seed=4"]],
    }.get(verb, [])
    found = [option for option in some if rng.random() < 0.4]
    if rng.random() < 0.1:
        found.append([rng.choice(["--nothing", "--json=3", "--set", "-", "--out"])])
    return [word for option in found for word in option]


def flown(
    rng: random.Random, gain: bytes, run: dict[str, bytes], bases: Sequence[Any] = BASES
) -> Case:
    """Draw a scenario file under a verb."""
    data = scenario(rng, bases)
    text = as_yaml(data)
    if rng.random() < 0.2:
        text = torn(rng, text)
    verb = rng.choice(["check", "check", "check", "run", "design"])
    quick = ["--no-figures", "--out", "out"] if verb == "run" else []
    quick += ["--method", "riccati"] if verb == "design" else []
    return Case([verb, "s.yaml", *quick, *options(rng, verb)], {"s.yaml": text})


def overridden(
    rng: random.Random, gain: bytes, run: dict[str, bytes], bases: Sequence[Any] = BASES
) -> Case:
    """Draw a sound scenario under `--set`."""
    data = rng.choice(bases)
    sets = [["--set", setting(rng, data)] for _ in range(rng.randint(1, 3))]
    words = [word for pair in sets for word in pair]
    return Case(["check", "s.yaml", *words], {"s.yaml": as_yaml(data)})


def changing(rng: random.Random, gain: bytes, run: dict[str, bytes]) -> Case:
    """Draw a scenario file that changes while it runs, or a sound one under `--set`."""
    return rng.choice([flown, overridden])(rng, gain, run, CHANGING)


def exported(rng: random.Random, gain: bytes, run: dict[str, bytes]) -> Case:
    """Draw a scenario whose laws are written for other programs, or a run that is."""
    sound = [data for data in BASES if data["follower"].get("law") == "stopping-point"]
    data = scenario(rng, sound)
    files = {"s.yaml": as_yaml(data), "g.json": gain}
    if rng.random() < 0.2:
        files |= {f"out/{name}": text for name, text in run.items()}
        form = rng.choice(["csv", "npz", "mat", "nc", "json", "html", "law", "x", ""])
        words = ["export", rng.choice(["out", "out/run.nc", "s.yaml", "no"]), "--to", form]
        return Case([*words, *options(rng, "export")], files)
    agent = str(rng.choice([0, 1, 2, 3, -1, 4, 10**23, "x"]))
    if rng.random() < 0.4:
        return Case(["export", "s.yaml", "--agent", agent, *options(rng, "export")], files)
    # Without `--out` a flight begins, in a process in place of this one, where nothing is wrong.
    out = ["--out", rng.choice(["f", "f", "f", "s.yaml", "."])]
    more = [["--agent", agent, "--key", "g.json"], ["--ground", "--key", "no"], ["--link", "x"]]
    more += [["--agent", agent], [], ["--ground", "--all"]]
    return Case(["fly", "s.yaml", *(out if rng.random() < 0.8 else rng.choice(more))], files)


def gained(rng: random.Random, gain: bytes, run: dict[str, bytes]) -> Case:
    """Draw a gain file under `verify`, or under `check`."""
    if rng.random() < 0.3:
        spoiled = torn(rng, gain)
    else:
        data = json.loads(gain)
        for _ in range(rng.choice([1, 1, 2, 3])):
            data = spoil(rng, data) if places(data) else data
        spoiled = json.dumps(data, default=str).encode("utf-8", "surrogatepass")
    files = {"g.json": spoiled, "s.yaml": as_yaml(BASES[0])}
    if rng.random() < 0.5:
        return Case(["verify", "g.json", *options(rng, "verify")], files)
    return Case(["check", "s.yaml", "--set", "follower.gain.file=g.json"], files)


def reopened(rng: random.Random, gain: bytes, run: dict[str, bytes]) -> Case:
    """Draw the folder of a run of which a file is torn or missing."""
    files = {f"out/{name}": text for name, text in run.items()}
    for name in rng.sample(sorted(files), rng.randint(1, min(2, len(files)))):
        files[name] = torn(rng, files[name]) if rng.random() < 0.7 else b""
        if rng.random() < 0.2:
            del files[name]
    words = rng.choice([["run", "out", "--no-figures", "--out", "again"], ["check", "out"]])
    if rng.random() < 0.4:
        words = ["run", "--resume", "out"]
    return Case(words, files)


def typed(rng: random.Random, gain: bytes, run: dict[str, bytes]) -> Case:
    """Draw a command line of words."""
    verbs = ["run", "check", "design", "compare", "verify", "list", "schema", "fly", "export"]
    verbs += ["", "--help"]
    verb = rng.choice(verbs)
    names = ["s.yaml", "nowhere.yaml", ".", "", "g.json", "pape", "é", "\udcff", "-", "--", "/"]
    words = [rng.choice(names) for _ in range(rng.randint(0, 2))]
    if verb in ("run", "compare"):
        # Sound ones of these take a while, and are drawn elsewhere.
        words = [word for word in words if word != "s.yaml"] or ["nowhere.yaml"]
    files = {"s.yaml": as_yaml(BASES[0]), "g.json": gain}
    return Case([word for word in (verb, *words, *options(rng, verb))], files)


def sized(rng: random.Random, gain: bytes, run: dict[str, bytes]) -> Case:
    """Draw an experiment of which one or two numbers are far too large."""
    data = copy.deepcopy(rng.choice(BASES))
    done = [each for each in rng.sample(SIZED, 4) if put(data, each, rng.choice(SIZES))]
    verb = rng.choice(["check", "check", "design", "run"])
    # What stores little may be run for as long as one likes.
    if "simulation.store_every" in done and verb == "run":
        verb = "check"
    more = {"design": ["--method", "riccati"], "run": ["--no-figures", "--out", "out"]}
    return Case([verb, "s.yaml", *more.get(verb, [])], {"s.yaml": as_yaml(data)})


KINDS: dict[str, Callable[..., Case]] = {
    "scenario files": flown,
    "--set": overridden,
    "gain files": gained,
    "folders of runs": reopened,
    "command lines": typed,
    "sizes": sized,
    "changes": changing,
    "laws": exported,
}


# ---- one case ------------------------------------------------------------------------------------


def call(arguments: list[str]) -> int:
    """Run the command line in this process, and return its exit code."""
    from echelon.apps.cli.app import main

    sys.argv = ["echelon", *arguments]
    try:
        main()
    except SystemExit as left:
        return left.code if isinstance(left.code, int) else int(left.code is not None)
    except BaseException:
        traceback.print_exc()
        return 99
    return 0


def tried(case: Case) -> Ending:
    """Run a case in this process, which it may end, and judge how it ended."""
    with tempfile.TemporaryDirectory(prefix="case-", dir=os.environ["TMPDIR"]) as text:
        folder = Path(text) / "here"
        for name, content in case.files.items():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / name).write_bytes(content)
        folder.mkdir(exist_ok=True)
        os.chdir(folder)
        for name, stream in (("out", 1), ("err", 2)):
            end = os.open(Path(text) / name, os.O_WRONLY | os.O_CREAT)
            os.dup2(end, stream)
            os.close(end)
        began = time.process_time()
        resource.setrlimit(resource.RLIMIT_CPU, (math.ceil(began) + CPU, resource.RLIM_INFINITY))
        code = call(case.arguments)
        for stream in (sys.stdout, sys.stderr):
            with contextlib.suppress(OSError):
                stream.flush()
        seconds = time.process_time() - began
        told = (
            (Path(text) / name).read_bytes().decode("utf-8", "replace") for name in ("out", "err")
        )
        os.chdir("/")
        return ended(code, *told, seconds)


def ended(code: int, out: str, err: str, seconds: float) -> Ending:
    """Return an ending with its faults."""
    faults = [*judged(code, out, err)]
    if code == 2 and seconds > REFUSING:
        faults.append(f"it takes {seconds:.0f} s to refuse")
    return Ending(code, out, err, seconds, tuple(faults))


def endings(cases: Sequence[Case]) -> Iterator[Ending]:
    """Run cases one after another, all in one process unless one of them ends it."""
    left = list(cases)
    while left:
        with tempfile.TemporaryDirectory(prefix="echelon-fuzz-") as folder:
            here, there = multiprocessing.Pipe(duplex=False)
            child = os.fork()
            if not child:
                os.environ["TMPDIR"] = folder
                for case in left:
                    there.send(tried(case))
                os._exit(0)
            there.close()
            alive = True
            while left and alive:
                ending, alive = _heard(here, child)
                left.pop(0)
                yield ending
            here.close()
            if alive:
                os.waitpid(child, 0)


def attempt(case: Case) -> Ending:
    """Run a case in a process of its own."""
    [ending] = endings([case])
    return ending


def _heard(here: Connection, child: int) -> tuple[Ending, bool]:
    """Return how the next case of a process ended, and whether the process goes on."""
    began, fault = time.monotonic(), ""
    while not here.poll(0.05):
        with contextlib.suppress(OSError, ValueError):
            resident = int(Path(f"/proc/{child}/statm").read_text().split()[1]) * 4096
            fault = fault or ("it takes more than 4 GiB of memory" if resident > MEMORY else "")
        if fault or time.monotonic() - began > 12 * CPU:  # it waits, and does not compute
            os.kill(child, signal.SIGKILL)
    with contextlib.suppress(EOFError):
        return here.recv(), True
    code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    found = ended(code, "", "", time.monotonic() - began)
    return found._replace(faults=(fault,)) if fault else found, False


def judged(code: int, out: str, err: str) -> Iterator[str]:
    """Yield what is wrong with how a case ended."""
    if code in (-signal.SIGXCPU, -signal.SIGKILL):
        yield f"it does not end within {CPU} s"
    elif code not in ALLOWED:
        yield f"its exit code is {code}"
    if "Traceback (most recent call last)" in out + err:
        yield "it shows a traceback"
    if "Warning: " in err:
        yield "it shows a library's warning"
    # On a busy machine what runs is named again, with how long it has run.
    running = re.compile(r"\.\.\. \d+ (s|min)\b")
    said = [line for line in err.splitlines() if line.strip() and not running.search(line)]
    if code in (2, 4) and not said:
        yield "it refuses without a word"
    # What the reader of words refuses, it does in a form of its own.
    if code == 2 and said and not any(line.startswith(("Usage:", "Error: ")) for line in said):
        if not said[0].startswith("echelon: "):
            yield "its sentence does not begin with `echelon: `"
        yield from (f"no full stop: {line}" for line in said if not line.endswith("."))


# ---- many ----------------------------------------------------------------------------------------


def sound() -> tuple[bytes, dict[str, bytes]]:
    """Return a gain file, and the files of a run, made in processes of their own."""
    with tempfile.TemporaryDirectory() as text:
        folder = Path(text)
        (folder / "s.yaml").write_bytes(as_yaml(BASES[0]))
        for words in (
            ["design", "s.yaml", "--method", "riccati", "--out", "g.json"],
            ["run", "s.yaml", "--no-figures", "--out", "out"],
        ):
            child = os.fork()
            if not child:
                os.chdir(folder)
                os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
                os._exit(call(words))
            if os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]):
                raise SystemExit(f"a sound command fails: echelon {' '.join(words)}")
        files = {path.name: path.read_bytes() for path in (folder / "out").iterdir()}
        return (folder / "g.json").read_bytes(), files


class Drawn(NamedTuple):
    """A case, its kind, and the seed that draws it."""

    seed: int
    kind: str
    case: Case


def drawn(seed: int, made: tuple[bytes, dict[str, bytes]], kind: str | None = None) -> Drawn:
    """Return what a seed draws, of one kind or of all in turn."""
    kind = kind or [*KINDS][seed % len(KINDS)]
    return Drawn(seed, kind, KINDS[kind](random.Random(seed), *made))


def preload(cache: str) -> None:
    """Import what the commands import, once for all processes, and compute nothing.

    Processes share what JAX compiles through a folder.
    """
    os.environ["ECHELON_CACHE"] = cache
    os.environ |= {"JAX_COMPILATION_CACHE_DIR": cache, "OPENBLAS_NUM_THREADS": "1"}
    os.environ["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = "0"
    os.environ["JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES"] = "-1"
    import jax
    from typer.main import get_command

    import echelon.apps.cli.app
    import echelon.experiments.results.recording
    import echelon.experiments.studies.design
    import echelon.guarantees.verifier.verify  # noqa: F401

    # A third of what a rejected case takes is to read the signatures of all commands.
    echelon.apps.cli.app.app = get_command(echelon.apps.cli.app.app)
    del jax


def main() -> int:
    """Draw cases until the time or their number is over, and tell the faulty ones."""
    parser = argparse.ArgumentParser(prog="fuzz", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("seconds", nargs="?", type=float, default=600.0)
    parser.add_argument("--seed", type=int, default=0, help="of the first case")
    parser.add_argument("--cases", type=int, default=sys.maxsize, help="at most so many")
    parser.add_argument("--kind", choices=KINDS, help="only cases of this kind")
    parser.add_argument("--alone", action="store_true", help="a process for each case")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as cache:
        preload(cache)
        made, ends, faulty = sound(), Counter[str](), 0
        # A collection in a fork would write to all pages that it shares with this process.
        gc.freeze()
        deadline, seeds = time.monotonic() + given.seconds, iter(range(given.seed, sys.maxsize))
        batch = 1 if given.alone else BATCH
        while time.monotonic() < deadline and (left := given.cases - sum(ends.values())):
            some = [drawn(next(seeds), made, given.kind) for _ in range(min(batch, left))]
            for each, ending in zip(some, endings([each.case for each in some]), strict=True):
                ends[f"{each.kind}: exit code {ending.code}"] += 1
                if ending.faults:
                    faulty += 1
                    tell(each, ending, ending if given.alone else attempt(each.case))
    for what, count in sorted(ends.items()):
        print(f"{count:6d}  {what}")
    print(f"{sum(ends.values())} cases from seed {given.seed} on, {faulty} of them faulty")
    return int(faulty > 0)


def tell(each: Drawn, ending: Ending, alone: Ending) -> None:
    """Print a faulty case, and whether it is faulty in a process of its own."""
    case, shown = each.case, alone if alone.faults else ending
    print(f"\nseed {each.seed}, {each.kind}: echelon {' '.join(map(ascii, case.arguments))}")
    print(*(f"  {fault}" for fault in shown.faults), sep="\n")
    if not alone.faults:
        print("  but not in a process of its own")
    for name, text in case.files.items() if each.kind != "folders of runs" else ():
        print(f"  {name}: {text[:1500]!r}")
    print(*(f"  | {line}" for line in shown.err.splitlines()[-6:]), sep="\n", flush=True)


if __name__ == "__main__":
    sys.exit(main())
