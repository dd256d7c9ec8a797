"""The ground station, beside agents that this test plays, under a clock that it moves."""

import json
import math
import threading
import time
import urllib.error
import urllib.request
from pathlib import Path

import pytest
from virtual_flight import Network, VirtualClock

from echelon_flight.ground import Ground, page_of
from echelon_flight.mission import NumberFile
from echelon_flight.wire import GROUND, DatagramKind, Drop, Message, Report, Wire

KEY, BOOT = b"k" * 32, 1_800_000_000_000
REPORT = Report(1, 0, 0, 0.0, math.nan, 0.0, 0.0, 1.0, 0.0, 2e-4, 0.01, math.nan, (0,) * len(Drop))


def wire(number, key=KEY, boot=BOOT, **options):
    return Wire(key, "ab" * 32, number, 2, 2, boot, **options)


class Station:
    def __init__(self, monkeypatch):
        self.clock = VirtualClock(monkeypatch, 1e-3 * BOOT)
        self.network = Network(self.clock)
        self.agents, self.ground = self.network.socket(), self.station()

    def station(self, **options):
        return Ground(self.network.socket(), wire(GROUND, **options), 2)

    def say(self, write, *more):
        self.agents.send(write(self.clock.time(), *more))
        self.ground.round()
        self.clock.now += 0.02

    def obeyed(self, agent):
        found = set()
        for _ in range(50):
            self.say(agent.report, REPORT)
            opened = [agent.open(x, None, self.clock.time()) for x in self.agents.receive()]
            real = [x for x in opened if not isinstance(x, Drop)]
            found |= {x.kind for x in real if x.kind is DatagramKind.STOP or x.body is not None}
        return found


@pytest.fixture
def station(monkeypatch):
    return Station(monkeypatch)


def test_commands_answer_those_that_wait(station):
    flies, waits, deaf = wire(0), wire(1), wire(1, boot=BOOT - 5)
    station.ground.start(station.clock.time())
    assert station.obeyed(waits) == {DatagramKind.START}
    assert station.obeyed(deaf) == set()
    flies.begin(station.ground.wire.flight)
    station.ground.stop()
    assert station.obeyed(flies) == station.obeyed(waits) == {DatagramKind.STOP}


def test_a_number_that_cannot_be_stored_is_shown_and_starts_nothing(station):
    ground = station.station(store=NumberFile(Path("/proc/self/key"), "ground").write)
    with page_of(ground).serving() as address:
        urllib.request.urlopen(urllib.request.Request(f"{address}start", b""))
    assert not ground.state()["started"]
    assert ground.state()["problem"].startswith("the flight number cannot be stored in `/proc")
    # A stop needs no file.
    ground.stop()
    assert ground.state()["stopped"]


def test_a_phone_sees_and_stops_and_starts_nothing(station):
    ground = station.station()
    with page_of(ground).serving_others() as address:
        near = "http://127.0.0.1:" + address.rpartition(":")[2]
        shown = json.loads(urllib.request.urlopen(f"{near}state").read())
        assert shown["stops_only"] and len(shown["agents"]) == len(ground.state()["agents"])
        with pytest.raises(urllib.error.HTTPError, match="404"):
            urllib.request.urlopen(urllib.request.Request(f"{near}start", b""))
        assert not ground.state()["started"] and not ground.state()["stopped"]
        urllib.request.urlopen(urllib.request.Request(f"{near}stop", b""))
        assert ground.state()["stopped"]


def test_each_row_names_the_nearest_agent_by_the_last_reports(station):
    ground, agents = station.ground, (wire(0), wire(1))
    for number, place in ((0, (0.0, 0.0, 1.0)), (1, (3.0, 4.0, 1.0))):
        x, y, z = place
        station.say(agents[number].report, REPORT._replace(x=x, y=y, z=z, step=0.01))
    first, second = ground.state()["agents"][:2]
    assert (first["nearest"], second["nearest"]) == ((5.0, 1), (5.0, 0))
    assert first["rate"] == 100.0
    # A place that is not known is near to nobody; what moves in a plane has no z.
    station.say(agents[1].report, REPORT._replace(x=math.nan, y=1.0, z=1.0))
    assert ground.state()["agents"][0]["nearest"] is None
    for number, x in ((0, 0.0), (1, 2.0)):
        station.say(agents[number].report, REPORT._replace(x=x, y=0.0, z=math.nan))
    assert ground.state()["agents"][0]["nearest"] == (2.0, 1)


def test_the_station_keeps_the_number_of_a_flight_and_of_a_stop(tmp_path, station):
    file = NumberFile(tmp_path / "key", "ground")
    ground = station.station(highest=file.read(), store=file.write)
    ground.start(station.clock.time())
    assert BOOT <= (flight := file.read()) == ground.wire.flight <= 1e3 * station.clock.time()
    ground.stop()
    assert file.read() > flight == ground.wire.flight


def test_a_button_that_is_pressed_twice_starts_one_flight(station):
    stored = []

    def store(number):
        time.sleep(0.1)
        stored.append(number)

    ground = station.station(store=store)
    presses = [threading.Thread(target=ground.start, args=(BOOT,)) for _ in range(3)]
    for press in presses:
        press.start()
    for press in presses:
        press.join()
    assert stored == [ground.wire.flight]


def test_notes_of_a_process_that_ended_vanish(station):
    early, flies, late = (wire(1, boot=BOOT + k) for k in (-10, 0, 10))
    station.say(early.note, "the address is in use")
    row = {"agent": 1, "mode": "not heard yet", "notes": ["the address is in use"]}
    assert station.ground.state()["agents"][1] == row
    station.say(flies.report, REPORT)
    row = station.ground.state()["agents"][1]
    assert row["mode"] == "flies" and row["notes"] == []
    for text in ("its own", "its own", *"abcde"):
        station.say(flies.note, text)
    assert station.ground.state()["agents"][1]["notes"] == [*"abcde"]
    # Another one that did not begin takes the place of nobody.
    station.say(late.note, "the address is in use")
    assert "the address is in use" in station.ground.state()["agents"][1]["notes"]
    station.say(flies.report, REPORT._replace(mode=2))
    assert station.ground.state()["agents"][1]["mode"] == "descends"
    station.clock.now += 1.1
    assert station.ground.state()["agents"][1]["mode"] == "silent"


MISTAKES = {
    "a datagram of agent 1 is signed with another key: 1": lambda now: wire(1, b"other" * 8).report(
        now, REPORT
    ),
    f"a datagram of agent 1 {Drop.CLOCK.value}: 1": lambda now: wire(1).report(now + 1.2, REPORT),
    "a datagram has a length that no datagram of this formation has: 1": lambda now: b"x" * 99,
}


@pytest.mark.parametrize("sentence", MISTAKES)
def test_whose_datagrams_are_dropped_is_shown(sentence, station):
    station.say(lambda now: wire(0).letter(Message(0, (99.0, 0.0))))
    station.say(MISTAKES[sentence])
    assert station.ground.state()["dropped"] == [sentence]
