"""The local certificate of what runs: the spectrum of its steps at rest, and what it rests on.

The step of the whole formation is differentiated where everybody rests at its goal. Agents that are
alike, behind leaders that do not react, split by the eigenvalues of what they hear; that they do is
seen by the derivative of the whole step along directions drawn at random, and is not assumed.
"""

import enum
import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse as sp
import scipy.sparse.csgraph as csgraph
import scipy.sparse.linalg as spla

from echelon.agents.models.model import ControlAffine
from echelon.agents.models.relative_equilibrium import moves, trim_velocity
from echelon.agents.network.graph import Graph
from echelon.core.digits import about
from echelon.core.types import Array, PyTree
from echelon.core.words import Feedforward, amount
from echelon.guarantees.local.resting_loop import (
    BodyPlaces,
    Span,
    begun,
    body_of,
    held_exactly,
    is_real,
    later,
    period_of,
    reacts,
    reals,
    resting_loop,
    slopes_along,
    values_after,
    with_reals,
)
from echelon.guarantees.local.spectra import Split, amplification, modes_of
from echelon.laws.law import Feeds, Law, LocalView, Memory, Speaks
from echelon.laws.law_check import traced_arguments, unknown_class
from echelon.simulation.engine.law_drive import Laws
from echelon.simulation.engine.parts import Parts
from echelon.simulation.engine.prepare import Prepared
from echelon.simulation.step.loop import Loop
from echelon.simulation.step.own_members import own_members
from echelon.simulation.step.records import LoopState
from echelon.simulation.step.sequence import begin, step
from echelon.simulation.step.turns import by_depth
from echelon_ranges.jaxpr import used_leaves

_DENSE = 1500
"""Numbers of a formation up to which one map of all of them is made."""
_ALL = 2000
"""Agents of an undirected graph up to which all eigenvalues are computed."""
_SHOWN = 32
"""Eigenvalues that stand for an interval of them."""
_PROBES = 6
_AGREES = 1e-9
"""Relative; what rounding may leave between the derivative and the map made of it."""
_AT_REST = 1e-9
_NEWTON, _WARM, _NEARER = 6, 2000, 0.9
_ELSEWHERE = 1e-3, -1e-3, 0.1
FAR = 1e6
"""Growth before errors end, beyond which the linearization says nothing of any start."""


class Fault(enum.StrEnum):
    """Why nothing is known near rest."""

    NO_REST = "agents do not stay where they rest"
    SINGULAR = "a step of agents at rest gives no finite numbers"
    OFF_GOALS = "agents rest off their goals"
    TIME = "the step depends on time"
    WHOLE = "the step depends on whole numbers that it remembers"
    PLACES = "the step depends on where agents are"
    KINK = "the step is not differentiable where agents rest"
    LASTING = "the law reads a memory that nothing changes"
    ADRIFT = "nothing drives a state to its goal"
    SWITCHES = "the graph has no period of whole steps"
    LEADERLESS = "the leader is lost, and a backup leader leads"
    LARGE = "the formation is too large, and its agents are not alike"
    UNDECIDED = "rounding hides whether the slowest mode decays"
    GROWS = "errors grow in the steps that run"
    GROWS_EXACTLY = "errors grow if inputs are held and agents move exactly"


class LocalCertificate(NamedTuple):
    """What the steps of a run do to small errors, or why that is not known.

    Attributes:
        faults: why not; none where errors end.
        radius: by which errors shrink a step in the end, as it runs; None where it is not known.
        exact: the same if agents move exactly under held inputs; None without a number.
        modes: how many were computed.
        split: whether by the eigenvalues of what agents hear.
        growth: how often errors may be multiplied before they end; None where that is not known.
        before: the same until the last switch of a graph; None of one that does not switch.
        period: steps after which the network and the graph are the same again.
        off: how far agents rest off their goals at most, in units of a state.
        adrift: states that nothing drives to zero, by name.
        steady: whether messages have one age; with others nothing is known of their mixture.
        culprit: what a fault is about, in words; empty for nothing.
        map: what a step does to errors, by the eigenvalues of what agents hear; None where it is
            not split by them, or errors do not end.
    """

    faults: tuple[Fault, ...]
    radius: float | None = None
    exact: float | None = None
    modes: int = 0
    split: bool = False
    growth: float | None = None
    before: float | None = None
    period: int = 1
    off: float = 0.0
    adrift: tuple[str, ...] = ()
    steady: bool = True
    culprit: str = ""
    map: Split | None = None

    @property
    def holds(self) -> bool:
        """Whether small errors end."""
        return not self.faults

    def rate(self, dt: float) -> float | None:
        """Return at which rate (1/s) errors shrink in the end."""
        return None if self.radius is None or not self.radius else -float(np.log(self.radius)) / dt


