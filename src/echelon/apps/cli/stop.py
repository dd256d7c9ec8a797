"""Ctrl-C and SIGTERM: the first stops a run after its chunk, the second ends the process."""

import contextlib
import os
import signal
import socket
import sys
import threading
from collections.abc import Callable, Iterator
from typing import NoReturn, final

NOTHING = "stopped; there were no results to save."
_MESSAGE = "echelon: stopping and saving results. Press Ctrl-C again to quit immediately."

_PATIENCE = 1.0
"""Seconds after which a signal ends the process although Python has not yet handled it."""
_GRACE = 0.2
"""Seconds in which work in a thread may end by itself."""


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
        self._saving, self._message, self._handled = False, _MESSAGE, False
        self._hurried = False

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
        self.number, self._saving, self._handled = None, False, False
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

    def aside(self, work: Callable[[], None]) -> None:
        """Do work in a thread, and return soon after a signal, even in the middle of a compilation.

        The work may then go on until the process ends; what it has stored is complete.

        Raises:
            KeyboardInterrupt: there was a signal.
            BaseException: that of the work.
        """
        faults = list[BaseException]()

        def attempt() -> None:
            try:
                work()
            except BaseException as fault:
                faults.append(fault)

        thread = threading.Thread(target=attempt, daemon=True)
        thread.start()
        while thread.is_alive() and self.number is None:
            thread.join(_GRACE / 4)
        thread.join(_GRACE)
        self._hurried = self.number is not None
        if faults:
            raise faults[0]
        if thread.is_alive():
            raise KeyboardInterrupt

    def leave(self, code: object) -> None:
        """End the process at once after a signal, if its work was in a thread.

        Python's own end would wait for that, and takes a second on a machine with other work.
        """
        if self._hurried:
            sys.stdout.flush()
            os._exit(code if isinstance(code, int) else 0)

    def _answer(self, receiver: socket.socket, signals: set[int]) -> None:
        count = 0
        while True:
            try:
                number = receiver.recv(1)
            except TimeoutError:
                # The main thread compiles, and nothing needs to be saved.
                if not self._handled and not self._saving:
                    self._quit(f"echelon: {NOTHING}\n")
                receiver.settimeout(None)
                continue
            if not number:
                return
            if number[0] in signals:
                count += 1
                # Nothing is lost: every file is either complete or under another name.
                if count > 1:
                    self._quit()
                self.number = number[0]
                if not self._saving:
                    receiver.settimeout(_PATIENCE)
                elif self._message:
                    print(self._message, file=sys.stderr, flush=True)

    def _quit(self, sentence: str = "") -> NoReturn:
        sys.stderr.write("\n" * sys.stderr.isatty() + sentence)
        sys.stderr.flush()
        os._exit(self.exit_code)

    def _interrupt(self, number: int, _: object) -> None:
        self.number, self._handled = number, True
        if not self._saving:
            raise Ended


STOP = Stop()
"""The state of this process."""
