"""What passes between the components of a step: masks, clocks, messages, and what agents do.

Every record has a row for each agent: N rows in a run, one for an agent alone.
"""

from typing import Any, Literal, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
from jaxtyping import Bool, Float, Int

from echelon.agents.network.channel import NEVER
from echelon.agents.network.exchange import Exchange, Near
from echelon.core.types import Array, Inputs, PyTree, States
from echelon.laws.law import Memory

# ---- which agents: all of them, known before the run, or a mask ----------------------------------

Mask: TypeAlias = Literal[True] | Bool[jax.Array, " N"]
"""Which agents: all of them, which costs nothing, or (N,)."""


def choose(mask: Mask, one: PyTree, other: PyTree) -> PyTree:
    """Return a tree with the rows of `one` where the mask holds, and of `other` elsewhere."""
    if mask is True:
        return one

    def rows(a: jax.Array, b: jax.Array) -> jax.Array:
        return jnp.where(mask.reshape(-1, *[1] * (jnp.ndim(a) - 1)), a, b)

    return jax.tree.map(rows, one, other)


def some(mask: Mask, agents: Array) -> Mask:
    """Return the mask of some agents."""
    return True if mask is True else mask[agents]


def as_array(mask: Mask, agents: int) -> Bool[jax.Array, " N"]:
    """Return a mask as an array, for what needs one."""
    return jnp.ones(agents, bool) if mask is True else mask


# ---- time ----------------------------------------------------------------------------------------


class Steps(NamedTuple):
    """The clock of a run: the number of the step, and its length dt, s."""

    step: jax.Array
    dt: Array | float

    @property
    def now(self) -> jax.Array:
        """The stamp of what is sent now."""
        return self.step

    @property
    def t(self) -> jax.Array:
        """Time, s."""
        # From the step number, since a sum of many dt would gather rounding.
        return self.step.astype(float) * self.dt

    @property
    def first(self) -> jax.Array:
        """Whether this is the first step."""
        return self.step == 0

    def age(self, stamp: jax.Array) -> Float[jax.Array, " *K"]:
        """Return the age (s) of what has this stamp; infinite where nothing came."""
        return jnp.where(stamp == NEVER, jnp.inf, (self.step - stamp) * jnp.asarray(self.dt))

    def waited(self, since: Float[jax.Array, " *N"]) -> Float[jax.Array, " *N"]:
        """Return for how long (s) each has been there that has been there `since` (s)."""
        return self.step * self.dt - since


class Seconds(NamedTuple):
    """The clock of an agent alone.

    Attributes:
        t: time, s.
        dt: its period, s.
        begun: when it acted first, s.
        first: whether it does now.
    """

    t: jax.Array
    dt: Array | float
    begun: jax.Array
    first: jax.Array

    @property
    def now(self) -> jax.Array:
        """The stamp of what is sent now."""
        return self.t

    @property
    def step(self) -> jax.Array:
        """What sensors count by."""
        return self.t

    def age(self, stamp: Float[jax.Array, " K"]) -> Float[jax.Array, " K"]:
        """Return the age (s) of what has this stamp; infinite where nothing came."""
        return jnp.where(stamp == NEVER, jnp.inf, jnp.maximum(0.0, self.t - stamp))

    def waited(self, since: Float[jax.Array, " *N"]) -> Float[jax.Array, " *N"]:
        """Return for how long (s) each has been there that has been there `since` (s)."""
        return self.t - jnp.maximum(since, self.begun)


Clock: TypeAlias = Steps | Seconds

# ---- messages ------------------------------------------------------------------------------------


class LeaderPackets(NamedTuple):
    """What a leader last said of itself, passed on unchanged by everybody; the newest counts.

    Attributes:
        leader: (N,) its number.
        stamp: (N,) when it said so; `NEVER` for no packet.
        content: (N, p) a row of numbers, which depends on the prediction.
        term: (N,) how often the lead was taken over; () where nobody can take it.
    """

    leader: Int[jax.Array, " N"]
    stamp: jax.Array
    content: Float[jax.Array, "N p"]
    term: PyTree


