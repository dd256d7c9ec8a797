"""Rigid bodies with four motors under an attitude controller, which stand in for real vehicles."""

import sys

import numpy as np

ARM, INERTIA = 0.0325, np.array([16.571710e-6, 16.655602e-6, 29.261652e-6])
LEVER, GRAVITY = 0.006993, 9.81
# Thrust, roll, pitch and yaw of four motors: front-left, rear-left, rear-right, front-right.
MIX = np.array([[1, 1, 1, 1], [1, 1, -1, -1], [-1, 1, 1, -1], [1, -1, 1, -1]]) * np.array(
    [[1.0], [ARM], [ARM], [LEVER]]
)
PULL = np.linalg.inv(MIX).T

# The answer of `crazyflie-attitude` by default, written again.
IDENTIFIED = {"stiff": 245.67, "damp": 17.32, "command": 196.18, "turn": 25.63}
MELLINGER = {"stiff": 412.3, "damp": 58.9, "command": 412.3, "turn": 21.0}


def cross(a, b):
    """Of rows; NumPy's takes ten times as long."""
    i, j = [1, 2, 0], [2, 0, 1]
    return a[:, i] * b[:, j] - a[:, j] * b[:, i]


def turned(q, v):
    """Vectors (N, 3) of bodies with quaternions (N, 4), w first, in the world."""
    t = 2.0 * cross(q[:, 1:], v)
    return v + q[:, :1] * t + cross(q[:, 1:], t)


def angles(q):
    w, x, y, z = q.T
    roll = np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    pitch = np.arcsin(np.clip(2 * (w * y - z * x), -1, 1))
    return np.stack([roll, pitch, np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))], 1)


class Recorder:
    def __init__(self):
        self.times, self.places, self.tilts = [], [], []

    def add(self, now, vehicles):
        self.times.append(now)
        self.places.append(vehicles.p.copy())
        upright = 1.0 - 2.0 * np.sum(vehicles.q[:, 1:3] ** 2, axis=1)
        self.tilts.append(np.degrees(np.arccos(np.clip(upright, -1.0, 1.0))))

    def save(self, file):
        np.savez(file, times=self.times, places=self.places, tilts=self.tilts)


class Radio:
    """What reaches vehicles: a line `cut K SECONDS` on the standard input silences one."""

    def __init__(self, count):
        self.until = [-np.inf] * count

    def open(self, k, now):
        return now >= self.until[k]

    def ends(self, now):
        """Whether the standard input, which has something to say, ended; a cut begins now (s)."""
        words = sys.stdin.readline().split()
        if words:
            self.until[int(words[1])] = now + float(words[2])
        return not words


class Vehicles:
    """N of them. They are held at their starts until a first thrust is commanded.

    `command` (N, 4) is roll, pitch (rad), yaw rate (rad/s), thrust (N); it may be changed any time.
    `controller` takes the vehicles and returns the forces (N, 4) that it asks of their motors, N;
    without one an attitude controller of `response` does.
    """

    def __init__(self, starts, mass, gain=1.0, lag=0.0, motor=0.12, controller=None, **response):
        count = len(starts)
        self.mass, self.gain, self.lag, self.motor, self.response = mass, gain, lag, motor, response
        self.controller = controller or Vehicles.responding
        self.p, self.v, self.w = np.array(starts, float), np.zeros((count, 3)), np.zeros((count, 3))
        self.q = np.tile([1.0, 0.0, 0.0, 0.0], (count, 1))
        self.command = np.zeros((count, 4))
        self.force = np.full((count, 4), mass * GRAVITY / 4)
        self.held = np.ones(count, bool)

    def responding(self):
        zeta, at = angles(self.q), self.response
        turn = -at["damp"] * self.w
        turn[:, :2] += at["command"] * self.command[:, :2] - at["stiff"] * zeta[:, :2]
        turn[:, 2] = at["turn"] * (self.command[:, 2] - self.w[:, 2])
        torque = INERTIA * turn + cross(self.w, INERTIA * self.w)
        return np.concatenate([self.gain * self.command[:, 3:], torque], 1) @ PULL

    def step(self, dt):
        on = self.command[:, 3:] > 0.0
        asked = np.where(on, np.clip(self.controller(self), 0.0, self.motor), 0.0)
        share = 1.0 if self.lag == 0.0 else 1.0 - np.exp(-dt / self.lag)
        self.force += share * (asked - self.force)
        wrench = self.force @ MIX.T
        lift = np.zeros_like(self.p)
        lift[:, 2] = wrench[:, 0] / self.mass
        push = turned(self.q, lift)
        push[:, 2] -= GRAVITY
        self.held &= ~on[:, 0]
        free = ~self.held[:, None]
        spin = (wrench[:, 1:] - cross(self.w, INERTIA * self.w)) / INERTIA
        middle = self.v + 0.5 * dt * push * free
        self.v, self.p = self.v + dt * push * free, self.p + dt * middle * free
        rate = self.w + 0.5 * dt * spin * free
        self.w = self.w + dt * spin * free
        half = 0.5 * dt * rate * free
        change = np.concatenate([-np.sum(half * self.q[:, 1:], 1, keepdims=True),
                                 self.q[:, :1] * half - cross(half, self.q[:, 1:])], 1)  # fmt: skip
        self.q = self.q + change
        self.q /= np.linalg.norm(self.q, axis=1, keepdims=True)
        ground = self.p[:, 2] < 0.0
        self.p[ground, 2] = 0.0
        self.v[ground] = 0.0
