"""A run in flat coordinates, and the hypotheses of theorem T5 beside its tube."""

import functools
import math
from collections.abc import Callable, Hashable, Iterable, Iterator
from fractions import Fraction
from typing import Any, Concatenate, NamedTuple, ParamSpec, TypeVar, cast

import jax
import jax.numpy as jnp
import numpy as np
import scipy.linalg
from jaxtyping import Float

from echelon.agents.models.chains import Chains, flat_output, to_flat
from echelon.agents.models.model import ControlAffine
from echelon.agents.network.edges import name_agents
from echelon.agents.network.formation_motion import FormationMotion
from echelon.agents.network.graph import Graph
from echelon.agents.network.matrices import unreached
from echelon.core.cache import memoize
from echelon.core.compiled import cached_jit
from echelon.core.digits import about, at_least, at_most
from echelon.core.errors import GraphError
from echelon.core.identity import process_key
from echelon.core.linear import sampled_radius
from echelon.core.statement import Hypothesis, Statement, fails, holds, unneeded
from echelon.core.types import Array
from echelon.core.words import Feedforward, Kind
from echelon.guarantees.messages.late_messages import (
    Following,
    LateMessages,
    Uncovered,
    late_messages_of,
)
from echelon.guarantees.stopping.chain_response import Chain
from echelon.guarantees.stopping.moving_offsets import size_beside
from echelon.guarantees.stopping.path_bounds import path_speed
from echelon.laws.flat_loop import FlatLoop
from echelon.laws.stopping_point import StoppingLeader, StoppingPoint, beginning_of
from echelon.simulation.engine.law_drive import Laws
from echelon.simulation.engine.parts import Parts
from echelon.simulation.scalars import Node, ScalarGraph, Unsupported, lower, nodes
from echelon.simulation.step.settings import Settings

# ---- states that are flat outputs ----------------------------------------------------------------


class FlatStates(NamedTuple):
    """States by name, as traces of the equations show them; what has no trace is left out.

    Attributes:
        outputs: states that are flat outputs themselves, in the same unit.
        free: those of them on which no derivative of an output depends, nor another output: agents
            that differ in these alone have all other states in common.
    """

    outputs: tuple[str, ...]
    free: tuple[str, ...]


@memoize
def flat_states_of(model: ControlAffine, chains: Chains) -> FlatStates:
    """Return which states of a model are flat outputs."""
    graph, n = ScalarGraph(), len(model.state_names)
    leaves = [graph.leaf("row", place) for place in range(n + chains.size)]
    x, e = (np.array(part, object) for part in (leaves[:n], leaves[n:]))

    def above(x: jax.Array, e: jax.Array) -> jax.Array:
        return to_flat(model, chains, x, e).values[1:]

    try:
        [found] = lower(lambda x: flat_output(model, chains.outputs, x), graph, [x])
        place = nodes(graph, found)
    except Unsupported:
        return FlatStates((), ())
    pairs = zip(chains.outputs, place, strict=True)
    same = tuple(
        name
        for name, node in pairs
        if name in model.state_names and node is leaves[model.state_names.index(name)]
    )
    try:
        [higher] = lower(above, graph, [x, e])
    except Unsupported:
        return FlatStates(same, ())
    others = [node for name, node in zip(chains.outputs, place, strict=True) if name not in same]
    used = _leaves_of([*nodes(graph, higher), *others])
    free = (name for name in same if leaves[model.state_names.index(name)].number not in used)
    return FlatStates(same, tuple(free))


def _leaves_of(results: Iterable[Node]) -> set[int]:
    """Return the numbers of the nodes that results depend on, but for products with 0."""
    reached, todo = set[int](), list(results)
    while todo:
        node = todo.pop()
        zero = node.op == "mul" and any(a.op == "constant" and a.value == 0.0 for a in node.args)
        if node.number not in reached and not zero:
            reached.add(node.number)
            todo += node.args
    return reached


# ---- starts in flat coordinates ------------------------------------------------------------------

_TURN = 2.0 * np.pi


