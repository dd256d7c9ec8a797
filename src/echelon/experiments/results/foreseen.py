"""Recordings of a run before it is computed, and of each part while it is computed."""

import dataclasses
import json
from collections.abc import Callable

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from echelon.agents.network.formation import Formation
from echelon.core.numerics import precision
from echelon.core.types import Array, JsonObject
from echelon.experiments.results.labelled_parts import labelled_parts
from echelon.experiments.results.recording import Recording, recording
from echelon.simulation.engine.parts import Parts
from echelon.simulation.engine.record import Stretch
from echelon.simulation.step.settings import Settings

_AHEAD, _PLACES = 60.0, 121
"""Seconds of the reference by which the scene is sized, and the number of times in them."""
_BLOCK = 32
"""Frames for which V is computed at once: a constant, so that it is compiled once."""

_NO_PROMISE: JsonObject = {
    "promised": False,
    "rate": None,
    "theorem": None,
    "sentence": "",
    "kind": "",
    "hypotheses": (),
}


def foreseen(
    parts: Parts,
    settings: Settings,
    states: Float[Array, "N n"],
    name: str,
    promise: JsonObject = _NO_PROMISE,
) -> Recording:
    """Return a recording of agents that stay at their goals, by which the scene is sized.

    Args:
        parts: of the run, with its drive completed.
        settings: of the run.
        states: at the beginning.
        name: of the scenario.
        promise: as `Promise.as_mapping` returns it; none by default.
    """
    model, fixed = parts.model, labelled_parts(parts, settings)
    times = np.linspace(0.0, min(_AHEAD, max(settings.horizon, 10.0)), _PLACES)
    ahead, reference = _ahead(parts, states, times)
    trim, agents = np.asarray(model.trim[1], float), parts.graph.agents
    frames = {
        "time": times,
        "states": ahead,
        "inputs": np.broadcast_to(trim, (_PLACES, agents, len(trim))),
        "saturated": np.zeros(agents),
    }
    frames |= {} if reference is None else {"reference": reference}
    if parts.formation.motion is not None:
        frames["moving_offset"] = parts.formation.offsets_at(times)
    attributes = {"scenario": name, "outcome": "completed", "message": ""}
    attributes["promise"] = json.dumps(promise)
    return recording(fixed.arrays() | frames, fixed.attributes | attributes)


def _ahead(
    parts: Parts, start: Float[Array, "N n"], times: Float[Array, " T"]
) -> tuple[Float[Array, "T N n"], Float[Array, "T n"] | None]:
    """Return the states at the start and the goals from then on, and the reference if any."""
    with precision("float64"):
        path = parts.drive.reference_states(parts.model, jnp.asarray(times))
    if path is None:
        return np.broadcast_to(start, (len(times), *np.shape(start))).copy(), None
    reference = np.asarray(path, float)
    states = reference[:, None] + parts.formation.offsets_at(times)
    states[0] = start
    return states, reference


def so_far(
    run: Recording,
    stretch: Stretch,
    potential: Callable[[Array], Array] | None,
    formation: Formation,
) -> Recording:
    """Return a part of a run as a recording.

    Args:
        run: as returned by `foreseen`.
        stretch: the part, with finite numbers.
        potential: V (T,) of states minus offsets (T, N, n); None where there is none.
        formation: of the run.
    """
    moving = None if formation.motion is None else formation.offsets_at(stretch.times)
    return dataclasses.replace(
        run,
        times=stretch.times,
        states=stretch.states,
        inputs=stretch.inputs,
        reference=stretch.reference,
        moving=moving,
        lyapunov=None if potential is None else _in_blocks(potential, stretch.states - run.offsets),
    )


def _in_blocks(potential: Callable[[Array], Array], y: Float[Array, "T N n"]) -> Float[Array, " T"]:
    """Return V of states minus offsets, block by block, the last one padded with copies."""
    whole = -(-len(y) // _BLOCK) * _BLOCK
    padded = np.concatenate([y, np.repeat(y[-1:], whole - len(y), axis=0)])
    return np.concatenate([potential(part) for part in np.split(padded, whole // _BLOCK)])[: len(y)]
