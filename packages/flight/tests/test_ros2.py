"""The link to nodes of ROS 2, as far as it needs no DDS: its addresses, and its velocities."""

import math
import sys

import pytest

from echelon_flight import FlightError, MissingLibraryError
from echelon_flight.links import open_link
from echelon_flight.links.attitude import product, quaternion_of
from echelon_flight.links.ros2 import Differences, Ros2Address, read_ros2_address
from echelon_flight.parameters import DEFAULTS

DOUBLE = dict.fromkeys(["x", "y", "z", "vx", "vy", "vz"], ""), ["ax", "ay", "az"]
UNICYCLE = dict.fromkeys(["x", "y", "heading"], ""), ["speed", "turn_rate"]


def facts(states, inputs, **parameters):
    """Return the content of law.json, with parameters of the flight."""
    own = {"agent": 0, "dt": 0.01, "states": states, "inputs": dict.fromkeys(inputs, "")}
    return own | {"parameters": DEFAULTS | parameters}


def test_addresses():
    usual = Ros2Address("pose", "full_state", "/cf1/pose", "/cf1/cmd_full_state")
    assert read_ros2_address("cf1") == usual
    robot = read_ros2_address("lab/r2?state=odom&output=cmd_vel&from=/mocap/r2&ahead=0.1")
    assert robot == Ros2Address("odom", "cmd_vel", "/mocap/r2", "/lab/r2/cmd_vel", 0.1)


WRONG = {
    "": "must be as `ros2://cf1`",
    "1cf": "must be as `ros2://cf1`",
    "cf1?input=x": "`input` in `ros2://cf1?input=x` must be one of `state`, `output`",
    "cf1?state=imu": "`state=imu` in `ros2://cf1?state=imu` must be one of `pose`, `odom`",
    "cf1?ahead=far": "`ahead=far` in `ros2://cf1?ahead=far` must be a number, in m",
}


@pytest.mark.parametrize("text", WRONG)
def test_a_wrong_address_is_one_sentence(text):
    with pytest.raises(FlightError, match=WRONG[text].replace("?", r"\?")):
        read_ros2_address(text)


def test_a_law_that_the_output_cannot_carry_is_refused_with_the_output_that_can():
    with pytest.raises(FlightError, match="`speed`, `turn_rate`, and `output=full_state` carries"):
        open_link("ros2://cf1", facts(*UNICYCLE))
    with pytest.raises(FlightError, match="; use `output=full_state`"):
        open_link("ros2://cf1?output=cmd_vel", facts(*DOUBLE))


def test_without_the_library_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "cyclonedds.builtin", None)
    with pytest.raises(MissingLibraryError, match="ROS 2 needs cyclonedds"):
        open_link("ros2://cf1", facts(*DOUBLE))


@pytest.mark.parametrize("yaw", [0.4, 3.13])
def test_differences_are_the_velocities_of_a_body_that_turns_steadily(yaw):
    body, speed, dt = (0.3, -0.2, 1.1), (0.5, -1.0, 0.25), 0.01
    size, q, poses = math.hypot(*body), quaternion_of(0.2, -0.1, yaw), Differences()
    for k in range(8):
        half = 0.5 * size * k * dt
        turn = (math.cos(half), *(math.sin(half) * part / size for part in body))
        sign = -1.0 if k % 2 else 1.0  # both quaternions of an attitude are right
        at = tuple(sign * part for part in product(q, turn))
        found = poses.add(k * dt, tuple(k * dt * v for v in speed), at)
        assert (found is None) == (k < 4)
    assert found[0] == pytest.approx(speed) and found[1] == pytest.approx(body)
    assert poses.add(7 * dt, (9.0, 9.0, 9.0), q) is None
