"""One agent's process, with a vehicle and others that a test plays, under a clock that it moves."""

import math

from virtual_flight import Network, VirtualClock

from echelon_flight import FlightError
from echelon_flight.agent_process import AgentContext, AgentProcess, PlanClock
from echelon_flight.links import Link, Reading
from echelon_flight.wire import GROUND, Message, Wire

DT, KEY = 0.01, b"k" * 32
FLIGHT = {
    **{"dt": DT, "leadership": None, "weather": {"delay": 0.02, "jitter": 0.03, "loss": 0.0}},
    "position": [0],
    "velocity": [1],
    "tilt": [],
    "fence": {"low": [-5.0], "high": [5.0], "speed": 10.0},
}
PARTS = {"time": 1, "hops": 1, "signal": 1, "leader": 1, "said": 1, "content": 1, "term": 1}
FACTS = {
    **{"agent": 1, "dt": DT, "leads": False, "hears": [0]},
    **{"message": PARTS, "network": {"period": 0.02, "leaders": [0]}},
}


def letter(sender, time, said=None, leader=0, hops=0.0, term=0.0):
    """A letter whose packet is of the same time, unless one is given."""
    said = time if said is None else said
    return Message(sender, (time, float(hops), 0.0, float(leader), said, 0.0, float(term)))


class Law:
    """A law that returns where the leader is expected, at t, less its place, or what a test wants.

    It passes on the packet that it received.
    """

    u, ticks = 0.0, 0

    def begin(self, x):
        return []

    def step(self, t, x, received, memory):
        self.ticks += 1
        heard = not math.isnan(received[0])
        off = t - x[0] if heard else 0.0
        row = [t if heard else math.nan, received[1] + 1.0, off, *received[3:]]
        return [self.u + off], [], row, math.isfinite(self.u)


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
        return Wire(key, formation, number, 3, len(PARTS), boot, **numbers)

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
