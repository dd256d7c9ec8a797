"""Links to autopilots without their libraries: what they send and read, and what they refuse."""

import math
import sys
import time
from types import ModuleType, SimpleNamespace

import pytest
from cflib_stub import LogConfig, Stub

from echelon_flight import FlightError, MissingLibraryError
from echelon_flight import __main__ as process
from echelon_flight.links import open_link
from echelon_flight.links.crazyflie import CflibLink
from echelon_flight.links.px4 import Px4Link
from echelon_flight.parameters import DEFAULTS

STATES = dict.fromkeys(["x", "y", "z", "vx", "vy", "vz", "roll", "pitch", "yaw"], "")
COMMANDS = ("roll_command", "pitch_command", "yaw_rate_command", "thrust")


def facts(*inputs):
    names = inputs or COMMANDS
    return {
        "agent": 0, "dt": 0.01, "states": STATES, "inputs": dict.fromkeys(names, ""),
        "trim": dict.fromkeys(names, 0.0) | {"thrust": 0.3},
    }  # fmt: skip


@pytest.fixture
def crazyflie(monkeypatch):
    for name in ("cflib", "cflib.crazyflie", "cflib.crazyflie.log"):
        monkeypatch.setitem(sys.modules, name, ModuleType(name))
    sys.modules["cflib.crazyflie.log"].LogConfig = LogConfig
    return Stub()


def test_attitudes_reach_the_crazyflie_with_the_signs_of_echelon(crazyflie):
    link = CflibLink("", facts(), crazyflie)
    assert crazyflie.armed == [] and crazyflie.fake.locked and link.watchdog
    link.send([0.1, 0.2, -0.3, 0.25])
    assert crazyflie.armed == [True] and crazyflie.fake.parameters["stabilizer.controller"] == 2
    assert not crazyflie.fake.locked
    assert crazyflie.fake.command == pytest.approx([0.1, 0.2, -0.3, 0.25], abs=4e-6)
    strong = CflibLink("radio://0/80/2M#0.72", facts(), crazyflie)
    crazyflie.fake.full = 0.72
    strong.send([0.0, 0.0, 0.0, 0.5])
    assert crazyflie.fake.command[3] == pytest.approx(0.5, abs=6e-6)


def test_a_crazyflie_that_keeps_another_controller_is_refused(crazyflie):
    crazyflie.param.set_value = lambda *_: None
    with pytest.raises(FlightError, match="does not confirm its parameter `stabilizer.controller`"):
        CflibLink("", facts() | {"parameters": DEFAULTS | {"cflib_patience": 0.01}}, crazyflie)


def test_the_newest_state_is_read_once(crazyflie):
    link = CflibLink("", facts(), crazyflie)
    assert link.read(0.0) is None
    crazyflie.arrive(z=1000)
    crazyflie.arrive(z=1200, vy=-300, vbat=3.55)
    reading = link.read(1.0)
    assert reading.x == pytest.approx([0.0, 0.0, 1.2, 0.0, -0.3, 0.0, 0.0, 0.0, 0.0])
    assert reading.battery == pytest.approx(0.5) and link.read(0.0) is None
    crazyflie.connection_lost[0]("", "Too many packets lost\nin the air.")
    with pytest.raises(
        FlightError, match="the link to the Crazyflie failed: Too many packets lost"
    ):
        link.read(1.0)


def test_accelerations_go_as_full_states_from_the_measured_place(crazyflie):
    link = CflibLink("", facts("ax", "ay", "az"), crazyflie)
    link.send([0.1, 0.2, 0.3])
    assert crazyflie.fake.acceleration is None
    crazyflie.arrive(z=1000)
    link.send([0.1, 0.2, -0.3])
    assert crazyflie.fake.acceleration == pytest.approx([0.1, 0.2, -0.3], abs=1e-3)


def test_a_descent_is_level_and_ends_with_the_motors_off_at_the_ground_or_in_time(
    crazyflie, monkeypatch
):
    link, blind = (CflibLink("", facts(), crazyflie) for _ in range(2))
    link.send([0.1, 0.2, -0.3, 0.25])
    link.level_descend()
    assert crazyflie.fake.command == pytest.approx([0.0, 0.0, 0.0, 0.93 * 0.3], abs=4e-6)
    for call in crazyflie.configs[0].data_received_cb:
        call(0, dict.fromkeys(crazyflie.configs[0].variables, 0), None)
    link.level_descend()
    assert crazyflie.fake.command == [0.0] * 4
    now = time.monotonic()
    for later, thrust in ((0.0, 0.93 * 0.3), (4.9, 0.93 * 0.3), (5.1, 0.0), (9.0, 0.0)):
        monkeypatch.setattr(time, "monotonic", lambda later=later: now + later)
        blind.level_descend()
        assert crazyflie.fake.command[3] == pytest.approx(thrust, abs=4e-6)


