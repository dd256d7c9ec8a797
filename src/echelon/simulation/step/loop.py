"""One step of the closed loop: who hears what, what the laws want, what the plant does with it.

This file sees only the interfaces of models and laws.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from echelon.agents.models.model import ControlAffine
from echelon.agents.network.exchange import Exchange
from echelon.agents.network.graph import Graph
from echelon.core.compiled import cached_jit
from echelon.core.types import Array, Input, Inputs, State, States
from echelon.core.words import Feedforward
from echelon.laws.law import Law, LocalView, Memory, without_certificates
from echelon.simulation.step.drive import Problem
from echelon.simulation.step.meter import Meter, Sums, reference_at
from echelon.simulation.step.motion import Motion


class Loop(eqx.Module):
    """All that never changes during a run.

    Laws know the model, and the plant of the motion moves. Agents are kept in their own order;
    leaders act first in a step.
    """

    model: ControlAffine
    motion: Motion
    meter: Meter
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
    switches: "Switches | None"


class Switches(NamedTuple):
    """From which steps on (K,), ascending from 0, which rows (K,) of the weights hold."""

    steps: Array
    rows: Array


def stretch_at(loop: Loop, step: int) -> tuple[int, int]:
    """Return which row of the weights holds at a step, and for how many steps from it on."""
    last = np.iinfo(np.int64).max
    if loop.switches is None:
        return 0, last
    steps, rows = loop.switches
    place = int(np.searchsorted(steps, step, side="right"))
    return int(rows[place - 1]), int(np.append(steps, last)[place]) - step


class _Acted(NamedTuple):
    """What some agents wanted and got, inputs (K, m), their next memories, and what they tell."""

    wanted: Inputs
    inputs: Inputs
    memory: Memory
    told: jax.Array


class Moment(NamedTuple):
    """All that changes during a run.

    The step number, the states (N, n), the memories of leaders and followers, and to which side the
    limits moved each input (N, m) in the step before: -1, 0 or 1.
    """

    step: jax.Array
    states: States
    leader_memory: Memory
    follower_memory: Memory
    cut: jax.Array


def assemble(problem: Problem, leader: Law, follower: Law) -> Loop:
    """Return the loop of prepared laws."""
    graph = problem.graph
    leaders, followers = np.array(graph.leaders), np.array(graph.followers)
    by_depth = follower.feedforward is Feedforward.PARENT
    nearest = np.array(graph.nearest_leader())
    return Loop(
        model=problem.model,
        motion=problem.motion,
        meter=problem.meter,
        leader=without_certificates(leader),
        follower=without_certificates(follower),
        exchange=graph.exchange(follower.leaderward),
        offsets=np.asarray(problem.formation.offsets),
        leaders=leaders,
        followers=followers,
        # The place of each follower's leader among the leaders, whose numbers ascend.
        sender=np.searchsorted(leaders, nearest[followers]),
        parents=np.array(graph.parents()) if by_depth else None,
        levels=_levels(graph) if by_depth else None,
        # Leaders act first, and this puts what all did back into the agents' own order.
        order=np.argsort(np.concatenate([leaders, followers])),
        switches=_switches(problem),
    )


def _switches(problem: Problem) -> Switches | None:
    """Return when the graph of a problem switches; None where it does not."""
    schedule, settings = problem.graph.schedule, problem.settings
    return None if schedule is None else Switches(*schedule.switches(settings.dt, settings.horizon))


def _levels(graph: Graph) -> Array:
    """Return the places of followers among the followers, (D, W), a row for each depth.

    A row that is too short repeats its first.
    """
    depth = graph.depths()[list(graph.followers)]
    rows = [np.flatnonzero(depth == d) for d in range(1, depth.max() + 1)]
    # One shape for all levels, as a scan needs; a copy of an agent does what the agent does.
    width = max(map(len, rows))
    return np.stack([np.append(row, np.repeat(row[0], width - len(row))) for row in rows])


@cached_jit
def begin(loop: Loop, states: States) -> Moment:
    """Return the moment at which a run begins from states (N, n)."""

    def remember(law: Law, who: Array) -> Memory:
        return jax.vmap(lambda x: law.begin(loop.model, x))(jnp.asarray(states)[who])

    return Moment(
        step=jnp.zeros((), jnp.int32),
        states=jnp.asarray(states),
        leader_memory=remember(loop.leader, loop.leaders),
        follower_memory=remember(loop.follower, loop.followers),
        cut=jnp.zeros((len(states), len(loop.model.input_names)), jnp.int8),
    )


def begin_forgetful(loop: Loop, states: Any) -> Moment:
    """Return that moment for laws that remember nothing, without JAX: its calls cost many steps."""
    cut: Any = np.zeros((len(states), len(loop.model.input_names)), np.int8)
    step: Any = np.zeros((), np.int32)
    return Moment(step, states, loop.leader.init(), loop.follower.init(), cut)


# ---- one step ------------------------------------------------------------------------------------


class Control(NamedTuple):
    """Delivered inputs (N, m), who was limited (N,), to which side (N, m), and next memories."""

    inputs: Inputs
    limited: jax.Array
    cut: jax.Array
    leader_memory: Memory
    follower_memory: Memory


def control(loop: Loop, now: Moment) -> Control:
    """Return what all agents do from a moment on."""
    x, offsets = now.states, jnp.asarray(loop.offsets, now.states.dtype)
    z = _disagreement(loop, now, offsets)
    # From the step number, since a sum of many dt would gather rounding.
    t = now.step.astype(x.dtype) * loop.motion.dt

    def act(law: Law, who: Any, sent: jax.Array, memory: Memory, leads: bool = False) -> _Acted:
        # One time for all; of everything else, an agent sees its own row and no other.
        def one(x: Any, offset: Any, z: Any, sent: Any, memory: Memory) -> _Acted:
            view = LocalView(t, x, offset, z, sent, loop.motion.dt)
            return _Acted(*act_alone(loop, law, view, memory, leads))

        return jax.vmap(one)(x[who], offsets[who], z[who], sent, memory)

    # Nobody is before a leader whose input it could be sent.
    silence = jnp.zeros((len(loop.leaders), len(loop.model.input_names)), x.dtype)
    led = act(loop.leader, loop.leaders, silence, now.leader_memory, leads=True)
    if loop.levels is None:
        sent = led.told[loop.sender]
        followed = act(loop.follower, loop.followers, sent, now.follower_memory)
    else:
        followed = _by_depth(loop, now, led, act)
    u = jnp.concatenate([led.inputs, followed.inputs])[loop.order]
    wanted = jnp.concatenate([led.wanted, followed.wanted])[loop.order]
    limited, cut = what_limits_did(u, wanted)
    return Control(u, limited.any(axis=1), cut.astype(jnp.int8), led.memory, followed.memory)


def _disagreement(loop: Loop, now: Moment, offsets: jax.Array) -> jax.Array:
    """Return z of what neighbours hear of each other, (N, n) of states or (N, s) of signals."""
    said, exchange = signals(loop, now, offsets), loop.exchange
    if loop.switches is not None:
        steps, rows = map(jnp.asarray, loop.switches)
        exchange = exchange.during(rows[jnp.searchsorted(steps, now.step, side="right") - 1])
    # What was sent is what is: this network neither delays nor loses.
    if said is not None:
        return exchange(said, said)
    y = now.states - offsets
    return exchange(y, y, jax.vmap(loop.model.difference))


@cached_jit
def signals(loop: Loop, now: Moment, offsets: jax.Array) -> jax.Array | None:
    """Return what neighbours hear of the agents (N, s); None where it is their states."""
    x = jnp.asarray(now.states)

    def said(law: Law, who: Array, memory: Memory) -> jax.Array | None:
        return jax.vmap(lambda *known: law.signal(loop.model, *known))(x[who], offsets[who], memory)

    heard = said(loop.follower, loop.followers, now.follower_memory)
    if heard is None:
        return None
    led = said(loop.leader, loop.leaders, now.leader_memory)
    assert led is not None, "a law with a signal takes a leader that gives it"
    return jnp.concatenate([led, heard])[loop.order]


def act_alone(
    loop: Loop, law: Law, view: LocalView, memory: Memory, leads: bool
) -> tuple[Input, Input, Memory, jax.Array]:
    """Return what one agent wants and gets, its next memory, and what it tells its followers.

    What a follower is told of a heading stands behind the feed-forward, and goes on to who is told
    by it.
    """
    follower, heading = loop.follower, jnp.zeros(0, view.x.dtype)
    if loop.follower.turning:
        view, now = _heading_told(loop, law, view, leads)
        law, follower, heading = law.facing(now), follower.facing(now), now[None]
    wanted, memory = law.update(loop.model, view, memory)
    # After the limits: what a leader could not do its followers must not copy (theory page).
    got = loop.motion.deliver_one(wanted)
    memory = law.settle(loop.model, view, wanted, got, memory)
    told = tell(follower, loop.model, view.x, loop.model.normalized(got), memory)
    return wanted, got, memory, jnp.concatenate([told, heading])


def _heading_told(
    loop: Loop, law: Law, view: LocalView, leads: bool
) -> tuple[LocalView, jax.Array]:
    """Return what an agent knows besides the heading that it leads with or is told, and that."""
    if leads:
        return view, law.heading(loop.model, view.t, view.x)
    sent = view.feedforward
    return eqx.tree_at(lambda known: known.feedforward, view, sent[:-1]), sent[-1]


def what_limits_did(u: jax.Array, wanted: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return which wanted inputs (..., m) limits changed, and to which side, -1, 0 or 1."""
    # To the bit, as `limit` returns what fits. NaN differs from itself, and is a divergence.
    limited = (u != wanted) & ~jnp.isnan(wanted)
    # Where one input is cut, mixing there and back rounds all others, which says nothing of a side.
    clear = jnp.abs(u - wanted) > 1e-6 * (jnp.abs(u) + jnp.abs(wanted))
    side = jnp.where(u > wanted, 1.0, -1.0)
    return limited, jnp.where(limited & clear, side, 0.0)


