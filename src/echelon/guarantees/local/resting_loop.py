"""The loop of a run with everybody at rest, and the derivative of the steps that run there.

The leaders rest at their trim, unless they react; nothing pushes, measures or loses at random. All
else is what runs: laws, their memories, limits, motors, estimators, the ages of messages, plants.

Where the trim moves, rest is motion with it: whoever and whatever moves by w dt in a step stays.
"""

import dataclasses
import functools
import math
from collections.abc import Callable
from typing import NamedTuple, final

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Float

from echelon.agents.models.model import ControlAffine
from echelon.agents.models.relative_equilibrium import trim_velocity
from echelon.agents.models.unlike import UnlikeAgents
from echelon.agents.references.reference import LeaderPath
from echelon.core.compiled import cached_jit, compiled_for_one_call
from echelon.core.numerics import Field
from echelon.core.types import Array, Input, PyTree, Scalar, State
from echelon.laws.law import Expected, Law, LocalView, Memory, Speaks, Travels, reference_of
from echelon.simulation.engine.law_drive import Laws
from echelon.simulation.engine.parts import Parts
from echelon.simulation.engine.prepare import Prepared
from echelon.simulation.step.assembly import assemble
from echelon.simulation.step.drive import Problem
from echelon.simulation.step.loop import Loop
from echelon.simulation.step.motion import IdealMotors, LaggingMotors, PlantStep
from echelon.simulation.step.own_members import own_classes
from echelon.simulation.step.records import LoopState
from echelon.simulation.step.roster import Everybody, Links, SwitchingLinks
from echelon.simulation.step.run_laws import feedforward_of
from echelon.simulation.step.sequence import begin, step

# ---- leaders at rest -----------------------------------------------------------------------------


@final
class RestingLeader(Law, Travels, Speaks):
    """A leader that rests at its trim, as everybody expects, and says what a follower would.

    `travel` (2, n): how far it is off its trim at first, and how fast that moves; None if it rests.
    """

    follower: Law
    travel: Array | None = None
    plans = True

    def init(self) -> Memory:
        """Return a follower's memory."""
        return self.follower.init()

    def begin(self, model: ControlAffine, x: State) -> Memory:
        """Return a follower's memory at x."""
        return self.follower.begin(model, x)

    def update(self, model: ControlAffine, view: LocalView, memory: Memory) -> tuple[Input, Memory]:
        """Return the trim input."""
        return model.physical(jnp.zeros(len(model.input_names))), memory

    def signal(
        self, model: ControlAffine, x: State, offset: State, memory: Memory
    ) -> Float[jax.Array, " s"] | None:
        """Return what a follower says."""
        return Speaks.of(self.follower).signal(model, x, offset, memory)

    def deviation(
        self, model: ControlAffine, t: Scalar, x: State, offset: State, memory: Memory
    ) -> Float[jax.Array, " s"]:
        """Return that it keeps to its plan."""
        return jnp.zeros_like(self._said(model, x, offset, memory))

    def expected(
        self,
        model: ControlAffine,
        t: Scalar,
        deviation: Float[jax.Array, " s"],
        age: Scalar,
        period: Scalar | float,
    ) -> Expected:
        """Return what it says at its trim, with the deviation."""
        x, still = _trim_at(model, t, self.travel), jnp.zeros(len(model.input_names))
        memory = self.begin(model, x)
        said = self._said(model, x, jnp.zeros_like(x), memory)
        if not Speaks.may(self.follower, "signal"):
            return Expected(deviation + said)
        # A signal is no state, from which its law could act.
        return Expected(deviation + said, feedforward_of(self.follower, model, x, still, memory))

    def _said(self, model: ControlAffine, x: State, offset: State, memory: Memory) -> jax.Array:
        said = self.signal(model, x, offset, memory)
        return x - offset if said is None else said


