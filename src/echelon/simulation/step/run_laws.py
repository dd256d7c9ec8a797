"""The laws of a run: who is under which, what agents say, and what one agent does."""

import functools
import operator
from typing import NamedTuple, final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from echelon.agents.models.model import ControlAffine
from echelon.agents.network.exchange import Difference
from echelon.agents.network.graph import Graph
from echelon.core.numerics import rk4
from echelon.core.types import Array, Input, Scalar, State, States
from echelon.core.words import Feedforward
from echelon.laws.flat_law import FlatLaw
from echelon.laws.law import Faces, Feeds, Law, LocalView, Memory, Speaks, without_certificates
from echelon.simulation.step.motion import PlantStep
from echelon.simulation.step.records import (
    AgentOutput,
    GroupOffsets,
    LawMemories,
    Mask,
    choose,
    some,
)

# ---- what agents say: their states less their offsets, or the signals of their laws --------------


class StateSpeech(eqx.Module):
    """What agents say to their neighbours: their states less their offsets."""

    # Whether they are signals of laws.
    signals = False

    def of_one(
        self, law: Law, model: ControlAffine, x: State, offset: State, memory: Memory
    ) -> Float[jax.Array, " s"]:
        """Return what an agent at x says (s,)."""
        return x - offset

    def of_all(self, laws: "RunLaws", known: "Sayings") -> Float[jax.Array, "N s"]:
        """Return what all say (N, s)."""
        return known.x - known.offsets

    def difference(self, model: ControlAffine) -> Difference:
        """Return the difference of values (K, s) and (K, s), which may wind."""
        return jax.vmap(model.difference)

    def carried(
        self, law: Law, model: ControlAffine, packet: tuple[jax.Array, ...], time: Scalar
    ) -> Float[jax.Array, " s"]:
        """Return what a leader says a time (s) after it sent signal, feed-forward and input.

        Its state moves on.
        """
        (said, _, u), (count, piece) = packet, carried_pieces(time)
        return jax.lax.fori_loop(0, count, lambda _, x: rk4(model.velocity, x, u, piece), said)


@final
class SignalSpeech(StateSpeech):
    """They say the signals of their laws."""

    signals = True

    def of_one(
        self, law: Law, model: ControlAffine, x: State, offset: State, memory: Memory
    ) -> Float[jax.Array, " s"]:
        """Return the law's signal."""
        signal = Speaks.of(law).signal(model, x, offset, memory)
        assert signal is not None, "laws that speak return a signal"
        return signal

    def of_all(self, laws: "RunLaws", known: "Sayings") -> Float[jax.Array, "N s"]:
        """Return the signals of both groups, in the agents' order."""
        said, rows = list[jax.Array](), zip(laws.groups, known.groups, known.memory, strict=True)
        for (law, agents), own, memory in rows:
            one = functools.partial(self.of_one, law, known.model)
            said.append(jax.vmap(one)(known.x[agents], own.offset, memory))
        return laws.ordered(*said)

    def difference(self, model: ControlAffine) -> Difference:
        """Return the plain one."""
        return operator.sub

    def carried(
        self, law: Law, model: ControlAffine, packet: tuple[jax.Array, ...], time: Scalar
    ) -> Float[jax.Array, " s"]:
        """Return what the follower's law makes of the signal."""
        said, feedforward, u = packet
        return Speaks.of(law).carried(model, said, feedforward, u, time)


_CARRIED = 0.03
"""s; longest step of the model by which the motion of a leader is carried on."""


def carried_pieces(time: Scalar) -> tuple[jax.Array, jax.Array]:
    """Return in how many steps of the model a leader is carried on, and their length (s).

    The time is in s.
    """
    count = jnp.ceil(time / _CARRIED).astype(int)
    return count, time / jnp.maximum(count, 1)


class Sayings(NamedTuple):
    """What agents need to say something: states and offsets (N, n), also by group, and memories."""

    model: ControlAffine
    x: States
    offsets: States
    groups: tuple[GroupOffsets, GroupOffsets]
    memory: LawMemories


# ---- axes: the world's, or those of a heading that everybody receives ----------------------------


class WorldAxes(eqx.Module):
    """In which axes gains are: in the world's."""

    def facing(
        self, laws: "RunLaws", model: ControlAffine, law: Law, view: LocalView, leads: bool
    ) -> tuple[LocalView, Law, Law, Float[jax.Array, " h"]]:
        """Return view, law, followers' law, and what is sent on behind the feed-forward."""
        return view, law, laws.follower, jnp.zeros(0, view.x.dtype)

    def alone(
        self, law: Law, model: ControlAffine, t: Scalar, x: State, size: int
    ) -> Float[jax.Array, " k"]:
        """Return the feed-forward of an agent that received none."""
        return jnp.zeros(size)


