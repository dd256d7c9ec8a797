"""Runs whose inputs come from the host: the plant of `simulate`, period by period."""

import time
from collections.abc import Callable, Mapping
from typing import NamedTuple, TypeAlias, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from echelon.core.errors import Outcome, SimulationError
from echelon.core.numerics import Precision, precision
from echelon.core.types import Array, Inputs, States
from echelon.engine.initial import Initial, initial_states
from echelon.engine.loop import Loop, advance_plant, assemble, delivered
from echelon.engine.prepare import check_parts, check_settings, formation_warnings
from echelon.engine.result import Result, Settings
from echelon.laws.trim_input import TrimInput
from echelon.models.check import check_model
from echelon.models.model import ControlAffine
from echelon.network.formation import Formation
from echelon.network.graph import Graph
from echelon.optimal.optimized import Optimized
from echelon.references.flatness import reference_warnings
from echelon.references.reference import Reference
from echelon.world.disturbance import Disturbance
from echelon.world.plant import check_plant

Progress: TypeAlias = Callable[[int, int], None]


class Stopped(Exception):
    """Raised by a pilot that gives no further inputs, with the reason in words."""


class Flight(NamedTuple):
    """The parts of a run on the host, checked and ready."""

    model: ControlAffine
    graph: Graph
    formation: Formation
    reference: Reference | None
    plant: ControlAffine | None
    disturbance: Disturbance | None
    settings: Settings
    loop: Loop
    states: Array
    warnings: tuple[str, ...]
    began: float

    @property
    def steps(self) -> int:
        """Steps of the simulation."""
        return max(1, round(self.settings.horizon / self.settings.dt))


Pilot: TypeAlias = Callable[[int, Array], Array]
"""(step, states (N, n)) -> wanted physical inputs (N, m) from that step on."""


def take_off(
    model: ControlAffine,
    graph: Graph,
    formation: Formation,
    *,
    reference: Reference | None,
    initial: Initial,
    start_error: Mapping[str, float] | None,
    plant: ControlAffine | None,
    disturbance: Disturbance | None,
    settings: Settings,
) -> Flight:
    """Check the parts as `simulate` does, and return them with the starts.

    Raises:
        EchelonError: a part is malformed or does not fit the others.
    """
    began = time.perf_counter()
    check_settings(settings)
    if reference is not None and not isinstance(reference, Reference):
        raise SimulationError(
            f"`reference` is a `{type(reference).__name__}`, and must be a `Reference`."
        )
    marker = Optimized((), reference)
    check_parts(graph, formation, marker, marker, disturbance)
    with precision("float64"):
        warnings = check_model(model)
        if plant is not None:
            warnings = tuple(dict.fromkeys((*warnings, *check_model(plant))))
            check_plant(model, plant)
        idle = TrimInput()
        loop = assemble(model, graph, formation, idle, idle, settings, plant, disturbance)
        states = initial_states(
            model, graph, formation, marker, initial, start_error or {}, settings.seed
        )
    warnings += formation_warnings(model, formation)
    if reference is not None and settings.limits:
        warnings += reference_warnings(model, reference, settings.horizon)
    parts = (model, graph, formation, reference, plant, disturbance, settings)
    return Flight(*parts, loop, states, warnings, began)


class _Track(NamedTuple):
    """States (T + 1, N, n), delivered inputs (T, N, m), saturated steps (N,), and why it ended."""

    states: Array
    inputs: Array
    saturated: Array
    stopped: str | None


def fly(
    flight: Flight,
    pilot: Pilot,
    hold: int,
    *,
    told: tuple[str, ...],
    progress: Progress | None,
) -> Result:
    """Run a flight whose pilot is asked every `hold` steps.

    `told` is what the followers know of others, in words.
    """
    with precision(cast(Precision, flight.settings.precision)):
        track = _fly(flight, pilot, hold, progress)
    return _result(flight, track, told)


