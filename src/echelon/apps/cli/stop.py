"""Ctrl-C and SIGTERM: the first stops a run after its chunk, the second ends the process."""

import contextlib
import os
import signal
import socket
import sys
import threading
from collections.abc import Iterator
from typing import final

_MESSAGE = "echelon: stopping and saving results. Press Ctrl-C again to quit immediately."

_CURSOR = "\x1b[?25h\n"
"""Shows the cursor again, which the progress bar hides."""


@final
class Ended(BaseException):
    """Raised by a signal while nothing needs to be saved.

    It is no KeyboardInterrupt, which a comparison would take for the end of one simulation.
    """


@final
class Stop:
    """Whether a signal has asked the program to stop, and which one.

    Python runs its signal handlers only between two of its instructions, and a compilation or a
    chunk is one instruction. So a thread receives signals through a socket, and answers at once.
    """

    def __init__(self) -> None:
        """Begin without a signal."""
        self.number: int | None = None
        self._saving, self._message = False, _MESSAGE

    @property
    def exit_code(self) -> int:
        """The exit code that shells report for the signal; 0 without one."""
        return 0 if self.number is None else 128 + self.number

    @contextlib.contextmanager
    def listen(self) -> Iterator[None]:
        """Handle Ctrl-C and SIGTERM inside this context; the second signal ends the process."""
        if threading.current_thread() is not threading.main_thread():
            yield  # Python lets no other thread handle signals
            return
        # One that the parent has switched off, as `nohup` does, stays off.
        signals = [
            number
            for number in (signal.SIGINT, signal.SIGTERM)
            if signal.getsignal(number) != signal.SIG_IGN
        ]
        self.number, self._saving = None, False
        receiver, sender = socket.socketpair()
        sender.setblocking(False)
        wakeup = signal.set_wakeup_fd(sender.fileno(), warn_on_full_buffer=False)
        before = {number: signal.signal(number, self._interrupt) for number in signals}
        thread = threading.Thread(target=self._answer, args=(receiver, {*signals}), daemon=True)
        thread.start()
        try:
            yield
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)
            signal.set_wakeup_fd(wakeup)
            sender.close()
            thread.join()
            receiver.close()
            # Another call in the same process begins without a signal.
            self.number = None

    @contextlib.contextmanager
    def hold(self, message: str = _MESSAGE) -> Iterator[None]:
        """Defer signals to `check` while there are results to save; print what follows then."""
        self._saving, self._message = True, message
        try:
            yield
        finally:
            self._saving = False

    def check(self) -> None:
        """Raise if there was a signal.

        Raises:
            KeyboardInterrupt: there was.
        """
        if self.number is not None:
            raise KeyboardInterrupt

    def _answer(self, receiver: socket.socket, signals: set[int]) -> None:
        count = 0
        while number := receiver.recv(1):
            if number[0] not in signals:
                continue
            count += 1
            if count > 1:
                # Nothing is lost: every file is either complete or under another name.
                if sys.stderr.isatty():
                    sys.stderr.write(_CURSOR)
                    sys.stderr.flush()
                os._exit(self.exit_code)
            self.number = number[0]
            if self._saving and self._message:
                print(self._message, file=sys.stderr, flush=True)

    def _interrupt(self, number: int, _: object) -> None:
        self.number = number
        if not self._saving:
            raise Ended


STOP = Stop()
"""The state of this process."""
