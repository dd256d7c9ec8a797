"""The page of a run that is still being computed: it is fed as stretches of it come."""

import contextlib
import dataclasses
import json
import struct
import threading
import zlib
from http.server import ThreadingHTTPServer
from typing import Final, final

import numpy as np

from echelon.experiments.results.recording import Recording
from echelon.output.plots.space import space_of
from echelon.output.viewer.page import page
from echelon.output.viewer.replay import header, replay_data, replay_page
from echelon.output.viewer.serve import Handler, serve

_PATIENCE: Final = 10.0
"""Seconds after which a page that waits is told that there is nothing yet."""


@final
class Growing:
    """What there is of a run so far, for any number of pages; none of them is waited for.

    Args:
        run: as it was foreseen.
    """

    def __init__(self, run: Recording) -> None:
        """Make the page that waits."""
        told = {**header(run, space_of(run)), "growing": True, "horizon": run.horizon, "groups": {}}
        text = json.dumps(told, allow_nan=False).encode()
        self.html = page(run.name, zlib.compress(struct.pack("<I", len(text)) + text, 9)).encode()
        self.blocks, self.done = list[bytes](), False
        self.changed = threading.Condition()
        self.last: Recording | None = None

    def add(self, stretch: Recording) -> None:
        """Add a stretch, which begins where the one before ended.

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

    def finish(self, run: Recording) -> None:
        """Take the whole run in the place of its stretches; every page then shows it.

        Raises:
            OutputError: it is too large for a page.
        """
        html = replay_page(run).encode()
        with self.changed:
            self.html, self.done = html, True
            self.changed.notify_all()

    def block(self, number: int) -> bytes | None:
        """Return a stretch once it is there; nothing where a page waited long, None at the end."""
        with self.changed:
            self.changed.wait_for(lambda: self.done or len(self.blocks) > number, _PATIENCE)
            if self.done:
                return None
            return self.blocks[number] if len(self.blocks) > number else b""


def _joined(before: Recording, stretch: Recording) -> Recording:
    """Return a stretch after the last frame of the one before, so that a page draws between."""
    names = ("times", "states", "inputs", "errors", "lyapunov")
    parts = {
        name: np.concatenate([getattr(before, name)[-1:], getattr(stretch, name)])
        for name in names
        if getattr(stretch, name) is not None
    }
    return dataclasses.replace(stretch, **parts)


def serve_growing(run: Growing, port: int | None) -> ThreadingHTTPServer:
    """Return a server of a run that is being computed.

    Raises:
        OutputError: no port is free.
    """

    class GrowingRun(Handler):
        """The page of this run, and its stretches by number."""

        def do_GET(self) -> None:
            """Send the page, or the stretch that it asks for."""
            # The page is another one at the end.
            type(self).page = run.html
            if not self.path.startswith("/stretch/"):
                super().do_GET()
            elif self.allowed():
                self._send_stretch(self.path.rpartition("/")[2])

        def _send_stretch(self, number: str) -> None:
            if not (number.isascii() and number.isdigit()) or len(number) > 9:
                self.send(b"there is nothing here.\n", "text/plain", 404)
                return
            block = run.block(int(number))
            with contextlib.suppress(ConnectionError):
                # 205, the page is to be loaded anew; 204, nothing yet.
                code = 205 if block is None else 200 if block else 204
                self.send(block or b"", "application/octet-stream", code)

    return serve(GrowingRun, port)
