"""Recordings of a run before it is computed, and of each part while it is computed."""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from echelon.agents.network.hearing import heard_along
from echelon.core.numerics import precision
from echelon.core.types import Array
from echelon.experiments.results.recording import InputBounds, Recording
from echelon.simulation.engine.parts import Parts
from echelon.simulation.engine.record import Stretch
from echelon.simulation.step.settings import Settings

_AHEAD, _PLACES = 60.0, 121
"""Seconds of the reference by which the scene is sized, and the number of times in them."""
_BLOCK = 32
"""Frames for which V is computed at once: a constant, so that it is compiled once."""

_NO_PROMISE = MappingProxyType(
    {"promised": False, "rate": None, "theorem": None, "sentence": "", "kind": "", "hypotheses": ()}
)


def foreseen(
    parts: Parts,
    settings: Settings,
    states: Float[Array, "N n"],
    name: str,
    promise: Mapping[str, Any] = _NO_PROMISE,
) -> Recording:
    """Return a recording of agents that stay at their goals, by which the scene is sized.

    Args:
        parts: of the run, with its drive completed.
        settings: of the run.
        states: at the beginning.
        name: of the scenario.
        promise: as `Promise.as_mapping` returns it; none by default.
    """
    model, graph = parts.model, parts.graph
    times = np.linspace(0.0, min(_AHEAD, max(settings.horizon, 10.0)), _PLACES)
    ahead = _ahead(parts, states, times)
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
        errors=_errors(ahead, parts.formation.offsets, graph.nearest_leader()),
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
        saturated=np.zeros(graph.agents),
        tracking=None,
        modes=None,
        promise=promise,
        horizon=settings.horizon,
        dt=settings.dt,
        attributes={"outcome": "completed", "message": "", "directed": int(graph.directed)},
    )


def heard_in(parts: Parts) -> Bool[Array, "E 2"]:
    """Return whether each end of each edge receives from the other under the laws."""
    drive = parts.drive
    reacts = drive.reacts or "neighbours' states" in drive.information.leader
    # A drive without laws, such as plans, uses all neighbours.
    leaderward = getattr(getattr(drive, "follower", None), "leaderward", False)
    return heard_along(parts.graph, leaderward, reacts)


def _errors(
    states: Float[Array, "T N n"], offsets: Float[Array, "N n"], nearest: Sequence[int] | Array
) -> Float[Array, "T N n"]:
    """Return the deviations from the goals relative to each agent's nearest leader."""
    y = states - offsets
    return y - y[:, np.asarray(nearest)]


def _ahead(
    parts: Parts, start: Float[Array, "N n"], times: Float[Array, " T"]
) -> Float[Array, "T N n"]:
    """Return the states at the start, and the goals from then on."""
    with precision("float64"):
        path = parts.drive.reference_states(parts.model, jnp.asarray(times))
    if path is None:
        return np.broadcast_to(start, (len(times), *np.shape(start))).copy()
    states = np.asarray(path)[:, None] + parts.formation.offsets
    states[0] = start
    return states


def so_far(
    run: Recording, stretch: Stretch, potential: Callable[[Array], Array] | None
) -> Recording:
    """Return a part of a run as a recording.

    Args:
        run: as returned by `foreseen`.
        stretch: the part, with finite numbers.
        potential: V (T,) of states minus offsets (T, N, n); None where there is none.
    """
    return dataclasses.replace(
        run,
        times=stretch.times,
        states=stretch.states,
        inputs=stretch.inputs,
        errors=_errors(stretch.states, run.offsets, run.nearest),
        lyapunov=None if potential is None else _in_blocks(potential, stretch.states - run.offsets),
    )


def _in_blocks(potential: Callable[[Array], Array], y: Float[Array, "T N n"]) -> Float[Array, " T"]:
    """Return V of states minus offsets, block by block, the last one padded with copies."""
    whole = -(-len(y) // _BLOCK) * _BLOCK
    padded = np.concatenate([y, np.repeat(y[-1:], whole - len(y), axis=0)])
    return np.concatenate([potential(part) for part in np.split(padded, whole // _BLOCK)])[: len(y)]
