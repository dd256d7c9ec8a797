"""What a process writes down while it flies: one file, to which records are appended.

A file begins with `MAGIC` and the version of the format. Then come records: length of the body
(u32), CRC-32 of the body (u32), body; little-endian. The first byte of a body is its kind: a header
(JSON), a tick, or a sentence. Whatever happens to a file, it is read up to its first damage.
"""

import contextlib
import json
import math
import os
import struct
import threading
import zlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple, final

from echelon_flight import FlightError

MAGIC: Final = b"ECHELON LOG"
VERSION: Final = 1
FOLDER: Final = "logs"
"""In the folder of a flight; it has one folder for each flight number."""
_BEGIN: Final = struct.Struct("<11sB")
_FRAME: Final = struct.Struct("<II")
_TICK: Final = struct.Struct("<cIdBBHBBddffH")
_SENTENCE: Final = struct.Struct("<cd")
_HEADER_KIND, _TICK_KIND, _SENTENCE_KIND = b"H", b"T", b"S"
_SYNC: Final = 1.0  # s
_LONGEST: Final = 1 << 20
"""Bytes of a record at most; a length beyond it is damage."""


class Received(NamedTuple):
    """A letter that the law may use.

    Attributes:
        sender: its number.
        arrived: when it was taken, a time of the plan on the receiver's clock, s.
        row: its numbers; the first is when it was sent, by the sender's clock, s.
    """

    sender: int
    arrived: float
    row: tuple[float, ...]

    @property
    def age(self) -> float:
        """How old it was when it arrived, s; clocks that differ add to it."""
        return self.arrived - self.row[0]


class Tick(NamedTuple):
    """One tick of a process.

    Attributes:
        time: of the plan, when the state was measured, s.
        x: the state (n,).
        u: the input (m,) that was sent; NaN where none was.
        missed: ticks that the law made up for just before, with the same state.
        sent: whether a letter was sent.
        mode: 1 flies, 2 descends.
        fault: the number of the supervisor's fault.
        amount: the number in its sentence.
        leader: whose packet the agent uses; 0xFFFF for none.
        age: of the state when the tick ended, s.
        spent: by the law, s.
        battery: share that is left; NaN if it is not known.
        received: letters that the law saw first in this tick, in the order of their arrival.
    """

    time: float
    x: tuple[float, ...]
    u: tuple[float, ...]
    missed: int = 0
    sent: bool = False
    mode: int = 1
    fault: int = 0
    amount: float = 0.0
    leader: int = 0xFFFF
    age: float = 0.0
    spent: float = 0.0
    battery: float = math.nan
    received: tuple[Received, ...] = ()


class Sentence(NamedTuple):
    """What a process said, at a time of the plan (s; NaN before there is one)."""

    time: float
    text: str


