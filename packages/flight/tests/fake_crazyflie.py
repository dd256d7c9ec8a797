"""Crazyflies that are none, at the other end of cflib's UDP: CRTP packets, and vehicles behind.

    python fake_crazyflie.py '{"port": 19850, "starts": [[0, 0, 1]], "file": "flown.npz"}'

serves one port for each vehicle in real time until its standard input ends, and then writes what
was flown; a line `cut 0 1.5` there silences the first vehicle for 1.5 s. `Crazyflie` holds the
packets alone, without sockets, clocks and vehicles.
"""

import json
import math
import select
import socket
import struct
import sys
import time

import numpy as np
from fake_vehicles import IDENTIFIED, Radio, Recorder, Vehicles

PROTOCOL = 12
LOGS = [*((f"stateEstimateZ.{k}", 5, "h") for k in ("x", "y", "z", "vx", "vy", "vz")),
        ("stateEstimateZ.quat", 3, "I"),
        *((f"stateEstimateZ.{k}", 5, "h") for k in ("rateRoll", "ratePitch", "rateYaw")),
        ("pm.vbat", 7, "f")]  # fmt: skip
PARAMETERS = {"stabilizer.controller": 1, "commander.enHighLevel": 1}
FORMATS = {1: "B", 2: "H", 3: "I", 4: "b", 5: "h", 6: "i", 7: "f", 8: "e"}
LEVEL, OFF = 0.5, 2.0
FULL = 0.48


def packed(q):
    """A quaternion (x, y, z, w) in 32 bits, as the firmware does it."""
    largest = max(range(4), key=lambda k: abs(q[k]))
    sign, bits = math.copysign(1.0, q[largest]), largest
    for k in range(4):
        if k != largest:
            size = int(511 * abs(q[k]) * math.sqrt(2.0) + 0.5)
            bits = bits << 10 | (q[k] * sign < 0.0) << 9 | size
    return bits


class Dongle:
    """A radio of several vehicles, which drops setpoints beyond so many a second in all.

    Attributes:
        carried, dropped: how many.
    """

    def __init__(self, most=300.0, burst=16.0):
        self.most, self.burst, self.credit, self.at = most, burst, burst, None
        self.carried = self.dropped = 0

    def carries(self, packet, now):
        if packet[0] >> 4 not in (3, 7):
            return True
        gone = 0.0 if self.at is None else now - self.at
        self.credit, self.at = min(self.burst, self.credit + self.most * gone), now
        passes = self.credit >= 1.0
        self.credit -= passes
        self.carried, self.dropped = self.carried + passes, self.dropped + (not passes)
        return passes


