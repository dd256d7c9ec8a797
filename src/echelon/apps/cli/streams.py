"""Standard output and error that survive a closed pipe, as that of `| head`."""

import contextlib
import os
import sys
from collections.abc import Iterator
from typing import Any, Final, TextIO, final

from echelon.apps.cli.status import STATUS

LEFT: Final = 141
"""Exit code of a success whose output was not read to its end: 128 + SIGPIPE, as in shells."""


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
        """Write text, to the null device if there is no reader, and return its length."""
        STATUS.pause()
        self.put(text)
        return len(text)

    def isatty(self) -> bool:
        """Return whether it is a terminal."""
        return self._stream.isatty()

    def put(self, text: str) -> None:
        """Write text beside the line of the status."""
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
    out, error = Stream(sys.stdout), Stream(sys.stderr)
    with (
        STATUS.show(error),
        contextlib.redirect_stdout(out),
        contextlib.redirect_stderr(error),
    ):
        try:
            yield
        except SystemExit as left:
            if not left.code and (out.left or error.left):
                raise SystemExit(LEFT) from None
            raise
