"""Standard output and error, for a reader who may leave before the end, as `head` does."""

import contextlib
import os
import sys
from collections.abc import Iterator
from typing import Any, Final, TextIO, final

LEFT: Final = 141
"""Exit code of what is done and was not read to its end: 128 + SIGPIPE, what shells report."""


@final
class Stream:
    """A stream that takes all that is written, also when nobody reads it any more.

    What prints need not know. Were the closed pipe an error, each printer would answer it in its
    own way: rich and typer leave with 1, which means that nothing is promised, and a run would end
    between its table and its files.
    """

    def __init__(self, stream: TextIO | None) -> None:
        """Wrap a stream; None is what Python makes of a descriptor that was closed before."""
        self._stream = stream or open(os.devnull, "w")
        self.left = False

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def write(self, text: str) -> int:
        """Write text, to nowhere if there is no reader, and return its length."""
        with self._outlived():
            self._stream.write(text)
        return len(text)

    def flush(self) -> None:
        """Send what is buffered, to nowhere if there is no reader."""
        with self._outlived():
            self._stream.flush()

    @contextlib.contextmanager
    def _outlived(self) -> Iterator[None]:
        try:
            yield
        except BrokenPipeError:
            self.left = True
            # The descriptor and not only this object: Python flushes the buffer below once more
            # when it ends, and would complain.
            nowhere = os.open(os.devnull, os.O_WRONLY)
            os.dup2(nowhere, self._stream.fileno())
            os.close(nowhere)


@contextlib.contextmanager
def outlive_readers() -> Iterator[None]:
    """Let a command go on to its end whoever reads, and leave with `LEFT` if it ends well.

    Another exit code stands: it is right whether or not the table was read, and no pipe loses it.
    """
    out, error = Stream(sys.stdout), Stream(sys.stderr)
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(error):
        try:
            yield
        except SystemExit as left:
            if not left.code and (out.left or error.left):
                raise SystemExit(LEFT) from None
            raise
