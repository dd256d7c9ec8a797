"""Several agents in one process, whose vehicles share one radio dongle.

Each agent is what it is in a process of its own: it has a thread, a law, a supervisor and a link.
Its letters reach the others here through memory, signed, checked and dropped by the same rules.
"""

import re
import signal
import threading
import time
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, ClassVar, Final, final

from echelon_flight import FlightError
from echelon_flight.agent_process import AgentContext, AgentProcess, PlanClock
from echelon_flight.datagram_socket import Datagrams
from echelon_flight.links import Link, Reading
from echelon_flight.links.crazyflie import CflibLink
from echelon_flight.local_flight import offsets_at
from echelon_flight.parameters import values_of
from echelon_flight.supervisor import Fault
from echelon_flight.wire import sender_of

_BURST: Final = 2.0
"""Setpoints that a vehicle may save up: states do not come evenly."""
_WINDOW: Final = 100
"""Setpoints over which the late ones are counted."""


def read_numbers(text: str, agents: int) -> list[int]:
    """Return the agents of `--agents`, such as `0,1,2`.

    Raises:
        FlightError: it is no list of different agents of the flight.
    """
    words = text.split(",")
    numbers = [int(word) for word in words if word.strip().isdecimal()]
    if len(numbers) < len(words) or len({*numbers}) < len(words) or max(numbers) >= agents:
        raise FlightError(
            f"`--agents` is `{text}`, and must be different numbers from 0 to {agents - 1}, "
            "separated by commas."
        )
    return numbers


def read_links(text: str, numbers: Sequence[int]) -> list[str]:
    """Return the link of each agent: `--link` has one for each, or a scheme alone for all.

    The addresses of `cflib` are those that `echelon path --all` writes: agent 0 has `E7E7E7E701`.

    Raises:
        FlightError: there is another number of links, or they are on several dongles.
    """
    if text == "cflib":
        return [f"cflib://radio://0/80/2M/E7E7E7E7{k + 1:02X}" for k in numbers]
    links = text.split(",") if "://" in text else [text] * len(numbers)
    if len(links) != len(numbers):
        raise FlightError(
            f"`--link` has {len(links)} addresses, and `--agents` {len(numbers)}; give one for "
            "each, separated by commas, or `cflib` alone."
        )
    dongles = {found[0] for link in links if (found := re.match(r"cflib://radio://[^/]*", link))}
    if len(dongles) > 1:
        raise FlightError("the vehicles are on several dongles; start a process for each dongle.")
    return links


@final
class SharedSocket:
    """The datagrams of an agent beside others in one process.

    Args:
        outer: to all that are not here.
        number: of the agent.
        inboxes: of all agents here, by number.
    """

    def __init__(self, outer: Datagrams, number: int, inboxes: Mapping[int, deque[bytes]]) -> None:
        """Receive nothing yet."""
        self._outer, self._own = outer, inboxes[number]
        self._others = {k: inbox for k, inbox in inboxes.items() if k != number}

    def send(self, datagram: bytes) -> None:
        """Send a datagram to all."""
        for inbox in self._others.values():
            inbox.append(datagram)
        self._outer.send(datagram)

    def receive(self) -> Iterator[bytes]:
        """Yield the datagrams that have arrived."""
        for _ in range(len(self._own)):
            yield self._own.popleft()
        # From a multicast group, those that came through memory come again.
        yield from (each for each in self._outer.receive() if sender_of(each) not in self._others)

    def skip(self) -> None:
        """Skip what arrived while nobody listened."""
        self._own.clear()
        self._outer.skip()

    def close(self) -> None:
        """Close the socket."""
        self._outer.close()


