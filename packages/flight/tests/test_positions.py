"""Positions from a file of the user's reach the estimators of Crazyflies."""

import sys
from types import ModuleType, SimpleNamespace

import pytest
from cflib_stub import LogConfig, Stub

from echelon_flight import FlightError
from echelon_flight.links import crazyflie
from echelon_flight.links.crazyflie import CflibLink
from echelon_flight.positions import PositionForwarder, load_positions

SOURCE = """
class Positions:
    def poses(self):
        yield 0, 1.0, 2.0, 0.5
        yield 0, 9.0, 9.0, 9.0  # too soon
        yield 7, 0.0, 0.0, 0.0  # of another process
        yield 1, float("nan"), 2.0, 0.5
        yield 1, 3.0, 4.0, 0.5, 0.0, 0.0, 0.0, 1.0
        {end}
"""
FACTS = {
    **{"states": dict.fromkeys(["x", "y", "z"], ""), "trim": {"thrust": 0.3}},
    "inputs": dict.fromkeys(("roll_command", "pitch_command", "yaw_rate_command", "thrust"), ""),
}


@pytest.fixture
def links(monkeypatch):
    for name in ("cflib", "cflib.crazyflie", "cflib.crazyflie.log"):
        monkeypatch.setitem(sys.modules, name, ModuleType(name))
    sys.modules["cflib.crazyflie.log"].LogConfig = LogConfig
    clock = SimpleNamespace(now=5.0)
    monkeypatch.setattr(crazyflie, "time", SimpleNamespace(monotonic=lambda: clock.now))
    result = {}
    for k in (0, 1):
        stub = Stub()
        stub.got, stub.clock = [], clock
        stub.extpos = SimpleNamespace(
            send_extpos=lambda *pose, got=stub.got: got.append(pose),
            send_extpose=lambda *pose, got=stub.got: got.append(pose),
        )
        result[k] = CflibLink("", FACTS, stub), stub
    return result


def forwarded(tmp_path, links, end):
    file = tmp_path / "mocap.py"
    file.write_text(SOURCE.format(end=end))
    known = {k: link for k, (link, _) in links.items()}
    PositionForwarder(load_positions(file), known, 5.0).run()


def test_positions_reach_their_vehicles_and_a_source_that_ends_lets_them_descend(tmp_path, links):
    forwarded(tmp_path, links, "return")
    (first, one), (second, two) = links.values()
    assert one.got == [(1.0, 2.0, 0.5)] and two.got == [(3.0, 4.0, 0.5, 0.0, 0.0, 0.0, 1.0)]
    one.arrive(z=500)
    for link in (first, second):
        with pytest.raises(FlightError, match="failed: the source of positions ended"):
            link.read(0.0)


@pytest.mark.parametrize("end", ["raise OSError('no camera')", "yield 0, 1.0", "1 / 0"])
def test_a_source_that_fails_says_why(tmp_path, links, end):
    forwarded(tmp_path, links, end)
    with pytest.raises(FlightError, match="the source of positions failed: [A-Z]\\w+Error: "):
        links[0][0].read(0.0)


def test_without_positions_for_half_a_second_states_no_longer_count(links):
    link, stub = links[0]
    stub.clock.now = 100.0
    stub.arrive(z=500)
    # One that never got positions from outside has its own.
    assert link.read(0.0).x == pytest.approx([0.0, 0.0, 0.5])
    link.locate((0.0, 0.0, 0.5))
    stub.clock.now = 100.4
    stub.arrive(z=500)
    assert link.read(0.0) is not None
    stub.clock.now = 100.6
    stub.arrive(z=500)
    with pytest.raises(FlightError, match=r"no position came from outside for 0\.5 s"):
        link.read(0.0)


def test_a_vehicle_that_waits_for_positions_gives_up_after_a_while(links):
    link, stub = links[0]
    link.expect_positions(5.0)
    assert stub.fake.parameters["stabilizer.estimator"] == 2
    stub.clock.now += 4.9
    assert link.read(0.0) is None
    stub.clock.now += 0.2
    with pytest.raises(FlightError, match="no position came from outside"):
        link.read(0.0)


WRONG = {
    "": "gives no positions: AttributeError",
    "import nothing_of_this_name": "gives no positions: ModuleNotFoundError",
    "class Positions: pass": "the class `Positions` in `.*` has no method `poses`",
}


@pytest.mark.parametrize("text", WRONG)
def test_a_file_without_a_source_is_one_sentence(tmp_path, text):
    (tmp_path / "mocap.py").write_text(text)
    with pytest.raises(FlightError, match=WRONG[text]):
        load_positions(tmp_path / "mocap.py")
