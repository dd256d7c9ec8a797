"""Datagrams of an earlier flight, recorded and sent again into the next one: none is used.

All clocks are those of the earlier flight, as on boards that wake at their last time.
"""

import math
from pathlib import Path

import pytest
from agent_scene import KEY, PARTS, Scene, letter

from echelon_flight import FlightError
from echelon_flight.mission import NumberFile
from echelon_flight.supervisor import Fault
from echelon_flight.wire import GROUND, DatagramKind, Drop, Report, Wire

WALL, BOOT, MARK = 1.8e9, 1_800_000_000_000, "ab" * 32
TIMES = [0.02 * k for k in range(1, 200)]
STATE = Report(0, 0, 0, 0.0, math.nan, *[0.0] * 7, (0,) * len(Drop))


def wire(number, highest=0, boot=BOOT):
    return Wire(KEY, MARK, number, 3, len(PARTS), boot, highest)


def join(ground, agent):
    """Let an agent on the ground follow a start by what both send; whether it did."""
    heard = ground.open(agent.report(WALL, STATE), None, WALL)
    assert not isinstance(heard, Drop)
    opened = agent.open(ground.start(WALL, WALL + 1.0, agent.number), None, WALL)
    if not isinstance(opened, Drop):
        agent.begin(opened.flight)
    return agent.flight == ground.flight


class Recorded:
    """A flight in which agent 2 took the lead, and the station stopped all: what was in the air."""

    def __init__(self):
        self.ground, self.leader, self.backup, self.agent = map(wire, (GROUND, 0, 2, 1))
        self.ground.begin(self.ground.next_flight(WALL))
        assert all(join(self.ground, each) for each in (self.leader, self.backup, self.agent))
        self.letters = [(t, self.leader.letter(letter(0, t))) for t in TIMES]
        self.letters += [(t, self.backup.letter(letter(2, t, leader=2, term=1))) for t in TIMES]
        self.ground.challenges[1] = self.agent.challenge
        self.commands = [self.ground.start(WALL, WALL + 1.0, to) for to in (0, 1, 2, 0xFFFE)]
        self.ground.highest = self.ground.next_flight(WALL + 60.0)
        self.commands += [self.ground.stop(WALL, to) for to in (0, 1, 2, 0xFFFE)]
        self.commands += [self.backup.stop(WALL)]


RECEIVERS = {"fresh": 0, "restarted": BOOT}


def used(receiver, recorded):
    plans = [*recorded.letters, *((None, command) for command in recorded.commands)]
    opened = [receiver.open(datagram, t, WALL) for t, datagram in plans]
    real = [x for x in opened if not isinstance(x, Drop)]
    # A start that is for others is read, and changes nothing.
    return sum(x.kind is not DatagramKind.START or x.body is not None for x in real)


@pytest.mark.parametrize("receiver", RECEIVERS)
def test_a_process_on_the_ground_uses_nothing_of_an_earlier_flight(receiver):
    recorded = Recorded()
    agent = wire(1, RECEIVERS[receiver], BOOT + 500)
    # The letters come at times of a plan that it does not have.
    recorded.letters = [(None, datagram) for _, datagram in recorded.letters]
    assert used(agent, recorded) == 0
    assert sum(agent.dropped.values()) >= len(recorded.letters) + 5
    ground = wire(GROUND, recorded.ground.highest, BOOT + 500)
    ground.begin(ground.next_flight(WALL))
    assert join(ground, agent) and not agent.suspects.keys() & {Drop.CLOCK, Drop.OLD}


@pytest.mark.parametrize("receiver", RECEIVERS)
def test_a_process_in_the_air_uses_nothing_of_an_earlier_flight(receiver):
    recorded = Recorded()
    agent, leader = wire(1, RECEIVERS[receiver], BOOT + 500), wire(0, boot=BOOT + 500)
    # The station knows of the last stop by its file alone: its clock went back.
    ground = wire(GROUND, recorded.ground.highest, BOOT + 500)
    ground.begin(ground.next_flight(WALL))
    assert join(ground, agent) and join(ground, leader)
    assert used(agent, recorded) == 0
    assert agent.dropped == {Drop.FLIGHT: len(recorded.letters) + len(recorded.commands)}
    today = [agent.open(leader.letter(letter(0, t)), t, WALL) for t in TIMES]
    assert sum(not isinstance(x, Drop) for x in today) == 199
    assert used(agent, recorded) == 0


