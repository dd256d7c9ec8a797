"""Whether the guarantee of a live loop covers its present state, and the badge that says so.

A local guarantee holds for errors that are small enough, and how small is not known. So the badge
withdraws it where the loop shows that they are not: where an agent leaves the domain of its
equations, and where errors grow after the first transient.
"""

import threading
from collections.abc import Callable
from typing import final

import numpy as np

from echelon.agents.models.model import ControlAffine
from echelon.agents.network.graph import Graph
from echelon.apps.live.swarm import Picture
from echelon.core.digits import at_least, at_most
from echelon.core.types import JsonObject
from echelon.experiments.results.metrics import ROUNDING
from echelon.simulation.step.meter import SETTLED, outside

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

    Args:
        model: of the agents.
        graph: of their communication.
        show: called with each new badge.
    """

    def __init__(
        self, model: ControlAffine, graph: Graph, show: Callable[[JsonObject], None]
    ) -> None:
        """Begin without a guarantee."""
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
        """Record the errors of the transient, and compare later errors with them."""
        if time > self.since + self._duration():
            limit = max(_GROWTH * self.transient, SETTLED)
            self.growing = not halved if self.growing else size > limit
            return
        self.transient = max(self.transient, size)
        self.reference = self.transient if self.fresh else self.reference

    def _duration(self) -> float:
        """Return the duration of the transient (s)."""
        rate = max(self.badge.get("rate") or 0.0, 1e-9)
        return min(_LONGEST, max(_SHORTEST, _TRANSIENT / rate))

    def _departure(self, picture: Picture) -> str:
        """Return a sentence about an agent outside its domain; empty if all are inside."""
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
        """Return a sentence about hulls that are nearer than they keep; empty if none are."""
        kept = self.badge.get("apart")
        if kept is None or self.near >= kept - ROUNDING:
            return ""
        return (
            f"The hulls of two agents are {at_most(self.near)} m apart, scaled, as after a kick; "
            f"from {at_least(kept)} m on it is guaranteed again that agents stay apart."
        )

    def _current(self) -> JsonObject:
        """Return the badge for the present state."""
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