def flat_starts(
    parts: Parts, law: StoppingPoint, states: Float[Array, "N n"]
) -> Float[Array, "N r m"]:
    """Return states in flat coordinates, less the offsets.

    Without `safety` they are less the offsets' derivatives too, which the law adds by itself.
    """
    motion = parts.formation.motion
    offsets = jnp.asarray(parts.formation.offsets_at([0.0])[0])
    flat = np.array(_flat(parts.model, law, jnp.asarray(states), offsets))
    if motion is not None and law.safety is None:
        rates = np.asarray(_offset_rates(motion, flat.shape[1] - 1))
        flat[:, 1:, np.array(law.ready.places_of(parts.model))] -= rates[:, 1:]
    return flat


@cached_jit
def _flat(
    model: ControlAffine, law: StoppingPoint, states: jax.Array, offsets: jax.Array
) -> jax.Array:
    chains = law.ready.chains

    def one(x: jax.Array, offset: jax.Array) -> jax.Array:
        memory = law.begin(model, x)
        values = to_flat(model, chains, x, memory.chain).values
        shift = flat_output(model, chains.outputs, offset)
        values = values.at[0].add(flat_output(model, chains.outputs, 0.0 * offset) - shift)
        # The law takes the turn of a heading that is next to the beginning of the leader's path.
        turns = jnp.round((law.signal(model, x, offset, memory) - law.ready.stop(values)) / _TURN)
        return values.at[0].add(_TURN * turns) if law.ready.angles else values

    return jax.vmap(one)(states, offsets)


@cached_jit
def _offset_rates(motion: FormationMotion, order: int) -> jax.Array:
    start, rows = jnp.zeros(()), jnp.asarray(motion.places)
    return jax.vmap(lambda row: motion.derivatives(row, start, order))(rows)


# ---- a graph that switches -----------------------------------------------------------------------


def switching_line(graph: Graph, leaderward: bool, left_out: str, rate: float) -> Statement:
    """Say along which edges the leader reaches everybody, of a graph as it runs in steps.

    `left_out` says why nothing is known of that, and `rate` is that of errors in the end, 1/s.
    """
    schedule, name = graph.schedule, Hypothesis.SWITCHING
    assert schedule is not None
    against = left_out or _left_behind(graph, leaderward)
    if against:
        remedy = "set `hears: all`, or add links" if leaderward else "add links"
        remedy = "switch at multiples of `simulation.dt`" if left_out else remedy
        return fails(name, Kind.PROOF, against, remedy=remedy, reason=against)
    since = at_least(schedule.starts[-1], 6)
    text = f"the leader reaches every agent along the edges from {since} s on"
    if schedule.period is not None:
        text = "the leader reaches every agent along the edges of any "
        text += f"{at_least(schedule.period, 6)} s together"
    text += ", and zeta' is received whatever edges are present"
    return holds(name, Kind.PROOF, text, rate)


def _left_behind(graph: Graph, leaderward: bool) -> str:
    """Laws are made for a graph without its events: of a part of them nobody has asked this."""
    schedule = graph.schedule
    assert schedule is not None
    since, lost = "in a period", np.array([], int)
    if schedule.period is None:
        since = f"from {schedule.starts[-1]:g} s on"
        lost = unreached(graph, schedule, -1)
    if leaderward:
        whole = graph.stretches(True)[-1 if schedule.period is None else 0 :]
        # Who is heard is nearer, and so on: the one of these that is nearest hears nobody.
        lost = np.array(graph.followers)[sum(L.diagonal() for L in whole) <= 0.0]
    along = " along neighbours that are nearer to it" if leaderward else ""
    return f"{name_agents(lost)} no path to the leader{along} {since}" if len(lost) else ""


# ---- the run -------------------------------------------------------------------------------------

_PROOF = Kind.PROOF
_BELOW = 1.0 - 1e-9
"""So little below a bound that nothing reaches; without chains a step at it has a radius of 1."""
_LONGEST = 1e6
"""Of c lambda times s; of a graph that lasts longer no exponential is computed."""
_TOGETHER = 1e-9
"""In flat coordinates; leaders that start nearer to each other differ by rounding."""


_P = ParamSpec("_P")
_R = TypeVar("_R")
_NO_SEED = -1