@final
class SharedRadioLink(Link):
    """A Crazyflie beside others on one dongle, which gets its share of the dongle's setpoints.

    A setpoint for which there is no share left is late: it is not sent, and the next one that is
    due has the newest input. Late setpoints are counted, and told in `notice`. When too many of the
    last hundred were late, the law is not trusted, and the vehicle hovers on the plan until it
    descends: its firmware holds the planned place, and needs few setpoints. Without a plan in
    flight.json it holds where it was.

    Args:
        link: to the vehicle.
        facts: the content of law.json.
        flight: the content of flight.json.
        clock: of the plan.
        vehicles: how many share the dongle.

    Attributes:
        total, late: how many setpoints of the law were due, and how many of them were late.
        hovers: whether the vehicle hovers on the plan.
    """

    watchdog: ClassVar[bool] = True

    def __init__(
        self,
        link: CflibLink,
        facts: Mapping[str, Any],
        flight: Mapping[str, Any],
        clock: PlanClock,
        vehicles: int,
    ) -> None:
        """Have the first setpoints free."""
        self._link, self._facts, self._flight, self._clock = link, facts, flight, clock
        self._vehicles, limits = vehicles, values_of(flight)
        self._carried, self._most = limits["radio_setpoints"], limits["late_setpoints"]
        self._credit, self._at = _BURST, time.monotonic()
        self.total, self.late, self.hovers = 0, 0, False
        self._last = deque[bool](maxlen=_WINDOW)
        self._x: list[float] = []
        self._stays: tuple[list[float], float] | None = None

    def read(self, wait: float) -> Reading | None:
        """Return the newest state that was not yet returned."""
        reading = self._link.read(wait)
        self._x = self._x if reading is None else reading.x
        return reading

    def send(self, u: Sequence[float]) -> None:
        """Send an input, or what holds the vehicle, if the dongle can carry it now."""
        due = self._is_due()
        if self.hovers:
            if due:
                self._link.hover(*self._hold())
            return
        late = not due
        if due:
            began = time.monotonic()
            self._link.send(u)
            # cflib waits while its queue to the dongle is full.
            late = time.monotonic() - began > self._facts["dt"] / self._clock.speed
        self._last.append(late)
        self.total, self.late = self.total + 1, self.late + late
        self._judge()

    def _is_due(self) -> bool:
        """Tell whether a setpoint may be sent now, and take it from the vehicle's share."""
        now, share = time.monotonic(), self._carried / self._vehicles * self._clock.speed
        self._credit = min(_BURST, self._credit + share * (now - self._at))
        self._at, due = now, self._credit >= 1.0
        self._credit -= due
        return due

    def _judge(self) -> None:
        count = sum(self._last)
        if len(self._last) < _WINDOW or not count:
            return
        why = f"the dongle carries {self._carried:g} a second for {self._vehicles} vehicles"
        if count > self._most * _WINDOW:
            self.hovers, self._stays = True, self._here()
            self.notice = f"{count} % of the setpoints are late ({why}); it hovers on the plan"
        elif not self.notice:
            self.notice = f"{count} % of the setpoints are late: {why}"

    def _here(self) -> tuple[list[float], float]:
        """Return the measured place (m) and yaw (rad)."""
        known = dict(zip(self._facts["states"], self._x, strict=False))
        place = [known.get(name, 0.0) for name in ("x", "y", "z")]
        return place, known.get("yaw", 0.0)

    def _hold(self) -> tuple[list[float], float]:
        """Return the planned place and the yaw; the place where it was, without a plan."""
        place, yaw = self._stays or self._here()
        if plan := self._flight.get("plan"):
            place = offsets_at(plan, self._clock.now or 0.0)[self._facts["agent"]]
        return place, yaw

    def level_descend(self) -> None:
        """Let the vehicle descend, at its share: a setpoint is good for half a second."""
        if self.late:
            self.notice = f"{self.late} of {self.total} setpoints were late"
        if self._is_due():
            self._link.level_descend()

    def close(self) -> None:
        """Let go of the link."""
        self._link.close()


def share(contexts: Sequence[AgentContext]) -> list[AgentContext]:
    """Return what agents of one process use: their letters pass through memory, and a radio."""
    inboxes = {each.wire.number: deque[bytes]() for each in contexts}
    shared = list[AgentContext]()
    for own in contexts:
        socket = SharedSocket(own.socket, own.wire.number, inboxes)
        if isinstance(own.link, CflibLink):
            radio = own.link, own.facts, own.flight, own.clock, len(contexts)
            own = own._replace(link=SharedRadioLink(*radio))
        shared.append(own._replace(socket=socket))
    return shared


def warn(dt: float, carried: float, vehicles: int) -> str:
    """Return a sentence where the vehicles want more setpoints than the dongle carries; else ""."""
    wanted = vehicles / dt
    if wanted <= carried * (1.0 + 1e-9):
        return ""
    return (
        f"{vehicles} vehicles want {wanted:g} setpoints a second, and the dongle carries "
        f"{carried:g}: {1.0 - carried / wanted:.0%} will be late. Fly fewer of them with a dongle, "
        "or use a larger `simulation.dt`."
    )


def fly_together(processes: Sequence[AgentProcess]) -> list[Fault]:
    """Fly agents, each by a thread, until all have ended; return why each did.

    An error of one thread ends that agent alone, whose vehicle is left to its own watchdog.
    """
    faults = [Fault.LINK] * len(processes)

    def interrupt(*_: object) -> None:
        for process in processes:
            process.interrupt()

    def fly(k: int) -> None:
        while not processes[k].over():
            processes[k].round()
        faults[k] = processes[k].end()

    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, interrupt)
    threads = [threading.Thread(target=fly, args=(k,)) for k in range(len(processes))]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    return faults
