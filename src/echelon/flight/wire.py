"""What agents and the ground send each other: one signed datagram each, dropped if in doubt.

Little-endian: version, kind, formation (8 bytes), sender, its boot (ms since 1970), number of the
datagram, stamp (s), body, and 16 bytes of HMAC-SHA256. Letters are stamped with the time of the
plan; commands and reports, which come before there is one, with that since 1970.
"""

import enum
import hmac
import math
import stat
import struct
import time
from collections import Counter
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, Final, NamedTuple, final

from echelon.core.errors import FlightError
from echelon.core.packet import Packet

VERSION: Final = 1
GROUND: Final = 0xFFFF
"""The number of the ground station as a sender."""
LONGEST: Final = 480
"""Bytes, which no network splits; 200 suffice for four outputs."""
LARGEST: Final = 1e6
"""Of a deviation."""
APART: Final = 1.0
"""s; clocks that differ by more are wrong."""

_HEAD: Final = struct.Struct("<BB8sHQId")
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
    TOO_LARGE = "has a deviation larger than 1e6"
    CLOCK = "has a time stamp that differs from this clock by more than 1 s"
    OLD = "is not newer than the last one from its sender"
    SENDER = "is from a sender that this process does not listen to"
    AHEAD = "has a time stamp ahead of this clock"
    PACKET = "has no packet of a leader"
    EARLY = "came before the start"
    START = "gives the start by a clock that differs from this one by more than 0.1 s"


class Letter(NamedTuple):
    """What an agent sends to those that hear it.

    Attributes:
        sender: its number.
        time: of the plan, s.
        hops: to a leader.
        value: (s,) its deviation from where it expects the leader, or its signal.
        packet: the newest of a leader; None before it has one.
    """

    sender: int
    time: float
    hops: int
    value: tuple[float, ...]
    packet: Packet | None


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


class Opened(NamedTuple):
    """A datagram that is used: its kind, who sent it since when, its stamp (s), and its body."""

    kind: DatagramKind
    sender: int
    boot: int
    stamp: float
    body: "Letter | Report | float | str | None"


_FIELDS: Final = len(Report._fields) - 1
_REPORT: Final = struct.Struct(f"<BBHdd{_FIELDS - 5}f{len(Drop)}I")
_START: Final = struct.Struct("<d")
_NOTE: Final = struct.Struct("<240s")


def require_key(file: Path | None) -> Path:
    """Return the key file.

    Raises:
        FlightError: none is named.
    """
    if file is None:
        raise FlightError("give `--key` with the key file, which all agents and the ground share.")
    return file


def read_key(file: Path) -> bytes:
    """Return the key of a formation, which its owner alone may read.

    Raises:
        FlightError: there is none, others may read it, or it is too short.
    """
    try:
        mode, key = file.stat().st_mode, file.read_bytes()
    except OSError as error:
        raise FlightError(
            f"the key file `{file}` cannot be read ({(error.strerror or '').lower()}); make one "
            f"with `(umask 077; head -c 32 /dev/urandom > {file})`, and copy it to every vehicle."
        ) from None
    if stat.S_IMODE(mode) & 0o077:
        raise FlightError(
            f"the key file `{file}` has mode {stat.S_IMODE(mode):04o}, and others may read it; "
            f"use `chmod 600 {file}`."
        )
    if len(key) < 16:
        raise FlightError(f"the key file `{file}` has {len(key)} bytes, and must have at least 16.")
    return key


