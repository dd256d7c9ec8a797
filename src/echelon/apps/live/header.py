"""The header of the live page: agents, space and controls, before the first picture."""

import numpy as np

from echelon.apps.live.panel import Panel
from echelon.apps.live.swarm import LiveLoop
from echelon.core.types import JsonObject
from echelon.experiments.results.recording import Recording, foreseen
from echelon.output.plots.space import Space, space_of
from echelon.output.viewer.charts import distance_chart
from echelon.output.viewer.replay import header, motor_loads

_AHEAD, _APART = 60.0, 0.1
"""Seconds of the reference that are drawn, and seconds between two places of it."""


def live_header(swarm: LiveLoop, panel: Panel, name: str, badge: JsonObject) -> JsonObject:
    """Return the header of a loop's page."""
    run = foreseen_of(swarm, name)
    space = space_of(run)
    loads = motor_loads(run, space)
    return {
        **header(run, space),
        "promise": badge,
        "stream": True,
        "knobs": panel.sliders(),
        "choices": panel.choices(),
        "lyapunov": swarm.potential is not None,
        "clock": {"start": 0.0, "step": swarm.span, "last": run.times[-1]},
        "axes": len(space.axes),
        "turns": len(space.angles),
        "loads": 0 if loads is None else loads.shape[2],
        "thrust": loads is not None,
        "path": _path(swarm, space),
        "unit": run.length_unit,
        "limited": run.loads is not None,
        "near": distance_chart(run, []) if run.ellipsoid and run.agents > 1 else None,
        "messages": swarm.parts.world.network is not None,
    }


def _path(swarm: LiveLoop, space: Space) -> list[list[float]]:
    """Return places along the reference as they are drawn; none without a reference."""
    times = swarm.first * swarm.settings.dt + np.arange(0.0, _AHEAD, _APART)
    states = swarm.reference_at(times)
    if states is None:
        return []
    places = np.zeros((len(times), 3))
    if space.kind == "time":
        places[:, :2] = np.column_stack([times, states[:, space.axes[0]]])
    else:
        places[:, : len(space.axes)] = states[:, list(space.axes)]
    places[:, :2] *= space.stretch
    return np.round(places, 4).tolist()


def foreseen_of(swarm: LiveLoop, name: str) -> Recording:
    """Return a recording with all of a loop but its frames."""
    return foreseen(swarm.parts, swarm.settings, np.asarray(swarm.states), name)
