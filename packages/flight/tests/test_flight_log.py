"""The log of a process: what was written is read, up to the first damage; no flight ends by it."""

import contextlib
import errno
import math
import os
import select
import signal
import socket
import struct
import subprocess
import sys
import time

import pytest
import two_points
from agent_scene import FACTS, Scene, letter
from free_port import free_port
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from virtual_flight import VirtualFlight

from echelon_flight import FlightError, flight_log
from echelon_flight.datagram_socket import LOOPBACK, DatagramSocket, ports_of
from echelon_flight.flight_log import FlightLog, Received, Sentence, Tick, find_logs, read_log
from echelon_flight.ground import Ground
from echelon_flight.links.udp import HEAD, INPUT
from echelon_flight.mission import Mission, make_key
from echelon_flight.pilot import Pilot
from echelon_flight.simulated_vehicles import simulated
from echelon_flight.supervisor import Fault
from echelon_flight.wire import GROUND, Message

HEADER = {"agent": 1, "states": {"x": "m", "v": "m/s"}, "inputs": {"a": "m/s^2"}}
HEADER |= {"message": {"time": 1, "content": 2}}
DOUBLE = st.floats(allow_nan=False)
SINGLE = st.floats(width=32, allow_nan=False)
LETTER = st.builds(Received, st.integers(0, 9), DOUBLE, st.tuples(*[DOUBLE] * 3))
TICK = st.builds(
    Tick, DOUBLE, st.tuples(DOUBLE, DOUBLE), st.tuples(DOUBLE), st.integers(0, 255), st.booleans(),
    st.integers(1, 2), st.integers(0, 13), DOUBLE, st.integers(0, 0xFFFF), SINGLE, SINGLE, DOUBLE,
    st.lists(LETTER, max_size=3).map(tuple),
)  # fmt: skip
ENTRY = st.one_of(TICK, st.builds(Sentence, DOUBLE, st.text(max_size=30)))
SAME_FOLDER = settings(suppress_health_check=[HealthCheck.function_scoped_fixture])


def write(folder, entries, boot=[0]):  # noqa: B006
    boot[0] += 1
    log = FlightLog(folder, HEADER, 2, 1, 3)
    log.begin(7, boot[0], {"start": 1.0})
    for entry in entries:
        if isinstance(entry, Sentence):
            log.say(*entry)
        else:
            for each in entry.received:
                log.receive(*each)
            log.tick(entry)
    log.close()
    assert not log.problem
    return log.file


def apart(entries):
    kinds = [isinstance(x, Sentence) for x in entries]
    return [x for x, k in zip(entries, kinds) if not k], [x for x, k in zip(entries, kinds) if k]


@SAME_FOLDER
@given(st.lists(ENTRY, max_size=6))
def test_what_is_written_is_read(tmp_path, entries):
    log = read_log(write(tmp_path, entries))
    assert (log.ticks, log.sentences) == apart(entries) and not log.warning
    assert log.header["flight"] == 7 and log.header["start"] == 1.0
    assert HEADER.items() <= log.header.items()


@SAME_FOLDER
@given(st.lists(ENTRY, min_size=1, max_size=6), st.data())
def test_a_log_damaged_at_a_byte_or_cut_is_read_up_to_there(tmp_path, entries, data):
    file = write(tmp_path, entries)
    whole = file.read_bytes()
    place = data.draw(st.integers(0, len(whole) - 1))
    changed = data.draw(st.integers(1, 255))
    cut = data.draw(st.booleans())
    other = whole[:place] if cut else bytearray(whole)
    if not cut:
        other[place] ^= changed
    file.write_bytes(other)
    try:
        log = read_log(file)
    except FlightError as error:
        # The header is damaged, without which nobody knows what the numbers are.
        assert place < whole.index(b'"start": 1.0}') + 14 and str(error).endswith(".")
        return
    ticks, sentences = apart(entries)
    assert log.ticks == ticks[: len(log.ticks)]
    assert log.sentences == sentences[: len(log.sentences)]
    lost = len(entries) - len(log.ticks) - len(log.sentences)
    # All in front of the damage is there: each record ends where the next one begins.
    ends = [len(write(tmp_path, entries[:k]).read_bytes()) for k in range(len(entries) + 1)]
    kept = sum(end <= place for end in ends) - 1
    assert len(entries) - lost == kept
    assert log.warning.endswith("are cut or damaged.") or cut and place in ends


def test_a_log_of_another_version_and_another_file_are_refused_in_a_sentence(tmp_path):
    file = write(tmp_path, [])
    data = bytearray(file.read_bytes())
    data[len(flight_log.MAGIC)] = 9
    file.write_bytes(data)
    with pytest.raises(FlightError, match="is a log of version 9, and this version reads 1; read"):
        read_log(file)
    file.write_bytes(b"something else")
    with pytest.raises(FlightError, match="is no log of a flight"):
        read_log(file)
    with pytest.raises(FlightError, match="cannot be read .no such file"):
        read_log(tmp_path / "none.log")


