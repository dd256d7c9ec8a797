"""Formations in real time over unmodified cflib and pymavlink, against vehicles that are none.

They need the extras `crazyflie` and `px4`. Over real radios and vehicles nothing was tried.
"""

import contextlib
import importlib
import json
import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from fake_vehicles import MELLINGER

import echelon as ech
from echelon.agents.models import CrazyflieAttitude
from echelon.output.archive.flight_folder import flight_files, save_flight
from echelon_flight.datagram_socket import DatagramSocket, ports_of
from echelon_flight.ground import Ground
from echelon_flight.mission import Mission, make_key
from echelon_flight.wire import GROUND

pytestmark = [pytest.mark.study, pytest.mark.outside]

HERE = Path(__file__).parent
STAND_INS = Path(__file__).parents[2] / "packages" / "flight" / "tests"
GRAPH = ech.Graph([(0, 1), (1, 2), (1, 3)])
OFFSETS = {1: (0.6, 0.0, 0.0), 2: (0.6, 0.5, 0.0), 3: (0.6, -0.5, 0.0)}
PATH = ech.references.Circle(center=(0.0, 0.0, 1.0), radius=0.6, rate=0.8)
DT, SETTLED, SECONDS = 0.01, 10.0, 18.0
SPEED = float(os.environ.get("FLIGHT_SPEED", "1"))  # below 1 on a machine that others use


def extra(library, name):
    try:
        return importlib.import_module(library)
    except ImportError:
        pytest.fail(f"this study needs `pip install '.[{name}]'`.", pytrace=False)


def consensus(model):
    gain = ech.synthesize(model, GRAPH, ech.gains.Riccati())
    return ech.Laws(ech.laws.Tracking(PATH), ech.laws.Consensus(gain, feedforward="relay"))


def stopping(_):
    return ech.Laws(ech.laws.StoppingLeader(reference=PATH), ech.laws.StoppingPoint())


def formation(model, laws=consensus, network=None):
    places = ech.Formation.from_offsets(model, GRAPH, OFFSETS)
    return ech.Parts(model, GRAPH, places, laws(model), world=ech.World(network=network))


@contextlib.contextmanager
def served(script, **settings):
    command = [sys.executable, STAND_INS / script, json.dumps({"speed": SPEED} | settings)]
    with subprocess.Popen(command, stdin=-1, stdout=-1, text=True) as process:
        assert process.stdout.readline() == "ready\n"
        try:
            yield process
        finally:
            process.stdin.close()
            # A test may have killed it.
            assert process.wait(10) in (0, -9)


@contextlib.contextmanager
def started(folder, model, laws, links, port, together=False):
    """Start a formation by `echelon fly`, a process an agent, or one process for all.

    Yields the ground station, the processes, and when the plan began.
    """
    parts = formation(model, laws, ech.Network(rate=50.0))
    save_flight(flight_files(parts, ech.Settings(horizon=SECONDS, dt=DT), "four"), folder)
    mission, key, ports = Mission(folder), folder / "key", ports_of(4, port)
    make_key(key)
    ground = Ground(DatagramSocket(ports[4], ports[:4]), mission.wire(GROUND, key), 4)
    ground.listen()
    command = [sys.executable, "-m", "echelon_flight", folder, "--key", key, "--port", str(port)]
    command += ["--speed", str(SPEED)]
    flying = []
    each = [["--agent", str(k), "--link", link] for k, link in enumerate(links)]
    if together:
        each = [["--agents", ",".join(map(str, range(len(links)))), "--link", ",".join(links)]]
    for k, words in enumerate(each):
        with (folder / f"said-{k}").open("w") as said:
            flying.append(subprocess.Popen([*command, *words], stderr=said))
    try:
        until = time.monotonic() + 30.0
        while not ground.ready:
            assert time.monotonic() < until and all(one.poll() is None for one in flying)
            time.sleep(0.05)
        ground.start(time.time() + 0.5)
        yield ground, flying, time.monotonic() + 0.5
    finally:
        for one in flying:
            one.kill()
            one.wait()
        ground.close()


def fly_processes(*arguments):
    """Fly a formation by `echelon fly` to its end; returns when the plan began."""
    with started(*arguments) as (_, flying, begin):
        # At the end of the plan they descend, and end by themselves.
        assert [one.wait(SECONDS / SPEED + 30.0) for one in flying] == [0] * 4
    return begin


def errors(file, begin):
    """The largest distances (m) from the goals beside the leader, and of it from its path."""
    flown = np.load(file)
    t = (flown["times"] - begin) * SPEED
    within = (t > SETTLED) & (t < SECONDS - 0.1)
    places, t = flown["places"][within], t[within]
    wanted = np.stack([0.6 * np.cos(0.8 * t), 0.6 * np.sin(0.8 * t), np.ones_like(t)], 1)
    apart = [places[:, k] - places[:, 0] - np.array(OFFSETS[k]) for k in OFFSETS]
    beside = max(np.linalg.norm(gap, axis=1).max() for gap in apart)
    return beside, np.linalg.norm(places[:, 0] - wanted, axis=1).max()


def say(capsys, name, beside, leader):
    with capsys.disabled():
        print(f"\n{name}: followers at most {1e3 * beside:.1f} mm from their places beside the")
        print(f"leader, and the leader {1e3 * leader:.1f} mm from its path")


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


