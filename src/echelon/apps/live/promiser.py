"""What is promised of the knobs as they stand, found beside the loop that runs."""

import threading
from collections.abc import Callable
from typing import Any, final

from echelon.apps.live.knobs import Knobs, Panel
from echelon.core.errors import EchelonError
from echelon.experiments.scenario.build import build
from echelon.guarantees.promises.promise import Promise, promise
from echelon.output.reports.causes import beyond
from echelon.output.viewer.replay import promise_badge

_NEAR = 1.1
"""Times the edge of the coupling, below which a promise is told to stand on it."""


@final
class Promiser:
    """Finds what is promised in a thread of its own; of many questions only the last is answered.

    Args:
        answer: called with what the page is told.
    """

    def __init__(self, answer: Callable[[dict[str, Any]], None]) -> None:
        """Start the thread, which waits for a question."""
        self.answer = answer
        self.asked: tuple[Panel, Knobs] | None = None
        self.woken, self.ended = threading.Condition(), False
        self.thread = threading.Thread(target=self._work, daemon=True)
        self.thread.start()

    def ask(self, panel: Panel, knobs: Knobs) -> None:
        """Ask what is promised of the knobs of a panel."""
        with self.woken:
            self.asked = panel, knobs
            self.woken.notify()

    def end(self) -> None:
        """Ask nothing more."""
        with self.woken:
            self.ended = True
            self.woken.notify()
        # An interpreter that ends while XLA compiles in a thread is aborted by it.
        self.thread.join()

    def _work(self) -> None:
        while True:
            with self.woken:
                self.woken.wait_for(lambda: self.ended or self.asked is not None)
                if self.ended:
                    return
                asked, self.asked = self.asked, None
            assert asked is not None
            # At once what eigenvalues show, since a promise takes seconds to be found.
            self.answer(first_look(*asked))
            found = badge_of(*asked)
            # A knob that was turned meanwhile has made it an answer to no question.
            if self.asked is None and not self.ended:
                self.answer(found)


def badge_of(panel: Panel, knobs: Knobs) -> dict[str, Any]:
    """Return what is promised of knobs: `holds`, at the `edge` or `lost`, why, and with what."""
    try:
        same = knobs == panel.start
        found = promise(*(panel.built if same else build(panel.standing(knobs))))
    except EchelonError as error:
        # Whatever is refused as a scenario is promised nothing, such as a graph in two parts.
        why = str(error).removeprefix("mapping: ")
        return {"state": "lost", "short": "nothing promised", "whole": why, "causes": [why]}
    badge: dict[str, Any] = promise_badge(found.as_mapping())
    badge["causes"] = [each.sentence() for each in found.causes]
    badge["edge"] = found.edge
    badge["rate"], certified = found.rate, found.certified
    badge["anywhere"] = certified is not None and certified.radius == float("inf")
    # Told where the promise does not reach.
    badge["beyond"] = [each.sentence() for each in beyond(0.0, found)]
    if found.promised and _near(found, knobs):
        badge |= {"state": "edge", "short": f"{badge['short']}, at its edge"}
    elif not found.promised and found.slowest is not None and found.slowest >= 0.0:
        badge["short"] = f"nothing promised: a mode grows, {found.slowest:+.3g} 1/s"
    return badge


def asking(short: str = "promise \u2026") -> dict[str, Any]:
    """Return what is told while a promise is being found."""
    whole = "What is promised of the loop as it stands is being found."
    return {"state": "asking", "short": short, "whole": whole, "causes": []}


def first_look(panel: Panel, knobs: Knobs) -> dict[str, Any]:
    """Return the slowest mode near the trim, which is no promise; a growing one breaks any."""
    slowest = panel.slowest(knobs)
    if slowest is None:
        return asking()
    if slowest < 0.0:
        return asking(f"slowest mode {slowest:.3g} 1/s; promise \u2026")
    return asking() | {
        "state": "lost",
        "short": f"nothing promised: a mode grows, {slowest:+.3g} 1/s",
    }


def _near(found: Promise, knobs: Knobs) -> bool:
    edge = found.edge
    return edge is not None and knobs.coupling is not None and knobs.coupling < _NEAR * edge