def of_leaders(
    function: Callable[Concatenate["StoppingRun", _P], _R],
) -> Callable[Concatenate["StoppingRun", _P], _R]:
    """Return a function of a run that computes once for all starts of followers, and all seeds.

    It is given a run whose followers are nowhere, so that it cannot depend on where they start.
    """

    @functools.wraps(function)
    def once(run: "StoppingRun", *args: _P.args, **named: _P.kwargs) -> _R:
        values: Hashable = args, tuple(named.items())
        try:
            hash(values)
        except TypeError:  # such as a list that a user's model has
            values = process_key(values)
        if values is None:
            return function(run.without_followers(), *args, **named)
        key = function.__qualname__, values
        if key not in run.kept:
            run.kept[key] = function(run.without_followers(), *args, **named)
        return cast(_R, run.kept[key])

    return once


class StoppingRun(NamedTuple):
    """A run under the law, as its theorem sees it.

    Attributes:
        states: (N, n) at the start.
        flat: (N, r, m) the same in flat coordinates, less the offsets and their derivatives.
        ahead: (r, m) of what the leader follows.
        late: what is guaranteed over its network; None for the ideal one.
        left_out: why nothing is known of how its graph switches in steps; empty elsewhere.
        kept: what follows from all but the seed and where followers start, see `of_leaders`.
    """

    parts: Parts
    settings: Settings
    states: Array
    flat: Array
    ahead: Array
    kept: dict[Hashable, Any]
    late: LateMessages | Uncovered | None = None
    left_out: str = ""

    def again(self, settings: Settings, states: Array) -> "StoppingRun":
        """Return a run that differs in its seed and in where agents start alone."""
        leads = list(self.parts.graph.leaders)
        if not np.array_equal(states[leads], self.states[leads]):
            return stopping_run_of(self.parts, settings, states)
        flat = flat_starts(self.parts, self.law, states)
        return self._replace(settings=settings, states=states, flat=flat)

    def without_followers(self) -> "StoppingRun":
        """Return the same with followers nowhere, and no seed."""
        nowhere = np.ones(len(self.states), bool)
        nowhere[list(self.parts.graph.leaders)] = False
        states, flat = (np.array(x, float) for x in (self.states, self.flat))
        states[nowhere], flat[nowhere] = np.nan, np.nan
        settings = self.settings._replace(seed=_NO_SEED)
        return self._replace(states=states, flat=flat, settings=settings)

    @property
    def law(self) -> StoppingPoint:
        """The followers' law."""
        return self.parts.drive.follower  # pyright: ignore

    @property
    def leader(self) -> StoppingLeader:
        """The leader's law."""
        return self.parts.drive.leader  # pyright: ignore

    @property
    @of_leaders
    def coupling(self) -> float:
        """C."""
        return float(self.law.strength(self.settings.dt))

    @property
    @of_leaders
    def rate(self) -> float:
        """The slowest mode of the formation, 1/s, as a positive number."""
        root = [self.law.slowest_root] if max(self.law.ready.chains.degrees) > 1 else []
        leaders = [float(self.leader.strength(self.settings.dt))] if self.apart else []
        return min([self.agreement, *root, *leaders])

    @property
    def network(self) -> LateMessages | None:
        """What is guaranteed over the network, if that is covered."""
        return self.late if isinstance(self.late, LateMessages) else None

    @property
    @of_leaders
    def still(self) -> bool:
        """Whether the leader is where it stays, from the start on."""
        outputs, motion = range(len(self.law.ready.chains.outputs)), self.parts.formation.motion
        if motion is not None and motion.moves(self.parts.graph.leaders):
            return False
        return self.leader.reference is None and max(map(self.own_speed, outputs)) < _TOGETHER

    @property
    @of_leaders
    def apart(self) -> bool:
        """Whether leaders start apart, so that their own agreement is in the errors."""
        return bool(np.ptp(self.flat[list(self.parts.graph.leaders)], axis=0).max() > _TOGETHER)

    @property
    @of_leaders
    def agreement(self) -> float:
        """The slowest disagreement of stopping points near rest, 1/s, as a positive number.

        Of a graph that switches again and again, what errors fall by in a period (Floquet), and of
        one that switches for a while, that of the graph which stays.
        """
        schedule, c = self.parts.graph.schedule, self.coupling
        if self.network is not None:
            return self.network.rate
        if schedule is None:
            assert self.law.reach is not None
            return c * self.law.reach.slowest
        whole = self.parts.graph.stretches(self.law.leaderward)
        if schedule.period is None:
            return c * float(np.linalg.eigvals(whole[-1].toarray()).real.min())
        flow = np.eye(len(self.parts.graph.followers))
        spans = np.diff(schedule.starts, append=schedule.period)
        for span, L in zip(spans, whole, strict=True):
            if c * span * L.diagonal().max() > _LONGEST:
                return 0.0
            flow = scipy.linalg.expm(-c * span * L.toarray()) @ flow
        left = max(float(np.abs(np.linalg.eigvals(flow)).max()), np.finfo(float).tiny)
        return -math.log(left) / schedule.period

    @of_leaders
    def chain(self, output: int) -> Chain:
        """Return the chain of an output.

        Raises:
            GainError: its roots have no common unit.
        """
        degree = self.law.ready.chains.degrees[output]
        return Chain.of(self.law.roots_for(degree - 1))

    @of_leaders
    def speed(self, output: int) -> float:
        """Return s of a follower against the leader: of each link on the way, told by parents.

        Over a network an agent stands still against the path until its first packet comes.
        """
        s = self.links * self.law.speed_of(output)
        if self.network is None:
            return s
        return max(s, self.path_speed(output) - self.own_speed(output))

    @property
    def shifted(self) -> FormationMotion | None:
        """How offsets move agents beside what they agree on; None where they do not."""
        # With `safety` the rate of an offset is within the speed, like any other.
        return None if self.law.safety is not None else self.parts.formation.motion

    @of_leaders
    def offset_size(self, order: int, *outputs: int) -> Fraction:
        """Return a bound of a derivative of offsets, the norm of some outputs, beside the path.

        Raises:
            GainError: none is known.
        """
        names = [self.law.ready.chains.outputs[k] for k in outputs]
        return size_beside(self.shifted, self.parts.model.position, names, order)

    @of_leaders
    def path_speed(self, output: int, until: float | None = None) -> float:
        """Return what |zeta_r'| of the leader's path does not pass until a time (s), or at all.

        Raises:
            GainError: the path has no enclosure.
        """
        return path_speed(self.leader, self.parts.model, self.settings.horizon, output, until)

    @property
    def links(self) -> int:
        """How many speeds add up on the way from a leader."""
        told = self.law.feedforward is Feedforward.PARENT
        return int(self.parts.graph.depths().max()) if told else 1

    @property
    @of_leaders
    def longest_step(self) -> float:
        """The longest step (s) that keeps the largest stopping point from growing."""
        return 1.0 / (self.coupling * self.heaviest)

    @property
    def heaviest(self) -> float:
        """d_max, the largest sum of weights that a follower hears."""
        assert self.law.reach is not None
        return self.law.reach.heaviest if self.network is None else float(self.network.sums.max())

    @of_leaders
    def own_speed(self, output: int) -> float:
        """Return the speed against its path that a leader may have: what it starts off, or s_0."""
        leads = list(self.parts.graph.leaders)
        weights = self.leader.ready.weights[:, output]
        away = np.abs(weights @ (self.flat[leads] - self.ahead)[:, :, output].T).max()
        c = float(self.leader.strength(self.settings.dt))
        # Its distance never grows, and sigma(c zeta) is below c zeta.
        return min(self.leader.speed_of(output), c * float(away))


