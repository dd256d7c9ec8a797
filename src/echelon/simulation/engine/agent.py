"""One agent in a process of its own: what a vehicle computes from its state and messages."""

import dataclasses
import math
import numbers
from collections.abc import Sequence
from typing import NamedTuple, TypeAlias, final

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Float

from echelon.agents.models.model import ControlAffine
from echelon.agents.network.exchange import Exchange, Near
from echelon.agents.network.inbox import (
    Inbox,
    LeaderPacket,
    Message,
    NamedValues,
    Received,
    Stamps,
    Surroundings,
)
from echelon.agents.network.switching import Schedule
from echelon.agents.world.sensing import Sensors
from echelon.core.compiled import cached_jit
from echelon.core.errors import SimulationError, check_kind
from echelon.core.numerics import precision
from echelon.core.types import Array, PyTree, Scalar, State
from echelon.core.words import Feedforward
from echelon.laws.flat_law import FlatLaw
from echelon.laws.law import Law, LocalView, Memory
from echelon.simulation.engine.law_drive import Laws
from echelon.simulation.engine.parts import Parts
from echelon.simulation.engine.prepare import prepare
from echelon.simulation.step.assembly import assemble
from echelon.simulation.step.leadership import NOBODY, Failover, FixedLeaders
from echelon.simulation.step.loop import Loop
from echelon.simulation.step.nearby import less_expected
from echelon.simulation.step.networks import (
    LateNetwork,
    MessageRules,
    PlanDeviations,
    Saying,
)
from echelon.simulation.step.places import MovingPlaces
from echelon.simulation.step.records import (
    AgentOutput,
    GroupOffsets,
    Known,
    LeaderPackets,
    Messages,
    Own,
    Seconds,
)
from echelon.simulation.step.run_laws import feedforward_of
from echelon.simulation.step.settings import Settings
from echelon.simulation.step.turns import by_depth

Signal: TypeAlias = Float[jax.Array, " s"]
"""What an agent sends to its neighbours."""


class OwnState(NamedTuple):
    """What an agent knows without messages: its state (n,), its offset (n,) and its memory.

    `rate` (n,) is of the offset, as in `LocalView`.
    """

    x: State
    offset: State
    memory: Memory
    rate: State | None = None


@cached_jit
def begin_alone(loop: Loop, law: Law, x: State) -> Memory:
    """Return the memory of an agent that begins at x."""
    return law.begin(loop.model, x)


@cached_jit
def beside_alone(law: Law, memory: Memory, other: Signal) -> Memory:
    """Return the memory of an agent that begins late, with its headings beside another signal's.

    An angle is a number that grows with every turn, and who begins late knows none of them.
    """
    return law.beside(memory, other) if isinstance(law, FlatLaw) else memory


@cached_jit
def expected_alone(
    loop: Loop,
    content_of: PlanDeviations,
    t: Scalar,
    content: Float[jax.Array, " p"],
    age: Scalar,
    s: int,
) -> Signal:
    """Return the signal (s,) at which an agent expects the leader, by its packet of an age (s)."""
    return content_of.expected(loop, s, t, content, jnp.maximum(age, 0.0))[0]


@cached_jit
def offset_alone(loop: Loop, law: Law, t: Scalar, agent: jax.Array) -> tuple[State, State | None]:
    """Return what an agent takes for its offset (n,) at a time (s), and its rate, or None."""
    return jax.tree.map(
        lambda row: row[0], (*loop.places.of_group(loop.model, law, t, agent[None]),)
    )


@cached_jit
def sense_alone(
    sensing: Sensors, model: ControlAffine, memory: PyTree, y: State, clock: Seconds
) -> tuple[State, PyTree]:
    """Return the state that an agent assumes at a measurement (n,), and what it remembers."""
    return sensing.read(model, memory, y, clock, jnp.zeros((), jnp.int32))


@cached_jit
def signal_of(loop: Loop, law: Law, own: OwnState) -> Signal:
    """Return what the agent sends to its neighbours."""
    return loop.laws.speech.of_one(law, loop.model, *own[:3])


@cached_jit
def hull_of(loop: Loop, law: Law, own: OwnState) -> Float[jax.Array, "r d"] | None:
    """Return the points in whose hull the agent's position stays, where agents keep apart."""
    return None if loop.laws.follower.safety is None else law.hull(loop.model, own.x, own.memory)


def _gaps(near: Near | None, hull: Float[jax.Array, "r d"] | None) -> Near | None:
    return None if near is None or hull is None else near._replace(gaps=hull[None] - near.gaps)