@final
class HeadingAxes(WorldAxes):
    """In those of the heading that the leader sends behind its feed-forward."""

    def facing(
        self, laws: "RunLaws", model: ControlAffine, law: Law, view: LocalView, leads: bool
    ) -> tuple[LocalView, Law, Law, Float[jax.Array, " h"]]:
        """Return laws in the axes of the heading, which a leader has and a follower receives."""
        if leads:
            angle = Faces.of(law).heading(model, view.t, view.x)
        else:
            received = view.feedforward
            view = eqx.tree_at(lambda view: view.feedforward, view, received[:-1])
            angle = received[-1]
        return view, Faces.of(law).facing(angle), Faces.of(laws.follower).facing(angle), angle[None]

    def alone(
        self, law: Law, model: ControlAffine, t: Scalar, x: State, size: int
    ) -> Float[jax.Array, " k"]:
        """Return zeros, and the agent's own heading."""
        return jnp.zeros(size).at[-1].set(Faces.of(law).heading(model, t, x))


# ---- how much of the feed-forward followers use --------------------------------------------------


class WholeFeedforward(eqx.Module):
    """Followers use all of what they are sent."""

    def of(self, view: LocalView, leads: bool) -> LocalView:
        """Return what an agent knows, with as much of the feed-forward as it uses."""
        return view


@final
class FeedforwardFraction(WholeFeedforward):
    """They use a fraction, which may be changed during a run."""

    fraction: Array

    def of(self, view: LocalView, leads: bool) -> LocalView:
        """Return what an agent knows, with as much of the feed-forward as it uses."""
        if leads:
            return view
        used = jnp.asarray(self.fraction, view.x.dtype) * view.feedforward
        return eqx.tree_at(lambda view: view.feedforward, view, used)


# ---- all laws of a run ---------------------------------------------------------------------------


def has_angles(law: Law) -> bool:
    """Tell whether what agents send under a law has angles, which grow with every turn."""
    return isinstance(law, FlatLaw) and bool(law.ready.angles)


