"""Four agents in one process, whose Crazyflies share a radio that carries 300 setpoints a second.

Agents, links and ground station are those that fly; cflib, radio and vehicles are none, and the
clock stands still while they compute.
"""

import shutil
import sys
from collections import deque
from types import ModuleType

import numpy as np
import pytest
from cflib_stub import LogConfig, Stub
from fake_crazyflie import Dongle, packed
from fake_vehicles import IDENTIFIED, Vehicles
from virtual_flight import Network, VirtualClock

import echelon as ech
from echelon.agents.models import CrazyflieAttitude
from echelon.output.archive.flight_folder import flight_files, save_flight
from echelon_flight import one_process
from echelon_flight.agent_process import AgentContext, AgentProcess, PlanClock
from echelon_flight.flight_log import find_logs, read_log
from echelon_flight.ground import Ground
from echelon_flight.links import crazyflie
from echelon_flight.mission import Mission, make_key
from echelon_flight.one_process import SharedRadioLink, SharedSocket
from echelon_flight.supervisor import Fault
from echelon_flight.wire import GROUND

pytestmark = pytest.mark.slow

GRAPH = ech.Graph([(0, 1), (1, 2), (1, 3)])
OFFSETS = {1: (0.6, 0.0, 0.0), 2: (0.6, 0.5, 0.0), 3: (0.6, -0.5, 0.0)}
PATH = ech.references.Circle(center=(0.0, 0.0, 1.0), radius=0.6, rate=0.8)
MASS, SETTLED, SECONDS = 0.0319, 8.0, 12.0


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    model = CrazyflieAttitude()
    gain = ech.synthesize(model, GRAPH, ech.gains.Riccati())
    laws = ech.Laws(ech.laws.Tracking(PATH), ech.laws.Consensus(gain, feedforward="relay"))
    places = ech.Formation.from_offsets(model, GRAPH, OFFSETS)
    world = ech.World(network=ech.Network(rate=50.0))
    settings = ech.Settings(horizon=SECONDS, dt=0.01)
    result = tmp_path_factory.mktemp("radio") / "flight"
    save_flight(
        flight_files(ech.Parts(model, GRAPH, places, laws, world=world), settings, "4"), result
    )
    return result


class OneProcess:
    """Four agents by rounds of one thread, and their ground station."""

    def __init__(self, folder, key, monkeypatch, most):
        self.clock, self.flown = VirtualClock(monkeypatch), []
        for module in (one_process, crazyflie):
            monkeypatch.setattr(module, "time", self.clock)
        for name in ("cflib", "cflib.crazyflie", "cflib.crazyflie.log"):
            monkeypatch.setitem(sys.modules, name, ModuleType(name))
        sys.modules["cflib.crazyflie.log"].LogConfig = LogConfig
        # With logs of its own.
        own = shutil.copytree(folder, key.with_name("flight"))
        self.mission, self.dongle, network = Mission(own), Dongle(), Network(self.clock)
        facts = self.mission.facts | {"parameters": {"radio_setpoints": most}}
        make_key(key)
        wire = self.mission.wire(GROUND, key)
        self.ground = Ground(network.socket(), wire, 4)
        starts = np.array([(0.0, 0.0, 0.0), *OFFSETS.values()]) + [0.6, 0.0, 1.0]
        starts += np.random.default_rng(3).uniform(-0.2, 0.2, (4, 3))
        self.vehicles = Vehicles(starts, MASS, 0.97605781, **IDENTIFIED)
        inboxes, self.stubs, self.links = {k: deque() for k in range(4)}, [], []
        self.agents = [self.agent(k, key, facts, network, inboxes) for k in range(4)]

    def agent(self, k, key, flight, network, inboxes):
        law, facts = self.mission.law(k)
        stub, clock = Stub(), PlanClock()
        stub.commander.dongle = self.dongle
        link = crazyflie.CflibLink("", facts, stub)
        self.stubs.append(stub)
        self.links.append(SharedRadioLink(link, facts, flight, clock, 4))
        # What does not pass through memory reaches the station alone.
        outer = network.socket()
        rest = SharedSocket(outer, k, inboxes), self.mission.wire(k, key), clock
        rest = *rest, self.mission.log(facts, "cflib")
        return AgentProcess(AgentContext(law, facts, flight, self.links[-1], *rest), SECONDS)

    def deliver(self):
        """Send each state, as the firmware logs it."""
        v = self.vehicles
        for k, stub in enumerate(self.stubs):
            p, s, (w, *axis), rates = v.p[k], v.v[k], v.q[k], v.w[k]
            numbers = [*(1e3 * p), *(1e3 * s), packed((*axis, w)), *(1e3 * rates * [1, -1, 1])]
            names = [*stub.configs[0].variables]
            values = dict(zip(names, [*map(int, numbers), 3.9], strict=True))
            for call in stub.configs[0].data_received_cb:
                call(0, values, None)

    def fly(self, seconds):
        now, v = self.clock, self.vehicles
        for step in range(round(seconds / 0.002)):
            now.now += 0.002
            for k, stub in enumerate(self.stubs):
                stub.commander.now = now.now
                stub.fake.hold(v.p[k], v.v[k], MASS)
            v.command = np.array([stub.fake.acting(now.now) for stub in self.stubs])
            v.step(0.002)
            if step % 5 == 0:
                self.deliver()
                for agent in self.agents:
                    if not agent.over():
                        agent.round()
                self.ground.round()
                t = self.agents[0].context.clock.now
                self.flown.append((-1.0 if t is None else t, v.p.copy()))

    def take_off(self):
        self.fly(0.5)
        assert self.ground.ready
        self.ground.start(self.clock.time() + 0.3)
        self.fly(0.3)

    def errors(self):
        """The worst distance of a follower from its place beside the leader, from `SETTLED` on."""
        late = [p for t, p in self.flown if SETTLED < t < SECONDS]
        gaps = np.array(late)[:, 1:] - np.array(late)[:, :1] - np.array([*OFFSETS.values()])
        return np.linalg.norm(gaps, axis=2).max()


