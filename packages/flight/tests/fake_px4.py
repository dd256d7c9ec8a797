"""Vehicles with PX4 that are none: MAVLink by pymavlink, and `fake_vehicles` behind it.

    python fake_px4.py '{"port": 14540, "starts": [[0, 0, 1]], "file": "flown.npz"}'

sends to one port for each vehicle in real time until its standard input ends, and then writes what
was flown; a line `cut 0 1.5` there silences the first vehicle for 1.5 s. As PX4, it enters OFFBOARD
only after setpoints at 2 Hz, obeys them there alone, and leaves it 1 s after the last one, when it
levels.
"""

import json
import math
import os
import select
import sys
import time

import numpy as np
from fake_vehicles import GRAVITY, IDENTIFIED, Radio, Recorder, Vehicles

os.environ["MAVLINK20"] = "1"
from pymavlink import mavutil  # noqa: E402

HOVER, OFFBOARD, LAND, LOST = 0.42, (6, 0), (4, 6), 1.0
# From east, north, up to north, east, down; and from forward, left, up to forward, right, down.
WORLD = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
BODY = np.diag([1.0, -1.0, -1.0])


def matrix(q):
    """Of a quaternion, w first; SciPy's takes ten times as long."""
    a, b, c, d = q
    return np.array([
        [1 - 2 * (c * c + d * d), 2 * (b * c - a * d), 2 * (b * d + a * c)],
        [2 * (b * c + a * d), 1 - 2 * (b * b + d * d), 2 * (c * d - a * b)],
        [2 * (b * d - a * c), 2 * (c * d + a * b), 1 - 2 * (b * b + c * c)],
    ])  # fmt: skip


class Px4:
    def __init__(self, port, weight):
        where = f"udpout:127.0.0.1:{port}"
        self.wire = mavutil.mavlink_connection(where, dialect="common", source_system=1)
        self.weight, self.mode, self.command = weight, (4, 3), np.zeros(4)
        self.came = [-np.inf] * 3
        self.period, self.logged, self.beat = 0.02, -np.inf, -np.inf

    def receive(self, now, heard):
        while (message := self.wire.recv_msg()) is not None:
            kind = message.get_type() if heard else ""
            if kind == "SET_ATTITUDE_TARGET":
                self.target(message, now)
            elif kind == "PARAM_REQUEST_READ" and message.param_id == "MPC_THR_HOVER":
                self.wire.mav.param_value_send(b"MPC_THR_HOVER", HOVER, 9, 1, 0)
            elif kind == "COMMAND_LONG" and message.command == 511 and message.param1 == 331:
                self.period = 1e-6 * message.param2
            elif kind == "COMMAND_LONG" and message.command == 176 and message.param1 == 1:
                wanted = int(message.param2), int(message.param3)
                steady = now - self.came[0] < 1.5
                if wanted != OFFBOARD or steady:
                    self.mode, self.beat = wanted, -np.inf

    def target(self, message, now):
        self.came = [*self.came[1:], now]
        if self.mode != OFFBOARD:
            return
        assert message.type_mask == 3
        turn = WORLD.T @ matrix(message.q) @ BODY
        roll, pitch = math.atan2(turn[2, 1], turn[2, 2]), -math.asin(turn[2, 0])
        self.command = np.array(
            [roll, pitch, -message.body_yaw_rate, message.thrust / HOVER * self.weight]
        )

    def acting(self, now, height):
        if self.mode == OFFBOARD and now - self.came[-1] > LOST:
            self.mode, self.beat = (4, 3), -np.inf
            self.command = np.array([0.0, 0.0, 0.0, self.weight])
        if self.mode == LAND:
            self.command = np.array([0.0, 0.0, 0.0, 0.95 * self.weight * (height > 0.05)])
        return self.command

    def send(self, now, p, v, q, w):
        if now > self.beat + 1.0:
            self.beat = now
            mode = self.mode[0] << 16 | self.mode[1] << 24
            self.wire.mav.heartbeat_send(2, 12, 1 | 128, mode, 4)
        if now < self.logged + self.period:
            return
        self.logged = max(self.logged + self.period, now - self.period)
        turn = WORLD @ matrix(q) @ BODY
        # Of half a turn about (1, 1, 0), then the vehicle's, then half a turn about (1, 0, 0).
        half, (a, b, c, d) = math.sqrt(0.5), q
        attitude = half * np.array([a + d, b + c, b - c, a - d])
        # As PX4 has it: the velocity in the body's frame.
        numbers = *(WORLD @ p), attitude, *(turn.T @ WORLD @ v), *(BODY @ w)
        self.wire.mav.odometry_send(int(1e6 * now), 1, 12, *numbers, [0.0] * 21, [0.0] * 21)


def serve(port, starts, file, mass=0.0319, gain=0.97605781, lag=0.0, response=None, speed=1.0):
    """Serve vehicles until the standard input ends; in slow motion with a speed below 1."""
    vehicles = Vehicles(starts, mass, gain, lag, **(response or IDENTIFIED))
    each = [Px4(port + k, mass * GRAVITY / gain) for k in range(len(starts))]
    radio = Radio(len(starts))
    flown, dt, real, begun, steps = Recorder(), 0.002, 0.002 / speed, time.monotonic(), 0
    print("ready", flush=True)
    while True:
        wait = max(0.0, begun + steps * real - time.monotonic())
        ends, _, _ = select.select([*(px4.wire.fd for px4 in each), sys.stdin], [], [], wait)
        now = time.monotonic()
        if sys.stdin in ends and radio.ends(now):
            break
        for k, px4 in enumerate(each):
            px4.receive(now, radio.open(k, now))
        while begun + steps * real <= now:
            vehicles.command = np.array(
                [px4.acting(now, z) for px4, z in zip(each, vehicles.p[:, 2], strict=True)]
            )
            vehicles.step(dt)
            steps += 1
        flown.add(begun + steps * real, vehicles)
        for k, px4 in enumerate(each):
            if not radio.open(k, now):
                continue
            px4.send(speed * now, vehicles.p[k], vehicles.v[k], vehicles.q[k], vehicles.w[k])
    flown.save(file)


if __name__ == "__main__":
    serve(**json.loads(sys.argv[1]))
