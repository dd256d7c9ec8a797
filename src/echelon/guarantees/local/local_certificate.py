"""The local certificate of what runs: the spectrum of its steps at rest, and what it rests on.

The step of the whole formation is differentiated where everybody rests at its goal. Agents that are
alike, behind leaders that do not react, split by the eigenvalues of what they hear; that they do is
seen by the derivative of the whole step along directions drawn at random, and is not assumed.
"""

import enum
from typing import NamedTuple

import jax
import numpy as np
import scipy.sparse as sp
import scipy.sparse.csgraph as csgraph

from echelon.agents.models.model import ControlAffine
from echelon.core.jaxpr import used_leaves
from echelon.core.types import Array, PyTree
from echelon.guarantees.local.resting_loop import (
    Body,
    begun,
    body_of,
    held_exactly,
    is_real,
    later,
    period_of,
    reacts,
    reals,
    responses,
    resting_loop,
)
from echelon.guarantees.local.spectra import Split, amplification, modes_of
from echelon.laws.law import Law, LocalView, Memory, Speaks
from echelon.laws.law_check import traced_arguments, unknown_class
from echelon.simulation.engine.law_drive import Laws
from echelon.simulation.engine.parts import Parts
from echelon.simulation.engine.prepare import Prepared
from echelon.simulation.step.loop import Loop
from echelon.simulation.step.own_members import own_members
from echelon.simulation.step.records import LoopState
from echelon.simulation.step.sequence import begin, step

_DENSE = 1500
"""Numbers of a formation up to which one map of all of them is made."""
_ALL = 2000
"""Agents of an undirected graph up to which all eigenvalues are computed."""
_PROBES = 6
_AGREES = 1e-9
"""Relative; what rounding may leave between the derivative and the map made of it."""
_AT_REST = 1e-9
_NEWTON, _WARM = 6, 2000
FAR = 1e6
"""Growth before errors end, beyond which the linearization says nothing of any start."""


class Fault(enum.StrEnum):
    """Why nothing is known near rest."""

    NO_REST = "agents do not stay where they rest"
    OFF_GOALS = "agents rest off their goals"
    TIME = "the step depends on time"
    WHOLE = "the step depends on whole numbers that it remembers"
    KINK = "the step is not differentiable where agents rest"
    LASTING = "the law reads a memory that nothing changes"
    ADRIFT = "nothing drives a state to its goal"
    SWITCHES = "the graph has no period of whole steps"
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

    @property
    def holds(self) -> bool:
        """Whether small errors end."""
        return not self.faults

    def rate(self, dt: float) -> float | None:
        """Return at which rate (1/s) errors shrink in the end."""
        return None if self.radius is None or not self.radius else -float(np.log(self.radius)) / dt


def local_certificate(prepared: Prepared) -> LocalCertificate:
    """Return the certificate of prepared parts under laws, in float64."""
    parts, problem = prepared.parts, prepared.problem
    assert isinstance(parts.drive, Laws)
    row, repeats = _graph_of(prepared)
    if not repeats:
        return LocalCertificate((Fault.SWITCHES,))
    period = period_of(problem, repeats)
    settled = _settled_after(prepared, period)
    loop = resting_loop(prepared, row, settled + 3 * period)
    goals, answer = np.asarray(parts.model.trim[0], float) + parts.formation.offsets, reacts(parts)
    for law in (parts.drive.follower, *[parts.drive.leader] * answer):
        timed = _timed(law, loop, parts.model, goals)
        if timed is not None:
            return LocalCertificate((timed[0],), culprit=timed[1])
    now = begun(loop, goals, np.asarray(settled))
    rest = _rest_of(loop, now, _movers(parts, answer), period)
    found = _judged(rest, goals, period, parts.model.state_names)
    if row and rest.whole is not None and found.radius is not None:
        found = _until_last(prepared, rest, goals, found)
    steady = problem.channel is None or problem.channel.steady
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
    loop = resting_loop(prepared, None, steps + 1)
    early = rest._replace(loop=loop, now=begun(loop, goals, np.asarray(0)))
    after, slopes = _maps(early, np.eye(len(rest.value)), steps)
    if not np.abs(after - rest.value).max(initial=0.0) <= _AT_REST * _size(rest):
        return found._replace(faults=(Fault.NO_REST,), radius=None)
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


