"""Units, signs and frames of autopilots, by values written by hand and by SciPy."""

import math
import struct

import numpy as np
import pytest
from fake_crazyflie import packed
from oracles import angle_rates as rates_by_axes
from scipy.spatial.transform import Rotation

from echelon_flight import FlightError
from echelon_flight.links import attitude, px4
from echelon_flight.links.crazyflie import (
    LOG,
    full_state_setpoint,
    manual_setpoint,
    state_of_log,
    unpack_quaternion,
)

rng = np.random.default_rng(5)
ANGLES = rng.uniform([-1.2, -1.2, -3.0], [1.2, 1.2, 3.0], (20, 3))


def first(quaternion):
    w_first = np.roll(np.asarray(quaternion), 1)
    return w_first * np.sign(w_first[0])


def scipy_of(zeta):
    return Rotation.from_euler("ZYX", zeta[::-1])


@pytest.mark.parametrize("zeta", ANGLES)
def test_quaternions_angles_and_rates_are_scipy_s(zeta):
    q = attitude.quaternion_of(*zeta)
    turn, vector, body = scipy_of(zeta), rng.normal(size=3), rng.normal(size=3)
    assert np.array(q) * np.sign(q[0]) == pytest.approx(first(turn.as_quat()), abs=1e-15)
    assert attitude.angles_of(q) == pytest.approx(zeta, abs=1e-14)
    assert attitude.rotate(q, vector) == pytest.approx(turn.apply(vector), abs=1e-14)
    assert attitude.angle_rates(zeta, body) == pytest.approx(rates_by_axes(zeta, body), abs=1e-13)


def test_a_quarter_turn_straight_up_has_a_pitch_and_no_domain_error():
    q = np.array(attitude.quaternion_of(0.0, math.pi / 2, 0.0)) * (1.0 + 1e-15)
    assert attitude.angles_of(q)[1] == pytest.approx(math.pi / 2)


def test_states_have_the_names_of_models_and_others_are_refused():
    known = attitude.named_state((1, 2, 3), (4, 5, 6), (1, 0, 0, 0), (0.7, 0.8, 0.9))
    assert [known[name] for name in ("x", "y", "z", "vx", "vy", "vz", "p", "q", "r")] == [
        1, 2, 3, 4, 5, 6, 0.7, 0.8, 0.9
    ]  # fmt: skip
    assert known["yaw_rate"] == 0.9 and known["roll"] == 0.0
    assert attitude.check_states({"x": "m", "yaw": "rad"}) == ("x", "yaw")
    with pytest.raises(FlightError, match="the law has the state `charge`, which no autopilot"):
        attitude.check_states({"x": "m", "charge": "C"})


def test_quaternions_of_32_bits_by_hand():
    half = math.sqrt(0.5)
    # Two bits for the largest of x, y, z, w, then a sign and 511 parts of 1/sqrt 2 for each other.
    assert unpack_quaternion(3 << 30) == (1.0, 0.0, 0.0, 0.0)
    assert unpack_quaternion(2 << 30 | 511) == pytest.approx((half, 0.0, 0.0, half))
    assert unpack_quaternion(3 << 30 | (512 + 511) << 10) == pytest.approx((half, 0.0, -half, 0.0))


@pytest.mark.parametrize("zeta", ANGLES)
def test_quaternions_of_32_bits_come_back(zeta):
    turn = scipy_of(zeta)
    w, *vector = unpack_quaternion(packed(turn.as_quat()))
    apart = Rotation.from_quat([*vector, w]) * turn.inv()
    # 9 bits of sqrt 1/2 for each of three numbers, of which an angle is twice the arc.
    assert apart.magnitude() <= 2.0 * math.sqrt(3.0) * 0.5 * math.sqrt(0.5) / 511 * 1.5


def test_a_packet_of_the_log_is_in_metres_and_its_pitch_rate_is_turned_back():
    numbers = (1500, -250, 1000, 100, -200, 300, 3 << 30, 400, -500, 600)
    known = state_of_log({f"stateEstimateZ.{n}": v for n, v in zip(LOG, numbers, strict=True)})
    assert [known[k] for k in ("x", "y", "z")] == pytest.approx([1.5, -0.25, 1.0])
    assert [known[k] for k in ("vx", "vy", "vz")] == pytest.approx([0.1, -0.2, 0.3])
    assert [known[k] for k in ("p", "q", "r")] == pytest.approx([0.4, 0.5, 0.6])


