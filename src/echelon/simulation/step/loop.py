"""The closed loop as data: what never changes during a run, and the moment, which does.

This file sees only the interfaces of models and laws.
"""

import dataclasses
from typing import Any, NamedTuple, Protocol

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from echelon.agents.models.model import ControlAffine
from echelon.agents.network.channel import Channel
from echelon.agents.network.exchange import Exchange
from echelon.agents.network.formation_motion import FormationMotion, OwnOffset
from echelon.agents.network.graph import Graph
from echelon.agents.world.sensing import Sensors
from echelon.core.types import Array, PyTree, Scalar, States
from echelon.core.words import Feedforward
from echelon.laws.law import Law, Memory, without_certificates
from echelon.simulation.step.drive import Problem
from echelon.simulation.step.leadership import Failover
from echelon.simulation.step.meter import RunStatistics
from echelon.simulation.step.motion import PlantStep
from echelon.simulation.step.settings import Settings


class Loop(eqx.Module):
    """All that never changes during a run.

    Laws know the model, and the plant of the motion moves. Agents are in their own order; leaders
    act first in a step.

    Attributes:
        model: what the laws know of an agent.
        motion: how the agents move.
        meter: what is measured at each step.
        leader, follower: the prepared laws.
        exchange: who receives messages of whom.
        offsets: the goals' (N, n).
        leaders, followers: their numbers.
        sender: the place of each follower's leader among the leaders.
        parents: (N,) the neighbour nearer to the leader, where followers are sent its input.
        levels: (D, W) the places of followers among the followers, level by level, likewise.
        order: (N,) from leaders and followers to the agents' own order.
        switches: when the graph switches; None where it does not.
        presence: who is there; None where all always are.
        succession: the backup leaders, which act with the leaders; None without any.
        channel: what the network does to messages; None for the ideal network.
        sensors: of the agents' own states; None for exact ones.
        share: of the feed-forward that followers use; None for all of it.
        moving: how the offsets change with time; None for constant ones.
    """

    model: ControlAffine
    motion: PlantStep
    meter: RunStatistics
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
    presence: "ActiveAgents | None" = None
    succession: Failover | None = None
    channel: Channel | None = None
    sensors: Sensors | None = None
    share: Array | None = None
    moving: FormationMotion | None = None

    def with_motion(self, row: PyTree) -> "Loop":
        """Return the loop of one agent whose plant has the parameters of a row; None for no row."""
        if row is None:
            return self
        return dataclasses.replace(self, motion=self.motion.of_row(row))


def offsets_at(
    loop: Loop, law: Law, t: Scalar, agents: Array | jax.Array
) -> tuple[Float[jax.Array, "K n"], Float[jax.Array, "K n"] | None]:
    """Return offsets of agents (K,) at a time (s), and their rates if a law uses moving ones."""
    offsets, motion = jnp.asarray(loop.offsets, t.dtype)[agents], loop.moving
    if motion is None:
        return offsets, None
    rows = offsets, jnp.asarray(motion.places, t.dtype)[agents]
    return jax.vmap(lambda *row: law.goal_offset(loop.model, OwnOffset(motion, *row), t))(*rows)


def all_offsets(loop: Loop, t: jax.Array) -> Float[jax.Array, "N n"]:
    """Return what all agents take for their offsets at a time (s)."""
    if loop.moving is None:
        return jnp.asarray(loop.offsets, t.dtype)
    laws = (loop.leader, loop.leaders), (loop.follower, loop.followers)
    return jnp.concatenate([offsets_at(loop, law, t, agents)[0] for law, agents in laws])[
        loop.order
    ]


def goals_at(loop: Loop, now: "LoopState") -> Float[jax.Array, "N n"] | None:
    """Return the offsets of all agents, as errors are measured; None of constant ones."""
    motion, t = loop.moving, time_of(loop, now)
    if motion is None:
        return None
    rows = jnp.asarray(loop.offsets, t.dtype), jnp.asarray(motion.places, t.dtype)
    return jax.vmap(lambda *row: OwnOffset(motion, *row).state(t))(*rows)


class Switches(NamedTuple):
    """From which steps on (K,), ascending from 0, which rows (K,) of the weights hold."""

    steps: Array
    rows: Array

    @classmethod
    def of(cls, graph: Graph, settings: Settings) -> "Switches | None":
        """Return when a graph switches; None where it does not."""
        schedule = graph.schedule
        return None if schedule is None else cls(*schedule.switches(settings.dt, settings.horizon))


class ActiveAgents(eqx.Module):
    """Who is there in each of S stretches of the graph.

    Attributes:
        rows: (S, N) whether an agent is.
        nearest: (S, N) whom it follows.
        since: (S, N) since when it has been there, s.
        returns: whether one that is lost joins again.
    """

    rows: Array
    nearest: Array
    since: Array
    # Static, since it decides what a moment has.
    returns: bool = eqx.field(static=True)

    @classmethod
    def of(cls, graph: Graph) -> "ActiveAgents | None":
        """Return who is there when; None where all always are."""
        schedule = graph.schedule
        if schedule is None or schedule.present is None or schedule.nearest is None:
            return None
        since = np.where(schedule.present, 0.0, np.inf)
        for k in range(1, len(since)):
            stays = schedule.present[k - 1]
            since[k] = np.where(stays, since[k - 1], schedule.starts[k])
        joins = (np.diff(schedule.present.astype(int), axis=0) > 0).any(axis=0)
        returns = bool((schedule.present[0] & joins).any())
        return cls(schedule.present, schedule.nearest, since, returns)


