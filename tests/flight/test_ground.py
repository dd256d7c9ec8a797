"""The ground station, beside agents that this test plays."""

import math
import threading
import time
import urllib.request
from pathlib import Path

import pytest
from processes import free_port

from echelon.flight.air import LOOPBACK, Air, ports_of
from echelon.flight.datagrams import DatagramKind, Drop
from echelon.flight.ground import Ground, page_of
from echelon.flight.key_files import NumberFile
from echelon.flight.wire import GROUND, Letter, Report, Wire
from echelon.output.viewer.serve import serve, serving

KEY, BOOT = b"k" * 32, time.time_ns() // 1_000_000
REPORT = Report(1, 0, 0, 0.0, math.nan, 0.0, 0.0, 1.0, 0.0, 2e-4, 0.01, math.nan, (0,) * len(Drop))


def wire(number, key=KEY, boot=BOOT):
    return Wire(key, "ab" * 32, number, 2, (1, 1), boot)


@pytest.fixture
def scene():
    """The ground station, and the socket of all others."""
    port = free_port()
    ground = Ground(Air((LOOPBACK, port), []), wire(GROUND), 2)
    agents = Air((LOOPBACK, free_port()), ports_of(0, port))
    yield ground, agents
    ground.close()
    agents.close()


def kinds(ground, agents, agent):
    """The kinds of the commands that an agent obeys, within a second."""
    found, until = set(), time.monotonic() + 1.0
    while not found and time.monotonic() < until:
        agents.send(agent.report(time.time(), REPORT))
        opened = [agent.open(each, None, time.time()) for each in agents.receive()]
        real = [x for x in opened if not isinstance(x, Drop)]
        found = {x.kind for x in real if x.kind is DatagramKind.STOP or x.body is not None}
        time.sleep(0.02)
    return found


def test_commands_answer_those_that_wait(station):
    ground, agents = station
    flies, waits, deaf = wire(0), wire(1), wire(1, boot=BOOT - 5)
    ground.start(time.time())
    assert kinds(ground, agents, waits) == {DatagramKind.START}
    assert kinds(ground, agents, deaf) == set()
    flies.begin(ground._wire.flight)
    ground.stop()
    assert kinds(ground, agents, flies) == kinds(ground, agents, waits) == {DatagramKind.STOP}


def test_a_number_that_cannot_be_stored_is_shown_and_starts_nothing():
    port = free_port()
    file = NumberFile(Path("/proc/self/key"), "ground")
    own = Wire(KEY, "ab" * 32, GROUND, 2, (1, 1), BOOT, 0, file.write)
    ground = Ground(Air((LOOPBACK, port), []), own, 2)
    try:
        with serving(serve(page_of(ground))) as address:
            urllib.request.urlopen(urllib.request.Request(f"{address}start", b""))
        assert not ground.state()["started"]
        assert ground.state()["problem"].startswith("the flight number cannot be stored in `/proc")
        # A stop needs no file.
        ground.stop()
        assert ground.state()["stopped"]
    finally:
        ground.close()


def test_the_station_keeps_the_number_of_a_flight_and_of_a_stop(tmp_path):
    file = NumberFile(tmp_path / "key", "ground")
    own = Wire(KEY, "ab" * 32, GROUND, 2, (1, 1), BOOT, file.read(), file.write)
    ground = Ground(Air((LOOPBACK, free_port()), []), own, 2)
    try:
        ground.start(time.time())
        assert BOOT <= (flight := file.read()) == own.flight <= 1e3 * time.time()
        ground.stop()
        assert file.read() > flight == own.flight
    finally:
        ground.close()


def test_a_button_that_is_pressed_twice_starts_one_flight():
    stored = []

    def store(number):
        time.sleep(0.1)
        stored.append(number)

    own = Wire(KEY, "ab" * 32, GROUND, 2, (1, 1), BOOT, 0, store)
    ground = Ground(Air((LOOPBACK, free_port()), []), own, 2)
    try:
        presses = [threading.Thread(target=ground.start, args=(time.time(),)) for _ in range(3)]
        for press in presses:
            press.start()
        for press in presses:
            press.join()
        assert stored == [own.flight]
    finally:
        ground.close()


def shown(ground, holds):
    """What the page shows, once it holds."""
    for _ in range(200):
        if holds(state := ground.state()):
            return state
        time.sleep(0.01)
    raise AssertionError(ground.state())


@pytest.fixture
def station():
    """The ground station, and the socket of an agent."""
    ways = [(LOOPBACK, free_port()) for _ in range(2)]
    ground, agents = Ground(Air(ways[0], [ways[1]]), wire(GROUND), 2), Air(ways[1], [ways[0]])
    yield ground, agents
    ground.close()
    agents.close()


def test_notes_of_a_process_that_ended_vanish(scene):
    ground, agents = scene
    agents.send(wire(1, boot=BOOT - 10).note(time.time(), "the address is in use"))
    state = shown(ground, lambda state: state["agents"][1]["notes"])
    assert state["agents"][1] == {
        **{"agent": 1, "mode": "not heard yet"},
        "notes": ["the address is in use"],
    }
    flies = wire(1)
    agents.send(flies.report(time.time(), REPORT))
    shown(ground, lambda state: state["agents"][1]["mode"] == "flies")
    assert ground.state()["agents"][1]["notes"] == []
    for text in ("its own", "its own", *"abcde"):
        agents.send(flies.note(time.time(), text))
    shown(ground, lambda state: state["agents"][1]["notes"] == [*"abcde"])
    # Another one that did not begin takes the place of nobody.
    agents.send(wire(1, boot=BOOT + 10).note(time.time(), "the address is in use"))
    state = shown(ground, lambda state: "the address is in use" in state["agents"][1]["notes"])
    agents.send(flies.report(time.time(), REPORT._replace(mode=2)))
    shown(ground, lambda state: state["agents"][1]["mode"] == "descends")


MISTAKES = {
    "a datagram of agent 1 is signed with another key: 1": lambda now: wire(1, b"other" * 8).report(
        now, REPORT
    ),
    f"a datagram of agent 1 {Drop.CLOCK.value}: 1": lambda now: wire(1).report(now + 1.2, REPORT),
    "a datagram has a length that no datagram of this formation has: 1": lambda now: b"x" * 99,
}


@pytest.mark.parametrize("sentence", MISTAKES)
def test_whose_datagrams_are_dropped_is_shown(sentence, scene):
    ground, agents = scene
    agents.send(wire(0).letter(Letter(0, 99.0, 0, (0.0,), None)))
    agents.send(MISTAKES[sentence](time.time()))
    assert shown(ground, lambda state: state["dropped"])["dropped"] == [sentence]