@final
class Wire:
    """Writes and reads the datagrams of one process.

    Args:
        key: of the formation.
        formation: its mark, in hexadecimal digits.
        number: of the agent, or `GROUND`.
        agents: how many there are.
        sizes: of a letter's value and of a packet's content.
        boot: when the process began, ms since 1970, so that its numbers are no replay of the last
            process's.

    Attributes:
        dropped: how many datagrams, by reason.
        suspects: who last sent one, by reason, as the datagram says.
    """

    def __init__(
        self,
        key: bytes,
        formation: str,
        number: int,
        agents: int,
        sizes: tuple[int, int],
        boot: int,
    ) -> None:
        """Begin to count."""
        self._key, self._formation = key, bytes.fromhex(formation)[:8]
        self.number, self.boot, self._agents, self._count = number, boot, agents, 0
        self._letter = struct.Struct(f"<HHB{sizes[0]}dHd{sizes[1]}d")
        self._sizes = sizes
        bodies = {
            DatagramKind.LETTER: self._letter,
            DatagramKind.START: _START,
            DatagramKind.REPORT: _REPORT,
            DatagramKind.NOTE: _NOTE,
        }
        around = _HEAD.size + _SIGNATURE
        self._lengths = {kind: around + body.size for kind, body in bodies.items()}
        self._lengths[DatagramKind.STOP] = around
        self._newest = dict[tuple[int, DatagramKind], tuple[int, int]]()
        self.dropped, self.suspects = Counter[Drop](), dict[Drop, int]()
        if max(self._lengths.values()) > LONGEST:
            raise FlightError(
                f"a letter has {max(self._lengths.values())} bytes, with {sizes[0]} numbers of a "
                f"deviation and {sizes[1]} of a leader, and may have {LONGEST}."
            )

    # ---- writing ---------------------------------------------------------------------------------

    def letter(self, letter: Letter) -> bytes:
        """Return the datagram of a letter."""
        packet = letter.packet or Packet(0, 0.0, (0.0,) * self._sizes[1])
        head = packet.epoch, letter.hops, letter.packet is not None
        rest = packet.leader, packet.time, *packet.content
        return self._sign(
            DatagramKind.LETTER, letter.time, self._letter.pack(*head, *letter.value, *rest)
        )

    def start(self, wall: float, at: float) -> bytes:
        """Return the command that the plan starts at a time, both in s since 1970."""
        return self._sign(DatagramKind.START, wall, _START.pack(at))

    def stop(self, wall: float) -> bytes:
        """Return the command that everybody levels and descends."""
        return self._sign(DatagramKind.STOP, wall, b"")

    def report(self, wall: float, report: Report) -> bytes:
        """Return the datagram of a report."""
        return self._sign(DatagramKind.REPORT, wall, _REPORT.pack(*report[:-1], *report.dropped))

    def note(self, wall: float, sentence: str) -> bytes:
        """Return the datagram of a sentence to the ground, of which 240 bytes are sent."""
        return self._sign(DatagramKind.NOTE, wall, _NOTE.pack(sentence.encode()))

    def _sign(self, kind: DatagramKind, stamp: float, body: bytes) -> bytes:
        self._count += 1
        who = VERSION, kind, self._formation, self.number, self.boot, self._count
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
        version, kind, formation, sender, boot, count, stamp = _HEAD.unpack_from(datagram)
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
        body = self._body(DatagramKind(kind), sender, stamp, text[_HEAD.size :])
        if isinstance(body, Drop):
            return body
        clock = plan if kind == DatagramKind.LETTER else wall
        if clock is None:
            return Drop.EARLY
        # A process whose clock was once far ahead would be believed for ever by its boot.
        if abs(stamp - clock) > APART or boot > 1e3 * (wall + APART):
            return Drop.CLOCK
        # Own datagrams return from a multicast group, and are newer than those of a process that
        # was started before with the same number.
        if (sender, boot) == (self.number, self.boot):
            return Opened(DatagramKind(kind), sender, boot, stamp, body)
        newest = self._newest.get((sender, DatagramKind(kind)), (0, 0))
        if (boot, count) <= newest:
            return Drop.OLD
        self._newest[sender, DatagramKind(kind)] = boot, count
        return Opened(DatagramKind(kind), sender, boot, stamp, body)

    def _body(
        self, kind: DatagramKind, sender: int, stamp: float, text: bytes
    ) -> Drop | Letter | Report | float | str | None:
        if not math.isfinite(stamp):
            return Drop.NOT_FINITE
        if kind is DatagramKind.STOP:
            return None
        if kind is DatagramKind.START:
            [at] = _START.unpack(text)
            return at if math.isfinite(at) else Drop.NOT_FINITE
        if kind is DatagramKind.NOTE:
            return text.rstrip(b"\0").decode(errors="ignore")
        if kind is DatagramKind.REPORT:
            numbers = _REPORT.unpack(text)
            return Report(*numbers[:_FIELDS], dropped=numbers[_FIELDS:])
        return self._read_letter(sender, stamp, text)

    def _read_letter(self, sender: int, stamp: float, text: bytes) -> Letter | Drop:
        epoch, hops, has, *numbers = self._letter.unpack(text)
        split = self._sizes[0]
        value, (leader, said, *content) = numbers[:split], numbers[split:]
        if not all(map(math.isfinite, numbers)):
            return Drop.NOT_FINITE
        if _largest(value) > LARGEST or _largest(content) > LARGEST:
            return Drop.TOO_LARGE
        packet = Packet(leader, said, tuple(content), epoch) if has else None
        return Letter(sender, stamp, hops, tuple(value), packet)


def sender_of(datagram: bytes) -> int | None:
    """Return who sent a datagram, as it says itself."""
    return _HEAD.unpack_from(datagram)[3] if len(datagram) >= _HEAD.size else None


def is_letter(datagram: bytes) -> bool:
    """Tell whether a datagram is a letter between agents, as it says itself."""
    return datagram[1:2] == bytes([DatagramKind.LETTER])


def name_of(sender: int | None) -> str:
    """Return the name of a sender in sentences."""
    return "the ground" if sender == GROUND else f"agent {sender}"


def _largest(numbers: Iterable[float]) -> float:
    return max(map(abs, numbers), default=0.0)


def wire_of(flight: Mapping[str, Any], number: int, key: Path) -> Wire:
    """Return what signs for an agent or the ground, by the content of flight.json and a key file.

    Raises:
        FlightError: the key cannot be used.
    """
    boot, (first, second) = time.time_ns() // 1_000_000, flight["sizes"]
    sizes = first, second
    return Wire(read_key(key), flight["formation"], number, flight["agents"], sizes, boot)
