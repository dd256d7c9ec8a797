"""One agent's process, with a vehicle and others that this test plays."""

import math

import pytest
from agent_scene import DT, Scene, letter

from echelon_flight.coverage_watch import CoverageWatch
from echelon_flight.links import Reading
from echelon_flight.supervisor import Fault
from echelon_flight.wire import GROUND, DatagramKind, Drop, Message, Report


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
    t = scene.context.clock.now
    scene.air.send(scene.leader.letter(letter(0, t)))
    scene.rounds(20)
    # The leader is expected at t, and the vehicle is at 0.
    assert scene.link.sent[-1][0] == pytest.approx(t, abs=1.0)
    wire = scene.wire(0)
    wire.begin(scene.ground.flight)
    now = scene.context.clock.now, scene.clock.time()
    letters = [wire.open(each, *now) for each in scene.air.receive()]
    bodies = [x.body for x in letters if not isinstance(x, Drop) and isinstance(x.body, Message)]
    # The packet is the leader's, and passed on.
    assert bodies and bodies[-1].row[1] == 1.0 and bodies[-1].row[3:] == letter(0, t).row[3:]
    # At the network's rate: every other state.
    assert len(bodies) <= 0.6 * len(scene.link.sent) + 2


FAULTS = {
    Fault.FENCE: lambda scene: setattr(scene.link, "x", [6.0, 0.0]),
    Fault.SPEED: lambda scene: setattr(scene.link, "x", [0.0, 11.0]),
    Fault.BATTERY: lambda scene: setattr(scene.link, "battery", 0.1),
    Fault.LINK: lambda scene: setattr(scene.link, "fails", True),
    Fault.INPUT: lambda scene: setattr(scene.law, "u", math.nan),
    Fault.STALE: lambda scene: setattr(scene.link, "age", 0.2),
    Fault.STOP: lambda scene: scene.air.send(scene.leader.stop(scene.clock.time())),
    Fault.SIGNAL: lambda scene: scene.process.interrupt(),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_each_fault_lets_the_vehicle_descend_and_stay_so(fault, scene, capsys):
    scene.start()
    sent = len(scene.link.sent)
    FAULTS[fault](scene)
    for _ in range(4):
        scene.process.over()
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
    scene.rounds(1_000)
    assert not scene.process.over()
    scene.link.silent = False
    scene.rounds(1)
    scene.link.x = [0.0, 0.0]
    scene.rounds(150)
    assert not scene.process.over()
    scene.rounds(60)
    assert scene.process.over()


WATCHED = (
    {"text": "an input is at a limit", "of": "u", "row": [2.0], "low": None, "high": 0.9},
    {"text": "`x` is outside of the domain", "of": "x", "row": [1, 0], "low": -0.5, "high": 0.5},
)


@pytest.mark.parametrize(
    ("u", "x", "why"),
    [(0.4, 0.5, ""), (0.5, 0.6, WATCHED[0]["text"]), (0.4, 0.6, WATCHED[1]["text"])],
)
def test_the_first_broken_condition_of_the_guarantee_is_told_with_its_time(scene, u, x, why):
    scene.process.watch = watch = CoverageWatch({"guarantee": {"watched": WATCHED}})
    scene.link.x, scene.law.u = [x, 1.0], u
    scene.start()
    scene.link.x, now = [0.7, 1.0], scene.context.clock.now
    scene.rounds(20)
    assert watch.why == (why or WATCHED[1]["text"])
    # Before the state changed, or by it.
    assert (watch.lost <= now) == bool(why) and watch.lost <= now + 20.0 * DT


def test_nothing_is_watched_of_a_claim_that_ignores_what_acts():
    ignores = CoverageWatch({"guarantee": {"watched": WATCHED, "ignores": ["wind acts"]}})
    assert math.isnan(ignores.lost) and ignores.why == "wind acts"
    assert math.isnan(CoverageWatch({}).lost) and not ignores.look(0.0, [9.0], [9.0])


@pytest.mark.parametrize(
    ("verdict", "why"),
    [("guaranteed", "an agent cannot see its conditions"), ("none", "nothing is guaranteed")],
)
def test_why_nothing_is_watched_is_the_verdict_s(verdict, why):
    watch = CoverageWatch({"guarantee": {"verdict": verdict, "watched": None}})
    assert math.isnan(watch.lost) and watch.why == why


def report(scene, number=1, earlier=0):
    nothing, wire = Report(*[0] * 12, dropped=(0,) * len(Drop)), scene.wire(number)
    wire.begin(scene.context.wire.flight - earlier)
    return wire.report(scene.clock.time(), nothing)


def test_a_process_with_the_same_number_ends_the_flight(scene):
    scene.start()
    scene.clock.now += 0.01
    # Another one that was killed just before may have sent it.
    scene.air.send(report(scene))
    scene.rounds(2)
    assert scene.fault is Fault.NONE
    scene.context.wire.boot -= 3000
    scene.air.send(report(scene, earlier=1))
    scene.rounds(2)
    assert scene.fault is Fault.NONE
    scene.air.send(report(scene))
    scene.rounds(2)
    assert scene.fault is Fault.TWIN
    assert scene.process.supervisor.sentence == "two agents have the number 1"


def test_who_descends_already_still_says_that_its_number_is_used_twice(scene):
    """The ground believes the process that began last, and sees the fault of that one alone."""
    scene.start()
    scene.process.supervisor.trip(Fault.PERIOD, 0.02)
    scene.context.wire.boot -= 3000
    scene.air.send(report(scene))
    scene.rounds(2)
    scene.process.report(scene.clock.now)
    assert "two agents have the number 1" in notes(scene)


def notes(scene):
    wire = scene.wire(GROUND)
    opened = [wire.open(each, None, scene.clock.time()) for each in scene.air.receive()]
    return {x.body for x in opened if not isinstance(x, Drop) and x.kind is DatagramKind.NOTE}


CLOCKS = {
    Drop.CLOCK.value: (-1.5, 1.5),
    Drop.START.value: (-0.4, -0.2, 0.15, 0.9),
}


@pytest.mark.parametrize("why", CLOCKS)
def test_a_clock_that_is_off_keeps_a_vehicle_on_the_ground(why, scene, capsys):
    scene.introduce()
    for off in CLOCKS[why]:
        for _ in range(3):
            now = scene.clock.time() + off
            scene.air.send(scene.ground.start(now, now, 1))
            scene.rounds(1)
    scene.process.report(scene.clock.now)
    sentence = f"a datagram of the ground {why}"
    assert capsys.readouterr().err == f"agent 1: {sentence}.\n"
    assert not scene.link.sent and notes(scene) == {sentence}
    scene.start()
    assert scene.link.sent


def test_a_neighbour_whose_clock_is_ahead_is_told(scene, capsys):
    scene.start()
    for off, why in ((1.5, "that is farther from this clock than"), (0.2, "ahead of this clock")):
        t = scene.context.clock.now + off
        scene.air.send(scene.leader.letter(letter(0, t)))
        scene.rounds(2)
        assert f"a datagram of agent 0 has a time stamp {why}" in capsys.readouterr().err
    # One that is late is none of them, and nobody is told.
    t = scene.context.clock.now - 0.5
    scene.air.send(scene.leader.letter(letter(0, t)))
    scene.rounds(2)
    assert not capsys.readouterr().err


def test_a_process_of_the_same_number_that_could_not_begin_changes_nothing(scene):
    scene.start()
    scene.rounds(600)
    scene.air.send(scene.wire(1).note(scene.clock.time(), "the address is in use"))
    scene.rounds(2)
    assert scene.fault is Fault.NONE


def test_the_first_start_counts(scene):
    scene.start()
    before = scene.context.clock.now
    scene.air.send(scene.ground.start(scene.clock.time(), scene.clock.time() + 100.0, 1))
    scene.rounds(2)
    assert scene.context.clock.now >= before


OFTEN = [k / 2 for k in range(100)]
ARRIVALS = {
    "up to 4 ms late": ([k + 0.4 * (k * 37 % 11) / 10 for k in range(200)], 200, 1),
    "too often, then every other": ([*OFTEN, *(50 + 2 * k for k in range(25))], 99, 2),
    "after a long gap": ([*range(50), *range(150, 200)], 100, 2),
}
"""Of states, in periods; how often the law acts on them, and how much that is off."""


@pytest.mark.parametrize("name", ARRIVALS)
def test_the_law_counts_its_time_by_ticks(scene, name):
    """States that come too often are skipped, and a few that were missed are made up for."""
    times, count, off = ARRIVALS[name]
    scene.start()
    before, begin, left = scene.law.ticks, scene.clock.now, [*times]

    def read(wait):
        scene.clock.now = begin + left.pop(0) * DT
        return Reading(scene.clock.now, [0.0, 1.0])

    scene.link.read = read
    scene.rounds(len(times))
    assert abs(scene.law.ticks - before - count) <= off
