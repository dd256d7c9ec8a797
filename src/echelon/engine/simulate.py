"""The closed loop in time: parts in, one `Result` out.

This file sees only the interfaces of models and laws.
"""

import math
import time
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from echelon.core import numerics
from echelon.core.errors import ModelError, Outcome
from echelon.core.types import Array
from echelon.engine.initial import Initial, initial_states
from echelon.engine.loop import Loop, Moment, assemble, control, step
from echelon.engine.prepare import check_parts, check_settings, formation_warnings
from echelon.engine.result import Result, Settings
from echelon.laws.law import Law, Memory
from echelon.models.check import check_model
from echelon.models.model import ControlAffine
from echelon.network.formation import Formation
from echelon.network.graph import Graph
from echelon.world.disturbance import Disturbance
from echelon.world.plant import check_plant

Progress = Callable[[int, int], None]
"""Called now and then with the steps done and the steps in all."""

_CHUNKS = 100


def simulate(
    model: ControlAffine,
    graph: Graph,
    formation: Formation,
    *,
    leader: Law,
    follower: Law,
    initial: Initial = None,
    start_error: Mapping[str, float] | None = None,
    plant: ControlAffine | None = None,
    disturbance: Disturbance | None = None,
    horizon: float,
    dt: float,
    integrator: str = "rk4",
    limits: bool = True,
    store_every: int = 1,
    seed: int = 0,
    precision: numerics.Precision = "float64",
    progress: Progress | None = None,
) -> Result:
    """Run the closed loop and return what happened.

    Args:
        model: the agents, all alike.
        graph: who hears whom, and who leads.
        formation: the goal offsets, (N, n).
        leader: law of the leaders.
        follower: law of all others.
        initial: spread of the followers' starts about their goals, per state or group (uniform
            within +- the number); or states (n,) by agent, all others on their goals; or all states
            (N, n).
        start_error: what is added to the leaders' starts, per state or group.
        plant: the agents as they are, where they differ from `model`: these move and have these
            actuators, and laws, gains and feed-forward go on knowing `model` alone.
        disturbance: wind and noise on all agents.
        horizon: length of the run, s; rounded to whole steps.
        dt: step, s.
        integrator: `rk4`, `euler` or `printed`; the input is held over a step.
        limits: whether the actuators' limits act.
        store_every: steps between stored frames; the last state is always stored.
        seed: of the random starts, and of the disturbance unless it has its own.
        precision: `float64` or `float32`, whatever the flags of JAX are.
        progress: called about a hundred times with (steps done, steps in all).

    Raises:
        EchelonError: a part is malformed or does not fit the others. A run that diverges or is
            interrupted by Ctrl-C is no error: the result says so and holds what was computed.
    """
    settings = Settings(horizon, dt, integrator, limits, store_every, precision, seed)
    check_settings(settings)
    check_parts(graph, formation, leader, follower, disturbance)
    began = time.perf_counter()
    with numerics.precision("float64"):
        warnings = _checked(model, plant)
        leader, follower = leader.prepared(model, graph), follower.prepared(model, graph)
        loop = assemble(model, graph, formation, leader, follower, settings, plant, disturbance)
        told = leader.warnings(model, graph) + follower.warnings(model, graph)
        told += formation_warnings(model, formation)
        states = initial_states(model, graph, formation, leader, initial, start_error or {}, seed)
    with numerics.precision(precision):
        record = _run(loop, states, _frame_counts(settings), progress)
    with numerics.precision("float64"):
        times = jnp.asarray(record.times)
        reference = leader.reference_states(model, times) if len(record.times) else None
    outcome, message = _verdict(record, graph)
    return Result(
        times=record.times,
        states=record.states,
        inputs=record.inputs,
        reference=None if reference is None else np.asarray(reference, np.float64),
        saturated=record.saturated,
        outcome=outcome,
        message=message,
        warnings=warnings + told,
        model=model,
        graph=graph,
        formation=formation,
        leader=leader,
        follower=follower,
        settings=settings,
        plant=plant,
        disturbance=disturbance,
        wall_time=time.perf_counter() - began,
    )


def _checked(model: ControlAffine, plant: ControlAffine | None) -> tuple[str, ...]:
    """Check the model, and the plant where there is one; return the warnings about both."""
    warnings = check_model(model)
    if plant is None:
        return warnings
    moved = check_model(plant)
    check_plant(model, plant)
    return tuple(dict.fromkeys((*warnings, *moved)))


