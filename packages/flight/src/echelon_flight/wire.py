"""What agents and the ground send each other: one signed datagram each, dropped if in doubt.

Little-endian: version, kind, formation (8 bytes), sender, its boot (ms since 1970), number of the
flight, number of the datagram, stamp (s), body, and 16 bytes of HMAC-SHA256. Letters are stamped
with the time of the plan; commands and reports, which come before there is one, with that since
1970. The ground chooses the number of a flight. A process on the ground draws a challenge, sends it
in its reports, and obeys commands that repeat it: nobody can have recorded them earlier.
"""

import enum
import hmac
import math
import secrets
import struct
from collections import Counter
from collections.abc import Callable
from typing import Final, NamedTuple, final

from echelon_flight import FlightError
from echelon_flight.parameters import DEFAULTS

VERSION: Final = 4
GROUND: Final = 0xFFFF
"""The number of the ground station as a sender."""
ALL: Final = 0xFFFE
"""Whom a command is for that answers no challenge."""
LONGEST: Final = 480
"""Bytes, which no network splits; 200 suffice for four outputs."""
LARGEST: Final = 1e7
"""Of a number of a letter."""

_HEAD: Final = struct.Struct("<BB8sHQQId")
_SIGNATURE: Final = 16


class DatagramKind(enum.IntEnum):
    """What a datagram is."""

    LETTER = 1
    START = 2
    STOP = 3
    REPORT = 4
    NOTE = 5


class Drop(enum.Enum):
    """Why a datagram is not used."""

    LENGTH = "has a length that no datagram of this formation has"
    VERSION = "is of another version of the protocol"
    FORMATION = "is of another formation"
    SIGNATURE = "is signed with another key"
    NOT_FINITE = "has a number that is not finite"
    TOO_LARGE = "has a number larger than 1e7"
    CLOCK = "has a time stamp that is farther from this clock than `stamp_difference` allows"
    OLD = "is not newer than the last one from its sender"
    SENDER = "is from a sender that this process does not listen to"
    AHEAD = "has a time stamp ahead of this clock"
    PACKET = "has no packet of a leader"
    EARLY = "came before the start"
    START = "gives the start by a clock farther from this one than `start_difference` allows"
    FLIGHT = "is of another flight"
    CHALLENGE = "answers an earlier process of this agent"


class Message(NamedTuple):
    """What an agent sends to those that hear it.

    Attributes:
        sender: its number.
        row: its numbers, as its law returns them; the first one is the time of the plan, s.
    """

    sender: int
    row: tuple[float, ...]

    @property
    def time(self) -> float:
        """When it was sent, a time of the plan, s."""
        return self.row[0]


class Report(NamedTuple):
    """What an agent says to the ground.

    Attributes:
        mode: 0 waits, 1 flies, 2 descends.
        fault: the number of its fault.
        leader: whose packet it follows; its own number if it leads, 0xFFFF before any.
        amount: that belongs to the fault.
        time: of the plan, s; NaN before there is one.
        x, y, z: position, m.
        heard: age of the oldest of the newest letters, s.
        tick: the longest of the last ticks, s.
        step: the median of the last steps between states, s.
        battery: share that is left; NaN if it is not known.
        dropped: how many datagrams, in the order of `Drop`.
        lost: when the first condition of the guarantee was broken, s of the plan; infinite while
            all are kept, NaN where there is nothing to watch.
        late: how many setpoints were late.
        why: which condition was broken.
        link: the address of the vehicle; of both texts 48 bytes are sent.
    """

    mode: int
    fault: int
    leader: int
    amount: float
    time: float
    x: float
    y: float
    z: float
    heard: float
    tick: float
    step: float
    battery: float
    dropped: tuple[int, ...]
    lost: float = math.nan
    late: int = 0
    why: str = ""
    link: str = ""


class Opened(NamedTuple):
    """A datagram that is used: its kind, sender, its boot, flight and stamp (s), and its body.

    A start that is for others has no body.
    """

    kind: DatagramKind
    sender: int
    boot: int
    flight: int
    stamp: float
    body: "Message | Report | float | str | None"


