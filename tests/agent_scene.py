"""One agent's process, with a vehicle and others that a test plays."""

import math
import socket
import time

from echelon.core.errors import FlightError
from echelon.flight.agent_process import AgentProcess, Crew
from echelon.flight.air import LOOPBACK, Air
from echelon.flight.links.link import Link, Reading
from echelon.flight.plan_clock import PlanClock
from echelon.flight.wire import GROUND, Wire

DT, KEY = 0.01, b"k" * 32
FLIGHT = {
    **{"dt": DT, "leadership": None, "weather": {"delay": 0.02, "jitter": 0.03, "loss": 0.0}},
    "position": [0],
    "velocity": [1],
    "tilt": [],
    "fence": {"low": [-5.0], "high": [5.0], "speed": 10.0},
}
NETWORK = {
    "moves": False,
    "period": 0.02,
    "forget": 0.5,
    "forget_hops": 5.0,
    "agents": 2,
    "leaders": [0],
}
FACTS = {
    **{"agent": 1, "dt": DT, "leads": False, "hears": [0], "weights": [1.0]},
    **{"signal": ["x"], "message": ["v"], "network": {**NETWORK, "uses": "all"}},
}


class Law:
    """A law that returns its disagreement, or what a test wants."""

    u, ticks = 0.0, 0

    def begin(self, x):
        return []

    def difference(self, t, x, memory, place):
        return [x[0] - place[0]]

    def expected(self, t, content, age):
        return [t], [1.0], True

    def tick(self, t, x, z, forward, memory):
        self.ticks += 1
        return [self.u - z[0]], [], [x[0]], [0.0], math.isfinite(self.u)


class Fake(Link):
    """A vehicle that reads as this test says."""

    def __init__(self):
        self.x, self.sent, self.sinks, self.fails, self.age = [0.0, 1.0], [], 0, False, 0.0
        self.battery, self.silent = None, False

    def read(self, wait):
        time.sleep(DT / 2)
        if self.fails:
            raise FlightError("the link is gone.")
        return None if self.silent else Reading(time.monotonic() - self.age, self.x, self.battery)

    def send(self, u):
        self.sent.append(u)

    def level_descend(self):
        self.sinks += 1

    def close(self):
        pass


class Scene:
    """An agent's process, its vehicle, and the socket of all others."""

    def __init__(self, monkeypatch, leadership=None, **numbers):
        monkeypatch.setattr("signal.signal", lambda *_: None)
        ways = []
        for _ in range(2):
            with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
                probe.bind((LOOPBACK, 0))
                ways.append(probe.getsockname())
        self.air, self.law, self.link = Air(ways[0], [ways[1]]), Law(), Fake()
        air = Air(ways[1], [ways[0]])
        flight = FLIGHT | {"leadership": leadership}
        own = self.wire(1, **numbers)
        crew = Crew(self.law, FACTS, flight, self.link, air, own, PlanClock())
        self.process = AgentProcess(crew)
        self.crew, self.ground, self.leader = crew, self.wire(GROUND), self.wire(0)

    def wire(self, number, key=KEY, formation="ab" * 32, **numbers):
        boot = time.time_ns() // 1_000_000
        return Wire(key, formation, number, 3, (1, 1), boot, **numbers)

    def start(self):
        self.introduce()
        self.leader.begin(self.ground.flight)
        self.air.send(self.ground.start(time.time(), time.time() - 1.0, 1))
        self.rounds(10)

    def introduce(self):
        """Let the ground hear what the process draws, and choose a flight."""
        self.process._report(time.monotonic())
        for datagram in self.air.receive():
            self.ground.open(datagram, None, time.time())
        self.ground.begin(self.ground.flight or self.ground.next_flight(time.time()))

    def rounds(self, count):
        for _ in range(count):
            self.process._round()

    @property
    def fault(self):
        return self.process._supervisor.fault
