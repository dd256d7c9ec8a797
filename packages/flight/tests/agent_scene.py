"""One agent's process, with a vehicle and others that a test plays, under a clock that it moves."""

import math

from virtual_flight import Network, VirtualClock

from echelon_flight import FlightError
from echelon_flight.agent_process import AgentContext, AgentProcess, PlanClock
from echelon_flight.links import Link, Reading
from echelon_flight.wire import GROUND, Wire

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
    """A vehicle that reads as this test says, every half of a period."""

    def __init__(self, clock):
        self.clock, self.x, self.sent, self.sinks, self.fails = clock, [0.0, 1.0], [], 0, False
        self.age, self.battery, self.silent = 0.0, None, False

    def read(self, wait):
        self.clock.now += DT / 2
        if self.fails:
            raise FlightError("the link is gone.")
        return None if self.silent else Reading(self.clock.now - self.age, self.x, self.battery)

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
        self.clock = VirtualClock(monkeypatch)
        network = Network(self.clock)
        self.air, own = network.socket(), network.socket()
        self.law, self.link = Law(), Fake(self.clock)
        flight = FLIGHT | {"leadership": leadership}
        rest = self.link, own, self.wire(1, **numbers), PlanClock()
        self.context = AgentContext(self.law, FACTS, flight, *rest)
        self.process = AgentProcess(self.context)
        self.ground, self.leader = self.wire(GROUND), self.wire(0)

    def wire(self, number, key=KEY, formation="ab" * 32, **numbers):
        boot = self.clock.time_ns() // 1_000_000
        return Wire(key, formation, number, 3, (1, 1), boot, **numbers)

    def start(self):
        self.introduce()
        self.leader.begin(self.ground.flight)
        now = self.clock.time()
        self.air.send(self.ground.start(now, now - 1.0, 1))
        self.rounds(10)

    def introduce(self):
        """Let the ground hear what the process draws, and choose a flight."""
        self.process.report(self.clock.now)
        for datagram in self.air.receive():
            self.ground.open(datagram, None, self.clock.time())
        now = self.clock.time()
        self.ground.begin(self.ground.flight or self.ground.next_flight(now))

    def rounds(self, count):
        for _ in range(count):
            self.process.round()

    @property
    def fault(self):
        return self.process.supervisor.fault
