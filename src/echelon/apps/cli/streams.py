"""Standard output and error that survive a closed pipe, as that of `| head`."""

import contextlib
import os
import sys
import threading
from collections.abc import Iterator
from typing import Any, Final, TextIO, final

LEFT: Final = 141
"""Exit code of a success whose output was not read to its end: 128 + SIGPIPE, as in shells."""


_LOADING: Final = "echelon: loading ..."
_ERASE: Final = "\r\x1b[K"
_SOON: Final = 0.5
"""Seconds of silence after which a terminal shows that the program runs."""


@final
class Notice:
    """A line on a terminal that disappears with the first output: libraries take seconds to load.

    Args:
        terminal: standard error; None, or what is no terminal, gets no line.
    """

    def __init__(self, terminal: TextIO | None) -> None:
        """Wait for the first output."""
        self._terminal, self._shown, self._lock = terminal, False, threading.Lock()
        self._timer = threading.Timer(_SOON, self._show)
        self._timer.daemon = True
        if terminal is not None and terminal.isatty():
            self._timer.start()

    def _show(self) -> None:
        with self._lock, contextlib.suppress(OSError):
            if not self._timer.finished.is_set() and self._terminal is not None:
                self._shown = True
                self._terminal.write(_LOADING)
                self._terminal.flush()

    def end(self) -> None:
        """Remove the line, or never show it."""
        if self._timer.finished.is_set() and not self._shown:
            return
        self._timer.cancel()
        with self._lock, contextlib.suppress(OSError):
            if self._shown and self._terminal is not None:
                self._shown = False
                self._terminal.write(_ERASE)
                self._terminal.flush()


@final
class Stream:
    """A stream that accepts all text, also after its reader has closed the pipe.

    If a closed pipe were an error, rich and typer would leave with 1, which means that nothing is
    guaranteed, and a run would end between its report and its files.
    """

    def __init__(self, stream: TextIO | None, notice: Notice) -> None:
        """Wrap a stream; Python gives None for a descriptor that was closed before it started."""
        self._notice = notice
        self._stream = stream or open(os.devnull, "w")
        self.left = False

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def write(self, text: str) -> int:
        """Write text, to the null device if there is no reader, and return its length."""
        self._notice.end()
        with self._survive():
            self._stream.write(text)
        return len(text)

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
            # The descriptor, not only this object: Python flushes the buffer of the descriptor once
            # more when it ends, and would report an error.
            null = os.open(os.devnull, os.O_WRONLY)
            os.dup2(null, self._stream.fileno())
            os.close(null)


@contextlib.contextmanager
def outlive_readers() -> Iterator[None]:
    """Let a command finish although its reader has left; a success then has the code `LEFT`.

    Another exit code is kept, since it is right whether or not the output was read.
    """
    notice = Notice(sys.stderr)
    out, error = Stream(sys.stdout, notice), Stream(sys.stderr, notice)
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(error):
        try:
            yield
        except SystemExit as left:
            if not left.code and (out.left or error.left):
                raise SystemExit(LEFT) from None
            raise
        finally:
            notice.end()
