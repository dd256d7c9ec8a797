"""The page of a run that is still being computed, which loads each part as it arrives."""

import contextlib
import dataclasses
import threading
from typing import Final, final

import numpy as np

from echelon.experiments.results.recording import Recording
from echelon.output.plots.space import space_of
from echelon.output.viewer.pack import pack
from echelon.output.viewer.page import page
from echelon.output.viewer.replay import header, replay_data, replay_page
from echelon_flight.page_server import Handler

_PATIENCE: Final = 10.0
"""Seconds after which a waiting page gets an empty answer."""


@final
class Growing:
    """The parts of a run so far, for any number of pages.

    Args:
        run: its recording before the first frame.
    """

    def __init__(self, run: Recording) -> None:
        """Create the page without frames."""
        more = {"growing": True, "horizon": run.horizon}
        self.html = page(run.name, pack(header(run, space_of(run)) | more, {})).encode()
        self.blocks, self.done = list[bytes](), False
        self.changed = threading.Condition()
        self.last: Recording | None = None

    def add(self, stretch: Recording) -> None:
        """Add a part, which begins where the previous one ended.

        Raises:
            OutputError: it is too large for a page.
        """
        if not len(stretch.times):
            return
        block = replay_data(stretch if self.last is None else _joined(self.last, stretch))
        with self.changed:
            self.blocks.append(block)
            self.last = stretch
            self.changed.notify_all()

    def finish(self, run: Recording, report: str) -> None:
        """Replace the parts by the complete run with its report, which all pages then load.

        Raises:
            OutputError: it is too large for a page.
        """
        html = replay_page(run, reports=[report]).encode()
        with self.changed:
            self.html, self.done = html, True
            self.changed.notify_all()

    def block(self, number: int) -> bytes | None:
        """Return a part; b"" if it is not there in time, None once the run is complete."""
        with self.changed:
            self.changed.wait_for(lambda: self.done or len(self.blocks) > number, _PATIENCE)
            if self.done:
                return None
            return self.blocks[number] if len(self.blocks) > number else b""


def _joined(before: Recording, stretch: Recording) -> Recording:
    """Return a part with the last frame of the previous one, for interpolation."""
    names = ("times", "states", "inputs", "lyapunov", "reference")
    parts = {
        name: np.concatenate([getattr(before, name)[-1:], getattr(stretch, name)])
        for name in names
        if getattr(stretch, name) is not None
    }
    return dataclasses.replace(stretch, **parts)


def growing_page(run: Growing) -> type[Handler]:
    """Return the handler of a run that is being computed."""

    class GrowingRun(Handler):
        """The handler of this run: its page, and its parts by number."""

        def do_GET(self) -> None:
            """Send the page or a part."""
            # The page changes when the run is complete.
            type(self).page = run.html
            if not self.path.startswith("/stretch/"):
                super().do_GET()
            elif self.allowed():
                self._send_stretch(self.path.rpartition("/")[2])

        def _send_stretch(self, number: str) -> None:
            if not (number.isascii() and number.isdigit()) or len(number) > 9:
                self.send(b"not found\n", "text/plain", 404)
                return
            block = run.block(int(number))
            with contextlib.suppress(ConnectionError):
                # 205: reload the page; 204: no part yet.
                code = 205 if block is None else 200 if block else 204
                self.send(block or b"", "application/octet-stream", code)

    return GrowingRun
