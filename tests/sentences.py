"""The messages of echelon: inputs from tests/sentences.txt and what echelon answers to each.

`python3 dev.py sentences` writes the answers into the file again; tests/test_sentences.py compares.
"""

import contextlib
import io
import os
import re
import shlex
import sys
import tempfile
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import networkx as nx
import numpy as np
from processes import without_status
from runs import simulate

import echelon as ech
from echelon.core.errors import EchelonError, ScenarioError, listing
from echelon.experiments.scenario import registry
from echelon.experiments.scenario.sections import GainSpec

FILE = Path(__file__).with_name("sentences.txt")
INDENT = "    "

# A scenario file of which each input of a group `Scenario file` replaces one line.
LINES = {
    "name": "name: paper",
    "model": "model: {name: quadrotor, parameters: crazyflie}",
    "graph": "graph: {edges: [[0, 1], [1, 2], [1, 3]], leaders: [0]}",
    "formation": "formation: {offsets: {1: [1, 0, 0], 2: [1, 0.8, 0], 3: [1, -0.8, 0]}}",
    "reference": "reference: {name: lemniscate, center: [0.25, 0.25, 1.0], amplitude: [1.25, 3.54],"
    " rate: 0.646}",
    "leader": "leader: {law: tracking, reacts: false, start_error: {x: -1.344, y: 0.530}}",
    "follower": "follower: {law: consensus, gain: {method: riccati}, feedforward: relay}",
    "initial": "initial: {spread: {position: 1.0, attitude: 0.3}}",
    "simulation": "simulation: {horizon: 60.0, dt: 0.005, integrator: rk4, limits: true}",
    "report": "report: {steady_window: 10.0}",
    "seed": "seed: 0",
}
TABLES = {name: table for name, table in vars(registry).items() if re.fullmatch("[A-Z_]+", name)}
TABLES["GAIN_KEYS"] = GainSpec.model_fields


class Own(ech.Method):
    answer: Any
    name = "own"

    def feedback(self, model, linear):
        return self.answer


class Flat(ech.Reference):
    def __call__(self, t):
        return jnp.stack([t, t])


class HalfFlat(ech.models.SingleIntegrator):
    """An agent whose flatness map forgets the input."""

    dimension: int = 1

    def flat(self, derivatives):
        return derivatives[0]


class LongFlat(HalfFlat):
    """An agent whose flatness map is another agent's."""

    def flat(self, derivatives):
        return jnp.zeros(2), derivatives[1]


def run(model=ech.models.SingleIntegrator(1), graph=None, **options):
    """Simulate two single integrators for 1 s with some options replaced."""
    graph = graph or ech.Graph.path(2)
    parts = {
        "leader": ech.laws.TrimInput(),
        "follower": ech.laws.TrimInput(),
        "horizon": 1.0,
        "dt": 0.1,
        "formation": ech.Formation(np.zeros((graph.agents, len(model.state_names)))),
    } | options
    return simulate(model, graph, parts.pop("formation"), **parts)


def gain_of(model, graph=None, **options):
    return ech.synthesize(model, graph or ech.Graph.path(2), ech.gains.FixedGain(**options))


NAMES = {
    **{name: getattr(family, name) for family in (ech.models, ech.gains, ech.laws, ech.references)
       for name in dir(family) if name[0].isupper()},
    **{name: getattr(ech, name) for name in ech.__all__},
    **{each.__name__: each for each in (Own, Flat, HalfFlat, LongFlat, run, gain_of)},
    "run_scenario": ech.run, "np": np, "nx": nx, "nan": float("nan"), "inf": float("inf"),
}  # fmt: skip


def of_python(text):
    try:
        eval(text, dict(NAMES))
    except EchelonError as error:
        return f"{type(error).__name__}: {error}"
    return "accepted"


def of_scenario(text):
    """The error of a scenario file in which a line is replaced."""
    changed = {text.partition(":")[0]: text}
    Path("s.yaml").write_text("\n".join(changed.get(key, LINES[key]) for key in LINES), "utf-8")
    try:
        ech.build(ech.load_scenario("s.yaml"))
    except ScenarioError as error:
        answer = str(error)
        for name, table in TABLES.items():
            answer = answer.replace(listing(table), f"<{name}>")
        return answer
    return "accepted"


def of_command(text):
    from echelon.apps.cli.app import main

    arguments, sys.argv = sys.argv, shlex.split(text)
    output = io.StringIO()
    with contextlib.redirect_stdout(output), contextlib.redirect_stderr(output):
        try:
            main()
        except SystemExit as end:
            code = end.code or 0
    sys.argv = arguments
    return f"{output.getvalue()}\nexit code {code}"


ANSWERS = {"Python": of_python, "Scenario file": of_scenario, "Command": of_command}


def groups():
    """The groups of the file: its header as "", then each title with its inputs and answers."""
    parts = re.split(r"^# (.+)\n", FILE.read_text("utf-8"), flags=re.MULTILINE)
    yield "", parts[0]
    for title, body in zip(parts[1::2], parts[2::2], strict=True):
        blocks = [block.strip("\n").split("\n", 1) for block in body.strip("\n").split("\n\n")]
        yield title, [(block[0], "".join(block[1:])) for block in blocks]


def answer(title, text):
    """What echelon answers now to an input of a group, as it stands in the file."""
    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
        lines = without_status(ANSWERS[title.partition(":")[0]](text)).splitlines()
    return "\n".join(f"{INDENT}{line.rstrip()}" for line in lines if line.strip())


def write():
    text = ""
    for title, body in [*groups()]:
        text += f"# {title}\n\n" if title else body
        for given, _ in body if title else ():
            text += f"{given}\n{answer(title, given)}\n\n"
    FILE.write_text(text.rstrip() + "\n", "utf-8")


if __name__ == "__main__":
    os.environ["ECHELON_CACHE"] = "off"
    write()
    print(f"{FILE} holds the sentences of today; `git diff` shows what changed.")