def test_the_numbers_of_a_flight_reach_a_crazyflie(crazyflie, monkeypatch):
    numbers = {"sinking_thrust": 0.8, "sinking_time": 2.0, "landed_height": 0.2}
    numbers |= {"position_age": 1.0, "empty_battery": 3.5, "full_battery": 3.9}
    link = CflibLink("", facts() | {"parameters": DEFAULTS | numbers}, crazyflie)
    crazyflie.arrive(z=500, vbat=3.6)
    assert link.read(0.0).battery == pytest.approx(0.25)
    now, thrust = time.monotonic(), 0.8 * 0.3
    for later, z, wanted in ((0.0, 500, thrust), (1.9, 210, thrust), (1.95, 190, 0.0)):
        monkeypatch.setattr(time, "monotonic", lambda later=later: now + later)
        crazyflie.arrive(z=z)
        link.send([0.0, 0.0, 0.0, 0.25])
        link.level_descend()
        assert crazyflie.fake.command[3] == pytest.approx(wanted, abs=4e-6)
    high = CflibLink("", facts() | {"parameters": DEFAULTS | numbers}, crazyflie)
    for later, wanted in ((10.0, thrust), (11.9, thrust), (12.1, 0.0)):
        monkeypatch.setattr(time, "monotonic", lambda later=later: now + later)
        high.level_descend()
        assert crazyflie.fake.command[3] == pytest.approx(wanted, abs=4e-6)
    crazyflie.extpos = SimpleNamespace(send_extpos=lambda *place: None)
    link.locate((0.0, 0.0, 0.5))
    for later, fails in ((12.9, False), (13.2, True)):
        monkeypatch.setattr(time, "monotonic", lambda later=later: now + later)
        if fails:
            with pytest.raises(FlightError, match="no position came from outside for 1 s"):
                link.read(0.0)
        else:
            link.read(0.0)


REFUSED = {
    ("cflib", "thrust", "torque_x", "torque_y", "torque_z"): "the law commands torques, which a "
    "Crazyflie would keep when the law stops; use the model `crazyflie-attitude`",
    (
        "cflib",
        "vx",
        "vy",
    ): "the law has the inputs `vx`, `vy`, and a Crazyflie takes ",
    ("px4", "thrust", "torque_x"): "the link `px4` sends `roll_command`, ",
}


def test_links_refuse_torques_and_unknown_inputs_before_they_connect():
    for (link, *inputs), sentence in REFUSED.items():
        with pytest.raises(FlightError, match=sentence):
            open_link(f"{link}://udp://127.0.0.1:19850", facts(*inputs))


def test_a_full_thrust_is_a_number():
    for text in ("much", "-1", "nan", "inf"):
        with pytest.raises(FlightError, match="must be the thrust of all motors, in N"):
            CflibLink(f"radio://0/80/2M#{text}", facts(), Stub())


def test_a_missing_library_is_named(monkeypatch):
    for name in ("cflib", "cflib.crtp", "pymavlink"):
        monkeypatch.setitem(sys.modules, name, None)
    for link, library in ((CflibLink, "cflib"), (Px4Link, "pymavlink")):
        with pytest.raises(MissingLibraryError, match=rf"pip install '{library}>="):
            link("udp://127.0.0.1:19850", facts())


class Mav:
    def __init__(self):
        self.sent = []

    def __getattr__(self, name):
        return lambda *numbers: self.sent.append((name.removesuffix("_send"), numbers))


class Wire:
    """What the link uses of pymavlink's connection."""

    target_system, target_component = 1, 1

    def __init__(self, *messages):
        self.queue, self.mav, self.closed = [*messages], Mav(), False

    def recv_msg(self):
        return self.queue.pop(0) if self.queue else None

    def select(self, _):
        pass

    def wait_heartbeat(self, timeout):
        return self.queue[0] if self.queue else None

    def close(self):
        self.closed = True


def message(kind, **fields):
    return SimpleNamespace(get_type=lambda: kind, **fields)


