"""The HTTP server of the live page: the page, its stream of pictures, and its requests."""

import abc
import contextlib
import copy
import json
import time
from collections.abc import Callable
from typing import Final

import numpy as np

from echelon.apps.live.attendance import as_changes
from echelon.apps.live.guarantee_status import pending_badge
from echelon.apps.live.panel import Panel
from echelon.apps.live.session import Session, live_header
from echelon.apps.live.swarm import LiveLoop
from echelon.core.errors import EchelonError, SimulationError
from echelon.core.types import JsonObject
from echelon.core.words import amount
from echelon.experiments.results.recording import Recording
from echelon.experiments.scenario.build import build
from echelon.experiments.scenario.scenario import Scenario, scenario_from_mapping
from echelon.output.viewer.page import pack, page
from echelon.simulation.engine.law_drive import Laws
from echelon_flight.page_server import Handler

_LONGEST: Final = 100_000  # bytes of a request
_SLOWEST: Final = 4.0
"""A loop that is more times slower than real time is refused."""


def live(
    scenario: Scenario,
    run: Recording | None = None,
    progress: Callable[[int, int], None] = lambda done, parts: None,
) -> tuple[Session, str]:
    """Return a session that is ready to start, and its page.

    Args:
        scenario: of the loop.
        run: of that scenario, whose last state the loop starts from; laws begin without memory.
        progress: called with how many parts are ready, and of how many.

    Raises:
        EchelonError: a part is invalid, or the loop is too slow for real time.
    """
    scenario = with_changes(scenario)
    experiment = build(scenario)
    parts, settings = experiment
    if not isinstance(parts.drive, Laws):
        raise SimulationError("only agents under laws can run live; use `echelon run` instead.")
    progress(1, 4)
    panel = Panel(scenario, experiment)
    progress(2, 4)
    eventful = any(change.lose is not None for change in scenario.live)
    swarm = LiveLoop(parts, settings, panel.live, eventful)
    name = scenario.name
    if run is not None:
        _continue(swarm, run)
        name = f"{name}, from {run.times[-1]:.4g} s on"
    _check_speed(swarm)
    progress(3, 4)
    header = live_header(swarm, panel, name, pending_badge())
    return Session(scenario, panel, swarm), page(f"{name}, live", pack(header, {}))


def with_changes(scenario: Scenario) -> Scenario:
    """Return a scenario with its events as changes of the live loop."""
    data = copy.deepcopy(scenario.data)
    events = data.pop("events", None)
    if not events:
        return scenario
    data["live"] = [*data.get("live", []), *as_changes(events)]
    return scenario_from_mapping(data, scenario.folder)


def _continue(swarm: LiveLoop, run: Recording) -> None:
    shape = np.shape(swarm.states)
    if not len(run.times) or run.states.shape[1:] != shape:
        got = "no state" if not len(run.times) else f"{run.agents} agents"
        raise SimulationError(
            f"the run has {got}, and its scenario {shape[0]} agents of {amount(shape[1], 'state')}."
        )
    swarm.states, swarm.first = run.states[-1], round(run.times[-1] / swarm.settings.dt)


def _check_speed(swarm: LiveLoop) -> None:
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
            f"use at most {max(2, int(agents * swarm.span / best))} agents, or a longer `dt`."
        )


def live_page(session: Session, html: str) -> type[Handler]:
    """Return the handler of a session and its page."""

    class Live(_Live):
        """The handler of this session."""

    Live.page, Live.session = html.encode(), session
    return Live


class _Live(Handler, abc.ABC):
    session: Session

    def do_GET(self) -> None:
        if self.path == "/stream" and self.allowed():
            self._stream()
        elif self.path != "/stream":
            super().do_GET()

    def do_POST(self) -> None:
        if not self.allowed():
            return
        try:
            self._answer(200, self.session.ask(self._request()))
        except (EchelonError, ValueError, AttributeError) as error:
            self._answer(400, {"fault": str(error)})

    def _request(self) -> JsonObject:
        length = int(self.headers.get("Content-Length") or 0)
        if self.path != "/knob" or not 0 < length <= _LONGEST:
            raise SimulationError("a request must be a JSON mapping sent to `/knob`.")
        request = json.loads(self.rfile.read(length))
        if not isinstance(request, dict):
            raise SimulationError("a request must be a JSON mapping.")
        return request

    def _answer(self, code: int, answer: JsonObject) -> None:
        self.send(json.dumps(answer).encode(), "application/json", code)

    def _stream(self) -> None:
        self.send_response(200)
        self.send_header("Content-Type", "application/octet-stream")
        self.send_header("Cache-Control", "no-store")
        self.send_header("Transfer-Encoding", "chunked")
        self.end_headers()
        # Closing a page breaks the pipe, which ends its stream.
        with contextlib.suppress(OSError):
            self.session.watch(self._chunk)
            self.wfile.write(b"0\r\n\r\n")
        self.close_connection = True

    def _chunk(self, block: bytes) -> None:
        self.wfile.write(f"{len(block):x}\r\n".encode() + block + b"\r\n")
