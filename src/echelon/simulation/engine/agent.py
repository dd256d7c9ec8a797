"""One agent in a process of its own: what a vehicle computes from its state and messages."""

from collections.abc import Mapping
from typing import NamedTuple, final

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Float

from echelon.core.compiled import cached_jit
from echelon.core.errors import SimulationError, check_kind, listing
from echelon.core.numerics import precision
from echelon.core.types import Array, Scalar, State
from echelon.core.words import Feedforward
from echelon.laws.law import Law, LocalView, Memory
from echelon.simulation.engine.law_drive import Laws
from echelon.simulation.engine.parts import Parts
from echelon.simulation.engine.prepare import prepare
from echelon.simulation.step.action import Action, act
from echelon.simulation.step.loop import Loop, assemble
from echelon.simulation.step.settings import Settings


class Message(NamedTuple):
    """What an agent sends.

    Attributes:
        signal: what its neighbours use: its state less its offset, or the signal of its law.
        feedforward: the feed-forward of its input, of the same step; None before it has acted.
    """

    signal: Array
    feedforward: Array | None = None


@final
class Agent:
    """One agent of a formation under laws, which knows its own state and what it receives.

    In every step each agent sends its `hello`, and then takes its `step` with the messages that it
    received: leaders first, where their input is fed forward, and followers by their distance from
    the leaders where it is their parents'. Together they do what `simulate` does, to rounding.

    Args:
        parts: of the whole formation; the starts are not used.
        agent: its number.
        dt: how long its inputs are held, s.
        limits: whether the actuators' limits act on it.

    Raises:
        EchelonError: the parts do not fit each other, or there is no such agent.
    """

    def __init__(self, parts: Parts, agent: int, dt: float = 0.005, limits: bool = True) -> None:
        """Prepare its law."""
        check_kind("parts", parts, Parts)
        check_kind("drive", parts.drive, Laws)
        if not 0 <= agent < parts.graph.agents:
            raise SimulationError(
                f"agent {agent} is not in this graph, whose agents are 0 to "
                f"{parts.graph.agents - 1}."
            )
        prepared = prepare(parts, Settings(horizon=dt, dt=dt, limits=limits))
        drive = prepared.parts.drive
        assert isinstance(drive, Laws)
        with precision("float64"):
            self._loop = assemble(prepared.problem, drive.leader, drive.follower)
        self.number, graph = agent, parts.graph
        self.leads = agent in graph.leaders
        self._law = self._loop.leader if self.leads else self._loop.follower
        exchange = self._loop.exchange
        edges = np.asarray(exchange.receivers) == agent
        self.neighbours = tuple(np.asarray(exchange.senders)[edges].tolist())
        self._weights = np.atleast_2d(np.asarray(exchange.weights))[:, edges]
        self._schedule = graph.schedule
        self._source = self._source_in(parts)
        self._memory: Memory | None = None

    def _source_in(self, parts: Parts) -> int | None:
        """Return whose feed-forward this agent needs; None for nobody's."""
        silent = self._loop.follower.feedforward is Feedforward.NONE
        if self.leads or silent and not self._loop.follower.turning:
            return None
        if self._loop.parents is not None:
            return int(self._loop.parents[self.number])
        return parts.graph.nearest_leader()[self.number]

    def hello(self, x: ArrayLike) -> Message:
        """Return the message of the agent at a state (n,), before it acts."""
        with precision("float64"):
            state = self._state(x)
            return Message(np.asarray(_signal(self._loop, self._law, self._own(state))))

    def step(
        self, t: float, x: ArrayLike, messages: Mapping[int, Message]
    ) -> tuple[Array, Message]:
        """Return the physical input (m,) that is delivered from t (s) on, and the whole message.

        Args:
            t: time, s.
            x: own state (n,).
            messages: of the neighbours, by their numbers; that of the leader or the parent with
                its feed-forward, where the law uses one.

        Raises:
            SimulationError: one is missing, or the state has another shape.
        """
        weights = self._weights[0 if self._schedule is None else self._schedule.row(t)]
        senders = [j for j, weight in zip(self.neighbours, weights, strict=True) if weight > 0.0]
        missing = [j for j in senders if j not in messages]
        forward = None
        if self._source is not None:
            forward = messages.get(self._source, Message(np.zeros(0))).feedforward
        if missing or (forward is None and self._source is not None):
            who = missing[0] if missing else self._source
            what = "its message" if missing else "what it tells of its input"
            raise SimulationError(
                f"agent {self.number} needs {what} of agent {who} at t = {t:g} s, and got messages "
                f"of {listing(map(str, messages)) or 'nobody'}."
            )
        with precision("float64"):
            received = jnp.asarray(np.array([messages[j].signal for j in senders]))
            if forward is None:
                forward = np.zeros(len(self._loop.model.input_names))
            signal, action = _step(
                self._loop,
                self.leads,
                jnp.asarray(float(t)),
                self._own(self._state(x)),
                received,
                weights[weights > 0.0],
                jnp.asarray(forward),
            )
        self._memory = action.memory
        return np.asarray(action.input), Message(np.asarray(signal), np.asarray(action.message))

    def _state(self, x: ArrayLike) -> State:
        state, n = jnp.asarray(np.asarray(x, float)), len(self._loop.model.state_names)
        if state.shape != (n,):
            raise SimulationError(
                f"the state of an agent has shape {state.shape}, and needs {(n,)}."
            )
        if self._memory is None:
            self._memory = _begin(self._loop, self._law, state)
        return state

    def _own(self, state: State) -> "_OwnState":
        return _OwnState(state, jnp.asarray(self._loop.offsets[self.number]), self._memory)


class _OwnState(NamedTuple):
    """What an agent knows without messages: its state (n,), its offset (n,) and its memory."""

    x: State
    offset: State
    memory: Memory


@cached_jit
def _begin(loop: Loop, law: Law, x: State) -> Memory:
    return law.begin(loop.model, x)


@cached_jit
def _signal(loop: Loop, law: Law, own: _OwnState) -> Float[jax.Array, " s"]:
    """Return what the agent sends to its neighbours."""
    signal = law.signal(loop.model, *own)
    return own.x - own.offset if signal is None else signal


@cached_jit
def _step(
    loop: Loop,
    leads: bool,
    t: Scalar,
    own: _OwnState,
    received: Float[jax.Array, "..."],
    weights: Float[jax.Array, " K"],
    forward: Float[jax.Array, " k"],
) -> tuple[Float[jax.Array, " s"], Action]:
    """Return the signal and what the agent does with the signals that it received."""
    law = loop.leader if leads else loop.follower
    signal = _signal(loop, law, own)
    states = law.signal(loop.model, *own) is None
    difference = loop.model.difference if states else jnp.subtract
    gaps = jax.vmap(lambda theirs: difference(signal, theirs))(received.reshape(-1, len(signal)))
    view = LocalView(t, own.x, own.offset, weights @ gaps, forward, loop.motion.dt)
    return signal, act(loop, law, view, own.memory, leads)