def odometry(z):
    half = math.sqrt(0.5)
    return message(
        "ODOMETRY", x=2.0, y=1.0, z=-z, q=(half, 0.0, 0.0, half), child_frame_id=1, vx=0.0, vy=0.0,
        vz=-0.5, rollspeed=0.0, pitchspeed=0.0, yawspeed=0.0,
    )  # fmt: skip


HOVER = message("PARAM_VALUE", param_id="MPC_THR_HOVER", param_value=0.4)


def beat(main, sub=0):
    return message("HEARTBEAT", autopilot=12, custom_mode=main << 16 | sub << 24)


@pytest.fixture
def px4(monkeypatch):
    """A link to a wire with messages, and the wire; time stands still until it is set."""

    def connect(*messages):
        wire = Wire(beat(4, 3), *messages)
        for name in ("pymavlink", "pymavlink.mavutil"):
            monkeypatch.setitem(sys.modules, name, ModuleType(name))
        sys.modules["pymavlink"].mavutil = sys.modules["pymavlink.mavutil"]
        sys.modules["pymavlink"].mavutil.mavlink_connection = lambda _, dialect: wire
        return Px4Link("udpin:127.0.0.1:14540", facts()), wire

    return connect


def test_px4_is_read_and_commanded_in_its_own_frames(px4):
    link, wire = px4(HOVER, odometry(0.9), odometry(1.1))
    assert link.read(0.0).x == pytest.approx([1.0, 2.0, 1.1, 0.0, 0.0, 0.5, 0.0, 0.0, 0.0])
    assert link.read(0.0) is None and link.watchdog
    link.send([0.0, 0.0, 0.2, 0.3])
    _, numbers = next(each for each in wire.mav.sent if each[0] == "set_attitude_target")
    assert numbers[1:4] == (1, 1, 3) and numbers[5:] == pytest.approx((0.0, 0.0, -0.2, 0.4))
    assert numbers[4] == pytest.approx([math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5)])
    assert ("heartbeat", (18, 8, 0, 0, 0)) in wire.mav.sent
    link.close()
    assert wire.closed


def test_an_address_that_cannot_be_opened_is_one_sentence(px4, monkeypatch):
    px4(HOVER)
    for error in (ImportError("No module named 'serial'"), OSError("no port")):

        def refuse(_, dialect, error=error):
            raise error

        monkeypatch.setattr(sys.modules["pymavlink"].mavutil, "mavlink_connection", refuse)
        with pytest.raises(FlightError, match=f"`px4://rubbish` cannot be opened: {error}"):
            Px4Link("rubbish", facts())


def test_a_missing_library_ends_a_process_with_a_sentence_and_its_code(monkeypatch, capsys):
    def missing(*_):
        raise MissingLibraryError("a Crazyflie needs cflib.")

    monkeypatch.setattr(process, "_options", lambda: SimpleNamespace(folder=None))
    monkeypatch.setattr(process, "Mission", missing)
    with pytest.raises(SystemExit) as left:
        process.main()
    assert left.value.code == 4
    assert capsys.readouterr().err == "echelon-flight: a Crazyflie needs cflib.\n"


def modes(wire):
    return [n[4:7] for name, n in wire.mav.sent if name == "command_long" and n[2] == 176]


def test_offboard_is_asked_for_after_a_second_of_setpoints_until_it_is_there(px4, monkeypatch):
    link, wire = px4(HOVER)
    now = 100.0
    monkeypatch.setattr("time.monotonic", lambda: now)
    for _ in range(200):
        link.send([0.0, 0.0, 0.0, 0.3])
        assert bool(modes(wire)) == (now > 101.0)
        now += 0.01
    assert modes(wire) == [(1, 6, 0)] * 2
    wire.queue += [beat(6), odometry(1.0)]
    link.read(0.0)
    for _ in range(200):
        link.send([0.0, 0.0, 0.0, 0.3])
        now += 0.01
    assert len(modes(wire)) == 2
    link.level_descend()
    assert modes(wire)[-1] == (1, 4, 6)


def test_px4_that_does_not_tell_its_hover_thrust_is_refused(px4, monkeypatch):
    clock = iter(range(100))
    monkeypatch.setattr("time.monotonic", lambda: float(next(clock)))
    with pytest.raises(FlightError, match="PX4 does not send its parameter `MPC_THR_HOVER`"):
        px4()
