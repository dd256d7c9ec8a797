"""The loops of a live session, each compiled while another one runs."""

from collections.abc import Callable
from typing import final

from echelon.apps.live.choices import under
from echelon.apps.live.panel import Panel, check_choice
from echelon.apps.live.swarm import LiveLoop
from echelon.core.types import JsonObject


@final
class LoopsByLaw:
    """Loops by the followers' law, each also with agents that can be lost and join.

    Args:
        panel: of the first law.
        swarm: its loop.
        send: called with messages to the pages.
    """

    def __init__(self, panel: Panel, swarm: LiveLoop, send: Callable[[JsonObject], None]) -> None:
        """Begin with one loop."""
        self.first, self.send = panel, send
        self.ready = {(panel.law, swarm.eventful): (panel, swarm)}

    def prepare(self, law: str, eventful: bool) -> tuple[Panel, LiveLoop]:
        """Return the loop under a law with its panel, compiled if it is not yet.

        Args:
            law: of the followers.
            eventful: whether agents can be lost and join.

        Raises:
            EchelonError: the law is unknown, or does not fit these agents.
        """
        key = law, eventful
        for usable in (key, (law, True)):
            if usable in self.ready:
                return self.ready[usable]
        check_choice("law", law, self.first.laws)
        what = "room for events" if eventful else f"the law `{law}`"
        self.send({"note": f"Compiling {what}; the loop continues meanwhile."})
        try:
            panel = self._panel(law)
            loop = LiveLoop(*panel.experiment, panel.live, eventful)
            # The first step compiles the rest.
            loop.advance()
            self.ready[key] = panel, loop
        finally:
            self.send({"note": ""})
        return self.ready[key]

    def _panel(self, law: str) -> Panel:
        for (name, _), (panel, _) in self.ready.items():
            if name == law:
                return panel
        return Panel(*under(self.first.scenario, law))
