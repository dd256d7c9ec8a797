"""Formations in real time over unmodified cflib and pymavlink, against vehicles that are none.

They need the extras `crazyflie` and `px4`. Over real radios and vehicles nothing was tried.
"""

import contextlib
import importlib
import json
import math
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from fake_vehicles import MELLINGER

import echelon as ech
from echelon.agents.models import CrazyflieAttitude
from echelon.flight.links.cflib_link import CflibLink
from echelon.flight.links.px4_link import Px4Link
from echelon.output.archive.law_folder import law_files

pytestmark = pytest.mark.study

TESTS = Path(__file__).parents[1]
GRAPH = ech.Graph([(0, 1), (1, 2), (1, 3)])
OFFSETS = {1: (0.6, 0.0, 0.0), 2: (0.6, 0.5, 0.0), 3: (0.6, -0.5, 0.0)}
PATH = ech.references.Circle(center=(0.0, 0.0, 1.0), radius=0.6, rate=0.8)
DT, SETTLED, SECONDS = 0.01, 8.0, 16.0


def extra(library, name):
    """A library that the study needs."""
    try:
        return importlib.import_module(library)
    except ImportError:
        pytest.fail(f"this study needs `pip install 'echelon-formation[{name}]'`.", pytrace=False)


def formation(model):
    """Four of a model, behind a leader on a circle."""
    gain = ech.synthesize(model, GRAPH, ech.gains.Riccati())
    laws = ech.Laws(ech.laws.Tracking(PATH), ech.laws.Consensus(gain, feedforward="relay"))
    return ech.Parts(model, GRAPH, ech.Formation.from_offsets(model, GRAPH, OFFSETS), laws)


def facts(model, agent):
    """What a link needs of law.json."""
    inputs = dict(zip(model.input_names, model.input_units, strict=True))
    states = dict(zip(model.state_names, model.state_units, strict=True))
    trim = dict(zip(model.input_names, model.trim[1], strict=True))
    return {"agent": agent, "dt": DT, "states": states, "inputs": inputs, "trim": trim}


@contextlib.contextmanager
def served(script, **settings):
    """A process of tests/ that serves vehicles while the block runs."""
    command = [sys.executable, TESTS / script, json.dumps(settings)]
    with subprocess.Popen(command, stdin=-1, stdout=-1, text=True) as process:
        assert process.stdout.readline() == "ready\n"
        try:
            yield
        finally:
            process.stdin.close()
            assert process.wait(10) == 0


class Flown:
    """One agent: its exported law, its link, its state and its memory."""

    def __init__(self, parts, agent, link):
        files = law_files(parts, ech.Settings(horizon=SECONDS, dt=DT), agent, "")
        self.facts, self.law, self.link = json.loads(files["law.json"]), {}, link
        exec(files["law.py"], self.law)
        self.x = link.read(5.0).x
        self.memory = self.law["begin"](self.x)

    def hello(self):
        if (reading := self.link.read(0.0)) is not None:
            self.x = reading.x
        return self.law["hello"](self.x, self.memory)

    def act(self, t, signals, forward):
        """Take a step; returns what the agent feeds forward."""
        hears, weights = self.facts["hears"], self.facts["weights"]
        gaps = [self.law["difference"](self.x, self.memory, signals[k]) for k in hears]
        z = [sum(w * gap[n] for w, gap in zip(weights, gaps, strict=True)) for n in range(12)]
        u, self.memory, _, message, valid = self.law["tick"](t, self.x, z, forward, self.memory)
        assert valid
        self.link.send(u)
        return message


def fly(parts, links):
    """Fly a formation in real time; returns when it began, and how late the steps were (s)."""
    agents, late = [Flown(parts, k, link) for k, link in enumerate(links)], []
    begin = time.monotonic()
    for step in range(int(SECONDS / DT)):
        ahead = begin + step * DT - time.monotonic()
        late.append(max(0.0, -ahead))
        time.sleep(max(0.0, ahead))
        signals, t = [agent.hello() for agent in agents], time.monotonic() - begin
        forward = agents[0].act(t, signals, [math.nan] * 4)
        for agent in agents[1:]:
            agent.act(t, signals, forward)
    return begin, np.array(late)


def errors(file, begin):
    """The largest distances (m) from the goals beside the leader, and of it from its path."""
    flown = np.load(file)
    t = flown["times"] - begin
    within = (t > SETTLED) & (t < SECONDS - 0.1)
    places, t = flown["places"][within], t[within]
    wanted = np.stack([0.6 * np.cos(0.8 * t), 0.6 * np.sin(0.8 * t), np.ones_like(t)], 1)
    apart = [places[:, k] - places[:, 0] - np.array(OFFSETS[k]) for k in OFFSETS]
    beside = max(np.linalg.norm(gap, axis=1).max() for gap in apart)
    return beside, np.linalg.norm(places[:, 0] - wanted, axis=1).max()


def say(capsys, name, beside, leader, late):
    beside, leader, late = 1e3 * beside, 1e3 * leader, 1e3 * np.quantile(late, 0.99)
    with capsys.disabled():
        print(
            f"\n{name}: followers {beside:.1f} mm beside the leader, leader {leader:.1f} mm beside"
        )
        print(f"its path; one step in 100 was {late:.1f} ms late")


def starts():
    goals = np.array([(0.0, 0.0, 0.0), *OFFSETS.values()]) + [0.6, 0.0, 1.0]
    return (goals + np.random.default_rng(3).uniform(-0.2, 0.2, (4, 3))).tolist()


VEHICLES = {
    "as identified": (CrazyflieAttitude(), {}),
    "firmware's gains, motors of 30 ms": (
        CrazyflieAttitude.named("firmware"),
        {"mass": 0.029, "gain": 1.0, "lag": 0.03, "response": MELLINGER},
    ),
}


@pytest.mark.parametrize("name", VEHICLES)
def test_a_swarm_of_cflib_flies_a_formation(tmp_path, name, capsys):
    crtp, swarm = extra("cflib.crtp", "crazyflie"), extra("cflib.crazyflie.swarm", "crazyflie")
    crtp.CLASSES or crtp.init_drivers()
    model, vehicle = VEHICLES[name]
    file = str(tmp_path / "flown.npz")
    uris = [f"udp://127.0.0.1:{19850 + k}" for k in range(4)]
    parts = formation(model)
    with served("fake_crazyflie.py", port=19850, starts=starts(), file=file, **vehicle):
        with swarm.Swarm(uris) as crazyflies:
            crazyflies.parallel_safe(lambda each: each.wait_for_params())
            each = [crazyflies._cfs[uri].cf for uri in uris]
            links = [CflibLink("", facts(model, k), each[k]) for k in range(4)]
            begin, late = fly(parts, links)
    beside, leader = errors(file, begin)
    say(capsys, name, beside, leader, late)
    assert beside <= 0.015 and leader <= 0.05


def test_a_stand_in_for_px4_flies_a_formation(tmp_path, capsys):
    extra("pymavlink.mavutil", "px4")
    model = CrazyflieAttitude()
    file, parts = str(tmp_path / "flown.npz"), formation(model)
    with (
        served("fake_px4.py", port=14540, starts=starts(), file=file),
        contextlib.ExitStack() as end,
    ):
        links = [Px4Link(f"udpin:127.0.0.1:{14540 + k}", facts(model, k)) for k in range(4)]
        for link in links:
            end.callback(link.close)
        begin, late = fly(parts, links)
    beside, leader = errors(file, begin)
    say(capsys, "PX4", beside, leader, late)
    assert beside <= 0.010 and leader <= 0.05
