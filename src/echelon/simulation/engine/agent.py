"""One agent in a process of its own: what a vehicle computes from its state and messages."""

import math
import numbers
from typing import NamedTuple, final

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from echelon.agents.network.channel import NEVER
from echelon.agents.network.inbox import (
    Inbox,
    LateInbox,
    LeaderPacket,
    Message,
    NamedValues,
    Received,
    Surroundings,
)
from echelon.agents.network.switching import Schedule
from echelon.core.compiled import cached_jit
from echelon.core.errors import SimulationError, check_kind
from echelon.core.numerics import precision
from echelon.core.types import Array, PyTree, State
from echelon.core.words import Feedforward
from echelon.laws.law import Feeds, KeepsApart, Law, Speaks
from echelon.simulation.engine.law_drive import Laws
from echelon.simulation.engine.parts import Parts
from echelon.simulation.engine.prepare import prepare
from echelon.simulation.step.alone import (
    Arrived,
    OwnMemory,
    after_mail,
    alone,
    begin_alone,
    step_alone,
)
from echelon.simulation.step.assembly import assemble
from echelon.simulation.step.loop import Loop
from echelon.simulation.step.networks import LateNetwork, MessageRules
from echelon.simulation.step.places import MovingPlaces
from echelon.simulation.step.records import Control, LeaderPackets, Messages
from echelon.simulation.step.run_laws import feedforward_of
from echelon.simulation.step.settings import Settings
from echelon.simulation.step.turns import by_depth


class OwnLaw(NamedTuple):
    """The law of one agent, and whom it hears.

    Attributes:
        loop: of its formation.
        leads: whether it is a leader.
        number: of the agent.
        neighbours: the numbers of those that it hears.
        signal_names, forward_names: of what it sends.
        source: whose feed-forward it uses; None for nobody's.
        schedule: when which row of weights holds, of a graph that switches.
    """

    loop: Loop
    leads: bool
    number: int
    neighbours: tuple[int, ...]
    signal_names: tuple[str, ...]
    forward_names: tuple[str, ...]
    source: int | None
    schedule: Schedule | None

    @property
    def law(self) -> Law:
        """The leaders' law or the others'."""
        return self.loop.laws.leader if self.leads else self.loop.laws.follower


@cached_jit
def act_alone(
    loop: Loop, own: OwnMemory, t: jax.Array, x: State
) -> tuple[Control, OwnMemory, jax.Array]:
    """Return what an agent does, its memory, and whether all of that and its state is finite."""
    acted, after = step_alone(loop, own, t, x)
    return acted, after, is_finite((x, acted))


_begin = cached_jit(begin_alone)


def is_finite(tree: PyTree) -> jax.Array:
    """Return whether all numbers of a tree are finite."""
    leaves = [leaf for leaf in jax.tree.leaves(tree) if jnp.issubdtype(leaf.dtype, jnp.inexact)]
    return jnp.all(jnp.array([jnp.isfinite(leaf).all() for leaf in leaves]))