def _settled_after(prepared: Prepared, period: int) -> int:
    """Return after how many steps everybody has heard of a leader at rest, in whole periods."""
    channel, hops = prepared.problem.channel, int(prepared.parts.graph.depths().max())
    late = 1 if channel is None else (hops + 2) * int(channel.delay + channel.every)
    return period * -(-late // period)


# ---- what the step reads besides states ----------------------------------------------------------


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

    def acts(view: LocalView, memory: Memory) -> object:
        u, after = law.update(model, view, memory)
        after = law.settle(model, view, u, u, after)
        return u, _reals_of(after), Speaks.of(law).signal(model, view.x, view.offset, memory)

    used = used_leaves(acts, view, memory)
    places = len(jax.tree.leaves(view))
    if used[[leaf is view.t for leaf in jax.tree.leaves(view)].index(True)]:
        return Fault.TIME, name
    return (Fault.WHOLE, name) if _whole(memory, used[places:]) else None


def _reals_of(tree: PyTree) -> list[jax.Array]:
    return [leaf for leaf in jax.tree.leaves(tree) if is_real(leaf)]


def _whole(tree: PyTree, used: list[bool]) -> bool:
    """Tell whether a leaf is used that is no real number."""
    pairs = zip(jax.tree.leaves(tree), used, strict=True)
    return any(use and not is_real(leaf) for leaf, use in pairs)


# ---- where everybody rests -----------------------------------------------------------------------


class _Rest(NamedTuple):
    """A moment that repeats after a period, and the map of deviations from it.

    Attributes:
        free: (d,) the places of the numbers that may move, agent by agent; what no agent has last.
        value: (d,) theirs.
        residual: what a period changes at most.
        movers: (A,) the agents that may move.
        size: s of a body; 0 where agents have bodies of different sizes.
        split: the map, by what agents hear; None where they are not alike.
        whole: (d, d) the map of everything; None of one that is split, or too large.
    """

    loop: Loop
    now: LoopState
    body: Body
    free: Array
    value: Array
    residual: float
    movers: Array
    size: int
    split: Split | None
    whole: Array | None

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


def _rest_of(loop: Loop, now: LoopState, movers: Array, period: int) -> _Rest:
    """Return where everybody rests, looked for from a moment on, and the map about it."""
    body = body_of(loop, now)
    mine = [np.flatnonzero(body.agent == k) for k in movers]
    shared = np.flatnonzero(body.agent == -1)
    free = np.concatenate([*mine, shared])
    sizes = {len(each) for each in mine}
    size = sizes.pop() if len(sizes) == 1 else 0
    rest = _Rest(loop, now, body, free, reals(now)[free], np.inf, movers, size, None, None)
    alike = size and not len(shared) and period == 1 and _links_of(rest) is not None
    if len(free) > _DENSE:
        return _split_at(_settled(rest), period) if alike else rest
    rest = _by_newton(rest, period)
    return _split_at(rest, period) if alike and len(movers) > 1 else rest


def _maps(rest: _Rest, directions: Array, period: int) -> tuple[Array, Array]:
    """Return the numbers (d,) a period later, and the derivative along directions (K, d)."""
    bases = np.tile(rest.value, (len(directions), 1))
    rows = rest.free, bases, directions, np.asarray(period)
    values, slopes = map(np.asarray, responses(rest.loop, rest.now, *rows))
    return values[0], slopes


def _by_newton(rest: _Rest, period: int) -> _Rest:
    """Return the moment that a period changes least, found by Newton's method, with its map."""
    one, best = np.eye(len(rest.value)), rest
    for _ in range(_NEWTON):
        after, slopes = _maps(rest, one, period)
        gap = after - rest.value
        residual = float(np.abs(gap).max(initial=0.0))
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
    """Return a moment of agents that are left to themselves for long."""
    now = later(rest.loop, rest.now, np.asarray(_WARM))
    after = later(rest.loop, now, np.asarray(1))
    value, then = reals(now)[rest.free], reals(after)[rest.free]
    return rest._replace(now=now, value=value, residual=float(np.abs(then - value).max()))


# ---- agents that are alike -----------------------------------------------------------------------


def _links_of(rest: _Rest) -> sp.csr_array | None:
    """Return C (A, A) of the agents that may move: what they hear; None of weights that change."""
    exchange = rest.loop.graph.exchange
    weights = np.asarray(exchange.weights, float)
    if weights.ndim > 1:
        return None
    place = np.full(rest.loop.agents, -1)
    place[rest.movers] = np.arange(len(rest.movers))
    to, of = place[np.asarray(exchange.receivers)], place[np.asarray(exchange.senders)]
    heard, inside, count = to >= 0, (to >= 0) & (of >= 0), len(rest.movers)
    rows = np.concatenate([to[heard], to[inside]]), np.concatenate([to[heard], of[inside]])
    return sp.csr_array((np.concatenate([weights[heard], -weights[inside]]), rows), (count, count))


def _split_at(rest: _Rest, period: int) -> _Rest:
    """Return the map by what agents hear, if the whole one is that; else the rest as it is."""
    C, size, count = _links_of(rest), rest.size, len(rest.movers)
    assert C is not None
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
    gap = np.abs(expected.reshape(_PROBES, -1) - slopes[2 * size :]).max(initial=0.0)
    if not gap <= _AGREES * (1.0 + np.abs(slopes[2 * size :]).max()):
        return rest
    grounded = len(rest.movers) < rest.loop.agents
    values = _eigenvalues(C, grounded)
    return rest if values is None else rest._replace(split=Split(F, K, *values))


def _eigenvalues(C: sp.csr_array, grounded: bool) -> tuple[Array, bool] | None:
    """Return the eigenvalues of what agents hear, and whether all between them count too.

    Without anybody who is led one of them is 0: all move alike, which is no disagreement.
    """
    count, block = csgraph.connected_components(C, connection="strong")
    sizes = np.bincount(block)
    if sizes.max() > _ALL:
        return None
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


def _size(rest: _Rest) -> float:
    return 1.0 + float(np.abs(rest.value).max(initial=0.0))


def _judged(rest: _Rest, goals: Array, period: int, names: tuple[str, ...]) -> LocalCertificate:
    if not rest.residual <= _AT_REST * _size(rest):
        return LocalCertificate((Fault.NO_REST,))
    states, agents = rest.body.state[rest.free], rest.body.agent[rest.free]
    at = states >= 0
    gaps = np.abs(rest.value[at] - goals[agents[at], states[at]])
    off = float(gaps.max(initial=0.0))
    if off > _AT_REST * _size(rest):
        culprit = names[states[at][gaps.argmax()]]
        return LocalCertificate((Fault.OFF_GOALS,), off=off, culprit=culprit)
    split = rest.map
    if split is None:
        return LocalCertificate((Fault.LARGE,))
    if _kink(rest, period):
        return LocalCertificate((Fault.KINK,))
    modes = modes_of(split, rest.is_state)
    exact = _exactly(rest, period)
    radius = modes.radius ** (1.0 / period)
    # A state that others read and nobody changes is not driven either.
    still = [k for k in modes.lasting if rest.is_state[k]]
    faults = [Fault.LASTING] * (len(modes.lasting) > len(still))
    faults += [Fault.ADRIFT] * bool(still or modes.adrift)
    faults += [Fault.GROWS] * (radius >= 1.0)
    faults += [Fault.UNDECIDED] * (radius < 1.0 <= modes.worst)
    faults += [Fault.GROWS_EXACTLY] * (exact is not None and not exact < 1.0)
    adrift = tuple(dict.fromkeys(names[states[k]] for k in (*still, *modes.adrift)))
    growth = amplification(split, rest.is_state)
    return LocalCertificate(
        (*faults,),
        radius,
        exact,
        len(modes.values),
        rest.split is not None,
        growth,
        off=off,
        adrift=adrift,
    )


def _exactly(rest: _Rest, period: int) -> float | None:
    """Return the radius of a step if agents move exactly under held inputs; None without any."""
    loop = held_exactly(rest.loop)
    if loop is None:
        return None
    there = rest._replace(loop=loop, split=None, whole=None)
    if rest.whole is not None:
        there = there._replace(whole=_maps(there, np.eye(len(rest.value)), period)[1].T)
    if rest.split is not None:
        there = _split_at(there, period)
    split = there.map
    if split is None or not np.isfinite(split.F).all():
        return None
    return modes_of(split, there.is_state).radius ** (1.0 / period)


_SIZES = 1e-4, 1e-6
"""Of changes along which values are compared with the derivative."""


def _kink(rest: _Rest, period: int) -> bool:
    """Tell whether values on some side are not those of the derivative.

    What the derivative leaves of a smooth function shrinks faster than the change.
    """
    count = 2 * rest.size + _PROBES if rest.whole is None else len(rest.value)
    random = np.random.default_rng(1).standard_normal((count, len(rest.value)))
    sets = [random] if rest.whole is None else [random, np.eye(len(rest.value))]
    rounding = np.finfo(float).eps * (1.0 + np.abs(rest.value).max())
    for along in sets:
        _, slopes = _maps(rest, along, period)
        left = []
        for size in _SIZES:
            for side in (size, -size):
                bases = rest.value + side * along
                rows = rest.free, bases, np.zeros_like(bases), np.asarray(period)
                there = np.asarray(responses(rest.loop, rest.now, *rows)[0])
                left.append(np.abs((there - rest.value) / side - slopes))
        large, small = np.maximum(*left[:2]), np.maximum(*left[2:])
        size = np.abs(slopes).max(axis=1, keepdims=True)
        seen = small > 1e-6 * (1.0 + size) + 1e3 * rounding / _SIZES[1]
        if (seen & (small > 0.3 * large)).any() or not np.isfinite(small).all():
            return True
    return False
