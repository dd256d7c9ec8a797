"""What the live page is told before the first picture."""

from typing import Any

import jax.numpy as jnp
import numpy as np

from echelon.core.numerics import precision
from echelon.core.types import Array
from echelon.engine.parts import Parts
from echelon.engine.settings import Settings
from echelon.live.knobs import Panel
from echelon.live.swarm import Swarm
from echelon.plots.space import Space, space_of
from echelon.results.recording import Bounds, Recording
from echelon.viewer.replay import header, motor_loads

_AHEAD, _PLACES = 60.0, 121
"""Seconds of the reference that the scene makes room for, and at how many times it is asked."""


def foreseen(swarm: Swarm, name: str, promise: dict[str, Any]) -> Recording:
    """Return a recording of agents that stay on their goals: it says where the scene will be."""
    parts, settings = swarm.parts, swarm.settings
    model, graph = parts.model, parts.graph
    times = np.linspace(0.0, min(_AHEAD, max(settings.horizon, 10.0)), _PLACES)
    states = _ahead(swarm, times)
    y = states - parts.formation.offsets
    limits = model.input_limits if settings.limits else None
    return Recording(
        name=name,
        model=type(model).__name__,
        times=times,
        states=states,
        inputs=np.broadcast_to(
            np.asarray(model.trim[1], float), (_PLACES, graph.agents, len(model.input_names))
        ),
        reference=None,
        errors=y - y[:, list(graph.nearest_leader())],
        offsets=parts.formation.offsets,
        leaders=graph.leaders,
        nearest=np.array(graph.nearest_leader()),
        edges=graph.edges,
        weights=graph.weights,
        mutual=parts.drive.reacts or "neighbours' states" in parts.drive.information.leader,
        state_names=model.state_names,
        state_units=model.state_units,
        input_names=model.input_names,
        input_units=model.input_units,
        position=model.position_indices(),
        bounds=None if limits is None else Bounds(*(np.asarray(x, float) for x in limits)),
        lyapunov=None,
        lyapunov_rate=None,
        metric=None,
        limited=np.zeros(graph.agents),
        tracking=None,
        modes=None,
        promise=promise,
        horizon=settings.horizon,
        dt=settings.dt,
        attributes={"outcome": "completed", "message": "", "directed": int(graph.directed)},
    )


def _ahead(swarm: Swarm, times: Array) -> Array:
    """Return where agents start, and their goals from then on, (T, N, n)."""
    parts = swarm.parts
    with precision("float64"):
        wanted = parts.drive.reference_states(parts.model, jnp.asarray(times))
    start = np.asarray(swarm.states)
    if wanted is None:
        return np.broadcast_to(start, (len(times), *start.shape)).copy()
    states = np.asarray(wanted)[:, None] + parts.formation.offsets
    states[0] = start
    return states


def live_header(swarm: Swarm, panel: Panel, name: str, badge: dict[str, Any]) -> dict[str, Any]:
    """Return what the page is told of a loop: agents, space, knobs."""
    run = foreseen(swarm, name, _silent(badge, swarm.parts))
    space = space_of(run)
    loads = motor_loads(run, space)
    return {
        **header(run, space),
        "promise": badge,
        "stream": True,
        "knobs": panel.told(),
        "methods": list(panel.methods),
        "clock": {"start": 0.0, "step": swarm.span, "last": run.times[-1]},
        "axes": len(space.axes),
        "turns": len(space.angles),
        "loads": 0 if loads is None else loads.shape[2],
        "thrust": loads is not None,
        "unit": run.unit,
        "limited": run.loads is not None,
    }


def _silent(badge: dict[str, Any], parts: Parts) -> dict[str, Any]:
    """Return a promise of nothing, as what is promised stands in the badge."""
    gain = parts.drive.gain
    coupling = None if gain is None else gain.coupling
    told = {"promised": False, "rate": None, "coupling": coupling, "theorem": None}
    return {**told, "sentence": badge["whole"], "kind": "", "hypotheses": []}


def drawn(swarm: Swarm, settings: Settings) -> tuple[Space, Bounds | None]:
    """Return where agents are drawn, and what limits their inputs."""
    run = foreseen(swarm, "", _silent({"whole": ""}, swarm.parts))
    return space_of(run), run.bounds if settings.limits else None
