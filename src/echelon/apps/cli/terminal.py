"""Signals, readers that leave, and the line that says what the program is doing."""

import contextlib
import os
import shutil
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any, Final, TextIO, final

LEFT: Final = 141
"""Exit code of a success whose output was not read to its end: 128 + SIGPIPE, as in shells."""
_STOPPING = "echelon: stopping and saving results. Press Ctrl-C again to quit immediately."
_DRAWN, _PLAIN = 0.1, 5.0
"""Seconds between two changes by counting: of a terminal's line, and between plain lines."""
_FORESEEN = 0.01
"""The share of the work after which the remaining time is shown: before, most is compilation."""
_ERASE = "\r\x1b[K"


@contextlib.contextmanager
def on_signal(handler: Any) -> Iterator[None]:
    """Handle Ctrl-C and SIGTERM inside this context.

    One that the parent has switched off, as `nohup` does, stays off.
    """
    # Python lets no other thread handle signals.
    main = threading.current_thread() is threading.main_thread()
    numbers = (signal.SIGINT, signal.SIGTERM) if main else ()
    before = {each: signal.getsignal(each) for each in numbers}
    before = {each: was for each, was in before.items() if was != signal.SIG_IGN}
    for number in before:
        signal.signal(number, handler)
    try:
        yield
    finally:
        for number, was in before.items():
            signal.signal(number, was)


@final
class Stop:
    """Whether Ctrl-C or SIGTERM has asked the program to stop, and which one.

    Outside `hold` there is nothing to save, and a signal ends the process at once, even in the
    middle of a compilation.
    """

    def __init__(self) -> None:
        self.number: int | None = None

    @property
    def exit_code(self) -> int:
        """The exit code that shells report for the signal; 0 without one."""
        return 0 if self.number is None else 128 + self.number

    @contextlib.contextmanager
    def hold(self) -> Iterator[None]:
        """Defer the first signal to `check` while there are results to save."""
        self.number, self._said = None, False
        with on_signal(self._defer):
            yield

    def check(self) -> None:
        """Raise if there was a signal, and say what follows.

        Raises:
            KeyboardInterrupt: there was.
        """
        if self.number is not None:
            if not self._said:
                print(_STOPPING, file=sys.stderr, flush=True)
            self._said = True
            raise KeyboardInterrupt

    def _defer(self, number: int, _: object) -> None:
        self.number = number
        # A second one loses nothing: every file is either complete or under another name.
        for each in (signal.SIGINT, signal.SIGTERM):
            if signal.getsignal(each) != signal.SIG_IGN:
                signal.signal(each, signal.SIG_DFL)


@final
class Stream:
    """A stream that accepts all text, also after its reader has closed the pipe.

    If a closed pipe were an error, rich and typer would leave with 1, which means that nothing is
    guaranteed, and a run would end between its report and its files.
    """

    def __init__(self, stream: TextIO | None) -> None:
        """Wrap a stream; Python gives None for a descriptor that was closed before it started."""
        self._stream = stream or open(os.devnull, "w")
        self.left = False

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def write(self, text: str) -> int:
        """Write text in place of the status, and return its length."""
        STATUS.pause()
        self.put(text)
        return len(text)

    def put(self, text: str) -> None:
        """Write text beside the status, to the null device if there is no reader."""
        with self._survive():
            self._stream.write(text)

    def flush(self) -> None:
        """Send what is buffered, to the null device if there is no reader."""
        with self._survive():
            self._stream.flush()

    @contextlib.contextmanager
    def _survive(self) -> Iterator[None]:
        try:
            yield
        except BrokenPipeError:
            self.left = True
            # The descriptor, since Python flushes its buffer once more when it ends.
            null = os.open(os.devnull, os.O_WRONLY)
            os.dup2(null, self._stream.fileno())
            os.close(null)


@contextlib.contextmanager
def outlive_readers() -> Iterator[None]:
    """Let a command finish although its reader has left; a success then has the code `LEFT`.

    Another exit code is kept, since it is right whether or not the output was read.
    """
    out, error = Stream(sys.stdout), Stream(sys.stderr)
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(error), STATUS.show(error):
        try:
            yield
        except SystemExit as left:
            if not left.code and (out.left or error.left):
                raise SystemExit(LEFT) from None
            raise


@final
class Status:
    """What the program is doing, on standard error; without `show` nothing is written.

    On a terminal it is one line that changes, and that other output replaces; elsewhere, as in a
    log, plain lines every few seconds.
    """

    def __init__(self) -> None:
        self._stream: Stream | None = None
        self._text, self._drawn, self._written = "", False, 0.0
        self._first: tuple[float, float] | None = None

    @contextlib.contextmanager
    def show(self, stream: Stream) -> Iterator[None]:
        """Show the line on a stream."""
        self.__init__()
        self._stream = stream
        try:
            yield
        finally:
            self.silence()

    @property
    def silent(self) -> bool:
        """Whether nothing is shown, as with `--quiet`."""
        return self._stream is None

    def silence(self) -> None:
        """Show nothing more."""
        self.pause()
        self._stream = None

    def begin(self, text: str, log: bool = True) -> None:
        """Show what the program begins to do; with `log` also where standard error is no terminal.

        Called before libraries are loaded, which takes seconds.
        """
        shown = self._stream is not None and (log or self._stream.isatty())
        self._text, self._first = text if shown else "", None
        self._write("", 0.0)

    def count(self, done: float, total: int, unit: str) -> None:
        """Show how much of the work is done, and the time that the rest will take."""
        now, left = time.monotonic(), ""
        begun, before = self._first = self._first or (now, done)
        if done < total and done - before >= _FORESEEN * total:
            left = f", {duration((total - done) * (now - begun) / (done - before))} left"
        terminal = self._stream is not None and self._stream.isatty()
        self._write(f": {int(done)} of {total} {unit}{left}", _DRAWN if terminal else _PLAIN)

    def counter(self, unit: str) -> Callable[[int, int], None]:
        """Return a function of what is done and the total that shows them."""
        return lambda done, total: self.count(done, total, unit)

    def pause(self) -> None:
        """Remove the line before other output, until something begins or is counted."""
        if self._drawn and self._stream is not None:
            self._drawn = False
            self._stream.put(_ERASE)
            self._stream.flush()

    def _write(self, counted: str, apart: float) -> None:
        """Write the line if it has not changed for so many seconds."""
        now, text = time.monotonic(), f"echelon: {self._text}{counted} ..."
        if not self._text or self._stream is None or apart and now - self._written < apart:
            return
        self._written, self._drawn = now, self._stream.isatty()
        columns = shutil.get_terminal_size().columns - 1
        self._stream.put(_ERASE + text[:columns] if self._drawn else f"{text}\n")
        self._stream.flush()


def duration(seconds: float) -> str:
    """Return a time in words, such as `2 min 5 s`."""
    whole = max(1, round(seconds))
    (minutes, rest), (hours, left) = divmod(whole, 60), divmod(whole // 60, 60)
    if hours:
        return f"{hours} h {left} min"
    return f"{minutes} min {rest} s" if minutes else f"{rest} s"


STOP = Stop()
"""Whether this process was asked to stop."""
STATUS = Status()
"""What this process is doing."""
