"""A run before it is computed, and while it is: what a page is told of either."""

import dataclasses
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any

import jax.numpy as jnp
import numpy as np

from echelon.agents.network.hearing import heard_along
from echelon.core.numerics import precision
from echelon.core.types import Array
from echelon.experiments.results.recording import InputBounds, Recording
from echelon.simulation.engine.parts import Parts
from echelon.simulation.engine.record import Stretch
from echelon.simulation.step.settings import Settings

_AHEAD, _PLACES = 60.0, 121
"""Seconds of the reference that the scene makes room for, and at how many times it is asked."""
_BLOCK = 32
"""Frames of which V is found at once: one number, so that no stretch compiles anew."""

_NO_PROMISE = MappingProxyType(
    {"promised": False, "rate": None, "theorem": None, "sentence": "", "kind": "", "hypotheses": ()}
)


def foreseen(
    parts: Parts,
    settings: Settings,
    states: Array,
    name: str,
    promise: Mapping[str, Any] = _NO_PROMISE,
) -> Recording:
    """Return a recording of agents that stay on their goals: it says where the scene will be.

    Args:
        parts: of the run, with its drive completed.
        settings: of it.
        states: (N, n) at the beginning.
        name: of the scenario.
        promise: as `Promise.as_mapping` gives it; none by default.
    """
    model, graph = parts.model, parts.graph
    times = np.linspace(0.0, min(_AHEAD, max(settings.horizon, 10.0)), _PLACES)
    ahead = _ahead(parts, states, times)
    y = ahead - parts.formation.offsets
    limits = model.input_limits if settings.limits else None
    return Recording(
        name=name,
        model=type(model).__name__,
        times=times,
        states=ahead,
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
        heard=heard_in(parts),
        schedule=graph.schedule,
        state_names=model.state_names,
        state_units=model.state_units,
        input_names=model.input_names,
        input_units=model.input_units,
        position=model.position_indices(),
        bounds=None if limits is None else InputBounds(*(np.asarray(x, float) for x in limits)),
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


def heard_in(parts: Parts) -> Array:
    """Return whether each end of each edge hears the other under what drives the agents, (E, 2)."""
    drive = parts.drive
    reacts = drive.reacts or "neighbours' states" in drive.information.leader
    # A drive without laws, such as plans, asks for all neighbours.
    leaderward = getattr(getattr(drive, "follower", None), "leaderward", False)
    return heard_along(parts.graph, leaderward, reacts)


def _ahead(parts: Parts, start: Array, times: Array) -> Array:
    """Return where agents start, and their goals from then on, (T, N, n)."""
    with precision("float64"):
        wanted = parts.drive.reference_states(parts.model, jnp.asarray(times))
    if wanted is None:
        return np.broadcast_to(start, (len(times), *np.shape(start))).copy()
    states = np.asarray(wanted)[:, None] + parts.formation.offsets
    states[0] = start
    return states


def so_far(
    run: Recording, stretch: Stretch, potential: Callable[[Array], Array] | None
) -> Recording:
    """Return a stretch of a run as a recording of its own.

    Args:
        run: as it was foreseen.
        stretch: of it, all its numbers finite.
        potential: V (T,) of states less their offsets (T, N, n); None where there is none.
    """
    y = stretch.states - run.offsets
    return dataclasses.replace(
        run,
        times=stretch.times,
        states=stretch.states,
        inputs=stretch.inputs,
        errors=y - y[:, run.nearest],
        lyapunov=None if potential is None else _in_blocks(potential, y),
    )


def _in_blocks(potential: Callable[[Array], Array], y: Array) -> Array:
    """Return V (T,) of states less their offsets (T, N, n), the last block filled with copies."""
    whole = -(-len(y) // _BLOCK) * _BLOCK
    padded = np.concatenate([y, np.repeat(y[-1:], whole - len(y), axis=0)])
    return np.concatenate([potential(part) for part in np.split(padded, whole // _BLOCK)])[: len(y)]