@final
class RestingPath(LeaderPath):
    """A path that stays at the trim of the model, or moves with it."""

    travel: Array | None = None

    def follow(self, model: ControlAffine, t: Scalar) -> tuple[State, Input]:
        """Return the trim."""
        u = jnp.asarray(np.asarray(model.trim[1], float))
        return _trim_at(model, t, self.travel), u

    def turns(self, model: ControlAffine) -> bool:
        """Tell that the heading stays."""
        return False

    def check(self) -> None:
        """Accept it."""

    def fit(self, model: ControlAffine) -> None:
        """Accept every model."""


def _trim_at(model: ControlAffine, t: Scalar, travel: Array | None) -> State:
    x = jnp.asarray(np.asarray(model.trim[0], float))
    return x if travel is None else x + travel[0] + t * travel[1]


def resting_leader(parts: Parts, answers: bool, ahead: float) -> Law:
    """Return the leaders' law with its path at rest; at the trim where it does not react."""
    assert isinstance(parts.drive, Laws)
    leader, velocity = parts.drive.leader, trim_velocity(parts.model)
    travel = np.stack([ahead * velocity, velocity]) if velocity.any() else None
    if not answers:
        return RestingLeader(parts.drive.follower, travel)
    if reference_of(leader) is None:
        return leader
    return dataclasses.replace(leader, reference=RestingPath(travel))  # pyright: ignore


def reacts(parts: Parts) -> bool:
    """Tell whether what leaders do counts: it depends on others, or nothing else is known of it."""
    words = parts.drive.information_for(parts.model, parts.graph).leader
    if isinstance(parts.model, UnlikeAgents):
        # No theorem is about their leaders: what they do counts as what others do.
        return True
    return parts.drive.reacts or any(word.startswith("neighbours") for word in words)


# ---- the loop ------------------------------------------------------------------------------------


def resting_loop(
    prepared: Prepared, graph_row: int | None, steps: int, ahead: float = 0.0, own: bool = False
) -> Loop:
    """Return the loop of a run at rest, for so many steps.

    Of a graph that switches it has one of its rows alone, unless that is None. A trim that moves
    has done so for a time `ahead` (s). `own`: leaders keep their law, whether they react or not.
    """
    parts, problem = prepared.parts, prepared.problem
    assert isinstance(parts.drive, Laws)
    still = problem._replace(
        settings=problem.settings._replace(horizon=steps * problem.settings.dt),
        motion=problem.motion.still,
        sensors=problem.sensors.still,
        channel=None if problem.channel is None else problem.channel.still,
    )
    leader = resting_leader(parts, own or reacts(parts), ahead)
    loop = assemble(still, leader, parts.drive.follower)
    loop = loop.replace(roster=Everybody())
    if graph_row is not None and isinstance(loop.graph, SwitchingLinks):
        loop = loop.replace(graph=Links(loop.graph.exchange.during(graph_row)))
    return loop


def period_of(problem: Problem, graph_steps: int) -> int:
    """Return after how many steps the network and the graph are the same again."""
    channel = problem.channel
    if channel is None:
        return graph_steps
    return math.lcm(graph_steps, int(channel.every) * channel.slots)


# ---- inputs that are held, exactly ---------------------------------------------------------------

_MOST_FLOW = 700.0
"""Of |A dt|: beyond, the exact flow of a step overflows or says nothing."""
_TERMS, _HALVINGS = 18, 12  # of Taylor's series at norm 1, and of the norm before it


