"""The guarantee of a live loop, computed in a thread while the loop runs."""

import threading
from collections.abc import Callable
from typing import final

from echelon.apps.live.knobs import Knobs
from echelon.apps.live.panel import Panel
from echelon.core.errors import EchelonError
from echelon.core.types import JsonObject
from echelon.experiments.scenario.build import build
from echelon.guarantees.promises.promise import Promise, promise
from echelon.output.reports.causes import beyond
from echelon.output.viewer.replay import promise_badge

_NEAR = 1.1
"""Below this multiple of the smallest guaranteed coupling the badge warns of the edge."""


@final
class Promiser:
    """Computes guarantees in its own thread; of several requests only the last is answered.

    Args:
        answer: called with the badge of the page.
    """

    def __init__(self, answer: Callable[[JsonObject], None]) -> None:
        """Start the thread, which waits for a request."""
        self.answer = answer
        self.request: tuple[Panel, Knobs] | None = None
        self.changed, self.ended = threading.Condition(), False
        self.thread = threading.Thread(target=self._work, daemon=True)
        self.thread.start()

    def ask(self, panel: Panel, knobs: Knobs) -> None:
        """Request the guarantee at a position of the knobs."""
        with self.changed:
            self.request = panel, knobs
            self.changed.notify()

    def end(self) -> None:
        """End the thread."""
        with self.changed:
            self.ended = True
            self.changed.notify()
        # An interpreter that ends while XLA compiles in a thread is aborted by it.
        self.thread.join()

    def _work(self) -> None:
        while True:
            with self.changed:
                self.changed.wait_for(lambda: self.ended or self.request is not None)
                if self.ended:
                    return
                request, self.request = self.request, None
            assert request is not None
            # The eigenvalues first, since a guarantee takes seconds.
            self.answer(first_look(*request))
            badge = badge_of(*request)
            # After another change of the knobs the badge is out of date.
            if self.request is None and not self.ended:
                self.answer(badge)


def badge_of(panel: Panel, knobs: Knobs) -> JsonObject:
    """Return the badge at a position of the knobs: `holds`, `edge` or `lost`, with the causes."""
    try:
        unchanged = knobs == panel.start
        guarantee = promise(*(panel.experiment if unchanged else build(panel.scenario_at(knobs))))
    except EchelonError as error:
        # A scenario that is refused has no guarantee, such as one with a disconnected graph.
        cause = str(error).removeprefix("mapping: ")
        return {"state": "lost", "short": "no guarantee", "whole": cause, "causes": [cause]}
    badge: JsonObject = promise_badge(guarantee.as_mapping())
    badge["causes"] = [cause.sentence() for cause in guarantee.causes]
    badge["edge"] = guarantee.edge
    badge["rate"], certified = guarantee.rate, guarantee.certified
    badge["anywhere"] = certified is not None and certified.radius == float("inf")
    # Shown where the guarantee does not cover the state.
    badge["beyond"] = [cause.sentence() for cause in beyond(0.0, guarantee)]
    if guarantee.promised and _near_edge(guarantee, knobs):
        badge |= {"state": "edge", "short": f"{badge['short']}, near its edge"}
    elif not guarantee.promised and guarantee.slowest is not None and guarantee.slowest >= 0.0:
        badge["short"] = _growth(guarantee.slowest)
    return badge


def pending_badge(short: str = "guarantee \u2026") -> JsonObject:
    """Return the badge while the guarantee is computed."""
    whole = "The guarantee of the present loop is being computed."
    return {"state": "pending", "short": short, "whole": whole, "causes": []}


def first_look(panel: Panel, knobs: Knobs) -> JsonObject:
    """Return a badge with the slowest mode at the trim; a growing mode rules out a guarantee."""
    slowest = panel.live.slowest(knobs)
    if slowest is None:
        return pending_badge()
    if slowest < 0.0:
        return pending_badge(f"slowest mode {slowest:.3g} 1/s; guarantee \u2026")
    return pending_badge() | {"state": "lost", "short": _growth(slowest)}


def _growth(slowest: float) -> str:
    return f"no guarantee: a mode grows at {slowest:.3g} 1/s"


def _near_edge(guarantee: Promise, knobs: Knobs) -> bool:
    edge = guarantee.edge
    return edge is not None and knobs.coupling is not None and knobs.coupling < _NEAR * edge
