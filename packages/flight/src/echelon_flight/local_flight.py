"""All processes of a flight on this machine: simulated vehicles, the network, and each agent."""

import contextlib
import math
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Self, final

from echelon_flight import FlightError
from echelon_flight.datagram_socket import LOOPBACK, DatagramSocket, ports_of
from echelon_flight.ground import Ground
from echelon_flight.mission import Mission, make_key
from echelon_flight.wire import GROUND, Report


@final
class LocalFlight:
    """The processes of a flight with simulated vehicles, which fly inside the block of a `with`.

    Args:
        mission: the flight.
        seconds: of the plan.
        speed: seconds of the plan in one of this machine.
        port: of agent 0 on 127.0.0.1; the others have the next ones, then come the ground station,
            the bridge, and the vehicles.
        vehicles: the command of another simulation of the vehicles.
        watch: called with the number of an agent and each of its reports.

    Attributes:
        ground: the ground station.
    """

    def __init__(
        self,
        mission: Mission,
        seconds: float,
        speed: float,
        port: int,
        vehicles: Sequence[str] = (),
        watch: Callable[[int, Report], None] = lambda number, report: None,
    ) -> None:
        """Start the vehicles and the network."""
        self._mission, self._seconds, self._speed = mission, seconds, speed
        self._key, self._others, self._watch = mission.folder / "key", vehicles, watch
        make_key(self._key)
        self._ports = ports_of(mission.agents, port)
        self._bridge, self._plant = (port + mission.agents + k for k in (1, 2))
        self._running = dict[str, subprocess.Popen[bytes]]()
        self._began, self.ready = dict[int, float](), dict[int, float]()
        self._begins = math.inf
        wire = mission.wire(GROUND, self._key)
        socket = DatagramSocket(self._ports[-1], self._ways(mission.agents))
        self.ground = Ground(socket, wire, mission.agents, self._note, mission.parameters)
        self.ground.listen()

    def _ways(self, own: int) -> list[tuple[str, int]]:
        """Return whom a process sends to: the bridge, where the network is not ideal."""
        if any(self._mission.facts["weather"].values()):
            return [(LOOPBACK, self._bridge)]
        return [address for k, address in enumerate(self._ports) if k != own]

    def _note(self, number: int, report: Report) -> None:
        self._watch(number, report)
        if math.isfinite(report.x) and number in self._began:
            self.ready.setdefault(number, time.monotonic() - self._began[number])

    def _start_world(self) -> None:
        where = ["--speed", repr(self._speed), "--port"]
        own = ["-m", "echelon_flight", str(self._mission.folder)]
        plant = [*(self._others or [*own, "--vehicles"]), *where, str(self._plant)]
        self._begin("vehicles", plant)
        if self._ways(GROUND)[0][1] == self._bridge:
            weather = self._mission.facts["weather"]
            numbers = [repr(weather[name]) for name in ("delay", "jitter", "loss")]
            words = [*own, "--weather", *numbers, *where, str(self._ports[0][1])]
            self._begin("bridge", words)

    def _wait_until_ready(self) -> None:
        deadline = time.monotonic() + (patience := self._mission.parameters["ready_patience"])
        while not (len(self.ready) == self._mission.agents and self.ground.ready):
            ended = [name for name, x in self._running.items() if x.poll() is not None]
            if ended:
                raise FlightError(f"the process of {ended[0]} ended before the start.")
            if time.monotonic() > deadline:
                missing = sorted({*range(self._mission.agents)} - {*self.ready})
                raise FlightError(
                    f"after {patience:g} s agent {missing[0] if missing else 0} is not ready."
                )
            time.sleep(0.02)

    def start_agent(self, number: int) -> None:
        """Start the process of an agent, or start it again."""
        to = [f"{host}:{port}" for host, port in self._ways(number)]
        options = {
            "--agent": str(number),
            "--key": str(self._key),
            "--link": f"udp://{LOOPBACK}:{self._plant}",
            "--listen": f"{LOOPBACK}:{self._ports[number][1]}",
            "--to": ",".join(to),
            "--speed": repr(self._speed),
            "--seconds": repr(self._seconds),
        }
        self.ready.pop(number, None)
        self._began[number] = time.monotonic()
        words = [word for pair in options.items() for word in pair]
        self._begin(f"agent {number}", ["-m", "echelon_flight", str(self._mission.folder), *words])

    def _begin(self, name: str, words: Sequence[str]) -> None:
        self._running[name] = subprocess.Popen([sys.executable, *words])

    def kill(self, number: int) -> None:
        """Kill the process of an agent at once."""
        process = self._running[f"agent {number}"]
        process.kill()
        process.wait()

    def memory(self, number: int) -> float:
        """Return the memory of an agent's process, MB; NaN where the system does not say."""
        status = Path(f"/proc/{self._running[f'agent {number}'].pid}/status")
        with contextlib.suppress(OSError):
            for line in status.read_text("utf-8").splitlines():
                if line.startswith("VmRSS:"):
                    return float(line.split()[1]) / 1024.0
        return math.nan

    def __enter__(self) -> Self:
        """Start all processes, wait until all are ready, and start the plan.

        Raises:
            FlightError: an agent does not get ready.
        """
        try:
            self._start_world()
            for k in range(self._mission.agents):
                self.start_agent(k)
            self._wait_until_ready()
            self._begins = time.monotonic() + 0.5
            self.ground.start(time.time() + 0.5)
        except BaseException:
            self.end()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        """End all processes."""
        self.end()

    def time(self) -> float:
        """Return the time of the plan, s."""
        return (time.monotonic() - self._begins) * self._speed

    def wait_until_down(self) -> None:
        """Wait until the process of each agent has ended by itself, after the plan."""
        for name, process in self._running.items():
            if name.startswith("agent"):
                process.wait()

    def end(self) -> None:
        """End all processes."""
        for process in self._running.values():
            process.terminate()
        for process in self._running.values():
            try:
                process.wait(2.0)
            except subprocess.TimeoutExpired:
                process.kill()
        self.ground.close()

    def errors(self) -> "Errors":
        """Return how far followers were from their places, by what the vehicles say."""
        times, rows, late = list[float](), list[list[float]](), 0
        size = len(self._mission.facts["position"])
        for line in (self._mission.folder / "positions.csv").read_text("utf-8").splitlines():
            moment, let_go, *flat = map(float, line.split(","))
            places = [flat[k : k + size] for k in range(0, len(flat), size)]
            times.append((moment - self._begins) * self._speed)
            rows.append(place_errors(self._mission.facts, times[-1], places))
            late = int(let_go)
        return Errors(times, rows, late)