class Messages(NamedTuple):
    """What each agent sends, what is under way, and what a receiver keeps of each link.

    Attributes:
        value: (K, s) a deviation or a signal.
        hops: (K,) of the sender to a leader.
        packet: the newest of a leader: of each sender, or of each receiver.
        stamp: (K,) when it was sent, where a receiver keeps it; () elsewhere.
    """

    value: Float[jax.Array, "K s"]
    hops: Int[jax.Array, " K"]
    packet: LeaderPackets
    stamp: PyTree = ()


class NetworkEstimate(NamedTuple):
    """What agents know of others from messages at a step.

    Attributes:
        disagreement: z (N, s).
        leads: (N,) who leads.
        feedforward: (N, k) that each expects of its leader; () in the ideal network, in which it
            is said in the same step.
        leader: (N, s) the signal at which each expects its leader; likewise.
        hops: (N,) to a leader; likewise.
        packet: of each agent; likewise.
    """

    disagreement: Float[jax.Array, "N s"]
    leads: Bool[jax.Array, " N"]
    feedforward: PyTree = ()
    leader: PyTree = ()
    hops: PyTree = ()
    packet: PyTree = ()


# ---- agents --------------------------------------------------------------------------------------


class Own(NamedTuple):
    """Agents as they know themselves: their numbers (N,), and their states (N, n) as sensed."""

    number: Int[jax.Array, " N"]
    x: States


class GroupOffsets(NamedTuple):
    """What the agents of a group take for their offsets (G, n), and the rates of these.

    `rate` is None where offsets are constant, or the law uses none.
    """

    offset: States
    rate: States | None


class AgentOutput(NamedTuple):
    """What an agent does in a step.

    Attributes:
        desired: the input (m,) that its law asks for.
        input: what the actuators deliver of it (m,).
        memory: of its law, afterwards.
        message: what it sends to its followers in the same step, the feed-forward (k,).
    """

    desired: jax.Array
    input: jax.Array
    memory: Memory
    message: Float[jax.Array, " k"]


class Known(NamedTuple):
    """All that is known in a step before anybody acts; the last two after they are heard and seen.

    Attributes:
        clock: of the step.
        here: who is there.
        own: the agents as they know themselves.
        offsets: of the leaders and of the followers.
        said: (N, s) what all say.
        links: the exchange with the weights of this step.
        heard: what they know from messages, a `NetworkEstimate`.
        near: what each knows of others near it; None where agents do not keep apart.
    """

    clock: Clock
    here: Mask
    own: Own
    offsets: tuple[GroupOffsets, GroupOffsets]
    said: Float[jax.Array, "N s"]
    links: Exchange
    heard: Any = None
    near: Near | None = None


class LeaderSpeech(NamedTuple):
    """What leaders would do if they lead, and the memories of their laws before it."""

    before: Memory
    output: AgentOutput


class Played(NamedTuple):
    """What leaders and followers do, what leaders say, and what the network then remembers."""

    led: AgentOutput
    followed: AgentOutput
    speech: LeaderSpeech
    network: PyTree


class LawMemories(NamedTuple):
    """The memories of the leaders' law and of the others', a row of each agent."""

    leader: Memory
    follower: Memory


class ComponentMemory(NamedTuple):
    """What the components remember between two steps; () of one that remembers nothing.

    The first three are of the agents' bodies: they stay as they are while an agent is absent, and
    begin anew when it returns.
    """

    laws: LawMemories
    sensing: PyTree = ()
    plant: PyTree = ()
    network: PyTree = ()
    near: PyTree = ()
    roster: PyTree = ()


class LoopState(NamedTuple):
    """All that changes during a run.

    Attributes:
        step: its number.
        states: (N, n).
        cut: to which side limits moved each input (N, m) in the step before: -1, 0 or 1.
        memory: of the components.
    """

    step: jax.Array
    states: States
    cut: jax.Array
    memory: ComponentMemory


class Control(NamedTuple):
    """What all agents do in a step.

    Attributes:
        inputs: (N, m) delivered.
        limited: (N,) whose desired input a limit changed.
        cut: (N, m) to which side.
        memory: of the components, afterwards.
        said: (N, s) what they said.
        message: (N, k) what they send to their followers in the same step.
    """

    inputs: Inputs
    limited: jax.Array
    cut: jax.Array
    memory: ComponentMemory
    said: Float[jax.Array, "N s"]
    message: Float[jax.Array, "N k"]
