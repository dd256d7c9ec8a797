"""One agent's process, with a vehicle and others that this test plays."""

import math
import socket
import time

import pytest

from echelon.core.errors import FlightError
from echelon.core.packet import Packet
from echelon.flight.agent_process import AgentProcess, Crew
from echelon.flight.air import LOOPBACK, Air
from echelon.flight.links.link import Link, Reading
from echelon.flight.plan_clock import PlanClock
from echelon.flight.supervisor import Fault
from echelon.flight.wire import GROUND, DatagramKind, Drop, Letter, Report, Wire

DT, KEY = 0.01, b"k" * 32
FLIGHT = {
    **{"dt": DT, "leadership": None, "weather": {"delay": 0.02, "jitter": 0.03, "loss": 0.0}},
    "position": [0],
    "velocity": [1],
    "tilt": [],
    "fence": {"low": [-5.0], "high": [5.0], "speed": 10.0},
}
NETWORK = {
    "moves": False,
    "period": 0.02,
    "forget": 0.5,
    "forget_hops": 5.0,
    "agents": 2,
    "leaders": [0],
}
FACTS = {
    **{"agent": 1, "dt": DT, "leads": False, "hears": [0], "weights": [1.0]},
    **{"signal": ["x"], "message": ["v"], "network": {**NETWORK, "uses": "all"}},
}


class Law:
    """A law that returns its disagreement, or what a test wants."""

    u, ticks = 0.0, 0

    def begin(self, x):
        return []

    def difference(self, t, x, memory, place):
        return [x[0] - place[0]]

    def expected(self, t, content, age):
        return [t], [1.0], True

    def tick(self, t, x, z, forward, memory):
        self.ticks += 1
        return [self.u - z[0]], [], [x[0]], [0.0], math.isfinite(self.u)


class Fake(Link):
    """A vehicle that reads as this test says."""

    def __init__(self):
        self.x, self.sent, self.sinks, self.fails, self.age = [0.0, 1.0], [], 0, False, 0.0
        self.battery, self.silent = None, False

    def read(self, wait):
        time.sleep(DT / 2)
        if self.fails:
            raise FlightError("the link is gone.")
        return None if self.silent else Reading(time.monotonic() - self.age, self.x, self.battery)

    def send(self, u):
        self.sent.append(u)

    def level_descend(self):
        self.sinks += 1

    def close(self):
        pass


