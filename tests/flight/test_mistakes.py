"""Mistakes on the ground with real processes: each says one sentence, and the page shows it.

At a quarter of the speed, so that other work on the machine does not count.
"""

import hashlib
import json
import shutil
import subprocess
import sys
import time

import pytest
from processes import free_port

import echelon as ech
from echelon.flight.air import Air, bound, ports_of
from echelon.flight.ground import Ground
from echelon.flight.local_flight import make_key
from echelon.flight.mission import Mission
from echelon.flight.wire import GROUND, is_letter, sender_of, wire_of
from echelon.output.archive.flight_folder import flight_files, save_flight

pytestmark = pytest.mark.slow
CARTS, DT, SECONDS, SPEED = ech.models.DoubleIntegrator(), 0.02, 3.0, 0.25
SHIFTED = """
import runpy, time
wall, fine = time.time, time.time_ns
time.time, time.time_ns = lambda: wall() + {0}, lambda: fine() + int(1e9 * {0})
runpy.run_module("echelon.flight", run_name="__main__")
"""
SLOW = """

def tick(*arguments, tick=tick):
    import time
    end = time.thread_time() + 0.06
    while time.thread_time() < end:
        pass
    return tick(*arguments)
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A flight of two carts, and the same under another name."""
    graph = ech.Graph([(0, 1)])
    places = ech.Formation.from_offsets(CARTS, graph, {1: (1.0, 0.0)})
    leader = ech.laws.StoppingLeader(reference=ech.references.Circle(rate=0.5))
    drive = ech.Laws(leader, ech.laws.StoppingPoint())
    world = ech.World(network=ech.Network(rate=25.0))
    parts = ech.Parts(CARTS, graph, places, drive, initial={"position": 0.2}, world=world)
    base = tmp_path_factory.mktemp("flights")
    for name in ("carts", "others"):
        files = flight_files(parts, ech.Settings(horizon=SECONDS, dt=DT), name)
        save_flight(files, base / name)
    return base


class Flight:
    """The ground station, vehicles, and the processes of agents 0 and 1."""

    def __init__(self, folder, own, group=None):
        self.own, self.port, self.group = own, free_port() // 8 * 8, group
        shutil.copytree(folder / "carts", own / "carts")
        shutil.copytree(folder / "others", own / "others")
        make_key(own / "key")
        make_key(own / "another key")
        self.vehicles, self.running, self.way = own / "carts", {}, (group, self.port)
        ports = ports_of(2, self.port)
        air = Air(self.way, [self.way]) if group else Air(ports[2], ports[:2])
        mission = Mission(own / "carts")
        self.ground = Ground(air, wire_of(mission.facts, GROUND, own / "key"), 2)

    def begin(self, *words, code=None):
        program = ["-m", "echelon.flight"] if code is None else ["-c", code]
        command = [sys.executable, *program, *map(str, words)]
        return subprocess.Popen(command, stderr=subprocess.PIPE, text=True)

    def start_vehicles(self):
        words = [self.vehicles, "--vehicles", "--port", self.port + 5, "--speed", SPEED]
        self.running["vehicles"] = self.begin(*words)

    def start_agent(self, number, flight="carts", key="key", code=None, name=None):
        words = [self.own / flight, "--agent", number, "--key", self.own / key]
        words += ["--link", f"udp://127.0.0.1:{self.port + 5}", "--port", self.port]
        words += ["--speed", SPEED]
        words += ["--listen", f"{self.group}:{self.port}"] * (self.group is not None)
        self.running[name or number] = self.begin(*words, code=code)

    def wait(self, holds):
        """Wait until the page shows something."""
        until = time.monotonic() + 15.0
        while not holds(state := self.ground.state()):
            assert time.monotonic() < until, state
            time.sleep(0.05)
        return state

    def start(self, *ready):
        self.wait(lambda state: all(state["agents"][k]["mode"] == "ready" for k in ready))
        self.ground.start(time.time() + 0.3)

    def said(self, name, end=True):
        """What a process says until it ends, and its exit code."""
        process = self.running.pop(name)
        process.terminate() if end else None
        return process.communicate(timeout=90.0)[1], process.returncode

    def close(self):
        for process in self.running.values():
            process.kill()
            process.communicate()
        self.ground.close()