def _by_depth(loop: Loop, now: Moment, led: _Acted, act: Callable[..., _Acted]) -> _Acted:
    """Let the followers act level by level, each sent what its parent has just done."""
    followers, parents = jnp.asarray(loop.followers), jnp.asarray(loop.parents)
    told = jnp.zeros((len(now.states), led.told.shape[1]), led.told.dtype)
    told = told.at[loop.leaders].set(led.told)
    nothing = jnp.zeros((len(followers), led.inputs.shape[1]), led.inputs.dtype)

    def level(done: tuple[jax.Array, _Acted], places: jax.Array) -> tuple[Any, None]:
        told, all_ = done
        who = followers[places]
        memory = jax.tree.map(lambda leaf: leaf[places], now.follower_memory)
        acted = act(loop.follower, who, told[parents[who]], memory)
        # Where a level repeats an agent, the same is written twice.
        all_ = jax.tree.map(lambda a, b: a.at[places].set(b), all_, acted)
        return (told.at[who].set(acted.told), all_), None

    # Every follower is in one level, so that no zero of these is left.
    start = _Acted(nothing, nothing, now.follower_memory, told[followers])
    return jax.lax.scan(level, (told, start), jnp.asarray(loop.levels))[0][1]


def tell(follower: Law, model: ControlAffine, x: State, v: Input, memory: Memory) -> jax.Array:
    """Return what an agent at x with normalized input v and its next memory sends to followers."""
    if follower.feedforward is Feedforward.NONE:
        return jnp.zeros_like(v)
    return follower.message(model, x, v, memory)


