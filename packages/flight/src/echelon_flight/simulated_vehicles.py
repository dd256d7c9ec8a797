"""Simulated vehicles in real time, in one process, and in another one a network that is not ideal.

The vehicles are the other end of `links/udp.py`. One stays where it starts until its first input.
Without inputs for a while its autopilot levels it, as real ones do; after that, or where it is
asked to, it descends.
"""

import heapq
import itertools
import math
import random
import select
import struct
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final, NamedTuple, TextIO, TypeAlias, final

from echelon_flight.datagram_socket import Address, bound
from echelon_flight.links.udp import DESCEND, HEAD, INPUT
from echelon_flight.mission import Mission, load_module
from echelon_flight.wire import sender_of

Move: TypeAlias = Callable[
    [list[float], Sequence[float], list[float], Sequence[float]], tuple[list[float], list[float]]
]
"""(state, input, what actuators remember, push) -> the first and the third a substep later."""

_SILENT: Final = 0.1
"""s without inputs until the autopilot levels; torques must not act longer."""
_LATE: Final = 10
"""Steps by which the simulation may be late before it lets time go."""
_EVERY: Final = 0.01  # s between rows of positions.csv


@final
class Vehicle:
    """One simulated vehicle.

    Args:
        facts: `vehicles` of flight.json.
        number: of its agent.
        move: its motion in a substep.
    """

    def __init__(self, facts: Mapping[str, Any], number: int, move: Move) -> None:
        """Stand at its start."""
        self._facts, self._move, self._trim = facts, move, facts["trim"][number]
        self.x: list[float] = list(facts["starts"][number])
        self.u: list[float] | None = None
        self.heard, self.descends, self.address = -math.inf, False, None
        self._memory: list[float] = list(facts["memory"])
        # Two streams, so that gusts do not depend on how often sensors are read.
        self._gusts = random.Random(f"{facts['seed']} {number}")
        self._noise = random.Random(f"{facts['seed']} {number} sensors")
        self._gust = [rms * self._gusts.gauss(0.0, 1.0) for rms in facts["rms"]]

    address: Any

    def hear(self, what: int, u: list[float], now: float) -> None:
        """Take an input, or descend."""
        if what == INPUT and not self.descends:
            self.u, self.heard = u, now
        self.descends = self.descends or what == DESCEND

    def measured(self) -> list[float]:
        """Return the state with the noise of its sensors."""
        pairs = zip(self.x, self._facts["noise"], strict=True)
        return [x + rms * self._noise.gauss(0.0, 1.0) if rms else x for x, rms in pairs]

    def advance(self, now: float, silent: float) -> None:
        """Move on by a substep; after a silence (s) its autopilot acts."""
        if self.u is None and not self.descends:
            return
        own = self.descends or now - self.heard > silent or self.u is None
        u = self._levelled() if own else self.u
        facts, fade = self._facts, self._facts["fade"]
        size = math.sqrt(1.0 - fade * fade)
        self._gust = [
            fade * gust + size * rms * self._gusts.gauss(0.0, 1.0) if rms else 0.0
            for gust, rms in zip(self._gust, facts["rms"], strict=True)
        ]
        push = [a + b for a, b in zip(facts["constant"], self._gust, strict=True)]
        self.x, self._memory = self._move(self.x, u or [], self._memory, push)
        self._land()

    def _levelled(self) -> list[float]:
        """Return the input that levels, and sinks if it was asked to."""
        facts = self._facts
        goal = facts["sinking"] if self.descends else facts["rest"]
        gaps = [x - y for x, y in zip(self.x, goal, strict=True)]
        return [
            u - sum(k * gap for k, gap in zip(row, gaps, strict=True))
            for u, row in zip(self._trim, facts["levelling"], strict=True)
        ]

    def _land(self) -> None:
        """Stay on the ground, where the motors are off."""
        height = self._facts["height"]
        if self.descends and height is not None and self.x[height] <= 0.0:
            self.x = [
                value if k in self._facts["place"] else rest
                for k, (value, rest) in enumerate(zip(self.x, self._facts["rest"], strict=True))
            ]
            self.x[height], self.u, self.descends = 0.0, None, False


