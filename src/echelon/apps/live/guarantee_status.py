"""What is guaranteed of a live loop: computed while it runs, and withdrawn by what it shows."""

import threading
import traceback
from collections.abc import Callable
from typing import Final, NamedTuple, final

import numpy as np

from echelon.agents.models.model import ControlAffine
from echelon.agents.network.graph import Graph
from echelon.apps.live.knobs import Knobs
from echelon.apps.live.panel import Panel
from echelon.apps.live.swarm import Picture
from echelon.core.digits import at_least, at_most
from echelon.core.errors import EchelonError, GraphError
from echelon.core.rational import bisect
from echelon.core.types import JsonObject
from echelon.experiments.results.metrics import ROUNDING
from echelon.experiments.scenario.build import build
from echelon.guarantees.promises.closed_loop import LinearLoop
from echelon.guarantees.promises.promise import guarantee
from echelon.output.reports.run_report import beyond
from echelon.output.viewer.replay import guarantee_badge
from echelon.simulation.step.meter import SETTLED, outside
from echelon.simulation.step.settings import Settings

_HALVINGS = 12  # of the slider, for the place of a mark
_NEAR = 1.1
"""Below this multiple of the smallest guaranteed coupling the badge warns of the edge."""


@final
class _Newest:
    """A thread that works on requests; of several that wait only the last is worked on."""

    def __init__(self, work: Callable[["_Request"], None]) -> None:
        self.work = work
        self.request: _Request | None = None
        self.changed, self.ended = threading.Condition(), False
        self.thread = threading.Thread(target=self._run, daemon=True)
        self.thread.start()

    def ask(self, request: "_Request") -> None:
        with self.changed:
            self.request = request
            self.changed.notify()

    def end(self) -> None:
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
    """

    def __init__(self, answer: Callable[[JsonObject], None]) -> None:
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
        found = guarantee(*(panel.experiment if unchanged else build(panel.scenario_at(knobs))))
    except EchelonError as error:
        # A scenario that is refused has no guarantee, such as one with a disconnected graph.
        cause = str(error).removeprefix("mapping: ")
        return {"state": "lost", "short": "no guarantee", "whole": cause, "causes": [cause]}
    stated = found.as_mapping()
    badge: JsonObject = guarantee_badge(stated)
    badge["apart"] = ((stated["anywhere"] or {}).get("separation") or {}).get("distance")
    badge["causes"] = [f"Not guaranteed: {cause.text}." for cause in found.causes]
    badge["edge"], badge["end"] = found.edge, _end(panel, knobs, found.edge)
    badge["above"] = None if found.edge is None else at_least(found.edge)
    badge["rate"] = found.rate if found.promised else None
    certified = found.certified
    badge["anywhere"] = certified is not None and certified.radius == float("inf")
    # Shown where the guarantee does not cover the state.
    badge["beyond"] = [*beyond(0.0, found)]
    edge, c = found.edge, knobs.coupling
    if found.promised and edge is not None and c is not None and c < _NEAR * edge:
        badge |= {"state": "edge", "short": f"{badge['short']}, near its edge"}
    elif not found.promised and found.slowest is not None:
        growth = _growth(panel.live.loop(knobs), panel.experiment.settings)
        badge["short"] = growth or badge["short"]
    return badge


def _end(panel: Panel, knobs: Knobs, edge: float | None) -> float | None:
    """None without an edge, and where they grow nowhere or everywhere on the slider."""
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
    slowest = at_least(np.log(loop.radius(settings)) / settings.dt)
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


# ---- the badge while the loop runs ---------------------------------------------------------------


_TRANSIENT = 2.0
"""Time constants of the guaranteed rate during which errors may grow, as after a kick."""
_SHORTEST, _LONGEST = 1.0, 10.0  # s of that transient
_GROWTH = 2.0
"""Factor by which errors may exceed those of the transient, as in the report of a run."""
_LARGE = (
    "Errors are more than twice as large as at the start. Whether the local guarantee covers them "
    "is known once they have halved."
)


@final
class GuaranteeStatus:
    """The badge of a guarantee, which is withdrawn while the state is not covered.

    It is restored once all agents are in their domain and errors have halved; of agents that keep
    apart, once their hulls are as far apart as they keep.
    """

    def __init__(
        self, model: ControlAffine, graph: Graph, show: Callable[[JsonObject], None]
    ) -> None:
        self.names, self.followers = [*model.chart], list(graph.followers)
        self.columns = [model.state_names.index(name) for name in self.names]
        self.chart = np.array([*model.chart.values()], float).reshape(-1, 2)
        self.show, self.lock, self.severity = show, threading.Lock(), 0
        self.badge: JsonObject = {"state": "pending"}
        self.restart()

    def restart(self) -> None:
        """Forget all errors, as after a reset."""
        self.departure, self.peak, self.lost, self.reference = "", 0.0, False, 0.0
        self.near = np.inf
        self.begin()
        self.fresh = True

    def begin(self) -> None:
        """Begin another transient, as after a change of a knob or a kick."""
        self.since, self.transient, self.growing, self.large = np.nan, 0.0, False, False
        self.fresh = False

    def update(self, badge: JsonObject) -> None:
        """Show the badge of another guarantee, withdrawn if it does not cover the state."""
        with self.lock:
            self.badge = badge
            self.show(self._current())

    def look(self, picture: Picture) -> None:
        """Evaluate a picture, and show the badge if it changes."""
        with self.lock:
            self._follow(picture)
            if self.severity != self._severity():
                self.show(self._current())

    def lose(self) -> None:
        """Withdraw any guarantee, since an agent has no finite state."""
        with self.lock:
            self.lost = True
            self.show(self._current())

    def _follow(self, picture: Picture) -> None:
        errors = picture.errors[self.followers]
        size = float(np.sqrt((errors**2).mean())) if errors.size else 0.0
        if np.isnan(self.since):
            self.since = picture.time
            # Errors beyond those of the first transient have never been seen to converge.
            self.large = not self.fresh and size > max(_GROWTH * self.reference, SETTLED)
        withdrawn = self.departure or self.growing or self.large
        self.peak = max(self.peak, size) if withdrawn else size
        self.near = picture.apart
        halved, departure = size <= 0.5 * self.peak, self._departure(picture)
        self.departure = (self.departure or departure) if departure or not halved else ""
        self.large = self.large and not halved
        self._follow_transient(picture.time, size, halved)

    def _follow_transient(self, time: float, size: float, halved: bool) -> None:
        rate = max(self.badge.get("rate") or 0.0, 1e-9)
        if time > self.since + min(_LONGEST, max(_SHORTEST, _TRANSIENT / rate)):
            limit = max(_GROWTH * self.transient, SETTLED)
            self.growing = not halved if self.growing else size > limit
            return
        self.transient = max(self.transient, size)
        self.reference = self.transient if self.fresh else self.reference

    def _departure(self, picture: Picture) -> str:
        out = outside(picture.states[:, self.columns], *self.chart.T)
        if not out.any():
            return ""
        agent, k = (int(place) for place in np.argwhere(out)[0])
        return (
            f"Agent {agent} left the domain of its equations at t = {picture.time:.2f} s: "
            f"`{self.names[k]}` is not between {self.chart[k, 0]:.4g} and {self.chart[k, 1]:.4g}. "
            "Its motion is not valid from then on."
        )

    def _severity(self) -> int:
        """Return 0 if the guarantee covers the state, 1 if that is not known, 2 if it does not."""
        if not self.badge.get("beyond"):
            return 0
        if self.badge.get("apart") is not None:
            return 2 * bool(self.departure or self.lost or self._too_near())
        if self.departure or self.growing or self.lost:
            return 2
        return int(self.large and not self.badge.get("anywhere"))

    def _too_near(self) -> str:
        kept = self.badge.get("apart")
        if kept is None or self.near >= kept - ROUNDING:
            return ""
        return (
            f"The hulls of two agents are {at_most(self.near)} m apart, scaled, as after a kick; "
            f"from {at_least(kept)} m on it is guaranteed again that agents stay apart."
        )

    def _current(self) -> JsonObject:
        self.severity = self._severity()
        if self.severity == 0:
            return self.badge
        if self.severity == 1:
            return self._replaced("edge", f"{self.badge['short']}, for small errors", [_LARGE])
        near = self._too_near()
        beyond = [] if near else self.badge["beyond"]
        causes = [cause for cause in (near, *beyond, self.departure) if cause]
        return self._replaced("lost", "the guarantee does not cover this state", causes)

    def _replaced(self, state: str, short: str, causes: list[str]) -> JsonObject:
        whole = f"{' '.join(causes)} {self.badge['whole']}"
        return {**self.badge, "state": state, "short": short, "whole": whole, "causes": causes}


def lost(picture: Picture) -> str:
    """Return a sentence about the agent that diverged."""
    agent, when = int(np.argmax(picture.beyond)), f"at {picture.time:.2f} s"
    if np.isfinite(picture.states[agent]).all():
        largest = np.abs(picture.states[agent]).max()
        return f"Agent {agent} diverged {when} (a state is {largest:.1e}). Reset to continue."
    return f"The state of agent {agent} stopped being finite {when}. Reset to continue."
