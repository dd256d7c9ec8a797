"""All processes of a flight on this machine: simulated vehicles, the network, and each agent."""

import contextlib
import math
import os
import secrets
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final, final

from echelon.core.errors import FlightError
from echelon.flight.air import LOOPBACK, Air, ports_of
from echelon.flight.ground import Ground
from echelon.flight.mission import Mission
from echelon.flight.wire import GROUND, Report, wire_of

_PATIENCE: Final = 20.0  # s until all agents are ready


@final
class Together:
    """The processes of a flight with simulated vehicles.

    Args:
        mission: the flight.
        seconds: of the plan.
        speed: seconds of the plan in one of this machine.
        port: of agent 0 on 127.0.0.1; the others have the next ones, then come the ground station,
            the bridge, and the vehicles.
        vehicles: the command of another simulation of the vehicles.

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
    ) -> None:
        """Start the vehicles and the network."""
        self._mission, self._seconds, self._speed = mission, seconds, speed
        self._key, self._others = mission.folder / "key", vehicles
        make_key(self._key)
        self._ports = ports_of(mission.agents, port)
        self._bridge, self._plant = (port + mission.agents + k for k in (1, 2))
        self._running = dict[str, subprocess.Popen[bytes]]()
        self._began, self.ready = dict[int, float](), dict[int, float]()
        self.at = math.inf
        wire = wire_of(mission.facts, GROUND, self._key)
        air = Air(self._ports[-1], self._ways(mission.agents))
        self.ground = Ground(air, wire, mission.agents, self._note)

    @property
    def _weather(self) -> list[str]:
        weather = self._mission.facts["weather"]
        return [f"{weather[name]!r}" for name in ("delay", "jitter", "loss")]

    def _ways(self, own: int) -> list[tuple[str, int]]:
        """Return whom a process sends to: the bridge, where the network is not ideal."""
        if any(self._mission.facts["weather"].values()):
            return [(LOOPBACK, self._bridge)]
        return [address for k, address in enumerate(self._ports) if k != own]

    def _note(self, number: int, report: Report) -> None:
        if math.isfinite(report.x) and number in self._began:
            self.ready.setdefault(number, time.monotonic() - self._began[number])

    def start_world(self) -> None:
        """Start the vehicles, and the network where it is not ideal."""
        where = ["--speed", repr(self._speed), "--port"]
        own = ["-m", "echelon.flight", str(self._mission.folder)]
        plant = [*(self._others or [*own, "--vehicles"]), *where, str(self._plant)]
        self._begin("vehicles", plant)
        if self._ways(GROUND)[0][1] == self._bridge:
            weather = ["--weather", *self._weather]
            self._begin("bridge", [*own, *weather, *where, str(self._ports[0][1])])

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
        self._begin(f"agent {number}", ["-m", "echelon.flight", str(self._mission.folder), *words])

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

    def wait_until_ready(self) -> None:
        """Wait until all agents know their states.

        Raises:
            FlightError: one of them does not, or has ended.
        """
        deadline = time.monotonic() + _PATIENCE
        while not (len(self.ready) == self._mission.agents and self.ground.ready):
            ended = [name for name, x in self._running.items() if x.poll() is not None]
            if ended:
                raise FlightError(f"the process of {ended[0]} ended before the start.")
            if time.monotonic() > deadline:
                missing = sorted({*range(self._mission.agents)} - {*self.ready})
                raise FlightError(
                    f"after {_PATIENCE:g} s agent {missing[0] if missing else 0} is not ready."
                )
            time.sleep(0.02)

    def start(self) -> None:
        """Let the plan start in half a second."""
        self.at = time.time() + 0.5
        self._begins = time.monotonic() + 0.5
        self.ground.start(self.at)

    _begins: float

    def time(self) -> float:
        """Return the time of the plan, s."""
        return (time.monotonic() - self._begins) * self._speed

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
        """Return what the vehicles say of themselves."""
        return read_errors(self._mission, self._begins, self._speed)


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

    def back(self, number: int, since: float, within: float = 0.01) -> float:
        """Return how long (s) after a time the error of an agent is last beyond a distance (m)."""
        pairs = zip(self.times, self.rows, strict=True)
        return max(
            (t - since for t, row in pairs if t >= since and row[number] > within), default=0.0
        )


def read_errors(mission: Mission, begins: float, speed: float) -> Errors:
    """Return the errors in positions.csv, of a plan that began at a monotonic time (s)."""
    facts = mission.facts
    d = len(facts["position"])
    leader = facts["leader"]
    times, rows, late = list[float](), list[list[float]](), 0
    for line in (mission.folder / "positions.csv").read_text("utf-8").splitlines():
        moment, gone, *flat = map(float, line.split(","))
        places = [flat[d * k : d * k + d] for k in range(mission.agents)]
        times.append((moment - begins) * speed)
        offsets = offsets_at(facts["offsets"], times[-1])
        goals = [
            [x + b - a for x, a, b in zip(places[leader], offsets[leader], own, strict=True)]
            for own in offsets
        ]
        rows.append([math.dist(x, goal) for x, goal in zip(places, goals, strict=True)])
        late = int(gone)
    return Errors(times, rows, late)


def offsets_at(facts: Mapping[str, Any], t: float) -> list[list[float]]:
    """Return where agents belong relative to each other (N, d) at a time of the plan (s)."""
    rows, index = facts["rows"], max(0.0, t) / facts["every"]
    k = min(int(index), len(rows) - 1)
    share, after = index - k, rows[min(k + 1, len(rows) - 1)]
    return [
        [a + share * (b - a) for a, b in zip(own, then, strict=True)]
        for own, then in zip(rows[k], after, strict=True)
    ]


def make_key(file: Path) -> None:
    """Write a new key that its owner alone may read."""
    file.unlink(missing_ok=True)
    with os.fdopen(os.open(file, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "wb") as out:
        out.write(secrets.token_bytes(32))


@contextlib.contextmanager
def flying(together: Together) -> Iterator[None]:
    """Start all processes, wait until all are ready, start the plan, and end all at last."""
    try:
        together.start_world()
        for k in range(together._mission.agents):
            together.start_agent(k)
        together.wait_until_ready()
        together.start()
        yield
    finally:
        together.end()