@final
class Errors:
    """How far followers were from their places beside the first leader, over time.

    Attributes:
        times: of the plan, s (T).
        rows: m, of each agent (T, N); the leader's is 0.
        late: how often the simulation let time go.
    """

    def __init__(self, times: list[float], rows: list[list[float]], late: int) -> None:
        """Store them."""
        self.times, self.rows, self.late = times, rows, late

    def worst(self, number: int, since: float) -> float:
        """Return the largest error (m) of an agent from a time (s) on; NaN without any."""
        pairs = zip(self.times, self.rows, strict=True)
        return max((row[number] for t, row in pairs if t >= since), default=math.nan)


def place_errors(
    facts: Mapping[str, Any], t: float, places: Sequence[Sequence[float]]
) -> list[float]:
    """Return how far agents are from their places beside the first leader (m).

    Args:
        facts: the content of flight.json.
        t: time of the plan, s.
        places: of all agents, m (N, d).
    """
    leader, offsets = facts["leader"], offsets_at(facts["offsets"], t)
    goals = [
        [x + b - a for x, a, b in zip(places[leader], offsets[leader], own, strict=True)]
        for own in offsets
    ]
    return [math.dist(x, goal) for x, goal in zip(places, goals, strict=True)]


def offsets_at(facts: Mapping[str, Any], t: float) -> list[list[float]]:
    """Return where agents belong relative to each other (N, d) at a time of the plan (s)."""
    rows, index = facts["rows"], max(0.0, t) / facts["every"]
    k = min(int(index), len(rows) - 1)
    share, after = index - k, rows[min(k + 1, len(rows) - 1)]
    return [
        [a + share * (b - a) for a, b in zip(own, then, strict=True)]
        for own, then in zip(rows[k], after, strict=True)
    ]
