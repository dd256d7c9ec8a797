"""Several agents in one process: their options, their letters, and their share of a radio."""

import subprocess
import sys
import threading
import time
from collections import deque
from types import SimpleNamespace

import pytest
import two_points
from agent_scene import letter
from free_port import free_port

from echelon_flight import FlightError, one_process
from echelon_flight.datagram_socket import DatagramSocket, ports_of
from echelon_flight.flight_log import find_logs, read_log
from echelon_flight.ground import Ground
from echelon_flight.links import Reading
from echelon_flight.mission import Mission, make_key
from echelon_flight.one_process import (
    SharedRadioLink,
    SharedSocket,
    fly_together,
    read_links,
    read_numbers,
    warn,
)
from echelon_flight.supervisor import Fault
from echelon_flight.wire import GROUND, Wire

STATES = dict.fromkeys(["x", "y", "z", "yaw"], "")


def test_agents_and_their_links():
    assert read_numbers("0,2,3", 4) == [0, 2, 3]
    usual = ["cflib://radio://0/80/2M/E7E7E7E701", "cflib://radio://0/80/2M/E7E7E7E70B"]
    assert read_links("cflib", [0, 10]) == usual
    assert read_links("udp", [1, 2]) == ["udp", "udp"]
    assert read_links("udp://a:1,udp://a:2", [1, 2]) == ["udp://a:1", "udp://a:2"]
    for text in ("", "0,0", "0,4", "0;1", "-1"):
        with pytest.raises(FlightError, match="must be different numbers from 0 to 3"):
            read_numbers(text, 4)
    with pytest.raises(FlightError, match="`--link` has 2 addresses, and `--agents` 3"):
        read_links("udp://a:1,udp://a:2", [1, 2, 3])
    two = "cflib://radio://0/80/2M/E7E7E7E701,cflib://radio://1/80/2M/E7E7E7E702"
    with pytest.raises(FlightError, match="several dongles; start a process for each dongle"):
        read_links(two, [0, 1])


def test_what_a_dongle_cannot_carry_is_said_before_the_flight():
    assert warn(0.01, 300.0, 3) == ""
    sentence = "4 vehicles want 400 setpoints a second, and the dongle carries 300: 25% will be"
    assert warn(0.01, 300.0, 4).startswith(sentence)


def wire(number):
    return Wire(b"k" * 32, "ab" * 32, number, 3, 7, 1)


def test_a_datagram_reaches_those_here_once_and_all_others():
    """In a multicast group it comes back from the network, too."""
    group, inboxes = ("239.255.71.1", free_port()), {0: deque(), 1: deque()}
    outer = [DatagramSocket(group, [group]) for _ in range(3)]
    here, other = [SharedSocket(outer[k], k, inboxes) for k in (0, 1)], outer[2]
    first, third = (wire(k).letter(letter(k, 1.0)) for k in (0, 2))
    here[0].send(first)
    other.send(third)
    got = []
    while third not in got:
        got += here[1].receive()
    assert got.count(first) == 1 and got.count(third) == 1
    # Who has its own number is heard: another process with it must not fly.
    again = []
    while first not in again:
        again += here[0].receive()
    here[1].send(first)
    here[0].skip()
    assert [*here[0].receive()] == []
    for each in (*here, other):
        each.close()


class Radio:
    """A link that takes so long for a setpoint."""

    def __init__(self, clock):
        self.clock, self.sent, self.held, self.sinks, self.takes = clock, 0, [], 0, 0.0

    def read(self, wait):
        return Reading(self.clock.now, [1.0, 2.0, 3.0, 0.5])

    def send(self, u):
        self.sent, self.clock.now = self.sent + 1, self.clock.now + self.takes

    def hover(self, place, yaw):
        self.held.append((place, yaw))

    def level_descend(self):
        self.sinks += 1


@pytest.fixture
def shared(monkeypatch):
    clock = SimpleNamespace(now=10.0, speed=1.0)
    monkeypatch.setattr(one_process, "time", SimpleNamespace(monotonic=lambda: clock.now))

    def link(vehicles, **flight):
        radio, facts = Radio(clock), {"states": STATES, "dt": 0.01, "agent": 0}
        return SharedRadioLink(radio, facts, flight, clock, vehicles), radio, clock

    return link


def ticks(link, clock, count):
    for _ in range(count):
        clock.now += 0.01
        link.read(0.0)
        link.send([0.0])


@pytest.mark.parametrize("vehicles", [1, 2, 3])
def test_vehicles_that_a_dongle_can_carry_have_no_late_setpoint(shared, vehicles):
    link, radio, clock = shared(vehicles)
    ticks(link, clock, 1000)
    assert (link.total, link.late, link.notice, radio.sent) == (1000, 0, "", 1000)