def _fly(flight: Flight, pilot: Pilot, hold: int, progress: Progress | None) -> _Track:
    total, states = flight.steps, jnp.asarray(flight.states)
    passed, inputs, stopped = [], [], None
    saturated = np.zeros(len(states))
    try:
        for first in range(0, total, hold):
            count = min(hold, total - first)
            wanted = jnp.asarray(pilot(first, np.asarray(states, np.float64)))
            states, each, u = _held(
                flight.loop, states, wanted, jnp.asarray(first, jnp.int32), count
            )
            passed.append(np.asarray(each, np.float64))
            inputs += [np.asarray(u, np.float64)[None]] * count
            saturated += count * np.asarray(u != wanted).any(axis=1)
            if progress is not None:
                progress(first + count, total)
            if not np.isfinite(passed[-1]).all() or not np.isfinite(inputs[-1]).all():
                break
    except KeyboardInterrupt:
        stopped = "The run was interrupted"
    except Stopped as reason:
        stopped = f"The run was stopped, since {reason}"
    every = np.concatenate(
        [np.zeros((0, *states.shape)), *passed, np.asarray(states, np.float64)[None]]
    )
    none = np.zeros((0, len(states), len(flight.model.input_names)))
    return _Track(every, np.concatenate([none, *inputs]), saturated, stopped)


@eqx.filter_jit
def _held(
    loop: Loop, states: States, wanted: Inputs, first: jax.Array, count: int
) -> tuple[States, jax.Array, Inputs]:
    """Return the states after `count` steps, those before each step, and the delivered inputs."""
    u = delivered(loop, wanted)

    def one(x: States, step: jax.Array) -> tuple[States, States]:
        return advance_plant(loop, x, u, step), x

    last, passed = jax.lax.scan(one, states, first + jnp.arange(count, dtype=jnp.int32))
    return last, passed, u


def _result(flight: Flight, track: _Track, told: tuple[str, ...]) -> Result:
    settings, total = flight.settings, flight.steps
    flown = len(track.inputs)
    lost = np.array(~np.isfinite(track.states).all(axis=2))
    cut = int(np.argwhere(lost)[0, 0]) if lost.any() else flown + 1
    outcome, message = _verdict(flight, track, cut, lost)
    kept = np.arange(0, min(cut, flown + 1), settings.store_every)
    if outcome is Outcome.COMPLETED and kept[-1] != total:
        kept = np.append(kept, total)
    # The last frame has no input of its own, since nothing is asked after the end.
    inputs = track.inputs[np.minimum(kept, flown - 1)] if flown else track.inputs
    kept = kept[: len(inputs)]
    times = settings.dt * kept
    leader = Optimized(("the reference",) if flight.reference is not None else (), flight.reference)
    with precision("float64"):
        followed = leader.reference_states(flight.model, jnp.asarray(times)) if len(kept) else None
    return Result(
        times=times,
        states=track.states[kept],
        inputs=inputs,
        reference=None if followed is None else np.asarray(followed, np.float64),
        saturated=track.saturated / max(1, flown),
        outcome=outcome,
        message=message,
        warnings=flight.warnings,
        model=flight.model,
        graph=flight.graph,
        formation=flight.formation,
        leader=leader,
        follower=Optimized(told),
        settings=settings,
        plant=flight.plant,
        disturbance=flight.disturbance,
        wall_time=time.perf_counter() - flight.began,
    )


def _verdict(flight: Flight, track: _Track, cut: int, lost: Array) -> tuple[Outcome, str]:
    dt = flight.settings.dt
    if lost.any():
        agent = int(np.argwhere(lost)[0, 1])
        role = "leader" if agent in flight.graph.leaders else "follower"
        return (
            Outcome.DIVERGED,
            f"The state of {role} {agent} stopped being finite by t = {cut * dt:.6g} s.",
        )
    if track.stopped is None:
        return Outcome.COMPLETED, Outcome.COMPLETED.value
    return (
        Outcome.INTERRUPTED,
        f"{track.stopped} at t = {len(track.inputs) * dt:.6g} s; what was computed is kept.",
    )
