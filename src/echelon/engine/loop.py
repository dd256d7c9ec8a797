"""One step of the closed loop: who hears what, what the laws ask for, what the plant does with it.

This file sees only the interfaces of models and laws.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from echelon.core import numerics
from echelon.core.errors import SimulationError
from echelon.core.types import Array, Input, Inputs, State, States
from echelon.core.words import Feedforward
from echelon.engine.result import Settings
from echelon.laws.law import Law, LocalView, Memory, without_certificates
from echelon.models.model import ControlAffine
from echelon.network.exchange import Exchange
from echelon.network.formation import Formation
from echelon.network.graph import Graph
from echelon.world.disturbance import Disturbance, Wind, disturbed


class Loop(eqx.Module):
    """All that never changes during a run.

    Laws know the model, and the plant moves. Agents are kept in their own order; leaders act first
    in a step.
    """

    model: ControlAffine
    plant: ControlAffine
    wind: Wind | None
    leader: Law
    follower: Law
    exchange: Exchange
    offsets: Array
    leaders: Array
    followers: Array
    sender: Array
    parents: Array | None
    levels: Array | None
    order: Array
    normalizer: Array
    dt: float = eqx.field(static=True)
    integrator: str = eqx.field(static=True)
    limits: bool = eqx.field(static=True)


class _Acted(NamedTuple):
    """What some agents wanted and got, inputs (K, m), and their next memories."""

    wanted: Inputs
    inputs: Inputs
    memory: Memory


class Moment(NamedTuple):
    """All that changes during a run.

    The step number, the states (N, n), the memories of leaders and followers, and the number of
    saturated steps (N,).
    """

    step: jax.Array
    states: States
    leader_memory: Memory
    follower_memory: Memory
    saturated: jax.Array


def assemble(
    model: ControlAffine,
    graph: Graph,
    formation: Formation,
    leader: Law,
    follower: Law,
    settings: Settings,
    plant: ControlAffine | None = None,
    disturbance: Disturbance | None = None,
) -> Loop:
    """Return the loop of prepared laws; without a plant of its own the model moves."""
    plant = model if plant is None else plant
    shape = (graph.agents, len(model.state_names))
    if formation.offsets.shape != shape:
        raise SimulationError(
            f"the formation has offsets {formation.offsets.shape}, and {graph.agents} agents "
            f"with {shape[1]} states need {shape}."
        )
    leaders, followers = np.array(graph.leaders), np.array(graph.followers)
    by_depth = follower.feedforward is Feedforward.PARENT
    nearest = np.array(graph.nearest_leader())
    return Loop(
        model=model,
        plant=plant,
        wind=disturbance and disturbance.prepared(plant, settings.dt, settings.seed),
        leader=without_certificates(leader),
        follower=without_certificates(follower),
        exchange=graph.exchange(),
        offsets=np.asarray(formation.offsets),
        leaders=leaders,
        followers=followers,
        sender=np.searchsorted(leaders, nearest[followers]),
        parents=np.array(graph.parents()) if by_depth else None,
        levels=_levels(graph) if by_depth else None,
        order=np.argsort(np.concatenate([leaders, followers])),
        normalizer=np.linalg.inv(np.asarray(model.input_scale, float)),
        dt=settings.dt,
        integrator=settings.integrator,
        limits=settings.limits,
    )


def _levels(graph: Graph) -> Array:
    """Return the places of followers among the followers, (D, W), a row for each depth.

    A row that is too short repeats its first.
    """
    depth = graph.depths()[list(graph.followers)]
    rows = [np.flatnonzero(depth == d) for d in range(1, depth.max() + 1)]
    width = max(map(len, rows))
    return np.stack([np.append(row, np.repeat(row[0], width - len(row))) for row in rows])


# ---- one step ------------------------------------------------------------------------------------


def control(loop: Loop, now: Moment) -> tuple[Inputs, jax.Array, Memory, Memory]:
    """Return delivered inputs (N, m), who saturated (N,), and the next memories.

    The memories are those of the leaders, then those of the followers.
    """
    x, offsets = now.states, jnp.asarray(loop.offsets, now.states.dtype)
    y = x - offsets
    z = loop.exchange(y, y)
    t = now.step.astype(x.dtype) * loop.dt

    def act(law: Law, who: Any, said: jax.Array, memory: Memory) -> _Acted:
        view = LocalView(t, x[who], offsets[who], z[who], said)
        axes = LocalView(None, 0, 0, 0, 0)  # type: ignore[arg-type]
        wanted, memory = jax.vmap(law.update, in_axes=(None, axes, 0))(loop.model, view, memory)
        return _Acted(wanted, delivered(loop, wanted), memory)

    silence = jnp.zeros((len(loop.leaders), len(loop.model.input_names)), x.dtype)
    led = act(loop.leader, loop.leaders, silence, now.leader_memory)
    if loop.levels is None:
        said = _told(loop, x[loop.leaders], led.inputs)[loop.sender]
        followed = act(loop.follower, loop.followers, said, now.follower_memory)
    else:
        followed = _by_depth(loop, now, led, act)
    u = jnp.concatenate([led.inputs, followed.inputs])[loop.order]
    wanted = jnp.concatenate([led.wanted, followed.wanted])[loop.order]
    limited = jnp.any((u != wanted) & ~jnp.isnan(wanted), axis=1)
    return u, limited, led.memory, followed.memory


def _by_depth(loop: Loop, now: Moment, led: _Acted, act: Callable[..., _Acted]) -> _Acted:
    """Let the followers act level by level, each told what its parent has just done."""
    followers, parents = jnp.asarray(loop.followers), jnp.asarray(loop.parents)
    u = jnp.zeros((len(now.states), led.inputs.shape[1]), led.inputs.dtype)
    u = u.at[loop.leaders].set(led.inputs)
    nothing = jnp.zeros((len(followers), u.shape[1]), u.dtype)

    def level(done: tuple[Inputs, _Acted], places: jax.Array) -> tuple[Any, None]:
        u, all_ = done
        who = followers[places]
        said = _told(loop, now.states[parents[who]], u[parents[who]])
        memory = jax.tree.map(lambda leaf: leaf[places], now.follower_memory)
        acted = act(loop.follower, who, said, memory)
        # Where a level repeats an agent, the same is written twice.
        all_ = jax.tree.map(lambda a, b: a.at[places].set(b), all_, acted)
        return (u.at[who].set(acted.inputs), all_), None

    start = _Acted(nothing, nothing, now.follower_memory)
    return jax.lax.scan(level, (u, start), jnp.asarray(loop.levels))[0][1]


def _told(loop: Loop, x: States, u: Inputs) -> jax.Array:
    """Return what is told of agents at x (K, n) with delivered inputs u (K, m)."""
    if loop.follower.feedforward is Feedforward.NONE:
        return jnp.zeros_like(u)
    trim = jnp.asarray(loop.model.trim[1], u.dtype)
    v = (u - trim[None]) @ jnp.asarray(loop.normalizer, u.dtype).T
    return jax.vmap(loop.follower.broadcast, in_axes=(None, 0, 0))(loop.model, x, v)


def delivered(loop: Loop, inputs: Inputs) -> Inputs:
    """Return what the plant's actuators make of wanted physical inputs (N, m)."""
    return jax.vmap(loop.plant.limit)(inputs) if loop.limits else inputs


def advance_plant(loop: Loop, states: States, inputs: Inputs, step: jax.Array) -> States:
    """Return the states (N, n) one dt later.

    The delivered inputs (N, m) are held over it, and so is the disturbance of this step.
    """
    integrate = numerics.INTEGRATORS[loop.integrator]

    def one(x: State, u: Input, agent: jax.Array) -> State:
        return integrate(disturbed(loop.plant, loop.wind, step, agent), x, u, loop.dt)

    return jax.vmap(one)(states, inputs, jnp.arange(len(states)))


def step(loop: Loop, now: Moment) -> Moment:
    """Advance all agents by one dt."""
    u, limited, memory_l, memory_f = control(loop, now)
    states = advance_plant(loop, now.states, u, now.step)
    return Moment(now.step + 1, states, memory_l, memory_f, now.saturated + limited)