@pytest.mark.parametrize(("most", "vehicles"), [(300.0, 4), (300.0, 5), (150.0, 2)])
def test_setpoints_are_as_many_as_the_share(shared, most, vehicles):
    link, radio, clock = shared(vehicles, parameters={"radio_setpoints": most})
    ticks(link, clock, 1000)
    # At the start two are saved.
    assert radio.sent == pytest.approx(10.0 * most / vehicles, abs=2.0)
    assert link.late == 1000 - radio.sent and not link.hovers
    assert f"% of the setpoints are late: the dongle carries {most:g} a second" in link.notice
    link.level_descend()
    assert link.notice == f"{link.late} of 1000 setpoints were late"


def test_without_a_plan_a_vehicle_hovers_where_it_was(shared):
    link, radio, clock = shared(10)
    ticks(link, clock, 150)
    assert link.hovers and link.notice.endswith("; it hovers on the plan")
    assert radio.held and all(held == ([1.0, 2.0, 3.0], 0.5) for held in radio.held)
    sent = radio.sent
    ticks(link, clock, 100)
    assert radio.sent == sent


@pytest.mark.parametrize(("most", "hovers"), [(0.2, True), (0.3, False)])
def test_the_share_of_late_setpoints_that_is_borne_is_a_parameter(shared, most, hovers):
    link, _, clock = shared(4, parameters={"late_setpoints": most})
    ticks(link, clock, 300)
    assert link.hovers == hovers


def test_with_a_plan_it_hovers_there(shared):
    plan = {"every": 100.0, "rows": [[[0.0, 0.0, 0.0]], [[100.0, 0.0, 200.0]]]}
    link, radio, clock = shared(10, plan=plan)
    ticks(link, clock, 101)
    clock.now = 20.0
    link.send([0.0])
    assert radio.held[-1] == ([20.0, 0.0, 40.0], 0.5)


def test_a_radio_that_is_slow_makes_setpoints_late(shared):
    link, radio, clock = shared(1)
    radio.takes = 0.011
    ticks(link, clock, 100)
    assert link.late == 100 and link.hovers


class Process:
    """What flies a few rounds; one of them fails."""

    def __init__(self, rounds, fails=False):
        self.left, self.fails, self.interrupted, self.thread = rounds, fails, False, None

    def over(self):
        return self.left == 0

    def round(self):
        self.left -= 1
        self.thread = threading.current_thread()
        if self.fails:
            raise ValueError("a fault of the program")

    def end(self):
        return Fault.END

    def interrupt(self):
        self.interrupted = True


@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
def test_each_agent_has_a_thread_and_one_that_fails_ends_alone(monkeypatch):
    handlers = {}
    monkeypatch.setattr("signal.signal", handlers.__setitem__)
    agents = [Process(5), Process(3, fails=True), Process(7)]
    assert fly_together(agents) == [Fault.END, Fault.LINK, Fault.END]
    assert [each.left for each in agents] == [0, 2, 0]
    assert len({each.thread for each in agents}) == 3
    for handle in handlers.values():
        handle()
    assert all(each.interrupted for each in agents)


@pytest.mark.slow
def test_one_process_flies_two_agents_and_lands_them(tmp_path):
    """Over the link to simulated vehicles, in slow motion."""
    two_points.write(tmp_path)
    mission, key, port = Mission(tmp_path), tmp_path / "key", free_port() // 8 * 8
    make_key(key)
    start = [sys.executable, "-m", "echelon_flight", tmp_path]
    speed, link = ["--speed", "0.5"], f"udp://127.0.0.1:{port + 4}"
    vehicles = subprocess.Popen([*start, "--vehicles", *speed, "--port", str(port + 4)])
    ports, heard = ports_of(2, port), {0: [], 1: []}
    wire = mission.wire(GROUND, key)
    # It hears the agents, and they hear each other through memory alone.
    ground = Ground(
        DatagramSocket(ports[2], ports[:2]), wire, 2, lambda k, report: heard[k].append(report)
    )
    ground.listen()
    words = [*start, "--agents", "0,1", "--key", key, "--link", f"{link},{link}", *speed]
    words += ["--port", str(port), "--seconds", "3"]
    try:
        assert subprocess.run([*words, "--dry-run"], capture_output=True, check=True).stdout == (
            b"agent 0: all checks passed; nothing was sent to other agents.\n"
            b"agent 1: all checks passed; nothing was sent to other agents.\n"
        )
        agents = subprocess.Popen(words)
        while not ground.ready:
            assert agents.poll() is None
            time.sleep(0.02)
        ground.start(time.time() + 0.5)
        assert agents.wait() == 0
    finally:
        vehicles.kill()
        vehicles.wait()
        ground.close()
    # Agent 1 follows a leader whose letters it has, and both end with the plan.
    flown = [report for report in heard[1] if report.mode == 1 and report.time > 0.5]
    assert flown and all(report.leader == 0 and report.heard < 1.0 for report in flown)
    assert {*ground.faults.values()} == {Fault.END}
    # Each writes a log of its own.
    [files] = find_logs(tmp_path).values()
    logs = [read_log(file) for file in files]
    assert [log.header["agent"] for log in logs] == [0, 1]
    for log in logs:
        assert log.header["vehicle"] == link and log.ticks[-1].fault and not log.warning
        assert log.sentences[-1].text.startswith("the flight is over; ")