@pytest.fixture
def fly(folder, tmp_path, monkeypatch):
    return lambda most: OneProcess(folder, tmp_path / "key", monkeypatch, most)


def test_late_setpoints_are_reported_and_the_formation_holds(fly, capsys):
    flight = fly(300.0)
    flight.take_off()
    flight.fly(SECONDS)
    # Each wants 100 a second and has 75: a quarter is late, and none is sent that would be lost. Of
    # the first hundred one is not, as shares are saved on the ground.
    for link in flight.links:
        assert link.late / link.total == pytest.approx(0.25, abs=0.01) and not link.hovers
    assert flight.dongle.dropped == 0
    assert flight.errors() <= 0.015
    said, sentence = (
        capsys.readouterr().err,
        "24 % of the setpoints are late: the dongle carries 300",
    )
    for k in range(4):
        assert said.count(f"agent {k}: {sentence} a second for 4 vehicles.\n") == 1
        assert any(sentence in note for note in flight.ground.state()["agents"][k]["notes"])
    flight.fly(3.0)
    assert capsys.readouterr().err.count(" setpoints were late.\n") == 4
    assert [a.supervisor.fault for a in flight.agents] == [Fault.END] * 4
    assert flight.vehicles.p[:, 2].max() < 0.06
    for agent in flight.agents:
        agent.end()
    [files] = find_logs(flight.mission.folder).values()
    for k, log in enumerate(map(read_log, files)):
        assert log.header["agent"] == k and not log.warning
        assert log.ticks[-1].time > SECONDS and list(Fault)[log.ticks[-1].fault] is Fault.END
        told = [each.text for each in log.sentences]
        assert sum(sentence in text for text in told) == 1
        assert sum(text.endswith(" setpoints were late") for text in told) == 1


def test_letters_pass_through_memory_by_the_same_rules(fly):
    flight = fly(300.0)
    flight.take_off()
    flight.fly(0.5)
    leader, second = flight.agents[0].context, flight.agents[1]
    before = second.pilot.box.letters[0]
    flight.fly(0.1)
    newer = second.pilot.box.letters[0]
    assert newer.time > before.time
    # A letter that comes again, or is signed with another key, is dropped and counted.
    datagram = leader.wire.letter(newer)
    for content in (datagram, datagram, datagram[:-1] + bytes([datagram[-1] ^ 1])):
        leader.socket.send(content)
    counts = sum(second.context.wire.dropped.values())
    second.round()
    assert sum(second.context.wire.dropped.values()) == counts + 3
    assert second.pilot.box.letters[0].time == newer.time


def test_where_most_setpoints_are_late_vehicles_hover_on_the_plan(fly, capsys):
    flight = fly(120.0)
    flight.take_off()
    flight.fly(SECONDS - 0.5)
    assert all(link.hovers for link in flight.links) and flight.dongle.dropped == 0
    assert capsys.readouterr().err.count("; it hovers on the plan.\n") == 4
    late = [(t, p) for t, p in flight.flown if SETTLED < t < SECONDS]
    goals = np.array([[0.6 * np.cos(0.8 * t), 0.6 * np.sin(0.8 * t), 1.0] for t, _ in late])
    places = np.array([p for _, p in late])
    gaps = places - goals[:, None] - np.array([(0.0, 0.0, 0.0), *OFFSETS.values()])
    # By a controller that knows no path but its last point, at 0.48 m/s: 0.75 s behind.
    assert np.linalg.norm(gaps, axis=2).max() < 0.5
    apart = [np.linalg.norm(places[:, a] - places[:, b], axis=1) for a, b in GRAPH.edges.tolist()]
    assert min(map(np.min, apart)) > 0.3
