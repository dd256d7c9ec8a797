"""What the program is doing, on standard error, from the first second on.

On a terminal it is one line that changes, and that other output replaces; elsewhere, as in a log,
plain lines every few seconds.
"""

import contextlib
import shutil
import threading
import time
from collections.abc import Callable, Iterator
from typing import Protocol, final

_LOADING = "loading"
_SOON = 0.5
"""Seconds of silence after which a terminal shows that the program runs."""
_TICK = 1.0
"""Seconds between two changes of the line of a terminal while nothing is counted."""
_DRAWN, _PLAIN = 0.1, 5.0
"""Seconds between two changes by counting: of a terminal's line, and between plain lines."""
_SILENT = 15.0
"""Seconds after which plain output shows that uncounted work continues."""
_FORESEEN, _LATE = 0.01, 30.0
"""The share of the work, or the seconds, after which the time that the rest takes is known."""
_ERASE = "\r\x1b[K"


class _Screen(Protocol):
    """Where the line is written."""

    def put(self, text: str) -> None: ...

    def flush(self) -> None: ...

    def isatty(self) -> bool: ...


def duration(seconds: float) -> str:
    """Return a time in words, such as `2 min 5 s`."""
    whole = max(1, round(seconds))
    (minutes, rest), (hours, left) = divmod(whole, 60), divmod(whole // 60, 60)
    if hours:
        return f"{hours} h {left} min"
    return f"{minutes} min {rest} s" if minutes else f"{rest} s"


@final
class Status:
    """The line of this process; without `show` nothing is written."""

    def __init__(self) -> None:
        """Begin without a stream."""
        self._lock, self._ended = threading.RLock(), threading.Event()
        self._stream: _Screen | None = None
        self._clear()

    def _clear(self) -> None:
        self._text, self._counted, self._drawn, self._terminal = "", "", False, False
        self._paused = False
        self._since, self._written, self._first = 0.0, 0.0, (0.0, -1)
        self._until = 0.0

    @contextlib.contextmanager
    def show(self, stream: _Screen) -> Iterator[None]:
        """Show the line on a stream; a terminal says that the program loads if nothing else is."""
        self._clear()
        self._stream, self._ended = stream, threading.Event()
        self._terminal = stream.isatty()
        if self._terminal:
            self._text = _LOADING
            self._since = time.monotonic()
        threading.Thread(target=self._tick, args=(self._ended,), daemon=True).start()
        try:
            yield
        finally:
            self._ended.set()
            self.pause()
            self._stream = None

    @property
    def silent(self) -> bool:
        """Whether nothing is shown, as with `--quiet`."""
        return self._stream is None

    def silence(self) -> None:
        """Show nothing more."""
        with self._lock:
            self.pause()
            self._stream = None

    def begin(self, text: str, log: bool = True) -> None:
        """Show what the program begins to do; with `log` also where standard error is no terminal.

        Called before libraries are loaded, which takes seconds.
        """
        with self._lock:
            self._text, self._paused = text if log or self._terminal else "", False
            self._since, self._counted, self._first = time.monotonic(), "", (0.0, -1)
            self._until = 0.0
            self._write(0.0)

    def count(self, done: float, total: int, unit: str) -> None:
        """Show how much of the work is done, and the time that the rest will take."""
        with self._lock:
            now, (begun, before), self._paused = time.monotonic(), self._first, False
            if before < 0:
                self._first = (now, done)
            self._until = 0.0
            if 0 <= before < done:
                seconds = (total - done) * (now - begun) / (done - before)
                # Before that, most of the time was taken by what is compiled once.
                foreseen = done - before >= _FORESEEN * total or now - begun >= _LATE
                self._until = now + seconds if foreseen and done < total else 0.0
            self._counted = f": {int(done)} of {total} {unit}"
            self._write(_DRAWN if self._terminal else _PLAIN)

    def counter(self, unit: str) -> Callable[[int, int], None]:
        """Return a function of what is done and the total that shows them."""
        return lambda done, total: self.count(done, total, unit)

    def pause(self) -> None:
        """Remove the line before other output, until something begins or is counted."""
        with self._lock:
            self._paused = True
            if self._drawn and self._stream is not None:
                self._drawn = False
                self._stream.put(_ERASE)
                self._stream.flush()

    def _tick(self, ended: threading.Event) -> None:
        wait = _SOON if self._terminal else _SILENT
        while not ended.wait(wait):
            wait = _TICK if self._terminal else _SILENT
            with self._lock:
                # A time that is over was wrong, as parts of work may take unlike times.
                if self._until < time.monotonic():
                    self._until = 0.0
                if ended is self._ended:
                    self._write(wait)

    def _write(self, apart: float) -> None:
        """Write the line if it has changed nothing for so many seconds."""
        now = time.monotonic()
        if not self._text or self._paused or self._stream is None:
            return
        if apart and now - self._written < apart:
            return
        self._written, took = now, now - self._since
        left = f", {duration(self._until - now)} left" if self._until else ""
        text = f"echelon: {self._text}{self._counted}{left} ..."
        text += f" {duration(took)}" if took > 2.0 and not self._counted else ""
        if self._terminal:
            self._drawn = True
            self._stream.put(_ERASE + text[: shutil.get_terminal_size().columns - 1])
        else:
            self._stream.put(f"{text}\n")
        self._stream.flush()


STATUS = Status()
"""That of this process."""
