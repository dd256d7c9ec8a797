"""Whether what is promised reaches the state that a loop is in, and what is told where it does not.

A promise near the trim is one of errors that are small enough, and no set of them is known to it.
So it is taken back where the loop itself shows that they are not: where an agent has left the chart
of its equations, and where errors grow after the first swing.
"""

import threading
from collections.abc import Callable, Mapping
from typing import Any, final

import numpy as np

from echelon.agents.models.model import ControlAffine
from echelon.agents.network.graph import Graph
from echelon.apps.live.swarm import Picture
from echelon.simulation.step.meter import SETTLED, outside

_SWING = 2.0
"""Time constants of the promised rate in which errors may grow first, as after a kick."""
_SHORTEST, _LONGEST = 1.0, 10.0  # s of that swing
_GROWN = 2.0
"""Times the errors of the swing: as much as a run's report allows them to grow."""
_DOUBT = (
    "Errors are more than twice those that the loop began with: whether this is near enough is "
    "known once they have halved."
)


@final
class GuaranteeStatus:
    """Tells the badge of a promise, or that what is promised does not reach the state at hand.

    What was taken back is given again once all are in their chart and errors have halved.

    Args:
        model: of the agents.
        graph: who follows whom.
        tell: called with the badge that holds now.
    """

    def __init__(
        self, model: ControlAffine, graph: Graph, tell: Callable[[Mapping[str, Any]], None]
    ) -> None:
        """Begin with nothing promised."""
        self.names, self.followers = [*model.chart], list(graph.followers)
        self.charted = [model.state_names.index(name) for name in self.names]
        self.chart = np.array([*model.chart.values()], float).reshape(-1, 2)
        self.tell, self.lock, self.stood = tell, threading.Lock(), 0
        self.badge: Mapping[str, Any] = {"state": "asking"}
        self.restart()

    def restart(self) -> None:
        """Forget how errors went, as where agents are put elsewhere."""
        self.left, self.farthest, self.gone, self.known = "", 0.0, False, 0.0
        self.begin()
        self.fresh = True

    def begin(self) -> None:
        """Let the first swing begin anew, as under other knobs or after a kick."""
        self.since, self.swing, self.grows, self.doubts = np.nan, 0.0, False, False
        self.fresh = False

    def hear(self, badge: Mapping[str, Any]) -> None:
        """Take what is promised, and tell it as far as it reaches."""
        with self.lock:
            self.badge = badge
            self.tell(self._told())

    def look(self, picture: Picture) -> None:
        """Look at a picture, and tell where it changes what is told."""
        with self.lock:
            self._follow(picture)
            if self.stood != self._stands():
                self.tell(self._told())

    def lose(self) -> None:
        """Take any promise back: an agent is where nothing can be computed."""
        with self.lock:
            self.gone = True
            self.tell(self._told())

    def _follow(self, picture: Picture) -> None:
        errors = picture.errors[self.followers]
        size = float(np.sqrt((errors**2).mean())) if errors.size else 0.0
        if np.isnan(self.since):
            self.since = picture.time
            # Nothing is known of errors that are larger than those that it began with.
            self.doubts = not self.fresh and size > max(_GROWN * self.known, SETTLED)
        taken = self.left or self.grows or self.doubts
        self.farthest = max(self.farthest, size) if taken else size
        back, out = size <= 0.5 * self.farthest, self._outside(picture)
        self.left = (self.left or out) if out or not back else ""
        self.doubts = self.doubts and not back
        self._swing(picture.time, size, back)

    def _swing(self, time: float, size: float, back: bool) -> None:
        """Take the errors of the swing, and compare with them what comes after it."""
        if time > self.since + self._longest():
            self.grows = not back if self.grows else size > max(_GROWN * self.swing, SETTLED)
            return
        self.swing = max(self.swing, size)
        self.known = self.swing if self.fresh else self.known

    def _longest(self) -> float:
        """Return how long errors may grow at first (s)."""
        return min(_LONGEST, max(_SHORTEST, _SWING / max(self.badge.get("rate") or 0.0, 1e-9)))

    def _outside(self, picture: Picture) -> str:
        """Return who is out of its chart, in words; nothing where all are inside."""
        out = outside(picture.states[:, self.charted], *self.chart.T)
        if not out.any():
            return ""
        agent, k = (int(place) for place in np.argwhere(out)[0])
        return (
            f"Agent {agent} left the chart of its equations at t = {picture.time:.2f} s: "
            f"`{self.names[k]}` is not between {self.chart[k, 0]:.4g} and {self.chart[k, 1]:.4g}, "
            "and what follows is not the agent's motion."
        )

    def _stands(self) -> int:
        """Return 0 where what is promised may reach, 1 where that is in doubt, 2 where not."""
        if not self.badge.get("beyond"):
            return 0
        if self.left or self.grows or self.gone:
            return 2
        return int(self.doubts and not self.badge.get("anywhere"))

    def _told(self) -> Mapping[str, Any]:
        """Return the badge, taken back where its promise does not reach."""
        self.stood = self._stands()
        if self.stood == 0:
            return self.badge
        if self.stood == 1:
            short, causes = f"{self.badge['short']}, if near enough", [_DOUBT]
            return self._instead("edge", short, causes)
        causes = [each for each in (*self.badge["beyond"], self.left) if each]
        return self._instead("lost", "what is promised does not reach here", causes)

    def _instead(self, state: str, short: str, causes: list[str]) -> Mapping[str, Any]:
        whole = f"{' '.join(causes)} {self.badge['whole']}"
        return {**self.badge, "state": state, "short": short, "whole": whole, "causes": causes}


def lost(picture: Picture) -> str:
    """Return who was lost, and when, in words."""
    who, when = int(np.argmax(picture.beyond)), f"at {picture.time:.2f} s"
    if np.isfinite(picture.states[who]).all():
        far = np.abs(picture.states[who]).max()
        return f"Agent {who} has flown apart, to {far:.1e}, {when}; reset."
    return f"The state of agent {who} stopped being finite {when}; reset."