@final
class Agent:
    """One agent of a formation under laws, which knows its own state and what it receives.

    In every step each agent sends its `hello`, and then takes its `step` after it received the
    messages: leaders first, where their input is fed forward, and followers by their distance from
    the leaders where it is their parents'. Together they do what `simulate` does, to rounding.

    Over the network of the parts' world, which is late, agents take their `step` in any order, and
    send its message whenever the network's rate allows it; `hello` is not needed.

    A message may be missing: the last one of its sender is used, and a neighbour that sent none is
    left out. Agents of other models are heard in the outputs that both have. Nothing that is not
    finite reaches the memory. With `safety` an agent keeps apart only from those whose messages it
    receives: give it those of all agents, neighbours or not.

    Args:
        parts: of the whole formation; the starts are not used.
        agent: its number.
        dt: how long its inputs are held, s.
        limits: whether the actuators' limits act on it.

    Attributes:
        number: its number.
        leads: whether it leads.
        neighbours: the numbers of those that it hears.
        own_law: its law, and whom it hears.
        blind: how many steps repeated the last input, as the state, or what follows from it, was
            not finite.

    Raises:
        EchelonError: the parts do not fit each other, or there is no such agent.
    """

    def __init__(self, parts: Parts, agent: int, dt: float = 0.005, limits: bool = True) -> None:
        check_kind("parts", parts, Parts)
        check_kind("drive", parts.drive, Laws)
        if not isinstance(agent, numbers.Integral) or not 0 <= agent < parts.graph.agents:
            raise SimulationError(
                f"agent {agent!r} is not in this graph, whose agents are 0 to "
                f"{parts.graph.agents - 1}."
            )
        effects = parts.world.effects
        late = max([effects.delay, effects.age, *(event.at for event in parts.events)])
        horizon = dt * math.ceil(1.0 + late / dt)
        prepared = prepare(parts, Settings(horizon=horizon, dt=dt, limits=limits))
        drive = prepared.parts.drive
        assert isinstance(drive, Laws)
        with precision("float64"):
            loop = assemble(prepared.problem, drive.leader, drive.follower)
        if loop.laws.backups and not loop.network.late:
            raise SimulationError(
                "got `leadership` without a network, in which single agents know at once who "
                "leads; give the parts' world a `network`."
            )
        self.number, self.leads = int(agent), agent in parts.graph.leaders
        self.own_law = _own_law(loop, parts, self.number)
        self.neighbours = self.own_law.neighbours
        own, leaders = self.own_law, [*parts.graph.leaders, *parts.graph.backups]
        self._mail = (
            LateMail(own, loop.network.rules, leaders)
            if isinstance(loop.network, LateNetwork)
            else Mail(own, Inbox(own.neighbours, own.source, own.signal_names, own.forward_names))
        )
        self._loop = alone(loop, self.number, self._mail.arrived, own.schedule)
        self._memory: OwnMemory | None = None
        self._time, self.blind = -math.inf, 0
        self._last: tuple[Array, Message | None] = np.array(loop.model.trim[1], float), None

    def receive(self, message: object) -> Received:
        """Take a message of another agent, or return why it is not used. It never raises."""
        return self._mail.receive(message)

    def hello(self, x: ArrayLike, t: float | None = None) -> Message | None:
        """Return the message of the agent at a state (n,), before it acts.

        If the state is not finite, it is the last message, None if there was none.

        Args:
            x: own state (n,).
            t: time, s, which a formation that changes with time needs.

        Raises:
            SimulationError: the state has another shape, or the time is needed.
        """
        if t is None and isinstance(self._loop.places, MovingPlaces):
            raise SimulationError("the formation changes with time; call `hello(x, t)`.")
        acted, _, finite = self._act(float(t or 0.0), x)
        return self._mail.hello(acted) if finite else self._last[1]

    def step(self, t: float, x: ArrayLike) -> tuple[Array, Message | None]:
        """Return the physical input (m,) that is delivered from t (s) on, and the whole message.

        They are the last ones if the state, or what follows from it, is not finite, and at first
        the trim's input and None.

        Args:
            t: time, s.
            x: own state (n,).

        Raises:
            SimulationError: the time goes back, or the state has another shape.
        """
        if not isinstance(t, numbers.Real) or not self._time <= float(t) < math.inf:
            raise SimulationError(
                f"`t` is {t!r}, and must be a finite time in seconds that does not go back; the "
                f"last step was at {self._time:g} s."
            )
        self._time = self._mail.inbox.clock = float(t)
        acted, after, finite = self._act(self._time, x)
        if finite:
            self._memory = after
            self.leads = self.leads or self._mail.leads(acted)
            self._last = np.asarray(acted.inputs)[0], self._mail.written(acted)
        else:
            self.blind += 1
        return self._last

    def _act(self, t: float, x: ArrayLike) -> tuple[Control, OwnMemory, bool]:
        """Return what the agent does, its memory after it, and whether all of it is finite."""
        state, loop = self._state(x), after_mail(self._loop, self._mail.arrived)
        with precision("float64"):
            memory = self._memory or _begin(loop, jnp.asarray(state))
            acted, after, finite = act_alone(loop, memory, jnp.asarray(t), jnp.asarray(state))
        return acted, after, bool(finite)

    def _state(self, x: ArrayLike) -> Array:
        state, n = np.asarray(x), len(self._loop.model.state_names)
        if state.shape != (n,) or state.dtype.kind not in "iuf":
            raise SimulationError(
                f"the state of an agent has shape {state.shape} of {state.dtype}, and must have "
                f"shape {(n,)} of numbers."
            )
        return np.asarray(state, float)