def test_a_record_of_a_size_that_no_header_says_is_damage(tmp_path):
    file = write(tmp_path, [Tick(0.0, (1.0, 2.0), (3.0,))])
    size = FlightLog(tmp_path, HEADER, 3, 1, 3)
    size.begin(8, 1, {})
    size.tick(Tick(0.0, (1.0, 2.0, 3.0), (4.0,)))
    size.close()
    # A sound record of a process with another law.
    record = size.file.read_bytes()[len(_beginning(size.file)) :]
    file.write_bytes(file.read_bytes() + record)
    log = read_log(file)
    assert len(log.ticks) == 1 and log.warning


def _beginning(file):
    data = file.read_bytes()
    begin = flight_log._BEGIN.size
    return data[: begin + 8 + struct.unpack_from("<I", data, begin)[0]]


# ---- a flight with a log -------------------------------------------------------------------------


def full(log, monkeypatch):
    monkeypatch.setattr(flight_log.os, "write", lambda *_: _raise(errno.ENOSPC))


def short(log, monkeypatch):
    monkeypatch.setattr(flight_log.os, "write", lambda _, data: len(data) - 1)


def closed(log, monkeypatch):
    os.close(log._descriptor)


def broken(log, monkeypatch):
    log._broken = OSError(errno.EIO, os.strerror(errno.EIO))


def _raise(number):
    raise OSError(number, os.strerror(number))


FAILURES = {
    full: "no space left on device",
    short: "the disk is full",
    closed: "bad file descriptor",
    broken: "input/output error",
}


def scene_with_log(monkeypatch, folder):
    scene = Scene(monkeypatch)
    facts = {"agent": 1, "states": {"x": "m", "v": "m/s"}, "inputs": {"u": "N"}}
    log = FlightLog(folder, facts | {"message": FACTS["message"]}, 2, 1, 7)
    scene.process.context = scene.context = scene.context._replace(log=log)
    return scene, log


@pytest.mark.parametrize("failure", FAILURES)
def test_nothing_that_flies_falls_because_of_its_log(failure, tmp_path, monkeypatch, capsys):
    scene, log = scene_with_log(monkeypatch, tmp_path)
    scene.start()
    with monkeypatch.context() as patch:
        failure(log, patch)
        scene.rounds(20)
    sent = len(scene.link.sent)
    scene.rounds(20)
    assert scene.fault is Fault.NONE and len(scene.link.sent) > sent
    told = f"the log of this flight ends here ({FAILURES[failure]}); the flight goes on without it"
    assert capsys.readouterr().err == f"agent 1: {told}.\n"
    assert read_log(log.file).ticks


def test_a_folder_in_which_nothing_can_be_written_delays_no_flight(tmp_path, monkeypatch, capsys):
    (tmp_path / "file").write_text("")
    scene, log = scene_with_log(monkeypatch, tmp_path / "file")
    scene.start()
    assert scene.fault is Fault.NONE and scene.link.sent and log.file is None
    assert capsys.readouterr().err.count("the flight goes on without it.\n") == 1


def test_letters_are_logged_with_their_ages_and_faults_with_their_sentences(tmp_path, monkeypatch):
    scene, log = scene_with_log(monkeypatch, tmp_path)
    scene.start()
    t = scene.context.clock.now
    scene.air.send(scene.leader.letter(letter(0, t - 0.03)))
    scene.rounds(4)
    scene.link.x = [6.0, 0.0]
    scene.rounds(4)
    scene.process.end()
    read = read_log(log.file)
    [heard] = [x for tick in read.ticks for x in tick.received]
    assert heard.row == letter(0, t - 0.03).row and heard.sender == 0
    assert heard.age == pytest.approx(0.03, abs=0.011)
    last = read.ticks[-1]
    assert (last.mode, list(Fault)[last.fault]) == (2, Fault.FENCE) and last.amount == 1.0
    assert math.isnan(last.u[0]) and last.x == (6.0, 0.0)
    said = [x.text for x in read.sentences]
    assert said[0].startswith("the vehicle is 1.00 m outside its fence") and "ticks" in said[-1]
    assert [x.sent for x in read.ticks].count(True) > 0


def test_a_fault_after_which_no_state_comes_is_logged_once(tmp_path, monkeypatch):
    scene, log = scene_with_log(monkeypatch, tmp_path)
    scene.start()
    scene.link.silent = True
    scene.rounds(60)
    ticks = read_log(log.file).ticks
    assert [list(Fault)[tick.fault] for tick in ticks[-2:]] == [Fault.NONE, Fault.STALE]
    assert ticks[-1].age == pytest.approx(ticks[-1].amount, abs=0.02) and ticks[-1].age > 0.1