def thrust_of(percent):
    """As cflib 0.1.34 writes it."""
    return int(10001 + 0.01 * percent * (60000 - 10001))


@pytest.mark.parametrize(
    ("newtons", "number"),
    [(0.24, 32768), (0.2845, 38843), (0.0, 10001), (-1.0, 10001), (1.0, 60000), (0.4394, 59992)],
)
def test_manual_setpoints_are_degrees_and_the_nearest_thrust(newtons, number):
    roll, pitch, rate, percent = manual_setpoint((0.1, math.pi / 6, -1.0, newtons), 0.48)
    assert (roll, pitch, rate) == pytest.approx((5.729578, 30.0, -57.29578), rel=1e-6)
    assert 0.0 <= percent <= 100.0 and thrust_of(percent) == number


def test_full_states_keep_place_and_speed_and_ask_for_an_acceleration():
    x = attitude.named_state((1, 2, 3), (4, 5, 6), attitude.quaternion_of(0.2, 0.1, 1.0), (0,) * 3)
    place, speed, wanted, q, *rates = full_state_setpoint(x, (0.5, 0.0, -0.5))
    assert (place, speed, wanted) == ([1, 2, 3], [4, 5, 6], [0.5, 0.0, -0.5])
    assert q == pytest.approx([0.0, 0.0, math.sin(0.5), math.cos(0.5)]) and rates == [0.0] * 3
    # Thousandths of what is given, in the two bytes that the firmware reads as mrad/s.
    assert struct.pack("<h", int(1.5 * 1000)) == struct.pack("<h", 1500)


def ned_of(zeta):
    """The attitude in north, east, down by its own angles."""
    roll, pitch, yaw = zeta
    return Rotation.from_euler("ZYX", [math.pi / 2 - yaw, -pitch, roll])


def test_frames_of_px4_by_hand():
    half = math.sqrt(0.5)
    assert px4.swap_world((1.0, 2.0, 3.0)) == (2.0, 1.0, -3.0)
    assert px4.swap_body((1.0, 2.0, 3.0)) == (1.0, -2.0, -3.0)
    # To the east is a heading of a quarter turn; level, with twice the weight, turning left.
    q, rate, thrust = px4.attitude_target((0.0, 0.0, 0.3, 0.6), 0.0, 0.4, 0.3)
    assert np.abs(q) == pytest.approx([half, 0.0, 0.0, half]) and q[0] * q[3] > 0.0
    assert (rate, thrust) == (-0.3, pytest.approx(0.8))
    assert px4.attitude_target((0.0, 0.0, 0.0, 9.0), 0.0, 0.4, 0.3)[2] == 1.0
    assert px4.attitude_target((0.0, 0.0, 0.0, -9.0), 0.0, 0.4, 0.3)[2] == 0.0


@pytest.mark.parametrize("zeta", ANGLES)
def test_attitudes_of_px4_are_those_of_its_own_angles(zeta):
    q, _, _ = px4.attitude_target((*zeta[:2], 0.0, 1.0), zeta[2], 0.5, 1.0)
    assert np.array(q) * np.sign(q[0]) == pytest.approx(first(ned_of(zeta).as_quat()), abs=1e-14)


@pytest.mark.parametrize("of_body", [False, True])
def test_an_odometry_of_px4_is_the_state_in_echelon_s_frames(of_body):
    zeta, body = ANGLES[3], np.array([0.1, 0.2, 0.3])
    turn, velocity = ned_of(zeta), np.array([4.0, 5.0, 6.0])
    ned = np.array([velocity[1], velocity[0], -velocity[2]])
    speed = turn.inv().apply(ned) if of_body else ned
    q, rates = np.roll(turn.as_quat(), 1), body * [1.0, -1.0, -1.0]
    known = px4.state_of_odometry((2.0, 1.0, -3.0), q, speed, rates, of_body)
    assert [known[k] for k in ("x", "y", "z")] == pytest.approx([1.0, 2.0, 3.0])
    assert [known[k] for k in ("vx", "vy", "vz")] == pytest.approx(velocity)
    assert [known[k] for k in ("roll", "pitch", "yaw")] == pytest.approx(zeta)
    assert [known[k] for k in ("p", "q", "r")] == pytest.approx(body)
