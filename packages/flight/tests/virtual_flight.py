"""A flight in this process alone: its clock stands still until a test moves it.

Agents and the ground station are those that fly; a network in memory and vehicles beside it are the
rest of the world.
"""

import random

from echelon_flight import agent_process, ground, mission
from echelon_flight.agent_process import AgentContext, AgentProcess, PlanClock
from echelon_flight.ground import Ground
from echelon_flight.links import Link, Reading
from echelon_flight.links.udp import DESCEND, INPUT
from echelon_flight.mission import Mission, make_key
from echelon_flight.simulated_vehicles import LinkImpairment, Vehicle, simulated
from echelon_flight.wire import GROUND

IDEAL = LinkImpairment()


class VirtualClock:
    """Stands for the module `time`.

    Attributes:
        now: of the monotonic clock, s.
        skew: of the wall clock of the process whose turn it is, s.
        busy: what this thread has used of a processor, s.
    """

    def __init__(self, monkeypatch, begins=1.8e9):
        self.now, self.skew, self.busy, self._begins = 100.0, 0.0, 0.0, begins - 100.0
        for module in (agent_process, ground, mission):
            monkeypatch.setattr(module, "time", self)

    def monotonic(self):
        return self.now

    perf_counter = monotonic

    def time(self):
        return self._begins + self.now + self.skew

    def time_ns(self):
        return round(1e3 * self.time()) * 1_000_000

    def thread_time(self):
        return self.busy

    def sleep(self, seconds):
        self.now += seconds


class Network:
    """Carries datagrams to all but their sender; `recorded` holds when each was sent, and each."""

    def __init__(self, clock, impairment=IDEAL):
        self.clock, self.impairment, self.sockets, self.recorded = clock, impairment, [], []
        self.draws = random.Random(impairment.seed)

    def socket(self):
        self.sockets.append(MemorySocket(self))
        return self.sockets[-1]

    def carry(self, sender, datagram):
        self.recorded.append((self.clock.time() - self.clock.skew, datagram))
        for socket in self.sockets:
            if socket is not sender and self.draws.random() >= self.impairment.loss:
                late = self.impairment.delay + self.impairment.jitter * self.draws.random()
                socket.queue.append((self.clock.now + late, datagram))


class MemorySocket:
    def __init__(self, network):
        self.network, self.queue = network, []

    def send(self, datagram):
        self.network.carry(self, datagram)

    def receive(self):
        now = self.network.clock.now
        come = sorted(each for each in self.queue if each[0] <= now)
        self.queue = [each for each in self.queue if each[0] > now]
        return [datagram for _, datagram in come]

    def close(self):
        self.network.sockets.remove(self)


class VehicleLink(Link):
    watchdog = True

    def __init__(self, vehicle, clock):
        self.vehicle, self.clock, self.reading = vehicle, clock, None

    def read(self, wait):
        reading, self.reading = self.reading, None
        return reading

    def send(self, u):
        self.vehicle.hear(INPUT, u, self.clock.now)

    def level_descend(self):
        self.vehicle.hear(DESCEND, [], self.clock.now)

    def close(self):
        pass


class VirtualFlight:
    """Vehicles, the ground station, and the agents that a test starts.

    Attributes:
        agents: the processes that run, by name.
        ended: why those ended that have.
        vehicles: of each number; their states no longer arrive where `silent`.
        step: between states of the vehicles, s.
    """

    def __init__(self, folder, key, monkeypatch, impairment=IDEAL):
        self.mission, self.key = Mission(folder), key
        self.clock = VirtualClock(monkeypatch)
        self.network = Network(self.clock, impairment)
        facts, moves = self.mission.facts["vehicles"], simulated(self.mission)
        self.vehicles = [Vehicle(facts, k, move) for k, move in enumerate(moves)]
        self.part, self.substeps = self.mission.facts["dt"] / facts["substeps"], facts["substeps"]
        self.step, self.silent, self._told = self.mission.facts["dt"], False, self.clock.now
        self.agents, self.ended, self._skews, self._links = {}, {}, {}, {}
        make_key(key)
        wire = self.mission.wire(GROUND, key)
        self.ground = Ground(self.network.socket(), wire, self.mission.agents)

    def start_agent(
        self, number, mission=None, key=None, skew=0.0, name=None, law=None, logs=False
    ):
        name, self.clock.skew = number if name is None else name, skew
        mission = mission or self.mission
        module, facts = mission.law(number)
        link = VehicleLink(self.vehicles[number], self.clock)
        wire = mission.wire(number, key or self.key)
        rest = link, self.network.socket(), wire, PlanClock()
        log = mission.log(facts, "virtual") if logs else None
        context = AgentContext(law or module, facts, mission.facts, *rest, log)
        self.agents[name] = AgentProcess(context, mission.facts["horizon"])
        self._skews[name], self._links[name] = skew, link
        self.clock.skew = 0.0

    def kill(self, name):
        agent = self.agents.pop(name)
        agent.context.socket.close()
        if agent.context.log is not None:
            agent.context.log.close()

    def take_off(self, *ready, soon=0.3):
        """Start the plan once some agents are ready, in all of which that is so soon."""
        self.wait(lambda state: all(state["agents"][k]["mode"] == "ready" for k in ready))
        self.ground.start(self.clock.time() + soon)

    def wait(self, holds, seconds=30.0):
        """Fly until the page shows something, and return what it shows."""
        until = self.clock.now + seconds
        while not holds(state := self.ground.state()):
            assert self.clock.now < until, state
            self.fly(0.1)
        return state

    def fly(self, seconds):
        for _ in range(round(seconds / self.part)):
            self.clock.now += self.part
            for vehicle in self.vehicles:
                vehicle.advance(self.clock.now, 0.1)
            self._tell()
            for name in [*self.agents]:
                self._turn(name)
            self.clock.skew = 0.0
            self.ground.round()

    def _tell(self):
        if self.clock.now < self._told + self.step - 1e-9 or self.silent:
            return
        self._told = self.clock.now
        for link in self._links.values():
            link.reading = Reading(self.clock.now, link.vehicle.measured())

    def _turn(self, name):
        self.clock.skew, agent = self._skews[name], self.agents[name]
        if agent.over():
            self.ended[name] = agent.end()
            self.kill(name)
        else:
            agent.round()

    @property
    def time(self):
        """Of the plan, by the clock of an agent that flies, s."""
        return next(t for x in self.agents.values() if (t := x.context.clock.now) is not None)