@final
class FlightLog:
    """Writes the log of one process; it never raises, and after a failure it only stays silent.

    Each record is handed to the operating system at once, so that it survives the process. Another
    thread writes the file to the disk each second.

    Args:
        folder: that gets `FLIGHT/agent-K-BOOT.log`; made when a flight begins.
        facts: what the header says besides.
        n, m: how many numbers a state and an input have.
        size: how many numbers a letter has.

    Attributes:
        file: that is written; None before a flight, or without a log.
        problem: why nothing more is written; empty where all is well.
    """

    def __init__(self, folder: Path, facts: Mapping[str, Any], n: int, m: int, size: int) -> None:
        """Write nothing yet."""
        self._folder, self._facts, self.file, self.problem = folder, facts, None, ""
        self._descriptor, self._done, self._count = -1, threading.Event(), 0
        self._whole, self._none = struct.Struct(f"{_TICK.format}{n + m}d"), (math.nan,) * m
        self._letter = struct.Struct(f"<Hd{size}d")
        self._letters, self._thread = list[bytes](), threading.Thread(target=self._sync)
        self._thread.daemon, self._broken = True, None

    file: Path | None
    _broken: OSError | None
    """Of the other thread, which closes nothing: a closed number may be another file's next."""

    def begin(self, flight: int, boot: int, more: Mapping[str, Any]) -> None:
        """Open the file of a flight, once.

        Args:
            flight: its number.
            boot: when the process began, ms since 1970.
            more: what else the header says.
        """
        if self.file is not None or self.problem:
            return
        own = {"version": VERSION, "flight": flight, "boot": boot}
        header = json.dumps(own | {**self._facts} | {**more}).encode()
        folder = self._folder / str(flight)
        file = folder / f"agent-{self._facts['agent']}-{boot}.log"
        try:
            folder.mkdir(parents=True, exist_ok=True)
            flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_APPEND
            self._descriptor = os.open(file, flags, 0o644)
            self.file = file
            self._put(_HEADER_KIND + header, _BEGIN.pack(MAGIC, VERSION))
            self._thread.start()
        except (OSError, RuntimeError) as error:
            self._fail(error)

    def receive(self, sender: int, arrived: float, row: Sequence[float]) -> None:
        """Remember a letter until the next tick."""
        if self._descriptor >= 0:
            try:
                self._letters.append(self._letter.pack(sender, arrived, *row))
            except struct.error as error:
                self._fail(error)

    def tick(self, tick: Tick) -> None:
        """Write a tick, with the letters since the last one in place of its own."""
        if self._descriptor < 0:
            return
        t, letters, self._letters = tick, self._letters, []
        state = t.missed, t.sent, len(letters), t.mode, t.fault, t.amount, t.battery
        rest = *state, t.age, t.spent, t.leader, *t.x, *(t.u or self._none)
        try:
            head = self._whole.pack(_TICK_KIND, self._count, t.time, *rest)
            self._put(b"".join((head, *letters)) if letters else head)
        except (OSError, struct.error) as error:
            self._fail(error)
        self._count += 1

    def say(self, time: float | None, text: str) -> None:
        """Write a sentence, at a time of the plan (s)."""
        if self._descriptor >= 0:
            at = math.nan if time is None else time
            try:
                self._put(_SENTENCE.pack(_SENTENCE_KIND, at) + text.encode())
            except (OSError, UnicodeError) as error:
                self._fail(error)

    def close(self) -> None:
        """Write the file to the disk, and close it."""
        self._done.set()
        if self._thread.ident is not None:
            # A disk may hang for ever.
            self._thread.join(2.0 * _SYNC)
        self._stop()

    def _put(self, body: bytes, before: bytes = b"") -> None:
        if self._broken is not None:
            raise self._broken
        data = before + _FRAME.pack(len(body), zlib.crc32(body)) + body
        if os.write(self._descriptor, data) != len(data):
            raise OSError(None, "the disk is full")

    def _fail(self, error: Exception) -> None:
        why = (getattr(error, "strerror", None) or str(error)).lower()
        self.problem = f"the log of this flight ends here ({why}); the flight goes on without it"
        self._stop()

    def _stop(self) -> None:
        descriptor, self._descriptor = self._descriptor, -1
        self._done.set()
        if descriptor >= 0:
            with contextlib.suppress(OSError):
                os.close(descriptor)

    def _sync(self) -> None:
        """Write the file to the disk each second, until it is closed."""
        while (descriptor := self._descriptor) >= 0:
            ends = self._done.wait(_SYNC)
            try:
                os.fsync(descriptor)
            except OSError as error:
                self._broken = error
                return
            if ends:
                return


# ---- reading -------------------------------------------------------------------------------------


class LogFile(NamedTuple):
    """The log of one process, as far as it is whole.

    Attributes:
        header: who wrote it: `flight`, `agent`, `boot`, `law` and more.
        ticks: in order.
        sentences: likewise.
        warning: what could not be read; empty where all could.
    """

    header: dict[str, Any]
    ticks: list[Tick]
    sentences: list[Sentence]
    warning: str = ""


