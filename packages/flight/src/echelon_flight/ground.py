"""The ground station: hears every agent, starts the plan, says stop, and serves a page."""

import contextlib
import json
import math
import threading
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Final, final

from echelon_flight import FlightError
from echelon_flight.datagram_socket import DatagramSocket
from echelon_flight.page_server import Handler
from echelon_flight.parameters import DEFAULTS
from echelon_flight.pilot import NOBODY
from echelon_flight.supervisor import Fault
from echelon_flight.wire import ALL, GROUND, Drop, Opened, Report, Wire, is_letter, name_of

_NOTES: Final = 5
"""Of an agent that are shown at most: the last ones."""
_MODES: Final = ("ready", "flies", "descends")


@final
class Ground:
    """What the ground station knows and says; it hears by `round`, or from `listen` to `close`.

    Args:
        socket: to the agents.
        wire: that signs for the ground.
        agents: how many there are.
        watch: called with the number of an agent and each of its reports.
        parameters: the value of each, by name.

    Attributes:
        wire: likewise.
        problem: why the last start failed.
    """

    def __init__(
        self,
        socket: DatagramSocket,
        wire: Wire,
        agents: int,
        watch: Callable[[int, Report], None] = lambda number, report: None,
        parameters: Mapping[str, float] = DEFAULTS,
    ) -> None:
        """Hear nothing yet."""
        self._socket, self.wire, self._agents, self._watch = socket, wire, agents, watch
        self._again, self._silence = parameters["command_period"], parameters["silent_agent"]
        self._delay = parameters["start_delay"]
        self._reports, self._boots = dict[int, tuple[float, Report]](), dict[int, int]()
        self._notes: dict[int, dict[str, int]] = {k: {} for k in range(agents)}
        self._start: float | None = None
        self.problem, self._starting = "", threading.Lock()
        self._stopped, self._said, self._closed = False, -math.inf, False
        self._thread = threading.Thread(target=self._run, daemon=True)

    def listen(self) -> None:
        """Hear and answer by a thread of its own."""
        self._thread.start()

    def start(self, at: float) -> None:
        """Let the plan start at a time, s since 1970, once.

        Raises:
            FlightError: the number of the flight cannot be stored.
        """
        # A disk may be slow, and the button is pressed again meanwhile: that is no other flight.
        with self._starting:
            if self._start is None:
                self.wire.begin(self.wire.next_flight(time.time()))
                self._start = at

    def start_soon(self) -> None:
        """Let the plan start after the parameter `start_delay`, once.

        Raises:
            FlightError: the number of the flight cannot be stored.
        """
        self.start(time.time() + self._delay)

    def stop(self) -> None:
        """Let everybody level and descend, in whatever flight of which it knows."""
        # Above this flight and below the next one, in which the command no longer counts.
        self.wire.highest = self.wire.next_flight(time.time())
        self._stopped, self._said = True, -math.inf
        # What cannot be stored delays no stop.
        with contextlib.suppress(FlightError):
            self.wire.keep()

    def close(self) -> None:
        """End."""
        self._closed = True
        if self._thread.ident is not None:
            self._thread.join()
        self._socket.close()

    def report(self, number: int) -> Report | None:
        """Return the last report of an agent that is alive; None of one that is silent."""
        heard, report = self._reports.get(number, (-math.inf, None))
        return report if time.monotonic() - heard < self._silence else None

    @property
    def faults(self) -> dict[int, Fault]:
        """The fault of each agent that was ever heard."""
        return {k: _fault(report) for k, (_, report) in self._reports.items()}

    @property
    def ready(self) -> bool:
        """Whether all agents are alive, know their states, and have no fault."""
        reports = [self.report(k) for k in range(self._agents)]
        return all(x is not None and math.isfinite(x.x) and x.mode < 2 for x in reports)

    def _run(self) -> None:
        while not self._closed:
            self.round()
            time.sleep(0.01)

    def round(self) -> None:
        """Hear what has arrived, and say the commands that are due."""
        for datagram in self._socket.receive():
            # The ground has no time of the plan, by which letters are stamped.
            if is_letter(datagram):
                continue
            opened = self.wire.open(datagram, None, time.time())
            if not isinstance(opened, Drop):
                self._hear(opened)
        if time.monotonic() > self._said + self._again:
            self._said = time.monotonic()
            self._command(ALL)

    def _command(self, to: int) -> None:
        """Send what the buttons said to an agent that waits, or to all that fly."""
        if self._stopped:
            self._socket.send(self.wire.stop(time.time(), to))
        elif self._start is not None:
            self._socket.send(self.wire.start(time.time(), self._start, to))

    def _hear(self, opened: Opened) -> None:
        """Remember a report or a note."""
        sender = opened.sender
        if isinstance(opened.body, str):
            notes = self._notes.get(sender, {})
            if notes.get(opened.body) != opened.boot:
                notes.pop(opened.body, None)
            notes[opened.body] = opened.boot
        elif isinstance(opened.body, Report):
            self._boots[sender] = opened.boot
            self._reports[sender] = time.monotonic(), opened.body
            self._watch(sender, opened.body)
            if not opened.flight:
                self._command(sender)

    def state(self) -> dict[str, Any]:
        """Return what the page shows."""
        return {
            "started": self._start is not None,
            "stopped": self._stopped,
            "problem": self.problem,
            "agents": [self._row(k) for k in range(self._agents)],
            "dropped": [self._dropped(why, n) for why, n in [*self.wire.dropped.items()]],
        }

    def _dropped(self, why: Drop, count: int) -> str:
        who = self.wire.suspects.get(why)
        named = who in self._notes or who == GROUND
        return f"a datagram {f'of {name_of(who)} ' if named else ''}{why.value}: {count}"

    def _noted(self, number: int) -> list[str]:
        """Return the last notes of an agent since its process began, and of others that tried."""
        since = self._boots.get(number, 0)
        notes = [text for text, boot in [*self._notes[number].items()] if boot >= since]
        return notes[-_NOTES:]

    def _row(self, number: int) -> dict[str, Any]:
        heard, report = self._reports.get(number, (None, None))
        if heard is None or report is None:
            return {"agent": number, "mode": "not heard yet", "notes": self._noted(number)}
        silent = time.monotonic() - heard
        fault, counts = _fault(report), zip(Drop, report.dropped, strict=True)
        return {
            "agent": number,
            "mode": _MODES[min(report.mode, 2)] if silent < self._silence else "silent",
            "why": "" if fault is Fault.NONE else fault.sentence(report.amount),
            "notes": self._noted(number),
            "silent": round(silent, 1),
            "leader": None if report.leader == NOBODY else report.leader,
            "time": _number(report.time, 2),
            "place": [_number(x, 2) for x in (report.x, report.y, report.z)],
            "nearest": self._nearest(number),
            "heard": _number(report.heard, 3),
            "rate": _number(1.0 / report.step, 1) if report.step > 0.0 else None,
            "tick": _number(1e3 * report.tick, 2),
            "dropped": [f"{n} × {why.value}" for why, n in counts if n],
            **_vehicle(report) | _guarantee(report),
        }

    def _nearest(self, number: int) -> tuple[float | None, int] | None:
        """Return how far the nearest agent is by the last reports, m, and who; None for nobody."""
        places = {k: (r.x, r.y, r.z) for k in range(self._agents) if (r := self.report(k))}
        own = places.pop(number, None)
        away = [] if own is None else [(_apart(own, there), k) for k, there in places.items()]
        far, who = min(away, default=(math.inf, NOBODY))
        return (_number(far, 3), who) if math.isfinite(far) else None