@pytest.fixture
def flight(folder, tmp_path):
    one = Flight(folder, tmp_path)
    yield one
    one.close()


def notes(state, number=1):
    return state["agents"][number].get("notes", [])


def test_a_port_in_use(flight):
    with bound(flight.port + 1):
        flight.start_agent(1)
        sentence = f"the address 127.0.0.1:{flight.port + 1} is in use; a process with the same"
        flight.wait(lambda state: any(sentence in note for note in notes(state)))
        text, code = flight.said(1, end=False)
    assert text.startswith(f"echelon: {sentence}") and text.count("\n") == 1 and code == 2


def test_a_key_that_is_missing_or_readable_by_others(flight):
    (flight.own / "another key").chmod(0o640)
    for key, sentence in (("none", "cannot be read"), ("another key", "has mode 0640")):
        flight.start_agent(1, key=key)
        text, code = flight.said(1, end=False)
        assert sentence in text and text.count("\n") == 1 and code == 2


def test_a_flight_number_that_is_damaged_or_cannot_be_stored(flight):
    damaged, folder = (flight.own / f"key.agent-{k}.flight" for k in (0, 1))
    damaged.write_text("x")
    folder.mkdir()
    for k, sentence in ((0, "is `x`, and must be a whole number"), (1, "(is a directory)")):
        flight.start_agent(k)
        text, code = flight.said(k, end=False)
        assert sentence in text and text.count("\n") == 1 and code == 2


def record(air, count, seconds):
    """What is in the air until so much is: each with its time."""
    datagrams, until = [], time.monotonic() + seconds
    while len(datagrams) < count and time.monotonic() < until:
        datagrams += [(time.time(), each) for each in air.receive()]
        time.sleep(0.005)
    return datagrams


def test_a_recorded_flight_starts_no_process_whose_clock_is_that_of_its_day(folder, tmp_path):
    """The start and the letters of the leader, into a process that is new and one that flew."""
    flight = Flight(folder, tmp_path, "239.255.71.32")
    air = Air(flight.way, [flight.way])
    try:
        flight.start_vehicles()
        for k in (0, 1):
            flight.start_agent(k)
        flight.start(0, 1)
        datagrams = [x for x in record(air, 400, 4.0) if sender_of(x[1]) != 1]
        assert any(is_letter(x) for _, x in datagrams)
        flight.wait(lambda state: state["agents"][1]["mode"] == "flies")
        for k in (0, 1):
            flight.said(k)
        flight.ground.close()
        # Beside this one there is no number.
        shutil.copy(flight.own / "key", flight.own / "another key")
        for name in ("key", "another key"):
            late = time.time() - datagrams[0][0] + 1.5
            flight.start_agent(1, key=name, code=SHIFTED.format(-late), name=name)
            for at, datagram in datagrams:
                time.sleep(max(0.0, at + late - time.time()))
                air.send(datagram)
            text, _ = flight.said(name)
            assert "it never flew" in text and "clock" not in text
    finally:
        air.close()
        flight.close()


UNLIKE = {
    "is signed with another key": {"key": "another key"},
    "is of another formation": {"flight": "others"},
    "has a time stamp that differs from this clock by more than 1 s": {"code": SHIFTED.format(1.2)},
}


@pytest.mark.parametrize("why", UNLIKE)
def test_an_agent_that_is_unlike_the_others_stays_on_the_ground(flight, why):
    flight.start_vehicles()
    flight.start_agent(0)
    flight.start_agent(1, **UNLIKE[why])
    flight.start(0)
    flight.wait(lambda state: state["agents"][0]["mode"] == "flies")
    state = flight.wait(lambda state: any(why in text for text in state["dropped"]))
    assert f"a datagram of agent 1 {why}" in state["dropped"][0]
    flight.wait(lambda state: f"a datagram of agent 1 {why}" in notes(state, 0))
    text, _ = flight.said(1)
    assert f"agent 1: a datagram of the ground {why}.\n" in text and "it never flew" in text
    assert flight.ground.report(0).mode == 1