class Crazyflie:
    """Answers packets: a header byte, then at most 30 bytes.

    Attributes:
        command: roll, pitch (rad), yaw rate (rad/s), thrust (N); the last that was received.
        heard: when, s.
    """

    def __init__(self, full=FULL):
        self.full, self.command, self.heard = full, [0.0] * 4, -math.inf
        self.parameters, self.blocks, self.locked = dict(PARAMETERS), {}, True
        self.acceleration = self.place = None

    def answer(self, packet, now):
        port, channel, data = packet[0] >> 4, packet[0] & 3, packet[1:]
        if packet[0] == 0xFF:
            return [packet]
        handler = {2: self.parameter, 3: self.legacy, 4: self.memory, 5: self.log, 7: self.generic,
                   9: self.supervisor, 13: self.platform, 15: self.link}.get(port)  # fmt: skip
        answers = handler(channel, data, now) if handler else []
        return [bytes([packet[0] | 0x0C]) + answer for answer in answers]

    def link(self, channel, data, _):
        if channel == 0:
            return [data]
        return [b"Bitcraze Crazyflie\0" + bytes(11)] if channel == 1 else []

    def platform(self, channel, data, _):
        return [bytes([0, PROTOCOL])] if channel == 1 and data[0] == 0 else []

    def memory(self, channel, data, _):
        return [bytes([1, 0])] if channel == 0 and data[0] == 1 else []

    def supervisor(self, channel, data, _):
        return [bytes([0x81, 1, 1])] if data[0] == 1 else []

    def contents(self, data, names):
        if data[0] == 3:
            return [struct.pack("<BHI", 3, len(names), 0x1234)]
        number = struct.unpack_from("<H", data, 1)[0]
        name, kind = names[number]
        text = name.replace(".", "\0").encode() + b"\0"
        return [struct.pack("<BHB", 2, number, kind) + text]

    def parameter(self, channel, data, _):
        names = list(self.parameters)
        if channel == 0:
            return self.contents(data, [(name, 0x08) for name in names])
        number = struct.unpack_from("<H", data)[0]
        if channel == 1:
            return [struct.pack("<HBB", number, 0, self.parameters[names[number]])]
        if channel == 2:
            self.parameters[names[number]] = data[2]
            return [bytes(data)]
        return []

    def log(self, channel, data, now):
        if channel == 0:
            return self.contents(data, [entry[:2] for entry in LOGS])
        if channel != 1:
            return []
        command, block = data[0], data[1] if len(data) > 1 else 0
        if command in (6, 7):
            entries = [struct.unpack_from("<BH", data, k) for k in range(2, len(data) - 2, 3)]
            self.blocks.setdefault(block, [0.0, now, []])[2].extend(entries)
        elif command == 3:
            self.blocks[block][:2] = data[2] / 100.0, now
        elif command in (2, 4):
            self.blocks.pop(block, None)
        elif command == 5:
            self.blocks.clear()
        return [bytes([command, block, 0])]

    def legacy(self, _, data, now):
        roll, pitch, rate, thrust = struct.unpack("<fffH", data)
        self.locked &= thrust != 0
        # The firmware's pitch is the other way round, and here the yaw rate too.
        self.take(roll, -pitch, -rate, 0 if self.locked else thrust, now)
        return []

    def generic(self, channel, data, now):
        if channel == 0 and data[0] == 11:
            roll, pitch, rate, thrust, rates = struct.unpack("<fffHB", data[1:])
            assert not rates and self.parameters["stabilizer.controller"] == 2
            self.take(roll, -pitch, rate, thrust, now)
        if channel == 0 and data[0] == 6:
            numbers = struct.unpack("<hhhhhhhhhIhhh", data[1:])
            self.acceleration, self.heard = [1e-3 * a for a in numbers[6:9]], now
        if channel == 0 and data[0] == 7:
            *self.place, yaw = struct.unpack("<ffff", data[1:])
            self.heard = now
        if channel == 0 and data[0] == 0:
            self.command, self.heard = [0.0] * 4, now
        return []

    def take(self, roll, pitch, rate, thrust, now):
        tilt = [math.radians(angle) for angle in (roll, pitch, rate)]
        self.command, self.heard = [*tilt, thrust / 65535.0 * self.full], now
        self.place = None

    def hold(self, p, v, mass):
        """Command what moves it to the place of its last setpoint, heading east."""
        if self.place is None:
            return
        ax, ay, az = (
            max(-3.0, min(3.0, 4.0 * (goal - x) - 3.0 * s))
            for goal, x, s in zip(self.place, p, v, strict=True)
        )
        self.command = [-ay / 9.81, ax / 9.81, 0.0, mass * (9.81 + az)]

    def acting(self, now):
        """The command that acts: level 0.5 s after the last, and none 2 s after it."""
        if now - self.heard > OFF:
            return [0.0] * 4
        return [0.0, 0.0, 0.0, self.command[3]] if now - self.heard > LEVEL else self.command

    def logged(self, p, v, q, w, now):
        millis = [int(1e3 * number) for number in (*p, *v)]
        rates = [int(1e3 * number) for number in (w[0], -w[1], w[2])]
        values = [*millis, packed((*q[1:], q[0])), *rates, 3.9]
        due = []
        for block, (period, last, entries) in self.blocks.items():
            if period and now >= last + period:
                self.blocks[block][1] = max(last + period, now - period)
                body = b"".join(
                    struct.pack("<" + FORMATS[kind & 15], values[k]) for kind, k in entries
                )
                stamp = int(1e3 * now) & 0xFFFFFF
                due.append(bytes([0x5E, block]) + struct.pack("<I", stamp)[:3] + body)
        return due


def serve(
    port, starts, file, mass=0.0319, gain=0.97605781, lag=0.0, response=None, speed=1.0,
    controller=None, carried=None,
):  # fmt: skip
    """Serve vehicles until the standard input ends; in slow motion with a speed below 1."""
    vehicles = Vehicles(starts, mass, gain, lag, controller=controller, **(response or IDENTIFIED))
    sockets = [socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in starts]
    for k, end in enumerate(sockets):
        end.bind(("127.0.0.1", port + k))
        end.setblocking(False)
    crazyflies, peers = [Crazyflie() for _ in starts], [None] * len(starts)
    radio, dongle = Radio(len(starts)), Dongle(speed * carried) if carried else None
    flown, dt, real, begun, steps = Recorder(), 0.002, 0.002 / speed, time.monotonic(), 0
    print("ready", flush=True)
    while True:
        now = time.monotonic()
        ends, _, _ = select.select(
            [*sockets, sys.stdin], [], [], max(0.0, begun + steps * real - now)
        )
        now = time.monotonic()
        if sys.stdin in ends:
            if radio.ends(now):
                break
            ends.remove(sys.stdin)
        for end in ends:
            k = sockets.index(end)
            packet, peer = end.recvfrom(64)
            if not radio.open(k, now):
                continue
            peers[k] = peer
            if dongle is not None and not dongle.carries(packet, now):
                continue
            for answer in crazyflies[k].answer(packet, speed * now):
                end.sendto(answer, peers[k])
        while begun + steps * real <= now:
            for each, p, v in zip(crazyflies, vehicles.p, vehicles.v, strict=True):
                each.hold(p, v, mass)
            vehicles.command = np.array([each.acting(speed * now) for each in crazyflies])
            vehicles.step(dt)
            steps += 1
        state = vehicles.p, vehicles.v, vehicles.q, vehicles.w
        flown.add(begun + steps * real, vehicles)
        for k, each in enumerate(crazyflies):
            for packet in each.logged(*(part[k] for part in state), speed * now):
                if peers[k] and radio.open(k, now):
                    sockets[k].sendto(packet, peers[k])
    flown.save(file)
    if dongle is not None:
        print(dongle.carried, dongle.dropped, flush=True)


if __name__ == "__main__":
    serve(**json.loads(sys.argv[1]))