class Mail:
    """What an agent receives, as arrays, and what it sends, as messages with names.

    Args:
        own: the agent.
        inbox: of its neighbours' messages.
    """

    def __init__(self, own: OwnLaw, inbox: Inbox) -> None:
        self._own, self.inbox, names = own, inbox, hull_names(own)
        # Of others than neighbours the place alone is used, where agents keep apart.
        others = [k for k in range(own.loop.agents) if k != own.number] if names else []
        self._others = Surroundings(others, names, inbox)

    def receive(self, message: object) -> Received:
        """Take a message, or return why it is not used."""
        received = self.inbox.receive(message)
        if received in (Received.TAKEN, Received.NOT_HEARD) and self._others.take(message):
            return Received.TAKEN
        return received

    @property
    def arrived(self) -> Arrived:
        """What came so far."""
        hulls, d = self._others.hulls, max(len(self._own.loop.model.position), 1)
        points = hulls.reshape(len(hulls), hulls.shape[1] // d, d)
        return Arrived(self.inbox.signals, self.inbox.feedforward, self._messages(), points)

    def _messages(self) -> PyTree:
        return ()

    def leads(self, acted: Control) -> bool:
        """Tell whether the agent took the lead."""
        return False

    def hello(self, acted: Control) -> Message:
        """Return the message before an agent acts."""
        signal = NamedValues(self._own.signal_names, np.asarray(acted.said[0]))
        return self._with_hull(Message(self._own.number, signal), acted)

    def written(self, acted: Control) -> Message | None:
        """Return the whole message of a step; None where there is nothing to say yet."""
        forward = NamedValues(self._own.forward_names, np.asarray(acted.message[0]))
        return self.hello(acted)._replace(feedforward=forward)

    def _with_hull(self, message: Message, acted: Control) -> Message:
        names = self._others.names
        hull = NamedValues(names, np.asarray(acted.memory.near).ravel())
        return message._replace(hull=hull) if names else message


@final
class LateMail(Mail):
    """The same over a late network."""

    inbox: LateInbox

    def __init__(self, own: OwnLaw, rules: MessageRules, leaders: list[int]) -> None:
        sizes = len(own.signal_names), len(own.forward_names), len(own.loop.model.input_names)
        self._changes, self._needs = rules.leadership.changes, rules.content.needs_packet
        rows = leaders, rules.content.size(*sizes), self._needs, self._changes
        names = own.signal_names, own.forward_names
        super().__init__(own, LateInbox(own.neighbours, own.source, *names, *rows))

    def _messages(self) -> PyTree:
        box = self.inbox
        packets = [box.leader, box.said, box.content, box.term if self._changes else ()]
        # Of an output that a sender does not have it is taken to be where the leader is.
        value = np.nan_to_num(box.signals, nan=0.0)
        return Messages._make([value, box.hops, LeaderPackets._make(packets), box.time])

    def leads(self, acted: Control) -> bool:
        """Tell whether the agent took the lead."""
        written: Messages = acted.memory.network[0]
        return self._changes and int(written.packet.leader[0]) == self._own.number

    def written(self, acted: Control) -> Message | None:
        """Return the message of a step; None without a packet, where it says nothing alone."""
        own, needs = self._own, self._needs
        letter: Messages = jax.tree.map(lambda row: np.asarray(row)[0], acted.memory.network[0])
        leader, said, content, term = letter.packet
        if said == NEVER and needs:
            return None
        rows = int(leader), float(said), tuple(content.tolist()), int(term) if self._changes else 0
        packet = None if said == NEVER else LeaderPacket(*rows)
        signal = NamedValues(own.signal_names, np.asarray(letter.value))
        message = Message(own.number, signal, None, self.inbox.clock, int(letter.hops), packet)
        return self._with_hull(message, acted)


def _own_law(loop: Loop, parts: Parts, number: int) -> OwnLaw:
    exchange, leads = loop.graph.exchange, number in parts.graph.leaders
    edges = np.asarray(exchange.receivers) == number
    neighbours = tuple(np.asarray(exchange.senders)[edges].tolist())
    with precision("float64"):
        names = _names(loop, loop.laws.leader if leads else loop.laws.follower)
    rows = neighbours, *names, _source_in(loop, parts, number, leads)
    return OwnLaw(loop, leads, number, *rows, parts.graph.schedule)


def _source_in(loop: Loop, parts: Parts, number: int, leads: bool) -> int | None:
    """Return whose feed-forward an agent uses; None for nobody's."""
    silent = loop.laws.follower.feedforward is Feedforward.NONE
    if leads or silent and not loop.laws.follower.turning:
        return None
    depths = by_depth(loop)
    if depths is not None:
        return int(depths.parents[number])
    return parts.graph.nearest_leader()[number]


def hull_names(own: OwnLaw) -> tuple[str, ...]:
    """Return the names of the numbers of an agent's hull; () where agents do not keep apart."""
    loop, model = own.loop, own.loop.model
    if not loop.surroundings.keeps_apart:
        return ()
    with precision("float64"):
        x = jnp.zeros(len(model.state_names))
        hull = jax.eval_shape(
            lambda: KeepsApart.of(own.law).hull(model, x, own.law.begin(model, x))
        )
    assert hull is not None, "a law with `safety` has hulls"
    return tuple(f"{name}{k}" for k in range(len(hull)) for name in model.position)


def _names(loop: Loop, law: Law) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return the names of what an agent sends: of its signal and of its feed-forward."""
    model, follower = loop.model, loop.laws.follower

    def sizes(x: State, v: jax.Array) -> tuple[jax.Array, jax.Array]:
        memory = law.begin(model, x)
        signal = loop.laws.speech.of_one(law, model, x, x, memory)
        return signal, feedforward_of(follower, model, x, v, memory)

    x, v = np.zeros(len(model.state_names)), np.zeros(len(model.input_names))
    signal, forward = jax.eval_shape(sizes, x, v)
    heading = ("heading",) * follower.turning
    return (
        _fitting(Speaks.of(law).signal_names(model), signal.size),
        (*_fitting(Feeds.of(follower).message_names(model), forward.size), *heading),
    )


def _fitting(names: tuple[str, ...], size: int) -> tuple[str, ...]:
    """Return names of as many values; numbers where a law of a user's own says no names."""
    return names if len(names) == size else tuple(map(str, range(size)))
