"""The guarantee of a live loop, computed in threads while the loop runs."""

import threading
import traceback
from collections.abc import Callable
from typing import Final, NamedTuple, final

from echelon.apps.live.knobs import Knobs
from echelon.apps.live.panel import Panel
from echelon.core.digits import at_least
from echelon.core.errors import EchelonError, GraphError
from echelon.core.rational import bisect
from echelon.core.types import JsonObject
from echelon.experiments.scenario.build import build
from echelon.guarantees.promises.closed_loop import LinearLoop
from echelon.guarantees.promises.promise import Promise, promise
from echelon.output.reports.run_report import beyond
from echelon.output.viewer.replay import promise_badge
from echelon.simulation.step.settings import Settings

_HALVINGS = 12  # of the slider, for the place of a mark
_NEAR = 1.1
"""Below this multiple of the smallest guaranteed coupling the badge warns of the edge."""


@final
class _Newest:
    """A thread that works on requests; of several that wait only the last is worked on.

    Args:
        work: called with the request.
    """

    def __init__(self, work: Callable[["_Request"], None]) -> None:
        """Start the thread, which waits for a request."""
        self.work = work
        self.request: _Request | None = None
        self.changed, self.ended = threading.Condition(), False
        self.thread = threading.Thread(target=self._run, daemon=True)
        self.thread.start()

    def ask(self, request: "_Request") -> None:
        """Replace the request that waits."""
        with self.changed:
            self.request = request
            self.changed.notify()

    def end(self) -> None:
        """End the thread."""
        with self.changed:
            self.ended = True
            self.changed.notify()
        # An interpreter that ends while XLA compiles in a thread is aborted by it.
        self.thread.join()

    def _run(self) -> None:
        while True:
            with self.changed:
                self.changed.wait_for(lambda: self.ended or self.request is not None)
                if self.ended:
                    return
                request, self.request = self.request, None
            assert request is not None
            self.work(request)


FAILED: Final[JsonObject] = {
    "state": "lost",
    "short": "guarantee not computed",
    "whole": "The guarantee could not be computed because of an internal error of echelon, which "
    "the terminal shows.",
    "causes": [],
}
"""The badge after an error that should not happen."""


class _Request(NamedTuple):
    """A position of the knobs, by the number of its change."""

    number: int
    panel: Panel
    knobs: Knobs


@final
class Promiser:
    """Computes guarantees while the loop runs, and before each a first look at the loop.

    A guarantee takes seconds. The first look at another position of the knobs does not wait for it:
    each has a thread, and no answer about an earlier position is given.

    Args:
        answer: called with the badge of the page.
    """

    def __init__(self, answer: Callable[[JsonObject], None]) -> None:
        """Start the threads, which wait for a request."""
        self.answer, self.lock = answer, threading.Lock()
        self.number = self.complete = 0
        self.workers = _Newest(self._look), _Newest(self._judge)

    def ask(self, panel: Panel, knobs: Knobs) -> None:
        """Request the guarantee at a position of the knobs; until then none is shown."""
        with self.lock:
            self.number += 1
            self.answer(pending_badge())
        for worker in self.workers:
            worker.ask(_Request(self.number, panel, knobs))

    def end(self) -> None:
        """End the threads."""
        for worker in self.workers:
            worker.end()

    def _look(self, request: _Request) -> None:
        badge = _badge(first_look, request)
        with self.lock:
            if self.complete < request.number == self.number:
                self.answer(badge)

    def _judge(self, request: _Request) -> None:
        badge = _badge(badge_of, request)
        with self.lock:
            if request.number == self.number:
                self.complete = request.number
                self.answer(badge)


def _badge(compute: Callable[[Panel, Knobs], JsonObject], request: _Request) -> JsonObject:
    try:
        return compute(request.panel, request.knobs)
    except Exception:
        # A thread that ends would leave the page waiting for ever.
        traceback.print_exc()
        return FAILED