@eqx.filter_jit
def advance(
    loop: Loop, now: Moment, counts: jax.Array
) -> tuple[Moment, tuple[jax.Array, jax.Array]]:
    """Store a frame and take counts[k] steps, for each k.

    Return the last moment and the stored frames.
    """

    def frame(now: Moment, count: jax.Array) -> tuple[Moment, tuple[jax.Array, jax.Array]]:
        stored = (now.states, control(loop, now)[0])
        return jax.lax.fori_loop(0, count, lambda _, moment: step(loop, moment), now), stored

    return jax.lax.scan(frame, now, counts)


# ---- the whole run -------------------------------------------------------------------------------


class _Record(NamedTuple):
    times: np.ndarray
    states: np.ndarray
    inputs: np.ndarray
    saturated: np.ndarray
    complete: bool
    failed: tuple[float, int] | None


def _frame_counts(settings: Settings) -> np.ndarray:
    """Return the number of steps after each stored frame; zero after the last."""
    steps = max(1, round(settings.horizon / settings.dt))
    whole, rest = divmod(steps, settings.store_every)
    return np.array([settings.store_every] * whole + [rest] * (rest > 0) + [0], dtype=np.int32)


def _start(loop: Loop, states: np.ndarray) -> Moment:
    def remember(law: Law, who: Array) -> Memory:
        return jax.tree.map(
            lambda leaf: jnp.broadcast_to(leaf, (len(who), *jnp.shape(leaf))), law.init()
        )

    return Moment(
        step=jnp.zeros((), jnp.int32),
        states=jnp.asarray(states),
        leader_memory=remember(loop.leader, loop.leaders),
        follower_memory=remember(loop.follower, loop.followers),
        saturated=jnp.zeros(len(states), jnp.int32),
    )


def _run(loop: Loop, states: np.ndarray, counts: np.ndarray, progress: Progress | None) -> _Record:
    """Advance chunk by chunk.

    So progress shows, and Ctrl-C or a divergence keeps what was computed.
    """
    size = math.ceil(len(counts) / _CHUNKS)
    padded = np.concatenate([counts, np.zeros(-len(counts) % size, np.int32)])
    now, frames, done = _start(loop, states), [], 0
    try:
        for chunk in padded.reshape(-1, size):
            now, stored = _advanced(loop, now, chunk)
            frames.append(jax.tree.map(lambda leaf: np.asarray(leaf, np.float64), stored))
            done += int(chunk.sum())
            if progress is not None:
                progress(done, int(counts.sum()))
            if not all(np.isfinite(part).all() for part in frames[-1]):
                break
    except KeyboardInterrupt:
        pass
    return _collect(loop, counts, frames, now)


def _advanced(loop: Loop, now: Moment, chunk: np.ndarray) -> tuple[Moment, Any]:
    """Call `advance`, and say in a sentence what JAX says of constants in another precision."""
    try:
        return advance(loop, now, jnp.asarray(chunk))
    except ValueError as error:
        if "Cannot lower jaxpr" not in str(error):
            raise
        raise ModelError(
            f"`{type(loop.model).__name__}` or a law uses a NumPy constant that JAX has already "
            "seen in another precision; write it as Python numbers or as "
            "`jnp.asarray(constant, x.dtype)`."
        ) from error


def _collect(loop: Loop, counts: np.ndarray, frames: list[Any], now: Moment) -> _Record:
    """Join the stored frames, cut at the first one that is not finite."""
    agents, n = now.states.shape
    nothing = (np.zeros((0, agents, n)), np.zeros((0, agents, len(loop.model.input_names))))
    states, inputs = (
        np.concatenate([frame[k] for frame in (nothing, *frames)])[: len(counts)] for k in (0, 1)
    )
    times = loop.dt * np.concatenate([[0], np.cumsum(counts[:-1])])[: len(states)]
    lost = np.array(~(np.isfinite(states).all(axis=2) & np.isfinite(inputs).all(axis=2)))
    failed = None
    if lost.any():
        cut, agent = np.argwhere(lost)[0]
        failed = (float(times[cut]), int(agent))
        times, states, inputs = times[:cut], states[:cut], inputs[:cut]
    saturated = np.asarray(now.saturated, np.float64) / max(1, int(now.step))
    return _Record(times, states, inputs, saturated, len(times) == len(counts), failed)


def _verdict(record: _Record, graph: Graph) -> tuple[Outcome, str]:
    if record.failed is not None:
        when, agent = record.failed
        role = "leader" if agent in graph.leaders else "follower"
        return (
            Outcome.DIVERGED,
            f"The state of {role} {agent} stopped being finite by t = {when:.6g} s.",
        )
    if record.complete:
        return Outcome.COMPLETED, Outcome.COMPLETED.value
    reached = record.times[-1] if len(record.times) else 0.0
    return (
        Outcome.INTERRUPTED,
        f"The run was interrupted at t = {reached:.6g} s; what was computed is kept.",
    )