def test_a_station_without_its_file_learns_of_earlier_flights_from_the_agents():
    recorded, station = Recorded(), wire(GROUND, boot=BOOT + 500)
    agent = wire(1, recorded.ground.highest, BOOT + 500)
    station.open(agent.report(WALL, STATE), None, WALL)
    station.begin(station.next_flight(WALL))
    assert station.flight > recorded.ground.highest and join(station, agent)
    assert used(agent, recorded) == 0


def test_reports_of_an_earlier_flight_are_no_agents_of_this_one():
    recorded, station = Recorded(), wire(GROUND, BOOT + 100, BOOT + 500)
    station.begin(station.next_flight(WALL))
    assert station.open(recorded.agent.report(WALL, STATE), None, WALL) is Drop.FLIGHT


def test_a_restarted_process_comes_back_and_its_start_is_no_other_s():
    ground, first = wire(GROUND), wire(1)
    ground.begin(ground.next_flight(WALL))
    assert join(ground, first)
    old = ground.start(WALL, WALL + 1.0, 1)
    again = wire(1, first.highest, BOOT + 900)
    assert again.open(old, None, WALL) is Drop.CHALLENGE
    assert join(ground, again) and again.flight == first.flight
    # Nor does it come back to a flight before that, by whatever it is asked.
    late = wire(1, first.highest + 1, BOOT + 1900)
    ground.challenges[1] = late.challenge
    assert late.open(ground.start(WALL, WALL + 1.0, 1), None, WALL) is Drop.FLIGHT


def test_a_recorded_start_for_others_keeps_no_genuine_one_out():
    ground, agent, ahead = wire(GROUND), wire(1), wire(GROUND, boot=BOOT + 900)
    ahead.begin(BOOT)
    for to in (0, 0xFFFE):
        assert agent.open(ahead.start(WALL, WALL + 1.0, to), None, WALL).body is None
    ground.begin(ground.next_flight(WALL))
    assert join(ground, agent)


def stops(ground, agent, wall=WALL, to=0xFFFE):
    """Whether an agent obeys a stop that is said now, at a time (s) of its clock."""
    ground.highest = ground.next_flight(WALL)
    return not isinstance(agent.open(ground.stop(WALL, to), None, wall), Drop)


@pytest.mark.parametrize("wrong", [0.0, 3600.0, -86400.0])
def test_a_genuine_stop_gets_through(wrong):
    ground, flies, waits = wire(GROUND), wire(1), wire(2, BOOT + 5)
    ground.begin(ground.next_flight(WALL))
    assert join(ground, flies)
    ground.open(waits.report(WALL, STATE), None, WALL)
    assert stops(ground, flies, WALL + wrong)
    assert stops(ground, waits, WALL + wrong, to=2)
    # Of a station that has heard nobody, and did not start the flight.
    assert stops(wire(GROUND, boot=BOOT + 90), flies, WALL + wrong)


def test_a_stop_ends_one_flight_and_not_the_next(tmp_path):
    """The station's clock goes back after the stop; what it stored does not."""
    key = tmp_path / "key"
    stop = None
    for begins in (WALL + 60.0, WALL):
        file, agent = NumberFile(key, "ground"), wire(1)
        ground = Wire(KEY, MARK, GROUND, 3, len(PARTS), BOOT, file.read(), file.write)
        ground.begin(ground.next_flight(begins))
        assert join(ground, agent)
        if stop is not None:
            assert agent.open(stop, None, WALL) is Drop.FLIGHT
        ground.highest = ground.next_flight(begins)
        ground.keep()
        stop = ground.stop(WALL)
        assert not isinstance(agent.open(stop, None, WALL), Drop)


