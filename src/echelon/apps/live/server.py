"""The live page: its code, its stream, and what it asks for."""

import abc
import contextlib
import json
import struct
import time
import zlib
from http.server import ThreadingHTTPServer
from typing import Any, Final

from echelon.apps.live.header import live_header
from echelon.apps.live.knobs import Panel
from echelon.apps.live.promiser import asking
from echelon.apps.live.session import Session
from echelon.apps.live.swarm import LiveLoop
from echelon.core.errors import EchelonError, SimulationError
from echelon.experiments.scenario.build import build
from echelon.experiments.scenario.scenario import Scenario
from echelon.output.viewer.page import page
from echelon.output.viewer.serve import Handler, serve
from echelon.simulation.engine.law_drive import Laws

_LONGEST: Final = 100_000  # bytes that a page may ask with
_SLOWEST: Final = 4.0
"""Times slower than the clock than which a loop is not called live."""


def live(scenario: Scenario) -> tuple[Session, str]:
    """Return a loop that is ready to run, and its page.

    Raises:
        EchelonError: a part cannot be made, or the loop is too slow to be live.
    """
    built = build(scenario)
    parts, settings = built
    if not isinstance(parts.drive, Laws):
        raise SimulationError("only agents under laws can be live.")
    panel = Panel(scenario, built)
    swarm = LiveLoop(parts, settings, panel)
    _check_speed(swarm)
    told = json.dumps(
        {**live_header(swarm, panel, scenario.name, asking()), "groups": {}}, allow_nan=False
    ).encode()
    data = zlib.compress(struct.pack("<I", len(told)) + told, 9)
    return Session(scenario, panel, swarm), page(f"{scenario.name}, live", data)


def _check_speed(swarm: LiveLoop) -> None:
    """Refuse a loop that cannot keep up, and say how many agents could.

    Raises:
        SimulationError: it cannot.
    """
    swarm.advance()  # which compiles
    best = float("inf")
    for _ in range(3):
        began = time.perf_counter()
        swarm.advance()
        best = min(best, time.perf_counter() - began)
    swarm.restart()
    if best > _SLOWEST * swarm.span:
        agents = swarm.parts.graph.agents
        raise SimulationError(
            f"{agents} agents are too many to be live here: {swarm.span:g} s take {best:.2g} s; "
            f"about {max(2, int(agents * swarm.span / best))} would be, or a longer `dt`."
        )


def serve_live(session: Session, html: str, port: int | None) -> ThreadingHTTPServer:
    """Return a server of the page, its stream and its knobs.

    Raises:
        OutputError: no port is free.
    """

    class Live(_Live):
        """That of this session."""

    Live.page, Live.session = html.encode(), session
    return serve(Live, port)


class _Live(Handler, abc.ABC):
    session: Session

    def do_GET(self) -> None:
        """Send the page, or the stream for as long as it is read."""
        if self.path == "/stream" and self.allowed():
            self._stream()
        elif self.path != "/stream":
            super().do_GET()

    def do_POST(self) -> None:
        """Do what the page asks."""
        if not self.allowed():
            return
        try:
            told = self._asked()
            self._answer(200, self.session.ask(told))
        except (EchelonError, ValueError, AttributeError) as error:
            self._answer(400, {"fault": str(error)})

    def _asked(self) -> dict[str, Any]:
        length = int(self.headers.get("Content-Length") or 0)
        if self.path != "/knob" or not 0 < length <= _LONGEST:
            raise SimulationError("nothing can be asked so.")
        told = json.loads(self.rfile.read(length))
        if not isinstance(told, dict):
            raise SimulationError("what is asked must be a mapping.")
        return told

    def _answer(self, code: int, told: dict[str, Any]) -> None:
        self.send(json.dumps(told).encode(), "application/json", code)

    def _stream(self) -> None:
        self.send_response(200)
        self.send_header("Content-Type", "application/octet-stream")
        self.send_header("Cache-Control", "no-store")
        self.send_header("Transfer-Encoding", "chunked")
        self.end_headers()
        # A page that is closed breaks the pipe, and is watched for no more.
        with contextlib.suppress(OSError):
            self.session.watch(self._chunk)
            self.wfile.write(b"0\r\n\r\n")
        self.close_connection = True

    def _chunk(self, block: bytes) -> None:
        self.wfile.write(f"{len(block):x}\r\n".encode() + block + b"\r\n")