def goals_at_rest(parts: Parts) -> Array:
    """Return the goals (N, n) about a leader at the trim, each with what its agent has."""
    goals = np.asarray(parts.model.trim[0], float) + parts.formation.offsets
    return np.asarray(jax.vmap(parts.model.own_state)(jnp.asarray(goals)))


def local_certificate(prepared: Prepared) -> LocalCertificate:
    """Return the certificate of prepared parts under laws, in float64."""
    parts, problem = prepared.parts, prepared.problem
    assert isinstance(parts.drive, Laws)
    row, repeats = _graph_of(prepared)
    if not repeats:
        return LocalCertificate((Fault.SWITCHES,))
    if not _led(parts.graph, row):
        return LocalCertificate((Fault.LEADERLESS,))
    period = period_of(problem, repeats)
    settled = _settled_after(prepared, period)
    loop = resting_loop(prepared, row, settled + 3 * period)
    goals, answer = goals_at_rest(parts), reacts(parts)
    counting = _counting(prepared, row, loop)
    for law in (parts.drive.follower, *[parts.drive.leader] * answer):
        timed = _timed(law, counting, parts.model, goals)
        if timed is not None:
            return LocalCertificate((timed[0],), culprit=timed[1])
    moving = _moving(prepared, row, settled, period, goals)
    if isinstance(moving, str):
        return LocalCertificate((Fault.PLACES,), culprit=moving)
    now = begun(loop, goals, np.asarray(settled))
    rest = _rest_of(loop, now, _movers(parts, answer), period, parts.graph, moving)
    return _certified(prepared, rest, goals, period, row)


def _certified(
    prepared: Prepared, rest: "_Rest", goals: Array, period: int, row: int | None
) -> LocalCertificate:
    parts, channel = prepared.parts, prepared.problem.channel
    if not _leaders_rest(rest, period):
        return LocalCertificate((Fault.NO_REST,))
    foreign = bool(parts.drive.unknown or own_members(rest.loop))
    found = _judged(rest, goals, period, parts.model.state_names, foreign)
    if row and found.radius is not None:
        found = _until_last(prepared, rest, goals, found)
    steady = channel is None or channel.steady
    return found._replace(period=period, steady=steady)


def _movers(parts: Parts, answer: bool) -> Array:
    """Return the agents (A,) whose deviations count: those that are led, and leaders that react."""
    agents = np.arange(parts.graph.agents) if answer else np.array(parts.graph.followers)
    schedule = parts.graph.schedule
    if schedule is None or schedule.present is None:
        return agents
    return agents[schedule.present[-1][agents]]


def _until_last(
    prepared: Prepared, rest: "_Rest", goals: Array, found: LocalCertificate
) -> LocalCertificate:
    """Return what is found with the growth of errors until the last switch of the graph."""
    schedule, dt = prepared.parts.graph.schedule, prepared.problem.settings.dt
    assert schedule is not None
    steps = int(schedule.switches(dt, 2.0 * float(schedule.starts[-1]))[0][-1])
    loop, value = resting_loop(prepared, None, steps + 1), _less(rest, rest.value, rest.since)
    now = begun(loop, goals, np.asarray(0))
    rest = rest._replace(loop=loop, now=now, value=value, since=0)
    if rest.whole is None:
        (start := reals(now))[rest.free] = value
        moved, slopes = with_reals(now, jnp.asarray(start)), None
        after = _less(rest, reals(later(loop, moved, np.asarray(steps)))[rest.free], steps)
    else:
        after, slopes = _maps(rest, np.eye(len(value)), steps)
    if not (np.abs(after - value) <= _AT_REST * _scale(value)).all():
        return found._replace(faults=(Fault.NO_REST,), radius=None, map=None)
    if slopes is None:
        return found
    at = rest.body.state[rest.free] >= 0
    before = np.linalg.norm(slopes.T[at][:, at], 2) if np.isfinite(slopes).all() else np.inf
    return found._replace(before=max(1.0, float(before)))


