"""What the live page is told before the first picture."""

from typing import Any

import numpy as np

from echelon.apps.live.knobs import Panel
from echelon.apps.live.swarm import LiveLoop
from echelon.experiments.results.foreseen import foreseen
from echelon.experiments.results.recording import InputBounds, Recording
from echelon.output.plots.space import Space, space_of
from echelon.output.viewer.replay import header, motor_loads
from echelon.simulation.step.settings import Settings


def live_header(swarm: LiveLoop, panel: Panel, name: str, badge: dict[str, Any]) -> dict[str, Any]:
    """Return what the page is told of a loop: agents, space, knobs."""
    run = _foreseen(swarm, name, badge)
    space = space_of(run)
    loads = motor_loads(run, space)
    return {
        **header(run, space),
        "promise": badge,
        "stream": True,
        "knobs": panel.told(),
        "choices": panel.choices(),
        "lyapunov": swarm.potential is not None,
        "clock": {"start": 0.0, "step": swarm.span, "last": run.times[-1]},
        "axes": len(space.axes),
        "turns": len(space.angles),
        "loads": 0 if loads is None else loads.shape[2],
        "thrust": loads is not None,
        "unit": run.unit,
        "limited": run.loads is not None,
    }


def _foreseen(swarm: LiveLoop, name: str, badge: dict[str, Any]) -> Recording:
    parts, states = swarm.parts, np.asarray(swarm.states)
    return foreseen(parts, swarm.settings, states, name, _silent(badge))


def _silent(badge: dict[str, Any]) -> dict[str, Any]:
    """Return a promise of nothing, as what is promised stands in the badge."""
    # How the coupling stands is told by its knob.
    told = {"promised": False, "rate": None, "coupling": None, "theorem": None}
    return {**told, "sentence": badge["whole"], "kind": "", "hypotheses": []}


def drawn(swarm: LiveLoop, settings: Settings) -> tuple[Space, InputBounds | None]:
    """Return where agents are drawn, and what limits their inputs."""
    run = _foreseen(swarm, "", {"whole": ""})
    return space_of(run), run.bounds if settings.limits else None
