"""The process of one agent: its loop from states and letters to inputs and letters."""

import contextlib
import math
import os
import signal
import sys
import time
from collections import deque
from collections.abc import Mapping
from types import ModuleType
from typing import Any, Final, NamedTuple, final

from echelon_flight import FlightError
from echelon_flight.coverage_watch import CoverageWatch
from echelon_flight.datagram_socket import Datagrams
from echelon_flight.flight_log import FlightLog, Tick
from echelon_flight.links import Link, Reading
from echelon_flight.parameters import values_of
from echelon_flight.pilot import Pilot
from echelon_flight.supervisor import Fault, Fence, Supervisor
from echelon_flight.wire import (
    DatagramKind,
    Drop,
    Message,
    Opened,
    Report,
    Wire,
    name_of,
    sender_of,
)

_TWIN: Final = 0.5
"""s after its own beginning from which on nobody else may have its number."""
_TOLD: Final = (
    *(Drop.VERSION, Drop.FORMATION, Drop.SIGNATURE, Drop.CLOCK, Drop.AHEAD, Drop.START),
    Drop.FLIGHT,
)
"""Reasons that somebody on the ground can remove."""


@final
class PlanClock:
    """Times of the plan; none before `start`.

    Args:
        speed: seconds of the plan in one of this machine: 1 in the air; less lets a slow machine
            keep up with simulated vehicles.
    """

    def __init__(self, speed: float = 1.0) -> None:
        """Wait for the start."""
        self.speed, self._origin = speed, None

    _origin: float | None

    def start(self, at: float) -> None:
        """Let the plan start at a time, s since 1970. The first command counts.

        Later steps of this machine's clock change nothing.
        """
        if self._origin is None:
            self._origin = time.monotonic() + at - time.time()

    @property
    def started(self) -> bool:
        """Whether the time of the start is known; it may lie ahead."""
        return self._origin is not None

    def at(self, moment: float) -> float | None:
        """Return the time of the plan (s) at one of `time.monotonic`; None before the command."""
        return None if self._origin is None else (moment - self._origin) * self.speed

    @property
    def now(self) -> float | None:
        """The time of the plan, s."""
        return self.at(time.monotonic())


class AgentContext(NamedTuple):
    """What one agent's process uses: its law, its vehicle, and the others.

    Attributes:
        law: the module law.py.
        facts: the content of law.json.
        flight: the content of flight.json.
        link: to the vehicle.
        socket: to the others.
        wire: that signs for the agent.
        clock: of the plan.
        log: that is written; None where none is.
        address: of the link, as the ground station shows it.
    """

    law: ModuleType
    facts: Mapping[str, Any]
    flight: Mapping[str, Any]
    link: Link
    socket: Datagrams
    wire: Wire
    clock: PlanClock
    log: FlightLog | None = None
    address: str = ""


