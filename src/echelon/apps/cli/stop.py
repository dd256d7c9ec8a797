"""How a user or the system ends the program: Ctrl-C or SIGTERM, between two chunks of a run."""

import contextlib
import os
import signal
import socket
import sys
import threading
from collections.abc import Iterator
from typing import final

_SAID = "echelon: stopping after this chunk, and writing what was computed; again ends at once."

_CURSOR = "\x1b[?25h\n"
"""Shows the cursor again, which the bar of progress hides."""


@final
class Ended(BaseException):
    """Raised by a signal where nothing is held; what goes on after Ctrl-C does not go on after it.

    A comparison would else take it for the end of one flight.
    """


@final
class Stop:
    """Whether the program was told to end, and by what.

    Python runs its own handlers between two of its instructions only, and a compilation or a chunk
    is one instruction. So a thread hears of a signal through a socket, and answers at once.
    """

    def __init__(self) -> None:
        """Begin untold."""
        self.number: int | None = None
        self._held, self._said = False, _SAID

    @property
    def exit_code(self) -> int:
        """What shells report of a program that such a signal ended; 0 without one."""
        return 0 if self.number is None else 128 + self.number

    @contextlib.contextmanager
    def listen(self) -> Iterator[None]:
        """Hear Ctrl-C and SIGTERM as long as this lasts; the second of them ends the process."""
        if threading.current_thread() is not threading.main_thread():
            yield  # Python lets no other thread hear of signals
            return
        # One that the parent has switched off, as `nohup` does, stays off.
        heard = [
            each
            for each in (signal.SIGINT, signal.SIGTERM)
            if signal.getsignal(each) != signal.SIG_IGN
        ]
        self.number, self._held = None, False
        ears, mouth = socket.socketpair()
        mouth.setblocking(False)
        wakeup = signal.set_wakeup_fd(mouth.fileno(), warn_on_full_buffer=False)
        before = {each: signal.signal(each, self._interrupt) for each in heard}
        thread = threading.Thread(target=self._answer, args=(ears, {*heard}), daemon=True)
        thread.start()
        try:
            yield
        finally:
            for each, handler in before.items():
                signal.signal(each, handler)
            signal.set_wakeup_fd(wakeup)
            mouth.close()
            thread.join()
            ears.close()
            # Another call in the same process was told nothing.
            self.number = None

    @contextlib.contextmanager
    def hold(self, said: str = _SAID) -> Iterator[None]:
        """Let signals wait for `check`, as long as there is something to lose; say what follows."""
        self._held, self._said = True, said
        try:
            yield
        finally:
            self._held = False

    def check(self) -> None:
        """Raise what a signal stands for, if there was one.

        Raises:
            KeyboardInterrupt: there was.
        """
        if self.number is not None:
            raise KeyboardInterrupt

    def _answer(self, ears: socket.socket, heard: set[int]) -> None:
        told = 0
        while number := ears.recv(1):
            if number[0] not in heard:
                continue
            told += 1
            if told > 1:
                # Nothing is lost: every file is either whole or under another name.
                if sys.stderr.isatty():
                    sys.stderr.write(_CURSOR)
                    sys.stderr.flush()
                os._exit(self.exit_code)
            self.number = number[0]
            if self._held and self._said:
                print(self._said, file=sys.stderr, flush=True)

    def _interrupt(self, number: int, _: object) -> None:
        self.number = number
        if not self._held:
            raise Ended


STOP = Stop()
"""That of this process."""