def read_log(file: Path) -> LogFile:
    """Return the log in a file, up to its first damage.

    Raises:
        FlightError: it cannot be read, is no log, is of another version, or its header is damaged.
    """
    data = _content(file)
    body, place = _next(data, _BEGIN.size)
    try:
        assert body is not None and body[:1] == _HEADER_KIND
        header: dict[str, Any] = json.loads(body[1:])
        sizes = len(header["states"]), len(header["inputs"]), sum(header["message"].values())
    except (AssertionError, ValueError, KeyError, TypeError, AttributeError):
        raise FlightError(f"the header of the log `{file}` is damaged.") from None
    log = LogFile(header, [], [])
    while place < len(data):
        body, after = _next(data, place)
        if body is None or not _read(body, sizes, log):
            return log._replace(warning=_damage(file, log, len(data) - place))
        place = after
    return log


def _content(file: Path) -> bytes:
    """Return the bytes of a log of this version."""
    try:
        data = file.read_bytes()
    except OSError as error:
        raise FlightError(f"`{file}` cannot be read ({(error.strerror or '').lower()}).") from None
    if len(data) < _BEGIN.size or not data.startswith(MAGIC):
        raise FlightError(f"`{file}` is no log of a flight, or its beginning is damaged.")
    version = _BEGIN.unpack_from(data)[1]
    if version != VERSION:
        raise FlightError(
            f"`{file}` is a log of version {version}, and this version reads {VERSION}; read it "
            "with the version that wrote it."
        )
    return data


def _next(data: bytes, place: int) -> tuple[bytes | None, int]:
    """Return the body of the record at a place, and where the next one begins; None if damaged."""
    begin = place + _FRAME.size
    if begin > len(data):
        return None, place
    length, check = _FRAME.unpack_from(data, place)
    body = data[begin : begin + length]
    whole = 0 < length <= _LONGEST and len(body) == length and zlib.crc32(body) == check
    return (body if whole else None), begin + length


def _read(body: bytes, sizes: tuple[int, int, int], log: LogFile) -> bool:
    """Add a record to the log; False if it is none of this format."""
    n, m, size = sizes
    kind, letter = body[:1], struct.Struct(f"<Hd{size}d")
    try:
        if kind == _SENTENCE_KIND:
            text = body[_SENTENCE.size :].decode(errors="replace")
            log.sentences.append(Sentence(_SENTENCE.unpack_from(body)[1], text))
            return True
        head = _TICK.unpack_from(body)
        _, count, time, missed, sent, letters, mode, fault, amount, battery, age, spent, who = head
        numbers = struct.unpack_from(f"<{n + m}d", body, _TICK.size)
    except struct.error:
        return False
    begin = _TICK.size + 8 * (n + m)
    fits = len(body) == begin + letters * letter.size
    if kind != _TICK_KIND or not fits or count != len(log.ticks):
        return False
    rows = (letter.unpack_from(body, begin + k * letter.size) for k in range(letters))
    received = tuple(Received(sender, at, tuple(row)) for sender, at, *row in rows)
    state = missed, bool(sent), mode, fault, amount, who, age, spent, battery
    log.ticks.append(Tick(time, numbers[:n], numbers[n:], *state, received))
    return True


def _damage(file: Path, log: LogFile, rest: int) -> str:
    until = f"up to {log.ticks[-1].time:.3f} s" if log.ticks else "before its first tick"
    return f"The log `{file.name}` is whole {until}; its last {rest} bytes are cut or damaged."


def find_logs(folder: Path) -> dict[int, list[Path]]:
    """Return the files of logs by flight number, in the folder of a flight or in one below it.

    Folders that processes wrote on several computers may be copied over each other.
    """
    inner = folder / FOLDER if (folder / FOLDER).is_dir() else folder
    found = dict[int, list[Path]]()
    for file in sorted([*inner.glob("agent-*.log"), *inner.glob("*/agent-*.log")]):
        if file.parent.name.isdecimal():
            found.setdefault(int(file.parent.name), []).append(file)
    return found