@final
class HeldExactly(IdealMotors):
    """Motors whose plant moves by the exact flow of its slopes where it is, in place of a method.

    Only its derivative says something, and only where the plant rests.
    """

    inner: IdealMotors
    at_once, remembers = False, True

    def begin(self, trim: Input) -> PyTree:
        """Return what the motors remember."""
        return self.inner.begin(trim)

    def integrate(
        self, field: Field, memory: PyTree, x: State, u: Input, plant: PlantStep
    ) -> tuple[State, PyTree]:
        """Return the state one dt later by the flow about x, and the memory."""
        n, m, motors = len(x), len(u), self.inner
        command = motors.arrays.command(u) if isinstance(motors, LaggingMotors) else u
        lags = motors if isinstance(motors, LaggingMotors) and motors.remembers else None
        start = command if lags is None else memory
        at = jnp.concatenate([x, start, command])
        rest = jax.lax.stop_gradient(at)

        def moving(at: jax.Array) -> jax.Array:
            x, acts, command = at[:n], at[n : n + m], at[n + m :]
            rates = jnp.zeros(m)
            if lags is not None:
                later = functools.partial(lags.arrays.after, acts, command)
                rates = jax.jvp(later, (0.0,), (1.0,))[1]
            return jnp.concatenate([field(x, acts), rates, jnp.zeros(m)])

        flow = jax.lax.stop_gradient(_flow(plant.dt * jax.jacfwd(moving)(rest)))
        after = rest + flow @ (at - rest)
        return after[:n], memory if lags is None else after[n : n + m]


def _flow(X: jax.Array) -> jax.Array:
    """Return exp(X), (n, n); NaN where |X| is too large for one."""
    # No function of LAPACK, since compiled code with one cannot be stored.
    size = jnp.abs(X).sum(axis=1).max()
    X, one = X * 0.5**_HALVINGS, jnp.eye(len(X))
    flow = one + X / _TERMS
    for k in range(_TERMS - 1, 0, -1):
        flow = one + X @ flow / k
    flow = jax.lax.fori_loop(0, _HALVINGS, lambda _, flow: flow @ flow, flow)
    return jnp.where(size <= _MOST_FLOW, flow, jnp.nan)


def held_exactly(loop: Loop) -> Loop | None:
    """Return the loop whose plants move by the exact flow; None where they have another step."""
    motion = loop.motion
    if motion.integrator == "printed" or any(own_classes(motion)):
        return None
    rows = motion.rows if motion.rows == () else (motion.rows[0], HeldExactly(motion.rows[1]))
    return loop.replace(
        motion=dataclasses.replace(motion, motors=HeldExactly(motion.motors), rows=rows)
    )


# ---- which numbers of a moment may move ----------------------------------------------------------


class BodyPlaces(NamedTuple):
    """Where each number of a moment belongs.

    Attributes:
        agent: (D,) whose it is; -1 of the network and of what surrounds agents.
        entry: (D,) its place in the agent's body; -1 likewise.
        state: (D,) which state of the model it is; -1 of a memory.
    """

    agent: Array
    entry: Array
    state: Array


def body_of(loop: Loop, now: LoopState) -> BodyPlaces:
    """Return where each real number of a moment belongs."""
    numbers = np.arange(loop.agents)
    nobody = LoopState(*(jax.tree.map(lambda x: _rows(x, None), part) for part in now))
    memory, laws = nobody.memory, loop.laws
    own = now.memory

    def of(part: PyTree, agents: Array) -> PyTree:
        return jax.tree.map(lambda x: _rows(x, agents), part)

    memory = memory._replace(
        laws=type(own.laws)(
            of(own.laws.leader, laws.leaders), of(own.laws.follower, laws.followers)
        ),
        sensing=of(own.sensing, numbers),
        plant=of(own.plant, numbers),
    )
    marked = nobody._replace(states=_rows(now.states, numbers), memory=memory)
    agent = _flat(marked, now).astype(int)
    states = nobody._replace(
        states=np.broadcast_to(np.arange(now.states.shape[1]), now.states.shape)
    )
    state, entry = _flat(states, now).astype(int), np.full(len(agent), -1)
    for k in numbers:
        mine = np.flatnonzero(agent == k)
        entry[mine] = np.arange(len(mine))
    return BodyPlaces(agent, entry, state)


def _rows(leaf: jax.Array, agents: Array | None) -> Array:
    """Return an array of a shape in which each row is the number of its agent; -1 of nobody."""
    shape = np.shape(leaf)
    if agents is None or not shape or shape[0] != len(agents):
        return np.full(shape, -1)
    return np.broadcast_to(agents.reshape(-1, *[1] * (len(shape) - 1)), shape)