def test_each_process_of_each_flight_has_a_file_of_its_own(tmp_path):
    files = [write(tmp_path / "logs", []) for _ in range(2)]
    other = FlightLog(tmp_path / "logs", HEADER, 2, 1, 3)
    other.begin(8, 1, {})
    other.close()
    assert find_logs(tmp_path) == {7: sorted(files), 8: [other.file]}
    assert find_logs(tmp_path / "logs" / "8") == {8: [other.file]}
    again = FlightLog(tmp_path / "logs", HEADER, 2, 1, 3)
    again.begin(8, 1, {})
    assert "file exists" in again.problem


# ---- a flight, and the same again from its logs --------------------------------------------------


def test_inputs_and_states_follow_from_the_log_alone(tmp_path, monkeypatch):
    """By the law and the motion in the folder, without the process that flew."""
    two_points.write(tmp_path / "points")
    flight = VirtualFlight(tmp_path / "points", tmp_path / "key", monkeypatch)
    for k in range(2):
        flight.start_agent(k, logs=True)
    flight.take_off(0, 1)
    flight.fly(20.0)
    assert set(flight.ended.values()) == {Fault.END}
    [files] = find_logs(tmp_path / "points").values()
    moves, substeps = simulated(flight.mission), flight.substeps
    for number, file in enumerate(files):
        log = read_log(file)
        assert not log.warning and log.header["agent"] == number
        law, facts = flight.mission.law(number)
        pilot, memory, x = Pilot(law, facts), [], log.ticks[0].x
        flown = [tick for tick in log.ticks if tick.mode == 1]
        assert len(flown) == 400 and all(tick.missed == 0 for tick in flown)
        for tick, after in zip(flown, flown[1:]):
            for each in tick.received:
                assert pilot.box.receive(Message(each.sender, each.row), each.arrived) is None
            result = pilot.tick(tick.time, list(tick.x))
            assert result.u == pytest.approx(tick.u, abs=1e-9)
            x, u = list(tick.x), list(tick.u)
            for _ in range(substeps):
                x, memory = moves[number](x, u, memory, [0.0] * 6)
            assert x == pytest.approx(after.x, abs=1e-9)


class Vehicle:
    """The other end of a real process's link: it says states, and remembers the inputs."""

    def __init__(self):
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.bind((LOOPBACK, 0))
        self.socket.settimeout(10.0)
        self.port, self.inputs, self.address = self.socket.getsockname()[1], [], None

    def meet(self):
        _, self.address = self.socket.recvfrom(64)

    def tell(self):
        x = [0.6, -0.1, 1.0, 0.0, 0.0, 0.0]
        state = struct.pack("<8d", time.monotonic(), math.nan, *x)
        self.socket.sendto(state, self.address)

    def heard(self):
        with contextlib.suppress(BlockingIOError, TimeoutError):
            while True:
                datagram = self.socket.recv(64)
                if HEAD.unpack_from(datagram)[0] == INPUT:
                    self.inputs.append(struct.unpack("<3d", datagram[HEAD.size :]))


@pytest.mark.parametrize("after", [1, 37])
def test_a_process_that_is_killed_loses_one_tick_at_most(tmp_path, after):
    """By kill -9, as soon as an input has arrived: only the process itself could write more."""
    two_points.write(tmp_path)
    make_key(tmp_path / "key")
    vehicle, port = Vehicle(), free_port() // 8 * 8
    ways = ports_of(2, port)
    mission = Mission(tmp_path)
    ground = Ground(DatagramSocket(ways[2], ways[:2]), mission.wire(GROUND, tmp_path / "key"), 2)
    words = ["--agent", "0", "--key", tmp_path / "key", "--port", port]
    link = ["--link", f"udp://{LOOPBACK}:{vehicle.port}"]
    words = [sys.executable, "-m", "echelon_flight", tmp_path, *words, *link]
    with subprocess.Popen([*map(str, words)], stderr=subprocess.DEVNULL) as process:
        try:
            vehicle.meet()
            vehicle.socket.setblocking(False)
            ground.start(time.time() + 0.2)
            while len(vehicle.inputs) < after:
                ground.round()
                vehicle.tell()
                until = time.monotonic() + 0.02
                while len(vehicle.inputs) < after and (wait := until - time.monotonic()) > 0.0:
                    select.select([vehicle.socket], [], [], wait)
                    vehicle.heard()
                assert process.poll() is None
        finally:
            process.send_signal(signal.SIGKILL)
    vehicle.heard()
    ground.close()
    vehicle.socket.close()
    [[file]] = find_logs(tmp_path).values()
    log = read_log(file)
    assert not log.warning
    logged = [tick.u for tick in log.ticks]
    assert len(vehicle.inputs) - len(logged) in (0, 1)
    assert logged == vehicle.inputs[: len(logged)]