@final
class RunLaws(eqx.Module):
    """The laws of a run, and who is under which. Leaders act first in a step.

    Attributes:
        leader, follower: the prepared laws.
        leaders, followers: the numbers of the agents; backup leaders are among the leaders.
        order: (N,) from leaders and followers to the agents' own order.
        numbers: (N,) of all agents.
        speech: what agents say.
        axes: of the gains.
        feedforward: how much of it followers use.
        backups: whether leaders may follow, and have the memory of followers.
    """

    leader: Law
    follower: Law
    leaders: Array
    followers: Array
    order: Array
    numbers: Array
    speech: StateSpeech
    axes: WorldAxes
    feedforward: WholeFeedforward = WholeFeedforward()
    backups: bool = eqx.field(static=True, default=False)

    @classmethod
    def of(
        cls, graph: Graph, leader: Law, follower: Law, backups: bool, signals: bool
    ) -> "RunLaws":
        """Return the prepared laws of a run, in which agents may send signals."""
        leaders = np.array([*graph.leaders, *graph.backups])
        followers = np.array([k for k in graph.followers if k not in graph.backups], int)
        return cls(
            without_certificates(leader),
            without_certificates(follower),
            leaders,
            followers,
            # This puts what leaders and followers did back into the agents' own order.
            np.argsort(np.concatenate([leaders, followers])),
            np.arange(graph.agents, dtype=np.int32),
            SignalSpeech() if signals else StateSpeech(),
            HeadingAxes() if follower.turning else WorldAxes(),
            backups=backups,
        )

    @property
    def groups(self) -> tuple[tuple[Law, Array], tuple[Law, Array]]:
        """Leaders and followers: their law, and their numbers."""
        return (self.leader, self.leaders), (self.follower, self.followers)

    @property
    def owners(self) -> tuple[tuple[Law, Array], tuple[Law, Array]]:
        """Leaders and followers: the law whose memory they have, and their numbers."""
        # Backup leaders, and a leader that may follow one of them, have the memory of followers.
        return (self.follower if self.backups else self.leader, self.leaders), self.groups[1]

    def ordered(self, leaders: jax.Array, followers: jax.Array) -> jax.Array:
        """Return rows of leaders and followers in the agents' own order."""
        return jnp.concatenate([leaders, followers])[self.order]

    def begin(self, model: ControlAffine, states: States) -> LawMemories:
        """Return the memories of agents that begin at states (N, n)."""
        return LawMemories(
            *(
                jax.vmap(lambda x, law=law: law.begin(model, x))(states[agents])
                for law, agents in self.owners
            )
        )

    def held(self, mask: Mask, one: LawMemories, other: LawMemories) -> LawMemories:
        """Return memories of which some agents' are as in `one`, and others' as in `other`."""
        rows = zip((self.leaders, self.followers), one, other, strict=True)
        return LawMemories(*(choose(some(mask, agents), a, b) for agents, a, b in rows))

    def beside(
        self, memory: LawMemories, joins: Bool[jax.Array, " N"], other: Float[jax.Array, " s"]
    ) -> LawMemories:
        """Return memories of which those who join have their headings beside another's signal.

        An angle is a number that grows with every turn, and who begins late knows none of them.
        """

        def taken(law: Law, agents: Array, own: Memory) -> Memory:
            if not isinstance(law, FlatLaw) or not law.ready.angles:
                return own

            def one(joins: jax.Array, own: Memory) -> Memory:
                beside = law.beside(own, other)
                return jax.tree.map(lambda *pair: jnp.where(joins, *pair), beside, own)

            return jax.vmap(one)(joins[agents], own)

        pairs = zip(self.owners, memory, strict=True)
        return LawMemories(*(taken(law, agents, own) for (law, agents), own in pairs))

    def act(
        self,
        model: ControlAffine,
        plant: PlantStep,
        law: Law,
        view: LocalView,
        memory: Memory,
        leads: bool,
    ) -> AgentOutput:
        """Return what one agent does with what it knows: alone, in a run, or as machine code."""
        view, law, follower, heading = self.axes.facing(self, model, law, view, leads)
        view = self.feedforward.of(view, leads)
        desired, memory = law.update(model, view, memory)
        # After the limits: what a leader could not do its followers must not copy (theory page).
        delivered = plant.deliver(desired)
        memory = law.settle(model, view, desired, delivered, memory)
        forward = feedforward_of(follower, model, view.x, model.normalized(delivered), memory)
        return AgentOutput(desired, delivered, memory, jnp.concatenate([forward, heading]))

    def message_size(self, model: ControlAffine, memory: Memory) -> int:
        """Return how many numbers an agent sends to its followers, with a leader's memory."""
        n, m = len(model.state_names), len(model.input_names)
        turning = self.follower.turning

        # Of the message alone: a trace of all that a leader does takes as long as its code.
        def message(x: jax.Array, v: jax.Array, memory: Memory) -> jax.Array:
            follower = Faces.of(self.follower).facing(x[0]) if turning else self.follower
            return feedforward_of(follower, model, x, v, memory)

        return jax.eval_shape(message, np.zeros(n), np.zeros(m), memory).shape[0] + turning


def feedforward_of(
    follower: Law, model: ControlAffine, x: State, v: Input, memory: Memory
) -> Float[jax.Array, " k"]:
    """Return the feed-forward of an agent at x with normalized input v and its next memory."""
    if follower.feedforward is Feedforward.NONE:
        return jnp.zeros_like(v)
    return Feeds.of(follower).message(model, x, v, memory)


def limit_sides(
    model: ControlAffine, delivered: jax.Array, desired: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Return which desired inputs (..., m) limits changed, and to which side, -1, 0 or 1."""
    # To the bit, as `limit` returns what fits. NaN differs from itself, and is a divergence.
    limited = (delivered != desired) & ~jnp.isnan(desired)
    # Where one input is cut, mixing there and back rounds all others, which says nothing of a side.
    change = jnp.abs(delivered - desired)
    clear = change > 1e-6 * (jnp.abs(delivered) + jnp.abs(desired))
    if model.input_limits is not None:
        # A change that moves no limited row by a millionth of its range is rounding too.
        G, low, high = (jnp.asarray(part, change.dtype) for part in model.input_limits)
        share = (jnp.abs(G) / (high - low)[:, None]).max(axis=0)
        clear &= change * jnp.broadcast_to(share, change.shape) > 1e-6
    side = jnp.where(delivered > desired, 1.0, -1.0)
    return limited, jnp.where(limited & clear, side, 0.0)