class OwnLaw(NamedTuple):
    """The law of one agent, and whom it hears.

    Attributes:
        loop: of its formation.
        leads: whether it is a leader.
        number: of the agent.
        neighbours: the numbers of those that it hears.
        weights: of their signals (rows, K); a graph that switches has several rows.
        signal_names, forward_names: of what it sends.
        source: whose feed-forward it uses; None for nobody's.
        schedule: when which row of weights holds, of a graph that switches.
    """

    loop: Loop
    leads: bool
    number: int
    neighbours: tuple[int, ...]
    weights: Array
    signal_names: tuple[str, ...]
    forward_names: tuple[str, ...]
    source: int | None
    schedule: Schedule | None

    @property
    def law(self) -> Law:
        """The leaders' law or the others'."""
        return self.loop.laws.leader if self.leads else self.loop.laws.follower


class Step(NamedTuple):
    """The signal (s,) of an agent, what it does, and whether both and its state are finite.

    `letter` is what it sends over a network that is late, as a row of one, and `hull` its hull.
    """

    signal: jax.Array
    action: AgentOutput
    finite: jax.Array
    letter: Messages | None = None
    hull: jax.Array | None = None


@cached_jit
def step_alone(
    loop: Loop,
    leads: bool,
    t: Scalar,
    own: OwnState,
    received: Float[jax.Array, "K s"],
    weights: Float[jax.Array, " K"],
    forward: Float[jax.Array, " k"],
    near: Near | None,
) -> Step:
    """Return what the agent does with what it received, NaN for what it did not."""
    gaps = jax.vmap(lambda value: gap_of(loop, leads, own, value))(received)
    return step_with(loop, leads, t, own, weights @ gaps, forward, near)


def gap_of(loop: Loop, leads: bool, own: OwnState, received: Signal) -> Float[jax.Array, " k"]:
    """Return the difference of an agent's signal from another's; 0 where that one is NaN."""
    signal = signal_of(loop, loop.laws.leader if leads else loop.laws.follower, own)
    # The own value has no difference: a neighbour that is not heard does not act.
    other = jnp.where(jnp.isnan(received), signal, received)
    return loop.laws.speech.difference(loop.model)(signal[None], other[None])[0]


def step_with(
    loop: Loop,
    leads: bool,
    t: Scalar,
    own: OwnState,
    z: Float[jax.Array, " s"],
    forward: Float[jax.Array, " k"],
    near: Near | None,
) -> Step:
    """Return what the agent does with a disagreement; a feed-forward is NaN if not received."""
    law, model = loop.laws.leader if leads else loop.laws.follower, loop.model
    signal, hull = signal_of(loop, law, own), hull_of(loop, law, own)
    if leads:
        forward = jnp.zeros(len(model.input_names))
    else:
        alone = loop.laws.axes.alone(law, model, t, own.x, len(forward))
        forward = jnp.where(jnp.isnan(forward), alone, forward)
    rows = z, forward, loop.motion.dt, _gaps(near, hull), own.rate
    view = LocalView(t, own.x, own.offset, *rows)
    action = loop.laws.act(model, loop.motion, law, view, own.memory, leads)
    return Step(signal, action, is_finite((own.x, signal, action, hull)), hull=hull)


def is_finite(tree: PyTree) -> jax.Array:
    """Return whether all numbers of a tree are finite."""
    leaves = [leaf for leaf in jax.tree.leaves(tree) if jnp.issubdtype(leaf.dtype, jnp.inexact)]
    return jnp.all(jnp.array([jnp.isfinite(leaf).all() for leaf in leaves]))