class Scene:
    """An agent's process, its vehicle, and the socket of all others."""

    def __init__(self, monkeypatch):
        monkeypatch.setattr("signal.signal", lambda *_: None)
        ways = []
        for _ in range(2):
            with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
                probe.bind((LOOPBACK, 0))
                ways.append(probe.getsockname())
        self.air, self.law, self.link = Air(ways[0], [ways[1]]), Law(), Fake()
        air = Air(ways[1], [ways[0]])
        crew = Crew(self.law, FACTS, FLIGHT, self.link, air, self.wire(1), PlanClock())
        self.process = AgentProcess(crew)
        self.crew, self.ground, self.leader = crew, self.wire(GROUND), self.wire(0)

    def wire(self, number, key=KEY, formation="ab" * 32):
        return Wire(key, formation, number, 2, (1, 1), time.time_ns() // 1_000_000)

    def start(self):
        self.air.send(self.ground.start(time.time(), time.time() - 1.0))
        self.rounds(10)

    def rounds(self, count):
        for _ in range(count):
            self.process._round()

    @property
    def fault(self):
        return self.process._supervisor.fault


@pytest.fixture
def scene(monkeypatch):
    return Scene(monkeypatch)


def test_nothing_is_sent_before_the_start(scene):
    scene.rounds(5)
    assert not scene.link.sent and scene.fault is Fault.NONE
    scene.start()
    assert scene.link.sent and scene.fault is Fault.NONE


def test_letters_are_heard_and_answered(scene):
    scene.start()
    t = scene.crew.clock.now
    packet = Packet(0, t, (0.0,))
    scene.air.send(scene.leader.letter(Letter(0, t, 0, (0.0,), packet)))
    scene.rounds(20)
    # The leader is expected at t, and the vehicle is at 0.
    assert scene.link.sent[-1][0] == pytest.approx(t, abs=1.0)
    wire = scene.wire(0)
    letters = [wire.open(each, scene.crew.clock.now, time.time()) for each in scene.air.receive()]
    bodies = [x.body for x in letters if not isinstance(x, Drop) and isinstance(x.body, Letter)]
    assert bodies and bodies[-1].packet == packet and bodies[-1].hops == 1
    # At the network's rate: every other state.
    assert len(bodies) <= 0.6 * len(scene.link.sent) + 2


FAULTS = {
    Fault.FENCE: lambda scene: setattr(scene.link, "x", [6.0, 0.0]),
    Fault.SPEED: lambda scene: setattr(scene.link, "x", [0.0, 11.0]),
    Fault.BATTERY: lambda scene: setattr(scene.link, "battery", 0.1),
    Fault.LINK: lambda scene: setattr(scene.link, "fails", True),
    Fault.INPUT: lambda scene: setattr(scene.law, "u", math.nan),
    Fault.STALE: lambda scene: setattr(scene.link, "age", 0.2),
    Fault.STOP: lambda scene: scene.air.send(scene.leader.stop(time.time())),
    Fault.SIGNAL: lambda scene: scene.process._interrupt(15, None),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_each_fault_lets_the_vehicle_descend_and_stay_so(fault, scene, capsys):
    scene.start()
    sent = len(scene.link.sent)
    FAULTS[fault](scene)
    for _ in range(4):
        scene.process._over()
        scene.rounds(1)
    assert scene.fault is fault
    scene.link.fails, scene.link.x, scene.law.u, scene.link.age = False, [0.0, 1.0], 0.0, 0.0
    before, sinks = len(scene.link.sent), scene.link.sinks
    scene.rounds(5)
    assert len(scene.link.sent) == before <= sent + 2 and scene.link.sinks == sinks + 5
    said = capsys.readouterr().err
    # The page has it in the report; what the link says is a note.
    assert notes(scene) == ({"the link is gone"} if fault is Fault.LINK else set())
    assert said.count("levels and descends.") == 1 and said.startswith("agent 1: ")


def test_a_vehicle_that_says_nothing_is_not_taken_for_one_that_rests(scene, capsys):
    scene.start()
    scene.link.silent = True
    scene.rounds(25)
    assert scene.fault is Fault.STALE and scene.link.sinks
    # Long ago it moved, and long ago it said so.
    scene.process._moved -= 5.0
    scene.process._heard_at -= 5.0
    assert not scene.process._over()
    scene.link.silent, scene.link.x = False, [0.0, 0.0]
    scene.rounds(1)
    assert scene.process._over()
    scene.link.silent, scene.process._fell = True, time.monotonic() - 30.0
    assert scene.process._over()


def report(scene, number=1):
    """A report of another process of the same number, as it is sent."""
    nothing = Report(*[0] * 12, dropped=(0,) * len(Drop))
    return scene.wire(number).report(time.time(), nothing)


def test_a_process_with_the_same_number_ends_the_flight(scene):
    scene.start()
    time.sleep(0.01)
    # Another one that was killed just before may have sent it.
    scene.air.send(report(scene))
    scene.rounds(2)
    assert scene.fault is Fault.NONE
    scene.crew.wire.boot -= 3000
    scene.air.send(report(scene))
    scene.rounds(2)
    assert scene.fault is Fault.TWIN
    assert scene.process._supervisor.sentence == "two agents have the number 1"


def test_who_descends_already_still_says_that_its_number_is_used_twice(scene):
    """The ground believes the process that began last, and sees the fault of that one alone."""
    scene.start()
    scene.process._supervisor.trip(Fault.PERIOD, 0.02)
    scene.crew.wire.boot -= 3000
    scene.air.send(report(scene))
    scene.rounds(2)
    scene.process._report(time.monotonic())
    assert "two agents have the number 1" in notes(scene)


MISTAKES = {
    "a datagram of agent 0 is signed with another key.": {"key": b"other" * 8},
    "a datagram of agent 0 is of another formation.": {"formation": "cd" * 32},
}


@pytest.mark.parametrize("sentence", MISTAKES)
def test_mistakes_on_the_ground_are_told_once(sentence, scene, capsys):
    scene.start()
    t, other = scene.crew.clock.now, scene.wire(0, **MISTAKES[sentence])
    for _ in range(3):
        scene.air.send(other.letter(Letter(0, t, 0, (0.0,), Packet(0, t, (0.0,)))))
        scene.rounds(1)
    said = capsys.readouterr().err.splitlines()
    assert said.count(f"agent 1: {sentence}") == 1 and scene.fault is Fault.NONE


def notes(scene):
    """What the process says to the ground, meanwhile."""
    wire = scene.wire(GROUND)
    opened = [wire.open(each, None, time.time()) for each in scene.air.receive()]
    return {x.body for x in opened if not isinstance(x, Drop) and x.kind is DatagramKind.NOTE}


CLOCKS = {
    Drop.CLOCK.value: (-1.5, 1.5),
    Drop.START.value: (-0.4, -0.2, 0.15, 0.9),
}


@pytest.mark.parametrize("why", CLOCKS)
def test_a_clock_that_is_off_keeps_a_vehicle_on_the_ground(why, scene, capsys):
    for off in CLOCKS[why]:
        for _ in range(3):
            now = time.time() + off
            scene.air.send(scene.ground.start(now, now))
            scene.rounds(1)
    scene.process._report(time.monotonic())
    sentence = f"a datagram of the ground {why}"
    assert capsys.readouterr().err == f"agent 1: {sentence}.\n"
    assert not scene.link.sent and notes(scene) == {sentence}
    scene.start()
    assert scene.link.sent


def test_a_neighbour_whose_clock_is_ahead_is_told(scene, capsys):
    scene.start()
    for off, why in ((1.5, "that differs from this clock by"), (0.2, "ahead of this clock")):
        t = scene.crew.clock.now + off
        scene.air.send(scene.leader.letter(Letter(0, t, 0, (0.0,), Packet(0, t, (0.0,)))))
        scene.rounds(2)
        assert f"a datagram of agent 0 has a time stamp {why}" in capsys.readouterr().err
    # One that is late is none of them, and nobody is told.
    t = scene.crew.clock.now - 0.5
    scene.air.send(scene.leader.letter(Letter(0, t, 0, (0.0,), Packet(0, t, (0.0,)))))
    scene.rounds(2)
    assert not capsys.readouterr().err


def test_a_process_of_the_same_number_that_could_not_begin_changes_nothing(scene):
    scene.start()
    scene.process._began -= 3.0
    scene.air.send(scene.wire(1).note(time.time(), "the address is in use"))
    scene.rounds(2)
    assert scene.fault is Fault.NONE


def test_the_first_start_counts(scene):
    scene.start()
    before = scene.crew.clock.now
    scene.air.send(scene.ground.start(time.time(), time.time() + 100.0))
    scene.rounds(2)
    assert scene.crew.clock.now >= before


def test_states_that_come_unevenly_are_all_used(scene):
    """States every period, each up to 4 ms late: the law counts its time by ticks."""
    scene.start()
    begin, before = time.monotonic(), len(scene.link.sent)
    for k in range(200):
        late = 0.004 * (k * 37 % 11) / 10
        scene.process._tick(Reading(begin + k * DT + late, [0.0, 1.0]))
    assert len(scene.link.sent) - before >= 199


def count_ticks(scene, times):
    """How often the law acts on states of times after the start, in periods."""
    scene.start()
    begin, before = time.monotonic(), scene.law.ticks
    for k in times:
        scene.process._tick(Reading(begin + k * DT, [0.0, 1.0]))
    return scene.law.ticks - before


def test_the_law_counts_its_time_by_ticks(scene):
    """States that come too often are skipped, and a few that were missed are made up for."""
    often = [k / 2 for k in range(100)]
    assert abs(count_ticks(scene, [*often, *(50 + 2 * k for k in range(25))]) - 99) <= 2


def test_a_long_gap_is_not_made_up_for(scene):
    assert abs(count_ticks(scene, [*range(50), *range(150, 200)]) - 100) <= 2