def test_a_clock_that_is_half_a_second_off_keeps_an_agent_on_the_ground(flight):
    flight.start_vehicles()
    flight.start_agent(0)
    flight.start_agent(1, code=SHIFTED.format(0.5))
    flight.start(0, 1)
    sentence = "a datagram of the ground gives the start by a clock that differs from this one"
    flight.wait(lambda state: any(sentence in note for note in notes(state)))
    assert flight.ground.report(1).mode == 0


def descends(flight, sentence):
    """Wait until agent 1 descends and says why; the other one flies on and ends as planned."""
    flight.wait(lambda state: sentence in (state["agents"][1].get("why") or ""))
    assert flight.ground.report(0).mode == 1
    text, code = flight.said(1, end=False)
    assert text.count("the vehicle levels and descends.") == 1 and sentence in text and code == 1
    assert flight.said(0, end=False)[1] == 0


def test_a_law_that_overruns_its_period(flight):
    file = flight.own / "others" / "law-1" / "law.py"
    shutil.copytree(flight.own / "carts" / "law-1", file.parent, dirs_exist_ok=True)
    shutil.copy(flight.own / "carts" / "flight.json", file.parents[1])
    text = file.read_text("utf-8") + SLOW
    file.write_text(text, "utf-8")
    facts = json.loads((file.parent / "law.json").read_text("utf-8"))
    facts["sha256"]["law.py"] = hashlib.sha256(text.encode()).hexdigest()
    (file.parent / "law.json").write_text(json.dumps(facts), "utf-8")
    flight.start_vehicles()
    flight.start_agent(0)
    flight.start_agent(1, flight="others")
    flight.start(0, 1)
    descends(flight, "of its period, more than half")


@pytest.mark.parametrize("step", [0.025, 0.05])
def test_a_link_with_another_step_than_the_law(flight, step):
    flight.vehicles = flight.own / "others"
    facts = json.loads((flight.vehicles / "flight.json").read_text("utf-8"))
    (flight.vehicles / "flight.json").write_text(json.dumps(facts | {"dt": step}), "utf-8")
    flight.start_vehicles()
    for k in (0, 1):
        flight.start_agent(k)
    flight.start(0, 1)
    if step < 2.0 * DT:
        told = f"states arrive every {step:g} s, and the law's period is {DT:g} s"
        flight.wait(lambda state: told in notes(state, 0) and told in notes(state))
        return
    told = f"states arrive every {step:g} s, at least twice the law's period"
    flight.wait(lambda state: all(row.get("why") == told for row in state["agents"]))
    assert [flight.said(k, end=False)[1] for k in (0, 1)] == [1, 1]


def test_two_agents_with_one_number(folder, tmp_path):
    flight = Flight(folder, tmp_path, "239.255.71.31")
    sentence = "two agents have the number 1"
    try:
        flight.start_vehicles()
        for k in (0, 1):
            flight.start_agent(k)
        flight.start(0, 1)
        flight.wait(lambda state: (state["agents"][1].get("time") or 0.0) > 0.7)
        flight.start_agent(1, name="again")
        flight.wait(lambda state: sentence in (*notes(state), state["agents"][1].get("why")))
        assert f"{sentence}; the vehicle levels and descends." in flight.said(1, end=False)[0]
        assert flight.said(0, end=False)[1] == 0
    finally:
        flight.close()


def test_vehicles_that_vanish_in_the_air(flight):
    flight.start_vehicles()
    for k in (0, 1):
        flight.start_agent(k)
    flight.start(0, 1)
    flight.wait(lambda state: (state["agents"][1].get("time") or 0.0) > 0.5)
    flight.running["vehicles"].kill()
    flight.wait(lambda state: "the newest state is" in (state["agents"][1].get("why") or ""))
    # Without states it may still be in the air.
    time.sleep(2.0 / SPEED)
    assert flight.running[1].poll() is None and flight.ground.report(1).mode == 2