def step(loop: Loop, now: Moment, acted: Control) -> Moment:
    """Advance all agents by one dt, under what they do."""
    states = loop.motion.advance(now.states, acted.inputs, now.step)
    return Moment(now.step + 1, states, acted.leader_memory, acted.follower_memory, acted.cut)


# ---- many steps ----------------------------------------------------------------------------------


@cached_jit
def advance(
    loop: Loop, now: Moment, counts: jax.Array, reference: Array | None
) -> tuple[Moment, tuple[Any, Any], Sums]:
    """Store a frame and take counts[k] steps, for each k.

    Return the last moment, the stored states and inputs, and the sums over the steps. `reference`
    (S, n) is what the leaders follow from this step on.
    """
    first = now.step

    def one(_: jax.Array, done: tuple[Moment, Sums]) -> tuple[Moment, Sums]:
        now, sums = done
        acted = control(loop, now)
        wanted = reference_at(reference, now.step - first, now.states)
        chatter = (acted.cut * now.cut < 0).any(axis=1)
        moment = now.step, now.states, acted.inputs
        read = loop.meter.read(*moment, acted.limited, chatter, wanted)
        return step(loop, now, acted), sums.plus(read)

    def frame(done: tuple[Moment, Sums], count: jax.Array) -> tuple[Any, tuple[Any, Any]]:
        # The first step computes these inputs again, but after the last frame there is none.
        stored = (done[0].states, control(loop, done[0]).inputs)
        return jax.lax.fori_loop(0, count, one, done), stored

    (now, sums), stored = jax.lax.scan(frame, (now, loop.meter.nothing()), counts)
    return now, stored, sums


@cached_jit
def final_states(loop: Loop, starts: jax.Array, steps: int) -> jax.Array:
    """Return the states (S, N, n) after `steps` steps from each of the starts (S, N, n)."""

    def last(states: States) -> States:
        def one(_: jax.Array, now: Moment) -> Moment:
            return step(loop, now, control(loop, now))

        return jax.lax.fori_loop(0, steps, one, begin(loop, states)).states

    return jax.vmap(last)(starts)