@final
class Vehicles:
    """The simulation of all vehicles.

    Args:
        mission: the flight.
        moves: of each vehicle.
        speed: seconds of the flight in one of this machine.
        port: of 127.0.0.1.
    """

    def __init__(self, mission: Mission, moves: Sequence[Move], speed: float, port: int) -> None:
        """Open the socket."""
        self._facts = facts = mission.facts["vehicles"]
        self.all = [Vehicle(facts, k, move) for k, move in enumerate(moves)]
        self._speed, self._substeps = speed, facts["substeps"]
        self._dt = mission.facts["dt"]
        self._input = struct.Struct(f"<{len(facts['trim'][0])}d")
        self._state = struct.Struct(f"<{2 + len(facts['rest'])}d")
        self._position = mission.facts["position"]
        self._socket = bound(port)
        self._socket.setblocking(False)
        self._log: TextIO = (mission.folder / "positions.csv").open("w", encoding="utf-8")
        self._logged, self.let_go = -math.inf, 0

    def run(self) -> None:
        """Simulate until the process ends."""
        count, period = 0, self._dt / self._speed / self._substeps
        due = time.monotonic()
        while True:
            if count % self._substeps == 0:
                self._tell(due)
            count, due = count + 1, due + period
            self._listen(due)
            now = time.monotonic()
            if now > due + _LATE * period * self._substeps:
                self.let_go, due = self.let_go + 1, now
            for vehicle in self.all:
                vehicle.advance(now, _SILENT / self._speed)

    def _tell(self, now: float) -> None:
        """Send every state, as of a time of the monotonic clock (s)."""
        for vehicle in self.all:
            if vehicle.address is not None:
                state = self._state.pack(now, math.nan, *vehicle.measured())
                self._send(state, vehicle.address)
        if now >= self._logged + _EVERY / self._speed:
            self._logged = now
            places = [f"{v.x[k]:.6f}" for v in self.all for k in self._position]
            print(f"{now:.6f}", self.let_go, *places, sep=",", file=self._log, flush=True)

    def _send(self, state: bytes, address: Any) -> None:
        try:
            self._socket.sendto(state, address)
        except OSError:
            return

    def _listen(self, until: float) -> None:
        """Take what arrives until a time of the monotonic clock (s)."""
        while (wait := until - time.monotonic()) > 0.0:
            if select.select([self._socket], [], [], wait)[0]:
                self._take()
        self._take()

    def _take(self) -> None:
        while True:
            try:
                datagram, address = self._socket.recvfrom(2048)
            except BlockingIOError:
                return
            except OSError:  # an agent that has ended
                continue
            if len(datagram) < HEAD.size:
                continue
            what, number = HEAD.unpack_from(datagram)
            if number >= len(self.all):
                continue
            rest = datagram[HEAD.size :]
            u = list(self._input.unpack(rest)) if len(rest) == self._input.size else []
            if what != INPUT or (u and all(map(math.isfinite, u))):
                self.all[number].address = address
                self.all[number].hear(what, u, time.monotonic())


def simulated(mission: Mission) -> list[Move]:
    """Return the motion of each vehicle, by the equations in the folder."""
    names = mission.facts["vehicles"]["files"]
    modules = {name: load_module(mission.folder / name) for name in names}
    return [modules[name].move for name in names]


class LinkImpairment(NamedTuple):
    """What happens to datagrams: delay and largest additional delay (s), loss, and the seed."""

    delay: float = 0.0
    jitter: float = 0.0
    loss: float = 0.0
    seed: int = 0


def carry(port: int, to: Sequence[Address], impairment: LinkImpairment, speed: float = 1.0) -> None:
    """Carry datagrams to all but their sender until the process ends.

    Args:
        port: of this machine, where agents send to.
        to: where agent k listens, and last the ground station.
        impairment: what happens on the way.
        speed: seconds of the plan in one of this machine.
    """
    draws, order = random.Random(impairment.seed), itertools.count()
    queue = list[tuple[float, int, bytes, Address]]()
    with bound(port) as network:
        while True:
            wait = max(0.0, queue[0][0] - time.monotonic()) if queue else None
            if select.select([network], [], [], wait)[0]:
                datagram, now = network.recv(2048), time.monotonic()
                own = sender_of(datagram)
                for k, address in enumerate(to):
                    late = impairment.delay + impairment.jitter * draws.random()
                    if k != own and draws.random() >= impairment.loss:
                        item = now + late / speed, next(order), datagram, address
                        heapq.heappush(queue, item)
            while queue and queue[0][0] <= time.monotonic():
                _, _, datagram, address = heapq.heappop(queue)
                try:
                    network.sendto(datagram, address)
                except OSError:
                    continue