SCRIPTS = {
    "cflib": ("cflib.crtp", "crazyflie", "fake_crazyflie.py", "cflib://udp://127.0.0.1:{}"),
    "px4": ("pymavlink.mavutil", "px4", "fake_px4.py", "px4://udpin:127.0.0.1:{}"),
}
FLIGHTS = [
    ("cflib", "as identified", consensus, 0.015),
    ("cflib", "as identified", stopping, 0.015),
    ("cflib", "firmware's gains, motors of 30 ms", stopping, 0.015),
    ("px4", "as identified", consensus, 0.010),
    ("px4", "as identified", stopping, 0.010),
]


@pytest.mark.parametrize(("name", "vehicle", "laws", "most"), FLIGHTS)
def test_four_processes_fly_a_formation_and_land(tmp_path, name, vehicle, laws, most, capsys):
    library, needed, script, address = SCRIPTS[name]
    extra(library, needed)
    file, (model, changes) = str(tmp_path / "flown.npz"), VEHICLES[vehicle]
    port = 52100 + 20 * FLIGHTS.index((name, vehicle, laws, most))
    with served(script, port=19860, starts=starts(), file=file, **changes):
        links = [address.format(19860 + k) for k in range(4)]
        begin = fly_processes(tmp_path / "flight", model, laws, links, port)
    beside, leader = errors(file, begin)
    say(capsys, f"four processes, {name}, {vehicle}, {laws.__name__}", beside, leader)
    assert beside <= most and leader <= 0.05
    assert np.load(file)["places"][-1, :, 2].max() < 0.06


def test_one_process_flies_four_on_a_dongle_that_carries_300_setpoints(tmp_path, capsys):
    extra("cflib.crtp", "crazyflie")
    file, model, folder = str(tmp_path / "flown.npz"), CrazyflieAttitude(), tmp_path / "flight"
    with served(
        "fake_crazyflie.py", port=19960, starts=starts(), file=file, carried=300.0
    ) as radio:
        links = [f"cflib://udp://127.0.0.1:{19960 + k}" for k in range(4)]
        flight = started(folder, model, consensus, links, 52300, together=True)
        with flight as (_, flying, begin):
            assert [one.wait(SECONDS / SPEED + 30.0) for one in flying] == [0]
        radio.stdin.close()
        carried, dropped = map(int, radio.stdout.readline().split())
    said = (folder / "said-0").read_text()
    assert said.count("setpoints are late: the dongle carries 300 a second for 4 vehicles.") == 4
    assert said.count(" setpoints were late.") == 4
    beside, leader = errors(file, begin)
    say(capsys, f"one process, one dongle ({dropped} of {carried + dropped} lost)", beside, leader)
    assert beside <= 0.015 and leader <= 0.05 and dropped < 0.01 * carried


# A cut in s of the plan; 0: the vehicle's program is killed.
REASONS = "the newest state is", "the link to the vehicle failed"
BREAKS = [(name, cut) for name in SCRIPTS for cut in (1.0, 5.0, 0.0)]


@pytest.mark.parametrize(("name", "cut"), BREAKS)
def test_a_link_that_breaks_in_the_air(tmp_path, name, cut):
    """Agent 2 descends level and says why, here and on the page; the others fly on."""
    library, needed, script, address = SCRIPTS[name]
    extra(library, needed)
    number, file = BREAKS.index((name, cut)), str(tmp_path / "broken.npz")
    port, model, at = 19700 + 10 * number, CrazyflieAttitude(), starts()
    links = [address.format(port + k) for k in (0, 1, 5, 2)]
    others = {"port": port, "starts": [at[0], at[1], at[3]], "file": str(tmp_path / "others.npz")}
    own = served(script, port=port + 5, starts=[at[2]], file=file)
    flight = started(tmp_path / "flight", model, consensus, links, 52400 + 10 * number)
    with served(script, **others), own as broken, flight as (ground, flying, begin):
        time.sleep(max(0.0, begin + 6.0 / SPEED - time.monotonic()))
        since = time.monotonic()
        if cut:
            print(f"cut 0 {cut / SPEED}", file=broken.stdin, flush=True)
        else:
            broken.kill()
        time.sleep(0.5 / SPEED)
        row = ground.state()["agents"][2]
        assert row["mode"] == "descends" and row["why"].startswith(REASONS)
        codes = [flying[k].wait((SECONDS + 30.0) / SPEED) for k in (2, 0, 1, 3)]
        said = [(tmp_path / "flight" / f"said-{k}").read_text() for k in range(4)]
        assert codes == [1, 0, 0, 0], said
    assert said[2].count("; the vehicle levels and descends.") == 1
    if cut:
        check_landing(np.load(file), since, name, cut)


def check_landing(flown, since, name, cut):
    times = np.arange(0.0, 12.0, 0.05)
    t = (flown["times"] - since) * SPEED
    tilts, heights = (
        np.interp(times, t, part) for part in (flown["tilts"][:, 0], flown["places"][:, 0, 2])
    )
    alone = {"cflib": 0.5, "px4": 1.0}[name]
    assert tilts[times > alone + 0.7].max() < 0.5 and heights[-1] < 0.06
    # After 2 s without commands a Crazyflie stops its motors, and falls. In slow motion the link
    # does so too, after 5 s of this machine.
    falls = name == "cflib" and (cut == 5.0 or SPEED < 1.0)
    assert falls or np.diff(heights).min() / 0.05 > -3.0