def stopping_run_of(parts: Parts, settings: Settings, states: Array) -> StoppingRun:
    """Return a run of prepared parts under the law, from states (N, n)."""
    drive = parts.drive
    assert isinstance(drive, Laws) and isinstance(drive.follower, StoppingPoint)
    assert isinstance(drive.leader, StoppingLeader)
    flat = flat_starts(parts, drive.follower, states)
    graph, left_out = _in_steps(parts.graph, settings.dt)
    if graph is not parts.graph:
        parts = parts.replace(graph=graph, events=graph.events)
    ahead, leaderward = beginning_of(drive.leader, parts.model), drive.follower.leaderward
    run = StoppingRun(parts, settings, states, flat, ahead, {}, None, left_out)
    speed = min(map(run.law.speed_of, range(len(run.law.ready.chains.outputs))))
    avoiding = run.law.safety is not None
    following = Following(graph, leaderward, run.coupling, speed, run.still, run.apart, avoiding)
    times = settings.dt, settings.horizon, settings.steps
    return run._replace(late=late_messages_of(parts.world.network, following, *times))


def _in_steps(graph: Graph, dt: float) -> tuple[Graph, str]:
    """Return a graph as it runs in steps (s), or the graph and why nothing is known of that."""
    rounded = f"switches are rounded up to steps of {dt:g} s"
    try:
        stepped = graph.in_steps(dt)
    except GraphError as error:
        return graph, f"{rounded}, and then {str(error).rstrip('.')}"
    if stepped is None:
        return graph, f"{rounded}, which are no part of the `period` and its small multiples"
    return stepped, ""