def replay(scene, other, term, count=40):
    for k in range(count):
        t = scene.context.clock.now
        if k % 4 == 0:
            scene.air.send(scene.leader.letter(letter(0, t)))
        scene.air.send(other.letter(letter(0, t, said=t - 0.9, leader=2, term=term)))
        scene.rounds(1)


@pytest.mark.parametrize("backups", [None, [2], [2, 1]])
def test_replayed_letters_let_nobody_take_the_lead(backups, monkeypatch):
    leadership = backups and {"backups": backups, "timeout": 0.3}
    scene = Scene(monkeypatch, leadership)
    earlier = scene.wire(0)
    scene.start()
    earlier.begin(scene.ground.flight - 86_400_000)
    scene.air.send(scene.leader.letter(letter(0, scene.context.clock.now)))
    scene.rounds(2)
    for term in (0, 1, 7):
        replay(scene, earlier, term)
        assert scene.process.pilot.leader == 0
        assert scene.process.pilot.box.letters[0].row[-1] == 0.0
    assert scene.context.wire.dropped == {Drop.FLIGHT: 120} and scene.fault is Fault.NONE


@pytest.mark.parametrize("restarted", [False, True])
def test_a_replayed_start_starts_nothing(restarted, monkeypatch, capsys):
    first = Scene(monkeypatch)
    first.start()
    now = first.clock.time()
    recorded = [first.ground.start(now, now - 1.0, to) for to in (1, 0xFFFE)]
    recorded += [first.ground.stop(now, to) for to in (1, 0xFFFE)]
    scene = Scene(monkeypatch, highest=first.context.wire.highest * restarted)
    for datagram in recorded:
        scene.air.send(datagram)
    scene.rounds(10)
    assert not scene.context.clock.started and scene.fault is Fault.NONE
    assert not scene.link.sent and not scene.link.sinks
    scene.ground.highest = first.context.wire.highest
    scene.start()
    assert scene.context.clock.started and scene.link.sent
    for datagram in recorded:
        scene.air.send(datagram)
    scene.rounds(5)
    assert scene.fault is Fault.NONE
    # It is told that somebody sends them.
    assert capsys.readouterr().err == "agent 1: a datagram of the ground is of another flight.\n"


def test_the_number_is_stored_before_the_flight_and_after_a_stop(monkeypatch):
    stored = []
    scene = Scene(monkeypatch, store=lambda n: stored.append((n, scene.context.clock.started)))
    scene.start()
    assert stored == [(scene.ground.flight, False)]
    scene.ground.highest += 9
    scene.air.send(scene.ground.stop(scene.clock.time()))
    scene.link.x = [0.0, 0.0]
    scene.rounds(2)
    assert scene.fault is Fault.STOP and len(stored) == 1
    scene.process.run()
    assert stored[1:] == [(scene.ground.highest, True)]


def test_a_number_that_cannot_be_stored_keeps_a_vehicle_on_the_ground(monkeypatch, capsys):
    # Not even root may write there.
    file = NumberFile(Path("/proc/self/key"), "agent-1")
    scene = Scene(monkeypatch, store=file.write)
    for _ in range(3):
        scene.start()
    said = capsys.readouterr().err
    assert not scene.context.clock.started and not scene.link.sent and said.count("\n") == 1
    assert said.startswith("agent 1: the flight number cannot be stored in `/proc/self/key.agent-1")
    assert said.endswith("); make its folder writable.\n")


def test_a_number_that_is_damaged_or_has_no_place_is_refused(tmp_path):
    for text in ("", "abc", "-5", "1.5", "9" * 30, "12 13", "\xff"):
        (tmp_path / "key.agent-1.flight").write_bytes(text.encode("latin-1"))
        with pytest.raises(FlightError, match="must be a whole number below 2") as info:
            NumberFile(tmp_path / "key", "agent-1").read()
        assert "\n" not in str(info.value)
    with pytest.raises(FlightError, match=r"cannot be stored in `/proc/self/key"):
        NumberFile(Path("/proc/self/key"), "agent-1").read()