@cached_jit
def step_over_network(
    loop: Loop,
    rules: MessageRules,
    leads: bool,
    number: jax.Array,
    clock: Seconds,
    own: OwnState,
    mail: Messages,
    weights: Float[jax.Array, " K"],
    near: Near | None,
) -> Step:
    """Return what the agent does and sends over a network that is late."""
    law, model = loop.laws.leader if leads else loop.laws.follower, loop.model
    signal, nobody = signal_of(loop, law, own), np.zeros(len(weights), np.int32)
    links, said = Exchange(nobody, nobody, weights), signal[None]
    offset = GroupOffsets(own.offset[None], None)
    known = Known(clock, True, Own(number, own.x[None]), (offset, offset), said, links)
    heard = rules.read(loop, mail, known)
    forward = jnp.zeros(len(model.input_names)) if leads else heard.feedforward[0]
    hull = hull_of(loop, law, own)
    hull = None if hull is None else less_expected(loop, clock.t, hull, heard.leader[0])
    rows = heard.disagreement[0], forward, loop.motion.dt, _gaps(near, hull), own.rate
    view = LocalView(clock.t, own.x, own.offset, *rows)
    action = loop.laws.act(model, loop.motion, law, view, own.memory, leads)
    content = mail.packet.content
    if leads:
        content = rules.content.content(loop, clock.t, Saying(*own[:3], signal, action))[None]
    rows = number, clock.now, said, content, loop.laws.speech.difference(model)
    letter, _ = rules.write(mail, heard, *rows)
    # Of a letter what it says: before the first packet its stamp is -inf.
    said = letter.value, letter.packet.content
    return Step(signal, action, is_finite((own.x, signal, action, said, hull)), letter, hull)


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
        neighbours: the numbers of those that it hears.
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
        network, sensing = parts.world.network, parts.world.sensing
        late = max(network.delay, network.jitter) if network else 0.0
        late = max([late, sensing.delay if sensing else 0.0, *(e.at for e in parts.events)])
        horizon = dt * math.ceil(1.0 + late / dt)
        prepared = prepare(parts, Settings(horizon=horizon, dt=dt, limits=limits))
        drive = prepared.parts.drive
        assert isinstance(drive, Laws)
        with precision("float64"):
            self._loop = assemble(prepared.problem, drive.leader, drive.follower)
        if self._loop.laws.backups and network is None:
            raise SimulationError(
                "got `leadership` without a network, in which single agents know at once who "
                "leads; give the parts' world a `network`."
            )
        self.number, graph = int(agent), parts.graph
        self.leads = agent in graph.leaders
        self._law = self._loop.laws.leader if self.leads else self._loop.laws.follower
        exchange = self._loop.graph.exchange
        edges = np.asarray(exchange.receivers) == agent
        self.neighbours = tuple(np.asarray(exchange.senders)[edges].tolist())
        self._weights = np.atleast_2d(np.asarray(exchange.weights))[:, edges]
        self._schedule = graph.schedule
        with precision("float64"):
            self._names = _names(self._loop, self._law)
        late = self._loop.network
        self._rules = late.rules if isinstance(late, LateNetwork) else None
        self._stamps = self._stamps_of(graph.leaders, graph.backups)
        self._source = self._source_in(parts)
        self._inbox = Inbox(self.neighbours, self._source, *self._names, stamps=self._stamps)
        self._others = self._surroundings(graph.agents)
        self._sensing, self._sensed = self._loop.sensing.on_board, None
        self._memory: Memory | None = None
        self._begun, self._time, self.blind, self._since = False, -math.inf, 0, math.inf
        self._late = False
        self._last: tuple[Array, Message | None] = np.array(self._loop.model.trim[1], float), None

    def _stamps_of(self, leaders: Sequence[int], backups: Sequence[int]) -> Stamps | None:
        if self._rules is None:
            return None
        size = self._rules.content.size(*self._sizes)
        own = self.number if self.leads else None
        needs_packet = self._rules.content.needs_packet
        return Stamps(len(self.neighbours), leaders, size, own, needs_packet, backups)

    def _succeed(self, stamps: Stamps) -> None:
        """Take the lead if nobody was heard to lead for long, or leave it to whoever has it."""
        leadership, packet = self._loop.network.leadership, stamps.packet
        if not isinstance(leadership, Failover):
            return
        self._since = min(self._since, self._time)
        last = -math.inf if packet is None else packet.time
        leader = self.number if stamps.leads else NOBODY if packet is None else packet.leader
        waited = min(self._time - last, self._time - self._since)
        rows = (np.array([value]) for value in (self.number, leader, waited))
        if leadership.silent(*rows)[0]:
            stamps.take_lead(self.number)
        self.leads = stamps.leads
        self._law = self._loop.laws.leader if self.leads else self._loop.laws.follower

    def _surroundings(self, agents: int) -> Surroundings | None:
        safety, model = self._loop.laws.follower.safety, self._loop.model
        if safety is None:
            return None
        with precision("float64"):
            x = jnp.zeros(len(model.state_names))
            hull = jax.eval_shape(lambda: self._law.hull(model, x, self._law.begin(model, x)))
        assert hull is not None
        names = tuple(f"{name}{k}" for k in range(len(hull)) for name in model.position)
        return Surroundings([k for k in range(agents) if k != self.number], names)

    @property
    def own_law(self) -> OwnLaw:
        """Its law, and whom it hears."""
        own, heard = (self.leads, self.number), (self.neighbours, self._weights)
        return OwnLaw(self._loop, *own, *heard, *self._names, self._source, self._schedule)

    @property
    def _sizes(self) -> tuple[int, int, int]:
        """How many numbers a signal, a feed-forward and an input have."""
        signal, forward = map(len, self._names)
        return signal, forward, len(self._loop.model.input_names)

    def _source_in(self, parts: Parts) -> int | None:
        """Return whose feed-forward this agent uses; None for nobody's."""
        silent = self._loop.laws.follower.feedforward is Feedforward.NONE
        if self.leads or silent and not self._loop.laws.follower.turning:
            return None
        depths = by_depth(self._loop)
        if depths is not None:
            return int(depths.parents[self.number])
        return parts.graph.nearest_leader()[self.number]

    def receive(self, message: object) -> Received:
        """Take a message of another agent, or return why it is not used. It never raises."""
        received = self._inbox.receive(message)
        if self._others is None or received not in (Received.TAKEN, Received.NOT_HEARD):
            return received
        # Of others than neighbours the place alone is used.
        clock = None if self._stamps is None else self._stamps.clock
        return Received.TAKEN if self._others.take(message, clock) else received

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
        with precision("float64"):
            time = jnp.asarray(float(t or 0.0))
            own = self._own(self._measured(self._state(x), time)[0], time)
            signal = signal_of(self._loop, self._law, own)
            hull = hull_of(self._loop, self._law, own)
        message = self._message(np.asarray(signal))
        finite = bool(is_finite((signal, hull)))
        return self._with_hull(message, hull) if finite else self._last[1]

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
        self._time = float(t)
        if self._stamps is not None:
            self._stamps.clock = self._time
            self._succeed(self._stamps)
        row = 0 if self._schedule is None else self._schedule.row(t)
        with precision("float64"):
            time = jnp.asarray(self._time)
            state, sensed = self._measured(self._state(x), time)
            own = self._own(state, time)
            if self._stamps is None or self._rules is None:
                step = step_alone(
                    self._loop,
                    self.leads,
                    time,
                    own,
                    self._inbox.signals,
                    self._weights[row],
                    self._inbox.feedforward,
                    self._hulls(),
                )
            else:
                leadership = FixedLeaders(np.array([self.leads]))
                rules = dataclasses.replace(self._rules, leadership=leadership)
                number = jnp.array([self.number], jnp.int32)
                clock = Seconds(time, self._loop.motion.dt, jnp.asarray(not self._begun))
                rows = own, self._mail(self._stamps, rules), self._weights[row], self._hulls()
                step = step_over_network(self._loop, rules, self.leads, number, clock, *rows)
        if step.finite:
            self._memory, self._begun = step.action.memory, True
            self._late = self._late and self._heard_at(time) is None
            self._sensed = self._sensing.acted(sensed, step.action.input)
            message = self._with_hull(self._written(step), step.hull)
            self._last = np.asarray(step.action.input), message
        else:
            self.blind += 1
        return self._last

    def _hulls(self) -> Near | None:
        if self._others is None or self.leads:
            return None
        others, d = len(self._others.time), len(self._loop.model.position)
        hulls = jnp.asarray(self._others.hulls.reshape(others, -1, d))
        numbers = np.delete(np.arange(others + 1), self.number)
        known = ~jnp.isnan(hulls).any(axis=(1, 2))
        leaders, packet = self._loop.laws.leaders, self._stamps and self._stamps.packet
        if self._loop.laws.backups and packet is not None:
            leaders = [packet.leader]
        return Near(hulls, jnp.asarray(np.isin(numbers, leaders)), known)

    def _with_hull(self, message: Message | None, hull: jax.Array | None) -> Message | None:
        if message is None or hull is None or self._others is None:
            return message
        return message._replace(hull=NamedValues(self._others.names, np.asarray(hull).ravel()))

    def _mail(self, stamps: Stamps, rules: MessageRules) -> Messages:
        size = rules.content.size(*self._sizes)
        packet = stamps.packet
        leader = self.number if self.leads else NOBODY
        leader = leader if packet is None else packet.leader
        content = np.zeros(size) if packet is None else np.asarray(packet.content)
        sent = -math.inf if packet is None else packet.time
        packets = LeaderPackets(
            jnp.array([leader], jnp.int32), jnp.array([sent]), jnp.asarray(content)[None], ()
        )
        # Of an output that a sender does not have it is taken to be where the leader is.
        value = jnp.nan_to_num(jnp.asarray(self._inbox.signals), nan=0.0)
        return Messages(
            value, jnp.asarray(stamps.hops, jnp.int32), packets, jnp.asarray(stamps.time)
        )

    def _written(self, step: "Step") -> Message | None:
        if self._stamps is None or step.letter is None:
            return self._message(step.signal, step.action.message)
        packet, leader = self._stamps.packet, int(step.letter.packet.leader[0])
        if leader == self.number:
            content = tuple(step.letter.packet.content[0].tolist())
            packet = LeaderPacket(leader, self._time, content, self._stamps.term)
        if packet is None and self._stamps.needs_packet:
            return None
        message = self._message(step.letter.value[0])
        hops = int(step.letter.hops[0])
        return message._replace(time=self._time, hops=hops, packet=packet)

    def _message(self, signal: ArrayLike, forward: ArrayLike | None = None) -> Message:
        names, forward_names = self._names
        sent = None if forward is None else NamedValues(forward_names, np.asarray(forward))
        return Message(self.number, NamedValues(names, np.asarray(signal)), sent)

    def _state(self, x: ArrayLike) -> State:
        state, n = np.asarray(x), len(self._loop.model.state_names)
        if state.shape != (n,) or state.dtype.kind not in "iuf":
            raise SimulationError(
                f"the state of an agent has shape {state.shape} of {state.dtype}, and must have "
                f"shape {(n,)} of numbers."
            )
        return jnp.asarray(state, float)

    def _measured(self, y: State, time: jax.Array) -> tuple[State, PyTree]:
        if not self._sensing.stages:
            return y, ()
        model, before = self._loop.model, self._sensed
        before = self._sensing.begin(model, y) if before is None else before
        clock = Seconds(time, self._loop.motion.dt, jnp.asarray(not self._begun))
        return sense_alone(self._sensing, model, before, y, clock)

    def _heard_at(self, time: jax.Array) -> Array | jax.Array | None:
        """Return the signal of another agent (s,), of the leader over a network; None before it."""
        stamps = self._stamps
        if stamps is None or not stamps.needs_packet:
            return next((x for x in self._inbox.signals if np.isfinite(x).all()), None)
        if stamps.packet is None:
            return None
        content, age = jnp.asarray(stamps.packet.content), time - stamps.packet.time
        deviations = self._rules and self._rules.content
        assert isinstance(deviations, PlanDeviations), "it has packets"
        return expected_alone(self._loop, deviations, time, content, age, self._sizes[0])

    def _own(self, state: State, time: jax.Array) -> "OwnState":
        # As in a run, where leaders may follow their backup leaders.
        law = self._loop.laws.follower if self._loop.laws.backups else self._law
        memory = self._memory if self._begun else begin_alone(self._loop, law, state)
        self._late = self._late if self._begun else float(time) > 0.0
        other = self._heard_at(time) if self._late else None
        if other is not None:
            memory = beside_alone(law, memory, other)
        if not isinstance(self._loop.places, MovingPlaces):
            return OwnState(state, jnp.asarray(self._loop.places.offsets[self.number]), memory)
        number = jnp.asarray(self.number)
        offset, rate = offset_alone(self._loop, self._law, time, number)
        return OwnState(state, offset, memory, rate)


def _names(loop: Loop, law: Law) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return the names of what an agent sends: of its signal and of its feed-forward."""
    model, follower = loop.model, loop.laws.follower

    def sizes(x: State, v: jax.Array) -> tuple[jax.Array, jax.Array]:
        own = OwnState(x, x, begin_alone(loop, law, x))
        forward = feedforward_of(follower, model, x, v, own.memory)
        return signal_of(loop, law, own), forward

    x, v = np.zeros(len(model.state_names)), np.zeros(len(model.input_names))
    signal, forward = jax.eval_shape(sizes, x, v)
    heading = ("heading",) * follower.turning
    return (
        _fitting(law.signal_names(model), signal.size),
        (*_fitting(follower.message_names(model), forward.size), *heading),
    )


def _fitting(names: tuple[str, ...], size: int) -> tuple[str, ...]:
    """Return names of as many values; numbers where a law of a user's own says no names."""
    return names if len(names) == size else tuple(map(str, range(size)))