# ---- what else it rests on -----------------------------------------------------------------------


@of_leaders
def condition_lines(run: StoppingRun) -> list[Statement]:
    """Return the conditions of T5 beside the tube."""
    return [*_condition_lines(run)]


def _condition_lines(run: StoppingRun) -> Iterator[Statement]:
    c = run.coupling
    yield _offsets_line(run)
    text = "in flat coordinates every agent is linear, with or without a trim"
    yield unneeded(Hypothesis.SMOOTH, _PROOF, text)
    text = "feedback turns all states and the integrators before inputs into chains"
    yield unneeded(Hypothesis.DETECTABLE, _PROOF, text)
    text = run.law.information[1]
    if run.network is not None:
        text = "everybody predicts zeta' by the leader's plan and the packet that it has of it"
    yield holds(Hypothesis.MATCHED_MOTION, _PROOF, text)
    yield holds(
        Hypothesis.COUPLING, _PROOF, "any coupling suffices", c, f"c {about(c, 4)}, edge 0", 0.0
    )
    text = "c lambda_min" if run.network is None else "the agreement over late messages"
    if run.parts.graph.schedule is not None:
        text = "the agreement over a period, or eventually"
    text += ", and the leaders' own coupling" * run.apart
    text = f"the slowest of the roots, {text}; far away the `speed` limits it"
    text += ", and not while agents hold each other back" * (run.law.safety is not None)
    rate = -run.rate, f"{at_least(-run.rate)} 1/s", 0.0
    yield holds(Hypothesis.DISAGREEMENT_DECAY, _PROOF, text, *rate)
    text = "the law is linear in flat coordinates everywhere"
    yield unneeded(Hypothesis.ALONG_PATH, _PROOF, text)
    yield _step_line(run)
    if run.parts.graph.schedule is not None:
        yield switching_line(run.parts.graph, run.law.leaderward, run.left_out, run.rate)
    yield unneeded(Hypothesis.CLAIMS, _PROOF, "there is no gain")


def _offsets_line(run: StoppingRun) -> Statement:
    model = run.parts.model
    motion = run.parts.formation.motion
    names = [model.state_names[k] for k in np.flatnonzero(np.ptp(run.parts.formation.offsets, 0))]
    names += [] if motion is None else [model.state_names[k] for k in motion.axes]
    flat, measured = flat_states_of(model, run.law.ready.chains), model.position
    broken = next((name for name in names if name not in flat.outputs), None)
    moving = next((name for name in names if name not in flat.free), None)
    alone = {*measured} <= {*flat.outputs} and measured
    if broken is None and (moving is None or alone):
        text = "offsets of flat outputs are symmetries"
        text += "" if motion is None else ", constant or not: zeta' has the rate of their own"
        return holds(Hypothesis.SYMMETRY, _PROOF, text)
    text, remedy = f"the offset of `{broken}` is not of a flat output", "offset flat outputs only"
    if broken is None:
        text = f"agents that differ in `{moving}` and follow the same path differ in other states"
        remedy = f"leave out the offset of `{moving}`, or give the model a `position`"
    reason = "an offset is no symmetry of the law"
    return fails(Hypothesis.SYMMETRY, _PROOF, text, remedy=remedy, reason=reason)