def _flat(tree: PyTree, like: PyTree) -> Array:
    """Return the entries of a tree whose leaves in `like` are real numbers."""
    pairs = zip(jax.tree.leaves(tree), jax.tree.leaves(like), strict=True)
    flat = [np.ravel(a) for a, b in pairs if is_real(b)]
    return np.concatenate(flat)


def is_real(leaf: object) -> bool:
    """Tell whether a leaf of a moment has real numbers, which may move."""
    return bool(jnp.issubdtype(jnp.result_type(leaf), jnp.floating))


# ---- steps as a function of real numbers ---------------------------------------------------------


def reals(now: LoopState) -> Array:
    """Return all real numbers of a moment, (D,)."""
    return _flat(now, now)


def with_reals(now: LoopState, values: jax.Array) -> LoopState:
    """Return a moment with other real numbers (D,)."""
    leaves, tree = jax.tree.flatten(now)
    real = [leaf for leaf in leaves if is_real(leaf)]
    _, back = ravel_pytree(real)
    moved = iter(back(values))
    return tree.unflatten([next(moved) if is_real(leaf) else leaf for leaf in leaves])


@compiled_for_one_call
def begun(loop: Loop, states: Array, steps: Array) -> LoopState:
    """Return the moment so many steps after a beginning at states (N, n)."""
    return jax.lax.fori_loop(0, steps, lambda _, now: step(loop, now), begin(loop, states))


@cached_jit
def later(loop: Loop, now: LoopState, steps: Array) -> LoopState:
    """Return the moment so many steps later."""
    return jax.lax.fori_loop(0, steps, lambda _, now: step(loop, now), now)


_NUMBERS = 2_000_000
"""Of all rows that are computed at a time."""


class Span(NamedTuple):
    """So many steps, and by how much all numbers (D,) move in one at rest; None for nothing."""

    steps: Array
    drift: Array | None


def _moved(
    loop: Loop, now: LoopState, free: Array, span: Span
) -> tuple[Callable[[jax.Array], jax.Array], int]:
    """Return where numbers (d,) are after some steps, and how many there are at most in a row."""
    (steps, drift), leaves = span, jax.tree.leaves(now)
    rest = jnp.concatenate([jnp.ravel(x) for x in leaves if is_real(x)])

    def moved(values: jax.Array) -> jax.Array:
        start = with_reals(now, rest.at[free].set(values))
        end = jax.lax.fori_loop(0, steps, lambda _, now: step(loop, now), start)
        after = jnp.concatenate([jnp.ravel(x) for x in jax.tree.leaves(end) if is_real(x)])[free]
        return after if drift is None else after - steps * drift[free]

    # As many rows at a time as memory takes.
    return moved, max(1, _NUMBERS // len(rest))


@compiled_for_one_call
def slopes_along(
    loop: Loop, now: LoopState, free: Array, base: Array, directions: Array, span: Span
) -> tuple[jax.Array, jax.Array]:
    """Return where numbers are after some steps, and the derivative along directions, (K, d) each.

    Args:
        loop: what runs.
        now: the moment from which.
        free: (d,) the places of the numbers that may move.
        base: (d,) their values, the same for all directions: only slopes are computed K times.
        directions: (K, d).
        span: how many steps.
    """
    moved, rows = _moved(loop, now, free, span)
    start = (jnp.asarray(base),)
    return jax.lax.map(lambda d: jax.jvp(moved, start, (d,)), directions, batch_size=rows)


@compiled_for_one_call
def values_after(loop: Loop, now: LoopState, free: Array, bases: Array, span: Span) -> jax.Array:
    """Return where numbers are after some steps from each of K values (K, d), likewise."""
    moved, rows = _moved(loop, now, free, span)
    return jax.lax.map(moved, bases, batch_size=rows)