def _apart(a: tuple[float, ...], b: tuple[float, ...]) -> float:
    """Return a distance; infinite where a place is not known. An axis that neither has is 0."""
    gaps = [x - y for x, y in zip(a, b, strict=True) if not (math.isnan(x) and math.isnan(y))]
    far = math.hypot(*gaps) if gaps else math.nan
    return far if math.isfinite(far) else math.inf


def _fault(report: Report) -> Fault:
    return list(Fault)[report.fault] if report.fault < len(Fault) else Fault.NONE


def _vehicle(report: Report) -> dict[str, Any]:
    """Return the link and what comes of it."""
    battery = _number(report.battery, 2)
    return {"link": report.link, "late": report.late, "battery": battery}


def _guarantee(report: Report) -> dict[str, Any]:
    """Return whether the conditions of the guarantee are kept, in words."""
    broken = math.isfinite(report.lost)
    text = f"not watched: {report.why}" if math.isnan(report.lost) else "kept"
    text = f"lost at {report.lost:.2f} s: {report.why}" if broken else text
    return {"guarantee": text, "broken": broken}


def _number(value: float, digits: int) -> float | None:
    """Return a number that JSON has; None for others."""
    return round(value, digits) if math.isfinite(value) else None


def page_of(ground: Ground) -> type[Handler]:
    """Return the handler of the page of a ground station."""

    class Page(Handler):
        page = Path(__file__).with_name("ground.html").read_bytes()

        def do_GET(self) -> None:
            """Send the page, or what it shows."""
            if self.path != "/state":
                super().do_GET()
            elif self.allowed():
                state = ground.state() | {"stops_only": bool(self.secret)}
                self.send(json.dumps(state).encode(), "application/json")

        def do_POST(self) -> None:
            """Start the plan, or stop everybody; from another machine stop alone."""
            if not self.allowed():
                return
            actions = {"/stop": ground.stop} | (
                {} if self.secret else {"/start": ground.start_soon}
            )
            action = actions.get(self.path)
            if action is not None:
                try:
                    action()
                except FlightError as error:
                    ground.problem = str(error)
            self.send(b"\n", "text/plain", 404 if action is None else 200)

    return Page