def _step_line(run: StoppingRun) -> Statement:
    """Return whether a held step keeps the largest stopping point from growing, c d_max dt <= 1."""
    name, dt, c = Hypothesis.SAMPLING, run.settings.dt, run.coupling
    share, own = c * run.heaviest * dt, float(run.leader.strength(dt))
    loops = (run.law.ready, c * _strengths(run)), (run.leader.ready, np.array([own]))
    radius = max(_step_radius(run, *loop) for loop in loops)
    share_text = f"c d_max dt = {at_least(share)}"
    if own * dt > 1.0 + 1e-12:
        # Its distance from its path would grow, on which the tube and the motors rest.
        own, remedy = own * dt, f"lower `leader.coupling` to {at_most(1.0 / dt, 4)}"
        text = f"the leader's step `dt` = {dt:g} s is too long: c dt = {at_least(own)} is above 1"
        return _too_long(text, (own, share_text), remedy)
    if share <= 1.0 + 1e-12 and radius < 1.0:
        text = f"Euler's step of zeta does not grow; spectral radius {at_least(radius, 4)} a step"
        return holds(name, Kind.LINEARIZATION, text, share, share_text, 1.0)
    if share <= 1.0:
        text = f"the step `dt` = {dt:g} s is too long: spectral radius {at_least(radius, 4)}"
        remedy = "lower `coupling` or `roots`, or shorten `simulation.dt`"
        return _too_long(text, (share, share_text), remedy)
    text = f"the step `dt` = {dt:g} s is too long: c d_max dt = {at_least(share)} is above 1"
    remedy = f"lower `coupling` to {at_most(1.0 / (run.heaviest * dt), 4)}, or shorten "
    remedy += f"`simulation.dt` to {at_most(1.0 / (c * run.heaviest))} s"
    return _too_long(text, (share, share_text), remedy)


def _too_long(text: str, number: tuple[float, str], remedy: str) -> Statement:
    name, kind = Hypothesis.SAMPLING, Kind.LINEARIZATION
    return fails(name, kind, text, *number, 1.0, remedy=remedy, reason=text)


def _step_radius(run: StoppingRun, loop: FlatLoop, strengths: Array) -> float:
    """Return the spectral radius of a step in flat coordinates, the highest derivatives held.

    What is off is felt by so much in each mode (K,), 1/s.
    """
    radius = 0.0
    for k, degree in enumerate(loop.chains.degrees):
        A, B = np.eye(degree, k=1), np.eye(degree)[:, -1:]
        stop = loop.stiffness[k] * loop.weights[:degree, k]
        inner = np.append(0.0, stop[:-1])
        gains = inner + strengths[:, None] * stop
        exact = sampled_radius(A, B, gains[:, None], run.settings.dt)
        radius = max(radius, exact, sampled_radius(A, B, gains[:, None], *run.settings.held))
    return radius


def _strengths(run: StoppingRun) -> Array:
    """Return eigenvalues of the followers' Laplacian that stand for all, (K,)."""
    graph, reach = run.parts.graph, run.law.reach
    assert reach is not None
    # What is heard over a network is late, and an agent answers to its own deviation.
    network = run.network
    alone = np.array([]) if network is None else network.sums
    if network is not None and network.ways is not None:
        return alone
    if run.law.leaderward or graph.directed or graph.schedule is not None:
        return np.append(alone, agreement_modes(graph, run.law))
    # By Gershgorin none is larger than 2 d_max, nor as large where somebody hears a leader.
    below = _BELOW if max(run.law.ready.chains.degrees) == 1 else 1.0
    return np.append(alone, [reach.slowest, 2.0 * reach.heaviest * below])


def agreement_modes(graph: Graph, law: StoppingPoint) -> Array:
    """Return eigenvalues lambda by which stopping points agree, zeta~' = -c lambda zeta~, (K,).

    Of graphs that take turns, those of each but for 0, of who is not reached for a while.
    """
    values = graph.spectrum().eigenvalues
    if law.leaderward:
        # Triangular in the order of how far agents are from the leader.
        values = np.unique([L.diagonal() for L in graph.stretches(True)])
    return values[np.abs(values) > 1e-12 * np.abs(values).max()]