def badge_of(panel: Panel, knobs: Knobs) -> JsonObject:
    """Return the badge at a position of the knobs: `holds`, `edge` or `lost`, with the causes."""
    if knobs.partial:
        text = f"Nothing is guaranteed at a feed-forward of {100.0 * knobs.feedforward:.3g} %: "
        text += "guarantees are of the scenario's law, which uses all of it."
        return {"state": "lost", "short": "no guarantee", "whole": text, "causes": [text]}
    try:
        unchanged = knobs == panel.start
        guarantee = promise(*(panel.experiment if unchanged else build(panel.scenario_at(knobs))))
    except EchelonError as error:
        # A scenario that is refused has no guarantee, such as one with a disconnected graph.
        cause = str(error).removeprefix("mapping: ")
        return {"state": "lost", "short": "no guarantee", "whole": cause, "causes": [cause]}
    stated = guarantee.as_mapping()
    badge: JsonObject = promise_badge(stated)
    badge["apart"] = ((stated["anywhere"] or {}).get("separation") or {}).get("distance")
    badge["causes"] = [cause.sentence() for cause in guarantee.causes]
    badge["edge"], badge["end"] = guarantee.edge, _end(panel, knobs, guarantee.edge)
    badge["above"] = None if guarantee.edge is None else at_least(guarantee.edge)
    badge["rate"] = guarantee.rate if guarantee.promised else None
    certified = guarantee.certified
    badge["anywhere"] = certified is not None and certified.radius == float("inf")
    # Shown where the guarantee does not cover the state.
    badge["beyond"] = [*beyond(0.0, guarantee)]
    if guarantee.promised and _near_edge(guarantee, knobs):
        badge |= {"state": "edge", "short": f"{badge['short']}, near its edge"}
    elif not guarantee.promised and guarantee.slowest is not None:
        growth = _growth(panel.live.loop(knobs), panel.experiment.settings)
        badge["short"] = growth or badge["short"]
    return badge


def _end(panel: Panel, knobs: Knobs, edge: float | None) -> float | None:
    """Return a coupling above the edge at which errors begin to grow in held steps.

    None without an edge, and where they grow nowhere or everywhere on the slider.
    """
    if edge is None or "coupling" not in panel.ranges:
        return None
    settings, highest = panel.experiment.settings, panel.ranges["coupling"].high

    def decays(coupling: float) -> bool:
        loop = panel.live.loop(knobs._replace(coupling=coupling))
        return loop is not None and loop.radius(settings) < 1.0

    if not edge < highest or not decays(1.001 * edge) or decays(highest):
        return None
    return float(bisect(decays, 1.001 * edge, highest, _HALVINGS))


def pending_badge(short: str = "guarantee \u2026") -> JsonObject:
    """Return the badge while the guarantee is computed."""
    whole = "The guarantee of the present loop is being computed."
    return {"state": "pending", "short": short, "whole": whole, "causes": []}


def first_look(panel: Panel, knobs: Knobs) -> JsonObject:
    """Return a badge with the slowest mode at the trim in steps with held inputs.

    A mode that grows rules out a guarantee.
    """
    settings = panel.experiment.settings
    if knobs.partial:
        return badge_of(panel, knobs)
    try:
        loop = panel.live.loop(knobs)
    except GraphError as error:
        return pending_badge() | {"state": "lost", "short": "no guarantee", "causes": [str(error)]}
    growth = _growth(loop, settings)
    if growth:
        return pending_badge() | {"state": "lost", "short": growth}
    if loop is None:
        return pending_badge()
    slowest = at_least(-loop.held_rate(settings))
    return pending_badge(f"slowest mode {slowest} 1/s; guarantee \u2026")


def _growth(loop: LinearLoop | None, settings: Settings) -> str:
    """Return that errors grow in the steps of a loop; empty where that is not known."""
    radius = 0.0 if loop is None else loop.radius(settings)
    # Exactly 1 stands for an interval of eigenvalues of which nothing is shown.
    if loop is None or not radius > 1.0:
        return ""
    if loop.slowest > 0.0:
        return f"no guarantee: a mode grows at {loop.slowest:.3g} 1/s"
    step = f"{1e3 * settings.dt:.3g} ms"
    return f"no guarantee: errors grow {radius:.3g}-fold in each step of {step}"


def _near_edge(guarantee: Promise, knobs: Knobs) -> bool:
    edge = guarantee.edge
    return edge is not None and knobs.coupling is not None and knobs.coupling < _NEAR * edge