def row_at(switches: Switches, step: jax.Array) -> jax.Array:
    """Return which row of the weights holds at a step."""
    steps, rows = map(jnp.asarray, switches)
    return rows[jnp.searchsorted(steps, step, side="right") - 1]


class Roster(Protocol):
    """Who is there when, and who may lead: a loop, or a network by itself."""

    @property
    def switches(self) -> "Switches | None": ...  # noqa: D102
    @property
    def presence(self) -> "ActiveAgents | None": ...  # noqa: D102
    @property
    def succession(self) -> Failover | None: ...  # noqa: D102


def present_at(loop: Roster, step: jax.Array) -> Bool[jax.Array, " N"] | None:
    """Return who is present at a step; None where all always are."""
    if loop.presence is None or loop.switches is None:
        return None
    return jnp.asarray(loop.presence.rows)[row_at(loop.switches, step)]


def since_at(loop: Roster, step: jax.Array) -> jax.Array:
    """Return since when each agent has been there, s, (N,)."""
    if loop.presence is None or loop.switches is None:
        return jnp.zeros(())
    return jnp.asarray(loop.presence.since)[row_at(loop.switches, step)]


def nearest_at(loop: Loop, step: jax.Array) -> jax.Array:
    """Return whom each agent follows at a step, (N,), where some are absent at times."""
    assert loop.presence is not None and loop.switches is not None
    return jnp.asarray(loop.presence.nearest)[row_at(loop.switches, step)]


def exchange_at(exchange: Exchange, switches: Switches | None, step: jax.Array) -> Exchange:
    """Return an exchange with the weights that hold at a step."""
    return exchange if switches is None else exchange.during(row_at(switches, step))


def stretch_at(loop: Loop, step: int) -> tuple[int, int]:
    """Return which row of the weights holds at a step, and for how many steps from it on."""
    last = np.iinfo(np.int64).max
    if loop.switches is None:
        return 0, last
    steps, rows = loop.switches
    place = int(np.searchsorted(steps, step, side="right"))
    return int(rows[place - 1]), int(np.append(steps, last)[place]) - step


class WorldState(NamedTuple):
    """What the world remembers between two steps; empty in the ideal world.

    Attributes:
        in_flight: the last messages that were sent, as `InFlight` of the channel.
        mail: what agents keep of those that they received, as `Mail`.
        motion: what the plants remember besides their states, as `MotionState`.
        measured: (d, N, n) the states of the last d steps, where agents measure theirs late.
        seen: messages about places, as `NeighbourHulls`, where agents keep away from each other.
        estimates: of agents that estimate their states, as `Estimate`.
        starts: (N, n) the initial states, where agents are lost and join again.
        led: what each agent last received of its leader, as `Packets`, in the ideal network with
            backup leaders.
    """

    in_flight: PyTree = None
    mail: PyTree = None
    motion: PyTree = None
    measured: PyTree = None
    seen: PyTree = None
    estimates: PyTree = None
    starts: PyTree = None
    led: PyTree = None


class LoopState(NamedTuple):
    """All that changes during a run.

    Attributes:
        step: its number.
        states: (N, n).
        leader_memory, follower_memory: of the laws.
        cut: to which side limits moved each input (N, m) in the step before: -1, 0 or 1.
        world: what the world remembers, messages in flight among it.
    """

    step: jax.Array
    states: States
    leader_memory: Memory
    follower_memory: Memory
    cut: jax.Array
    world: WorldState = WorldState()


def assemble(problem: Problem, leader: Law, follower: Law) -> Loop:
    """Return the loop of prepared laws."""
    graph = problem.graph
    leader = leader if problem.channel is None else leader.predictable(problem.model)
    leaders = np.array([*graph.leaders, *graph.backups])
    followers = np.array([k for k in graph.followers if k not in graph.backups], int)
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
        switches=Switches.of(graph, problem.settings),
        presence=ActiveAgents.of(graph),
        succession=Failover.of(graph, problem.leadership),
        channel=problem.channel,
        sensors=problem.sensors,
        moving=problem.formation.motion,
    )


def _levels(graph: Graph) -> Array:
    """Return followers' places among followers by depth, (D, W); short rows repeat a place."""
    depth = graph.depths()[list(graph.followers)]
    rows = [np.flatnonzero(depth == d) for d in range(1, depth.max() + 1)]
    # One shape for all levels, as a scan needs; a copy of an agent does what the agent does.
    width = max(map(len, rows))
    return np.stack([np.append(row, np.repeat(row[0], width - len(row))) for row in rows])


def begin_forgetful(loop: Loop, states: Any) -> LoopState:
    """Return it for laws without memory, without JAX: one of its calls costs many steps."""
    # `Any`, since NumPy's arrays are where a moment has JAX's until the first step.
    cut: Any = np.zeros((len(states), len(loop.model.input_names)), np.int8)
    step: Any = np.zeros((), np.int32)
    return LoopState(step, states, loop.leader.init(), loop.follower.init(), cut)


def time_of(loop: Loop, now: LoopState) -> jax.Array:
    """Return the time (s) of a moment."""
    # From the step number, since a sum of many dt would gather rounding.
    return now.step.astype(now.states.dtype) * loop.motion.dt


def measured(loop: Loop, now: LoopState) -> LoopState:
    """Return the moment as the agents measure it: they know nothing of their true states."""
    if loop.sensors is None:
        return now
    states, last = loop.sensors.read(now.world.measured, now.states, now.step)
    world, estimator = now.world._replace(measured=last), loop.sensors.estimator
    if estimator is not None:
        states, estimates = jax.vmap(
            lambda before, y: estimator.measure(loop.model, before, y, now.step == 0)
        )(world.estimates, states)
        world = world._replace(estimates=estimates)
    return now._replace(states=states, world=world)