@final
class AgentProcess:
    """Flies one vehicle.

    Args:
        context: what it uses.
        seconds: of the plan, after which it descends.

    Attributes:
        context: likewise.
        supervisor: that has the last word.
        pilot: that runs the law.
        watch: of the conditions of the guarantee.
    """

    def __init__(self, context: AgentContext, seconds: float = math.inf) -> None:
        """Wait for a state and for the start."""
        flight = context.flight
        self.context, self._seconds, self._dt = context, seconds, flight["dt"]
        self._limits = values_of(flight)
        self.supervisor = Supervisor(flight, Fence(**flight["fence"]))
        leadership = flight["leadership"] or {"backups": ()}
        ahead = self._limits["letter_ahead"]
        self.pilot = Pilot(context.law, context.facts, leadership["backups"], ahead)
        self.watch = CoverageWatch(context.facts)
        self._reading: Reading | None = None
        self._began, self._ticked, self._fell = time.monotonic(), -math.inf, math.inf
        self._due, self._fault_logged = 0.0, False
        self._sent, self._reported, self._signals = -math.inf, -math.inf, 0
        self._moved = self._heard_at = self._began
        self._said, self._notes = set[str](), deque[str](maxlen=10)
        self._ticks, self._longest = deque[float](maxlen=100_000), 0.0

    def run(self) -> Fault:
        """Fly until the vehicle is down again, or until a signal where it never flew."""
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, lambda *_: self.interrupt())
        while not self.over():
            self.round()
        return self.end()

    def end(self) -> Fault:
        """Report a last time, let go of the vehicle, say why, and return that."""
        self.report(time.monotonic())
        self.context.link.close()
        if self.supervisor.fault is Fault.STOP:
            # Not while it descends: a disk may take long.
            with contextlib.suppress(FlightError):
                self.context.wire.keep()
        self._say(f"{self.supervisor.sentence}; {self._summary()}")
        if self.context.log is not None:
            self.context.log.close()
        return self.supervisor.fault

    def interrupt(self) -> None:
        """Take a signal: the first lets the vehicle descend, another one ends the process."""
        self._signals += 1

    def over(self) -> bool:
        """Tell whether nothing is left to do."""
        if self._signals:
            self.supervisor.trip(Fault.SIGNAL)
        if self.supervisor.fault is Fault.NONE:
            return False
        now = time.monotonic()
        self._fell = min(self._fell, now)
        # As far as its states say: one that is not heard may still fly.
        speed, limits = self.context.clock.speed, self._limits
        rests = self._heard_at - self._moved > limits["rest_time"] / speed
        late = now - self._fell > limits["longest_descent"] / speed
        again = self._signals > (self.supervisor.fault is Fault.SIGNAL)
        return again or self._ticked < 0.0 or rests or late

    def round(self) -> None:
        """Do what is to be done when a state arrives, or none for a while."""
        reading = self._read()
        now = time.monotonic()
        for datagram in self.context.socket.receive():
            self._hear(datagram)
        if reading is not None and all(map(math.isfinite, reading.x)):
            self._reading, self._heard_at = reading, now
            speed = math.hypot(*(reading.x[k] for k in self.context.flight["velocity"]))
            self._moved = now if speed > self._limits["rest_speed"] else self._moved
            self._tick(reading)
        if self._ticked >= 0.0 and self._reading is not None:
            self.supervisor.look((now - self._reading.time) * self.context.clock.speed)
        if self.supervisor.fault is not Fault.NONE:
            self._descend()
        if now > self._reported + self._limits["report_period"]:
            self.report(now)

    def _read(self) -> Reading | None:
        try:
            return self.context.link.read(0.5 * self._dt / self.context.clock.speed)
        except FlightError as error:
            self._fail(error)
            return None

    def _fail(self, error: FlightError) -> None:
        self.supervisor.trip(Fault.LINK)
        self._say(str(error).rstrip("."))
        time.sleep(0.5 * self._dt)

    # ---- flying ----------------------------------------------------------------------------------

    def _tick(self, reading: Reading) -> None:
        """Let the law act on a state, if one of its periods has passed."""
        t, supervisor = self.context.clock.at(reading.time), self.supervisor
        if t is None or t < max(0.0, self._due - 0.5 * self._dt):
            return
        missed = self._missed(t)
        supervisor.judge(reading, t)
        if t > self._seconds:
            supervisor.trip(Fault.END)
        self._ticked = t
        if supervisor.fault is not Fault.NONE:
            self._log(t, reading)
            return
        # Of this thread alone: how long others on the machine took is seen in the states' ages.
        began, wall = time.thread_time(), time.perf_counter()
        for k in range(missed, 0, -1):
            self.pilot.tick(t - k * self._dt, reading.x)
        result = self.pilot.tick(t, reading.x)
        self._ticks.append(time.perf_counter() - wall)
        self._longest = max(self._longest, self._ticks[-1])
        supervisor.spend((time.thread_time() - began) * self.context.clock.speed / (1 + missed))
        supervisor.check(result.u, result.valid)
        flies = supervisor.fault is Fault.NONE
        if flies and self.watch.look(t, reading.x, result.u):
            lost = f"a condition of the guarantee is broken at {t:.2f} s: {self.watch.why}"
            self._say(lost, "guarantee")
        said = flies and self._act(result.u, result.letter, t)
        self._log(t, reading, tuple(result.u) if flies else (), missed, said)

    def _log(
        self,
        t: float,
        reading: Reading,
        u: tuple[float, ...] = (),
        missed: int = 0,
        sent: bool = False,
    ) -> None:
        log, supervisor = self.context.log, self.supervisor
        if log is None:
            return
        fault = 0 if supervisor.fault is Fault.NONE else list(Fault).index(supervisor.fault)
        self._fault_logged = fault > 0
        age = (time.monotonic() - reading.time) * self.context.clock.speed
        battery = math.nan if reading.battery is None else reading.battery
        state = missed, sent, 1 + (fault > 0), fault, supervisor.amount, self.pilot.leader, age
        log.tick(Tick(t, tuple(reading.x), u, *state, self._ticks[-1] if u else 0.0, battery))
        if log.problem:
            self._say(log.problem, "log")

    def _missed(self, t: float) -> int:
        """Return how many ticks are made up for at a time (s): the law counts its time by them.

        A state that is up to a period late misses none, and does not make the next one early.
        """
        missed = max(0, int((t - self._due) / self._dt))
        # After a longer gap the law goes on from where it was.
        if missed > self._limits["made_up_ticks"]:
            self._due = t + self._dt
            return 0
        self._due += (1 + missed) * self._dt
        return missed

    def _act(self, u: list[float], letter: Message | None, t: float) -> bool:
        """Send an input, and a letter where one is due; return whether one was."""
        try:
            self.context.link.send(u)
        except FlightError as error:
            self._fail(error)
        if self.context.link.notice:
            self._say(self.context.link.notice)
        # At the network's rate, whatever the ticks that were skipped.
        due = math.floor(t / self.context.facts["network"]["period"] + 1e-6)
        said = letter is not None and due > self._sent
        if letter is not None and said:
            self._sent = due
            self.context.socket.send(self.context.wire.letter(letter))
        if abs(self.supervisor.step - self._dt) > 0.1 * self._dt:
            step = f"{self.supervisor.step:.3g} s, and the law's period is {self._dt:g} s"
            self._say(f"states arrive every {step}", "period")
        return said

    def _descend(self) -> None:
        if not self._fault_logged and self._reading is not None:
            # No state may come any more.
            self._log(self.context.clock.now or math.nan, self._reading)
        self._say(f"{self.supervisor.sentence}; the vehicle levels and descends", "fault")
        try:
            if self._ticked >= 0.0:
                self.context.link.level_descend()
            if self.context.link.notice:
                self._say(self.context.link.notice)
        except FlightError as error:
            self._fail(error)

    # ---- others ----------------------------------------------------------------------------------

    def _hear(self, datagram: bytes) -> None:
        wire, clock = self.context.wire, self.context.clock
        opened = wire.open(datagram, clock.now, time.time())
        why = opened if isinstance(opened, Drop) else self._use(opened)
        if why is None:
            return
        if not isinstance(opened, Drop):
            wire.drop(why, datagram)
        # A process that was held up finds one or two of them old.
        if why in _TOLD and (why is not Drop.START or wire.dropped[why] > 2):
            self._say(f"a datagram of {name_of(sender_of(datagram))} {why.value}")

    def _use(self, opened: Opened) -> Drop | None:
        """Use what a datagram says, or return why it is not used."""
        if opened.kind is DatagramKind.NOTE:
            return None
        if opened.sender == self.context.wire.number:
            self._meet(opened)
        elif isinstance(opened.body, Message):
            return self._receive(opened.body, self.context.clock.now or 0.0)
        elif opened.kind is DatagramKind.START and isinstance(opened.body, float):
            return self._take_start(opened.body, opened.flight, time.time() - opened.stamp)
        elif opened.kind is DatagramKind.STOP:
            self.supervisor.trip(Fault.STOP)
        return None

    def _receive(self, letter: Message, now: float) -> Drop | None:
        """Use a letter at a time of the plan (s), or return why it is not used."""
        why = self.pilot.box.receive(letter, now)
        if why is None and self.context.log is not None:
            self.context.log.receive(letter.sender, now, letter.row)
        return why

    def _take_start(self, at: float, flight: int, late: float) -> Drop | None:
        """Let the plan of a flight start at a time (s since 1970) of a clock beside this one."""
        clock, weather = self.context.clock, self.context.flight["weather"]
        if not clock.started:
            differ = self._limits["start_difference"]
            if not -differ < late < differ + (weather["delay"] + weather["jitter"]) / clock.speed:
                return Drop.START
            try:
                self.context.wire.begin(flight)
            except FlightError as error:
                self._say(str(error).rstrip("."))
                return None
            clock.start(at)
            self._begin_log(at)
        return None

    def _begin_log(self, at: float) -> None:
        """Open the log, on the ground or after a restart; where that fails, say so once."""
        log, wire = self.context.log, self.context.wire
        if log is not None:
            log.begin(wire.flight, wire.boot, {"start": at, "wall": time.time()})
            if log.problem:
                self._say(log.problem, "log")

    def _meet(self, opened: Opened) -> None:
        """Judge a datagram with the agent's own number."""
        # What a process before this one sent may still be on its way. Letters have another clock.
        boot, alive = self.context.wire.boot, 1e-3 * self.context.wire.boot + _TWIN
        if opened.flight != self.context.wire.flight:
            return
        if opened.boot != boot and opened.kind is not DatagramKind.LETTER and opened.stamp > alive:
            self.supervisor.trip(Fault.TWIN, opened.sender)
            if self.supervisor.fault is not Fault.TWIN:
                self._say(Fault.TWIN.sentence(opened.sender))

    def report(self, now: float) -> None:
        """Tell the ground, at a time of the monotonic clock (s)."""
        self._reported = now
        supervisor, clock, flight = self.supervisor, self.context.clock, self.context.flight
        reading, t = self._reading, clock.at(now)
        place = [] if reading is None else [reading.x[k] for k in flight["position"]]
        x, y, z = (place + [math.nan] * 3)[:3]
        battery = None if reading is None else reading.battery
        report = Report(
            mode=2 if supervisor.fault is not Fault.NONE else int(self._ticked >= 0.0),
            fault=list(Fault).index(supervisor.fault),
            leader=self.pilot.leader,
            amount=supervisor.amount,
            time=math.nan if t is None else t,
            x=x,
            y=y,
            z=z,
            heard=max(self.pilot.box.ages(t or 0.0), default=0.0),
            tick=self._longest,
            step=supervisor.step,
            battery=math.nan if battery is None else battery,
            dropped=self.context.wire.counts,
            lost=self.watch.lost,
            late=self.context.link.late,
            why=self.watch.why,
            link=self.context.address,
        )
        self._longest = 0.0
        self.context.socket.send(self.context.wire.report(time.time(), report))
        if self._notes:
            # One after the other, again and again: some are lost.
            self._notes.rotate()
            self.context.socket.send(self.context.wire.note(time.time(), self._notes[0]))

    def _say(self, sentence: str, key: str | None = None) -> None:
        """Print a sentence once."""
        if (key or sentence) not in self._said:
            self._said.add(key or sentence)
            # At once, since several processes write to one terminal.
            sys.stderr.write(f"agent {self.context.wire.number}: {sentence}.\n")
            sys.stderr.flush()
            if self.context.log is not None:
                self.context.log.say(self.context.clock.now, sentence)
            # The page has places of their own for these.
            if key not in ("fault", "guarantee"):
                self._notes.append(sentence)

    def _summary(self) -> str:
        if not self._ticks:
            return "it never flew"
        ticks = sorted(self._ticks)
        middle, late = ticks[len(ticks) // 2], ticks[99 * len(ticks) // 100]
        used = os.times()
        return (
            f"{len(ticks)} ticks, median {1e3 * middle:.2f} ms, 99th percentile "
            f"{1e3 * late:.2f} ms, {used.user + used.system:.2f} s of a processor"
        )