def _graph_of(prepared: Prepared) -> tuple[int | None, int]:
    """Return the row of a schedule that lasts, or None, and after how many steps a graph repeats.

    0 steps stand for a graph that does not repeat in whole steps.
    """
    graph, dt = prepared.parts.graph, prepared.problem.settings.dt
    if graph.schedule is None:
        return None, 1
    if graph.schedule.period is None:
        return len(graph.schedule.starts) - 1, 1
    stepped = graph.schedule.in_steps(dt)
    if stepped is None or stepped.period is None:
        return None, 0
    return None, round(stepped.period / dt)


def _led(graph: Graph, row: int | None) -> bool:
    """Tell whether a leader of the graph, and no backup leader, leads in a row of its schedule."""
    present = None if graph.schedule is None or row is None else graph.schedule.present
    return present is None or bool(present[row, list(graph.leaders)].any())


def _settled_after(prepared: Prepared, period: int) -> int:
    """Return after how many steps everybody has heard of a leader at rest, in whole periods."""
    channel, graph = prepared.problem.channel, prepared.parts.graph
    # Of graphs that take turns each may be deeper than all of them together.
    hops = graph.agents if graph.schedule is not None else int(graph.depths().max())
    late = 1 if channel is None else (hops + 2) * int(channel.delay + channel.every)
    return period * -(-late // period)


# ---- what the step reads besides states ----------------------------------------------------------


def _counting(prepared: Prepared, row: int | None, loop: Loop) -> Loop:
    """Return a loop in which only what may be a user's own reads whole numbers, if one is found."""
    bodies = {"sensing": loop.sensing, "motion": loop.motion}
    if not loop.network.late or own_members(loop, frozenset(bodies)):
        return loop
    # Of echelon's network, which counts steps, it is known when it is the same again.
    problem = prepared.problem._replace(channel=None, parts=())
    return resting_loop(prepared._replace(problem=problem), row, 1).replace(**bodies)


def _timed(law: Law, loop: Loop, model: ControlAffine, goals: Array) -> tuple[Fault, str] | None:
    """Return why steps of the same numbers may differ: time, or whole numbers; None if they do not.

    Of echelon's own classes it is known what they count.
    """
    own, name = own_members(loop), unknown_class(law)
    if own:
        now = jax.eval_shape(lambda: begin(loop, goals))
        used = used_leaves(lambda now: _reals_of(step(loop, now)), now)
        whole = _whole(now, used)
        return (Fault.TIME, own) if whole else None
    if not name:
        return None
    view, memory = traced_arguments(law, model)
    used = used_leaves(functools.partial(_all_that, law, model), view, memory)
    places = len(jax.tree.leaves(view))
    if used[[leaf is view.t for leaf in jax.tree.leaves(view)].index(True)]:
        return Fault.TIME, name
    if _whole(memory, used[places:]):
        return Fault.WHOLE, name
    return (Fault.KINK, name) if _begins_with_a_jump(law, model, goals) else None


def _all_that(law: Law, model: ControlAffine, view: LocalView, memory: Memory) -> PyTree:
    """Return all real numbers that an agent makes of what it knows."""
    u, after = law.update(model, view, memory)
    after = law.settle(model, view, u, u, after)
    said = Speaks.of(law).signal(model, view.x, view.offset, memory)
    if law.feedforward is Feedforward.NONE:
        return u, _reals_of(after), said
    return u, _reals_of(after), said, Feeds.of(law).message(model, view.x, u, after)


_NEAR, _STEEP = 1e-6, 1e3
"""A change of a start, and how much more a memory may change with it."""


def _begins_with_a_jump(law: Law, model: ControlAffine, goals: Array) -> bool:
    """Tell whether starts near a goal begin with memories that are far apart."""
    n = goals.shape[1]
    starts = np.concatenate([goals[0] + _NEAR * np.eye(n), goals[0] - _NEAR * np.eye(n)])
    begins = jax.vmap(lambda x: _reals_of(law.begin(model, x)))
    here, there = begins(jnp.asarray(goals[:1])), begins(jnp.asarray(starts))
    gaps = [np.abs(np.asarray(b) - np.asarray(a)) for a, b in zip(here, there, strict=True)]
    return any((gap > _STEEP * _NEAR).any() for gap in gaps)


def _reals_of(tree: PyTree) -> list[jax.Array]:
    return [leaf for leaf in jax.tree.leaves(tree) if is_real(leaf)]


def _whole(tree: PyTree, used: list[bool]) -> bool:
    """Tell whether a leaf is used that is no real number."""
    pairs = zip(jax.tree.leaves(tree), used, strict=True)
    return any(use and not is_real(leaf) for leaf, use in pairs)


# ---- trims that move -----------------------------------------------------------------------------
# T shifts states and all that is remembered of them. If step(T s) = T step(s), the derivative of a
# step is the same all along the motion, and a moment rests if a step shifts it by w dt.

_AWAY = 0.01
_PLACES = (1.0, -37.0, 900.0)
"""s of motion by which a formation is shifted, and how far off its goals it is meanwhile."""


class _Moving(NamedTuple):
    """As in `_Rest`."""

    drift: Array | None
    since: int


def _moving(
    prepared: Prepared, row: int | None, settled: int, period: int, goals: Array
) -> _Moving | str:
    """Return how all moves at rest, or why that depends on where agents are, in words."""
    if not moves(prepared.parts.model):
        return _Moving(None, settled)
    bound = _bound_to_places(prepared, row, settled + 3 * period, goals)
    return bound or _Moving(_drift(prepared, row, settled, period, goals), settled)


def _bound_to_places(prepared: Prepared, row: int | None, steps: int, goals: Array) -> str:
    """Return what differs if all begin elsewhere, in words; empty where nothing does."""
    model, rest = prepared.parts.model, []
    draw = np.random.default_rng(0).standard_normal(goals.shape)
    for ahead in (0.0, *_PLACES):
        loop = resting_loop(prepared, row, steps, ahead, own=True)
        shift = ahead * trim_velocity(model)
        now = begun(loop, goals + _AWAY * draw + shift, np.asarray(steps))
        rest.append(np.asarray(now.states) - shift)
    gaps = np.abs(np.array(rest[1:]) - rest[0]).max(axis=(0, 1))
    # Places far away are rounded, in each step, and a loop that grows multiplies that.
    off = np.abs(rest[0] - goals - steps * prepared.problem.settings.dt * trim_velocity(model))
    if (gaps <= _AT_REST * steps * max(1.0, float(off.max()) / _AWAY)).all():
        return ""
    k = int(np.argmax(np.where(np.isfinite(gaps), gaps, np.inf)))
    return f"`{model.state_names[k]}` differs by {about(gaps[k])} after {amount(steps, 'step')}"


def _drift(prepared: Prepared, row: int | None, settled: int, period: int, goals: Array) -> Array:
    """Return by how much all numbers of a moment move in a step, (D,), where all are at rest."""
    ahead, moments = period * prepared.problem.settings.dt, []
    for time in (0.0, ahead):
        loop = resting_loop(prepared, row, settled + 3 * period, time)
        shift = time * trim_velocity(prepared.parts.model)
        moments.append(reals(begun(loop, goals + shift, np.asarray(settled))))
    return (moments[1] - moments[0]) / period


def _leaders_rest(rest: "_Rest", period: int) -> bool:
    """Tell whether agents that are not looked at move with the trim; so do those of one at rest."""
    if rest.drift is None:
        return True
    others = (rest.body.agent >= 0) & ~np.isin(rest.body.agent, rest.movers)
    now, then = reals(rest.now), reals(later(rest.loop, rest.now, np.asarray(period)))
    gaps = np.abs(then - now - period * rest.drift) / _scale(now)
    return bool((gaps[others] <= _AT_REST).all())


def _less(rest: "_Rest", values: Array, steps: int) -> Array:
    """Return numbers (d,) less what they move at rest in some steps."""
    return values if rest.drift is None else values - steps * rest.drift[rest.free]


# ---- where everybody rests -----------------------------------------------------------------------


class _Rest(NamedTuple):
    """A moment that repeats after a period, and the map of deviations from it.

    Attributes:
        free: (d,) the places of the numbers that may move, agent by agent; what no agent has last.
        value: (d,) theirs.
        residual: what a period changes at most, in `_scale` of each number.
        movers: (A,) the agents that may move.
        links: C (A, A), what they hear; None where they are not alike.
        size: s of a body; 0 where agents have bodies of different sizes.
        split: the map, by what agents hear; None where they are not alike.
        whole: (d, d) the map of everything; None of one that is split, or too large.
        common: the radius of what all do alike, where nobody is led.
        probes: random directions (K, d) and the derivative along them, of one that is split.
        drift: (D,) by which all numbers of the moment move in a step at rest; None for nothing.
        since: steps since the agents began at their goals.
    """

    loop: Loop
    graph: Graph
    now: LoopState
    body: BodyPlaces
    free: Array
    value: Array
    residual: float
    movers: Array
    links: sp.csr_array | None
    size: int
    split: Split | None
    whole: Array | None
    common: float = 0.0
    probes: tuple[Array, Array] | None = None
    drift: Array | None = None
    since: int = 0

    @property
    def map(self) -> Split | None:
        """The map by what agents hear, or of everything; None of one that is too large."""
        if self.split is not None or self.whole is None:
            return self.split
        return Split.whole(self.whole)

    @property
    def is_state(self) -> Array:
        """Which numbers of a body, or of everything, are states."""
        states = self.body.state[self.free] >= 0
        return states[: self.size] if self.split is not None else states


def _rest_of(
    loop: Loop, now: LoopState, movers: Array, period: int, graph: Graph, moving: _Moving
) -> _Rest:
    """Return where everybody rests, looked for from a moment on, and the map about it."""
    body = body_of(loop, now)
    mine = [np.flatnonzero(body.agent == k) for k in movers]
    shared = np.flatnonzero(body.agent == -1)
    free = np.concatenate([*mine, shared])
    sizes = {len(each) for each in mine}
    size = sizes.pop() if len(sizes) == 1 else 0
    links = _links_of(loop, movers) if size and not len(shared) and period == 1 else None
    value, known = reals(now)[free], (None, None)
    rest = _Rest(loop, graph, now, body, free, value, np.inf, movers, links, size, *known)
    rest = rest._replace(**moving._asdict())
    if len(free) > _DENSE:
        return rest if links is None else _split_at(_settled(rest), period)
    rest = _by_newton(rest, period)
    return rest if links is None or len(movers) == 1 else _split_at(rest, period)


def _maps(rest: _Rest, directions: Array, period: int) -> tuple[Array, Array]:
    """Return the numbers (d,) a period later, and the derivative along directions (K, d)."""
    rows = rest.free, rest.value, directions, Span(np.asarray(period), rest.drift)
    values, slopes = map(np.asarray, slopes_along(rest.loop, rest.now, *rows))
    return values[0], slopes


def _values(rest: _Rest, bases: Array, period: int) -> Array:
    """Return where numbers are a period later, from each of K values (K, d)."""
    # One shape, and so one program.
    count = max(_PROBES, len(bases))
    rows = np.concatenate([bases, np.tile(rest.value, (count - len(bases), 1))])
    span = Span(np.asarray(period), rest.drift)
    after = values_after(rest.loop, rest.now, rest.free, rows, span)
    return np.asarray(after)[: len(bases)]


def _by_newton(rest: _Rest, period: int) -> _Rest:
    """Return the moment that a period changes least, found by Newton's method, with its map."""
    one, best = np.eye(len(rest.value)), rest
    for _ in range(_NEWTON):
        after, slopes = _maps(rest, one, period)
        gap = after - rest.value
        residual = float((np.abs(gap) / _scale(rest.value)).max(initial=0.0))
        if not np.isfinite(slopes).all() or not np.isfinite(residual):
            break
        here = rest._replace(residual=residual, whole=slopes.T)
        best = here if residual < best.residual else best
        if residual <= _AT_REST * 1e-3:
            break
        # What nothing changes is not moved: the least change of all.
        more = np.linalg.lstsq(slopes.T - one, -gap, rcond=None)[0]
        rest = rest._replace(value=rest.value + more)
    return best


def _settled(rest: _Rest) -> _Rest:
    """Return a moment that a step leaves as it is, or that of agents left alone for long."""
    for steps in (0, _WARM):
        now = later(rest.loop, rest.now, np.asarray(steps)) if steps else rest.now
        rest = rest._replace(now=now, value=reals(now)[rest.free], since=rest.since + steps)
        moved = np.abs(_values(rest, rest.value[None], 1)[0] - rest.value)
        rest = rest._replace(residual=float((moved / _scale(rest.value)).max()))
        if rest.residual <= _AT_REST:
            break
    return rest


# ---- agents that are alike -----------------------------------------------------------------------


def _links_of(loop: Loop, movers: Array) -> sp.csr_array | None:
    """Return C (A, A) of the agents that may move: what they hear; None of weights that change."""
    exchange = loop.graph.exchange
    weights = np.asarray(exchange.weights, float)
    if weights.ndim > 1:
        return None
    place = np.full(loop.agents, -1)
    place[movers] = np.arange(len(movers))
    to, of = place[np.asarray(exchange.receivers)], place[np.asarray(exchange.senders)]
    heard, inside, count = to >= 0, (to >= 0) & (of >= 0), len(movers)
    rows = np.concatenate([to[heard], to[inside]]), np.concatenate([to[heard], of[inside]])
    C = sp.csr_array((np.concatenate([weights[heard], -weights[inside]]), rows), (count, count))
    told = by_depth(loop)
    if told is None or count > _ALL:
        return C
    # What each is sent by its parent adds up along the tree (theory page, T4).
    parent, own = place[np.asarray(told.parents)[movers]], np.arange(count)
    below = own[parent >= 0]
    tree = sp.csc_array((np.ones(len(below)), (below, parent[below])), (count, count))
    return sp.csr_array(spla.spsolve(sp.csc_array(sp.eye_array(count) - tree), sp.csc_array(C)))


def _split_at(rest: _Rest, period: int) -> _Rest:
    """Return the map by what agents hear, if the whole one is that; else the rest as it is."""
    C, size, count = rest.links, rest.size, len(rest.movers)
    assert C is not None
    known, rest = rest.split, rest._replace(split=None)
    own, apart = C.diagonal(), sp.csc_array(C - sp.diags_array(C.diagonal()))
    # Who is heard most; of agents that hear nobody here, the two that differ most.
    k = int(abs(apart).sum(axis=0).argmax())
    a, b = (k, k) if apart.nnz else (int(own.argmin()), int(own.argmax()))
    units = np.zeros((2, size, count, size))
    units[[0, 1], :, [a, b]] = np.eye(size)
    random = np.random.default_rng(0).standard_normal((_PROBES, count * size))
    directions = np.concatenate([units.reshape(2 * size, -1), random])
    slopes = _maps(rest, directions, period)[1] if rest.whole is None else directions @ rest.whole.T
    blocks = slopes[: 2 * size].reshape(2, size, count, size)
    first, second = blocks[0, :, a].T, blocks[1, :, b].T
    if apart.nnz:
        j = int(np.abs(apart[:, [k]].toarray()[:, 0]).argmax())
        K = blocks[0, :, j].T / apart[j, k]
    else:
        K = (second - first) / (own[b] - own[a]) if own[b] > own[a] else np.zeros((size, size))
    F = first - own[a] * K
    deviations = random.reshape(_PROBES, count, size)
    expected = deviations @ F.T + np.stack([C @ each for each in deviations]) @ K.T
    gap = np.abs(expected.reshape(_PROBES, -1) - slopes[2 * size :])
    felt = np.stack([abs(C) @ np.abs(each) for each in deviations])
    scale = np.abs(deviations) @ np.abs(F.T) + felt @ np.abs(K.T)
    if not (gap <= _AGREES * scale.reshape(_PROBES, -1)).all():
        return rest
    grounded = len(rest.movers) < rest.loop.agents
    if known is not None:
        values = known.eigenvalues, known.between
    elif by_depth(rest.loop) is not None:
        values = rest.graph.parent_spectrum().eigenvalues, False
    else:
        values = _eigenvalues(C, grounded, rest.graph)
    if values is None:
        return rest
    # Where nobody is led all move alike with F alone, which must not carry them away.
    common = 0.0 if grounded else modes_of(Split.whole(F)).radius
    probes = random, slopes[2 * size :]
    return rest._replace(split=Split(F, K, *values), common=common, probes=probes)


def _eigenvalues(C: sp.csr_array, grounded: bool, graph: Graph) -> tuple[Array, bool] | None:
    """Return the eigenvalues of what agents hear, and whether all between them count too.

    Without anybody who is led one of them is 0: all move alike, which is no disagreement. Of a
    large undirected graph the extreme ones are known; None where they are not.
    """
    count, block = csgraph.connected_components(C, connection="strong")
    if np.bincount(block).max() > _ALL:
        whole = graph.schedule is None and not graph.directed and grounded
        if not whole or abs(C - graph.grounded_laplacian()).max() > 0.0:
            return None
        spectrum = graph.spectrum()
        return np.geomspace(spectrum.low, spectrum.high, _SHOWN), True
    values = list[Array]()
    for k in range(count):
        part = C[np.ix_(block == k, block == k)].toarray()
        same = np.array_equal(part, part.T)
        values.append(np.linalg.eigvalsh(part) if same else np.linalg.eigvals(part))
    found = np.concatenate(values)
    if not grounded:
        found = np.delete(found, np.abs(found).argmin())
    return np.unique(found), False


# ---- the verdict ---------------------------------------------------------------------------------


def _scale(values: Array) -> Array:
    """Return what a change of each number counts against: 1, and of numbers beyond 1e4 more."""
    return np.maximum(1.0, 1e-4 * np.abs(values))


def _arrives(rest: _Rest, period: int) -> bool:
    """Tell whether memories that begin elsewhere come to where they rest."""
    start = reals(rest.now)[rest.free]
    before = np.abs(start - rest.value) / _scale(rest.value)
    if not (before > _AT_REST).any():
        return True
    steps = period * -(-_WARM // period)
    then = reals(later(rest.loop, rest.now, np.asarray(steps)))[rest.free]
    after = np.abs(_less(rest, then, steps) - rest.value) / _scale(rest.value)
    return bool(((after <= _AT_REST) | (after < _NEARER * before)).all())


def _stays_elsewhere(rest: _Rest, places: tuple[int, ...], period: int) -> bool:
    """Tell whether numbers that nothing changes stay as they are, to the bit, at other values too.

    Then rest is not one point but a family, in which these numbers choose.
    """
    if rest.split is not None:
        spread = (np.array(places)[:, None] + rest.size * np.arange(len(rest.movers))).reshape(-1)
    else:
        spread = np.array(places)
    for size in _ELSEWHERE:
        value = rest.value.copy()
        value[spread] += size * _scale(value[spread])
        after = _values(rest, value[None], period)[0]
        if not np.array_equal(after[spread], value[spread]):
            return False
    return True


def _judged(
    rest: _Rest, goals: Array, period: int, names: tuple[str, ...], foreign: bool
) -> LocalCertificate:
    """Return the certificate of what rests; `foreign`: whether a user's own code takes part."""
    if not np.isfinite(reals(rest.now)).all():
        return LocalCertificate((Fault.SINGULAR,))
    if not (rest.residual <= _AT_REST and _arrives(rest, period)):
        return LocalCertificate((Fault.NO_REST,))
    states, agents = rest.body.state[rest.free], rest.body.agent[rest.free]
    at = states >= 0
    there = goals[agents[at], states[at]]
    gaps = np.abs(_less(rest, rest.value, rest.since)[at] - there) / _scale(there)
    if not (gaps <= _AT_REST).all():
        off, culprit = float(gaps.max()), names[states[at][gaps.argmax()]]
        return LocalCertificate((Fault.OFF_GOALS,), off=off, culprit=culprit)
    split = rest.map
    if split is None:
        return LocalCertificate((Fault.LARGE,))
    modes = modes_of(split)
    # What all do alike does not end, and must not carry them away either.
    away = rest.common if rest.common > 1.0 + _AGREES else 0.0
    radius = max(modes.radius, away) ** (1.0 / period)
    sides = _sides(rest, period, 1.0 - modes.radius, foreign)
    if sides is not None:
        return LocalCertificate((sides,))
    exact = _exactly(rest, period)
    still = [k for k in (*modes.lasting, *modes.loose) if rest.is_state[k]]
    loose = tuple(k for k in modes.loose if not rest.is_state[k])
    faults = [Fault.ADRIFT] * bool(still)
    last = len(still) < len(modes.lasting) + len(modes.loose) - len(loose)
    last = last or bool(loose) and not _stays_elsewhere(rest, loose, period)
    faults += [Fault.LASTING] * last
    faults += [Fault.GROWS] * (radius >= 1.0)
    faults += [Fault.UNDECIDED] * (radius < 1.0 <= modes.worst)
    faults += [Fault.GROWS_EXACTLY] * (exact is not None and not exact < 1.0)
    return LocalCertificate(
        (*faults,),
        radius,
        exact,
        len(modes.values),
        rest.split is not None,
        amplification(split, rest.is_state),
        off=float(gaps.max(initial=0.0)),
        adrift=tuple(dict.fromkeys(names[states[k]] for k in still)),
        map=None if faults else rest.split,
    )


def _exactly(rest: _Rest, period: int) -> float | None:
    """Return the radius of a step if agents move exactly under held inputs; None without any."""
    loop = held_exactly(rest.loop)
    if loop is None:
        return None
    there = rest._replace(loop=loop, whole=None)
    if rest.whole is not None:
        there = there._replace(whole=_maps(there, np.eye(len(rest.value)), period)[1].T)
    if rest.split is not None:
        there = _split_at(there, period)
    split = there.map
    if split is None or not np.isfinite(split.F).all():
        return None
    return modes_of(split).radius ** (1.0 / period)


_SIZES = 1e-4, 1e-6
"""Of changes along which values are compared with the derivative."""
_LEAST = 1e-2
"""Of how far the slowest mode is from the unit circle: no smaller kink can matter."""


def _sides(rest: _Rest, period: int, margin: float, foreign: bool) -> Fault | None:
    """Return that values on some side are not those of the derivative, or that rounding hides it.

    What the derivative leaves of a smooth function shrinks faster than the change. Rounding hides
    nothing in echelon's own code, and a model's kinks are looked for where it is checked.
    """
    if rest.whole is None:
        assert rest.probes is not None
        # Of many agents that are alike each one is a sample.
        sets = [rest.probes]
    else:
        random = np.random.default_rng(1).standard_normal(rest.whole.shape)
        sets = [(along, along @ rest.whole.T) for along in (random, np.eye(len(random)))]
    matters = _LEAST * min(max(margin, 1e-9), 1.0)
    rounding = 1e2 * np.finfo(float).eps * np.maximum(1.0, np.abs(rest.value)) / _SIZES[1]
    if rest.split is None and rest.whole is not None:
        rounding = np.maximum(rounding, np.abs(rest.whole) @ rounding)
    if foreign and 0.0 < margin and not (rounding <= matters).all():
        return Fault.UNDECIDED
    for along, slopes in sets:
        left = list[Array]()
        for size in _SIZES:
            for side in (size, -size):
                there = _values(rest, rest.value + side * along, period)
                left.append(np.abs((there - rest.value) / side - slopes))
        large, small = np.maximum(*left[:2]), np.maximum(*left[2:])
        if not np.isfinite(small).all():
            return Fault.KINK
        # Beside a steep function a kink counts by its share.
        least = np.maximum(rounding, matters * np.maximum(1.0, np.abs(slopes)))
        bends = (small > least) & (small > 0.3 * large)
        if bends.any():
            # Steep slopes of other numbers may make a difference of rounding alone.
            hidden = (small[bends] <= np.abs(slopes).max() * rounding.max()).all()
            return Fault.UNDECIDED if hidden else Fault.KINK
    return None