_FIELDS: Final = Report._fields.index("dropped")
_REPORT: Final = struct.Struct(f"<BBHdd{_FIELDS - 5}f{len(Drop)}IdI48s48s")
_START: Final = struct.Struct("<HQd")
_STOP: Final = struct.Struct("<HQ")
_KNOWN: Final = struct.Struct("<QQ")
"""Before a report: the sender's challenge, and the highest flight number it has used."""
_NOTE: Final = struct.Struct("<240s")


@final
class Wire:
    """Writes and reads the datagrams of one process.

    Args:
        key: of the formation.
        formation: its mark, in hexadecimal digits.
        number: of the agent, or `GROUND`.
        agents: how many there are.
        size: how many numbers a letter has, its time included.
        boot: when the process began, ms since 1970, so that its numbers are no replay of the last
            process's.
        highest: flight number that a process of this number has used.
        store: keeps a flight number.
        apart: s; clocks that differ by more are wrong.

    Attributes:
        flight: the number of the flight; 0 before it begins.
        highest: flight number of which it knows.
        challenge: drawn by this process.
        challenges: of the others, by their newest reports.
        dropped: how many datagrams, by reason.
        suspects: who last sent one, by reason, as the datagram says.
    """

    def __init__(
        self,
        key: bytes,
        formation: str,
        number: int,
        agents: int,
        size: int,
        boot: int,
        highest: int = 0,
        store: Callable[[int], object] = lambda number: None,
        apart: float = DEFAULTS["stamp_difference"],
    ) -> None:
        """Begin to count."""
        self._key, self._formation = key, bytes.fromhex(formation)[:8]
        self.number, self.boot, self._agents, self._count = number, boot, agents, 0
        self._letter, self._store = struct.Struct(f"<{size - 1}d"), store
        self._apart = apart
        self.flight, self.highest = 0, highest
        self.challenge, self.challenges = secrets.randbits(64), dict[int, int]()
        bodies = {
            DatagramKind.LETTER: self._letter,
            DatagramKind.START: _START,
            DatagramKind.STOP: _STOP,
            DatagramKind.NOTE: _NOTE,
        }
        around = _HEAD.size + _SIGNATURE
        self._lengths = {kind: around + body.size for kind, body in bodies.items()}
        self._lengths[DatagramKind.REPORT] = around + _KNOWN.size + _REPORT.size
        self._newest = dict[tuple[int, DatagramKind], tuple[int, int]]()
        self.dropped, self.suspects = Counter[Drop](), dict[Drop, int]()
        if max(self._lengths.values()) > LONGEST:
            raise FlightError(
                f"a letter of {size} numbers has {max(self._lengths.values())} bytes, and may have "
                f"{LONGEST}."
            )

    def begin(self, flight: int) -> None:
        """Store the number of a flight, and take part in it.

        Raises:
            FlightError: it cannot be stored.
        """
        if flight > self.highest:
            self._store(flight)
        self.flight, self.highest = flight, max(flight, self.highest)

    def keep(self) -> None:
        """Store the highest flight number of which it knows.

        Raises:
            FlightError: it cannot be stored.
        """
        self._store(self.highest)

    def next_flight(self, wall: float) -> int:
        """Return a number above all flights of which it knows, at a time (s since 1970)."""
        return max(int(1e3 * wall), self.highest + 1)

    # ---- writing ---------------------------------------------------------------------------------

    def letter(self, letter: Message) -> bytes:
        """Return the datagram of a letter."""
        return self._sign(DatagramKind.LETTER, letter.time, self._letter.pack(*letter.row[1:]))

    def start(self, wall: float, at: float, to: int = ALL) -> bytes:
        """Return the command that the plan starts at a time, both in s since 1970, to an agent."""
        body = _START.pack(to, self.challenges.get(to, 0), at)
        return self._sign(DatagramKind.START, wall, body)

    def stop(self, wall: float, to: int = ALL) -> bytes:
        """Return the command that everybody levels and descends, whatever flight they are in."""
        body = _STOP.pack(to, self.challenges.get(to, 0))
        return self._sign(DatagramKind.STOP, wall, body, self.highest)

    def report(self, wall: float, report: Report) -> bytes:
        """Return the datagram of a report."""
        body = _KNOWN.pack(self.challenge, self.highest)
        *numbers, dropped, lost, late, why, link = report
        texts = why.encode(), link.encode()
        body += _REPORT.pack(*numbers, *dropped, lost, min(late, 0xFFFFFFFF), *texts)
        return self._sign(DatagramKind.REPORT, wall, body)

    def note(self, wall: float, sentence: str) -> bytes:
        """Return the datagram of a sentence to the ground, of which 240 bytes are sent."""
        return self._sign(DatagramKind.NOTE, wall, _NOTE.pack(sentence.encode()))

    def _sign(
        self, kind: DatagramKind, stamp: float, body: bytes, flight: int | None = None
    ) -> bytes:
        self._count += 1
        number = self.flight if flight is None else flight
        who = VERSION, kind, self._formation, self.number, self.boot, number, self._count
        text = _HEAD.pack(*who, stamp) + body
        return text + hmac.digest(self._key, text, "sha256")[:_SIGNATURE]

    # ---- reading ---------------------------------------------------------------------------------

    def open(self, datagram: bytes, plan: float | None, wall: float) -> Opened | Drop:
        """Return what a datagram says, or why it is not used; it never raises.

        Args:
            datagram: as it was received.
            plan: the time of the plan, s; None before there is one, when no letter is used.
            wall: s since 1970.
        """
        opened = self._open(datagram, plan, wall)
        if isinstance(opened, Drop):
            self.drop(opened, datagram)
        return opened

    def drop(self, why: Drop, datagram: bytes) -> None:
        """Count a datagram that is not used."""
        self.dropped[why] += 1
        sender = sender_of(datagram)
        if sender is not None:
            self.suspects[why] = sender

    @property
    def counts(self) -> tuple[int, ...]:
        """How many datagrams were not used, in the order of `Drop`."""
        return tuple(min(self.dropped[why], 0xFFFFFFFF) for why in Drop)

    def _open(self, datagram: bytes, plan: float | None, wall: float) -> Opened | Drop:
        if len(datagram) not in self._lengths.values():
            return Drop.LENGTH
        version, kind, formation, sender, boot, flight, count, stamp = _HEAD.unpack_from(datagram)
        if version != VERSION:
            return Drop.VERSION
        if self._lengths.get(kind) != len(datagram):
            return Drop.LENGTH
        if formation != self._formation:
            return Drop.FORMATION
        text, signature = datagram[:-_SIGNATURE], datagram[-_SIGNATURE:]
        if not hmac.compare_digest(hmac.digest(self._key, text, "sha256")[:_SIGNATURE], signature):
            return Drop.SIGNATURE
        # From here on it was written by somebody who has the key.
        # Only the ground starts a plan, and it has no letters; anybody says stop.
        ground = sender == GROUND and kind in (DatagramKind.START, DatagramKind.STOP)
        if not (ground or sender < self._agents and kind != DatagramKind.START):
            return Drop.SENDER
        kind = DatagramKind(kind)
        if self._is_foreign(kind, flight):
            return Drop.FLIGHT
        body = self._body(kind, sender, stamp, text[_HEAD.size :])
        if isinstance(body, Drop):
            return body
        clock = plan if kind is DatagramKind.LETTER else wall
        if clock is None:
            return Drop.EARLY
        # A process whose clock was once far ahead would be believed for ever by its boot.
        # A stop is known to be new by its flight or challenge, and counts whatever the clocks say.
        apart = self._apart
        wrong = abs(stamp - clock) > apart or boot > 1e3 * (wall + apart)
        if wrong and kind is not DatagramKind.STOP:
            return Drop.CLOCK
        opened = Opened(kind, sender, boot, flight, stamp, body)
        # Own datagrams return from a multicast group, and are newer than those of a process that
        # was started before with the same number. A start for others is not remembered: it may be
        # of any time.
        own = (sender, boot) == (self.number, self.boot)
        if own or kind is DatagramKind.START and body is None:
            return opened
        if (boot, count) <= self._newest.get((sender, kind), (0, 0)):
            return Drop.OLD
        self._newest[sender, kind] = boot, count
        if kind is DatagramKind.REPORT:
            self.challenges[sender], known = _KNOWN.unpack_from(text, _HEAD.size)
            flight = max(flight, known)
        if kind is DatagramKind.STOP or self.number == GROUND:
            self.highest = max(self.highest, flight)
        return opened

    def _is_foreign(self, kind: DatagramKind, flight: int) -> bool:
        """Tell whether a datagram is of a flight that does not count here."""
        if kind is DatagramKind.STOP:
            return flight < (self.flight or self.highest)
        if kind is DatagramKind.START and not self.flight:
            # A process that was restarted comes back to the flight whose number it has stored.
            return flight < self.highest
        if kind in (DatagramKind.START, DatagramKind.LETTER):
            return self.flight not in (0, flight)
        # The ground sees who waits, and who began a later flight.
        return self.number == GROUND and 0 < flight < self.flight

    def _body(
        self, kind: DatagramKind, sender: int, stamp: float, text: bytes
    ) -> Drop | Message | Report | float | str | None:
        if not math.isfinite(stamp):
            return Drop.NOT_FINITE
        if kind in (DatagramKind.START, DatagramKind.STOP):
            return self._read_command(kind, text)
        if kind is DatagramKind.NOTE:
            return _text(text)
        if kind is DatagramKind.REPORT:
            numbers = _REPORT.unpack_from(text, _KNOWN.size)
            *dropped, lost, late, why, link = numbers[_FIELDS:]
            texts = {"why": _text(why), "link": _text(link)}
            rest = {"dropped": tuple(dropped), "lost": lost, "late": late, **texts}
            return Report(*numbers[:_FIELDS], **rest)
        return self._read_letter(sender, stamp, text)

    def _read_command(self, kind: DatagramKind, text: bytes) -> Drop | float | None:
        """Return when a plan starts, if a process on the ground may believe it; None for others."""
        to, challenge, *rest = (_START if kind is DatagramKind.START else _STOP).unpack(text)
        if not all(map(math.isfinite, rest)):
            return Drop.NOT_FINITE
        own, start = to == self.number, kind is DatagramKind.START
        if not start and (self.flight or self.number == GROUND):
            # In a flight a stop for anybody counts for all.
            return None
        if own and challenge != self.challenge:
            return Drop.CHALLENGE
        if start:
            return rest[0] if own else None
        return None if own else Drop.EARLY

    def _read_letter(self, sender: int, stamp: float, text: bytes) -> Message | Drop:
        numbers = self._letter.unpack(text)
        if not all(map(math.isfinite, numbers)):
            return Drop.NOT_FINITE
        if max(map(abs, numbers), default=0.0) > LARGEST:
            return Drop.TOO_LARGE
        return Message(sender, (stamp, *numbers))


def _text(padded: bytes) -> str:
    return padded.rstrip(b"\0").decode(errors="ignore")


def sender_of(datagram: bytes) -> int | None:
    """Return who sent a datagram, as it says itself."""
    return _HEAD.unpack_from(datagram)[3] if len(datagram) >= _HEAD.size else None


def is_letter(datagram: bytes) -> bool:
    """Tell whether a datagram is a letter between agents, as it says itself."""
    return datagram[1:2] == bytes([DatagramKind.LETTER])


def name_of(sender: int | None) -> str:
    """Return the name of a sender in sentences."""
    return "the ground" if sender == GROUND else f"agent {sender}"
