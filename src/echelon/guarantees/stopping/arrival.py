"""Arrival time of the formation within 1 cm, by the closed form of T5.3.

With w = L_g^-1 1 the largest |zeta_i| / w_i falls as m' = -sigma(c m) / max w or faster. For
sigma(x) = x / sqrt(1 + (x/s)^2) that is solved by F(c m / s) = F(c m(0) / s) - c t / max w with
F(v) = sqrt(1 + v^2) - arsinh(1 / v). Behind it comes the inner loop, delta y = h * zeta and what
the start leaves, where h is positive. Fed by parents each link is e' = -sigma(c a e) by itself, so
that m is its |e| with w = 1, and what is off the leader is at most the sum along the way. Of graphs
that take turns each has its w, and while the leader does not reach everybody the largest |zeta_i|
at least does not grow.
"""

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg as spla

from echelon.agents.network.graph import Graph
from echelon.core.types import Array
from echelon.core.words import Feedforward
from echelon.guarantees.messages.late_agreement import LateRate
from echelon.guarantees.messages.late_messages import LateMessages
from echelon.guarantees.stopping.stopping_run import StoppingRun
from echelon.laws.stopping_point import StoppingPoint

_WITHIN = 0.01  # m
_CELL, _MOST = 0.01, 20_000
"""Of time, s; the bound holds all over each cell. So many cells are 200 s."""
_FEW = 100
"""Followers that are told by parents, or whose graph switches: each is followed by itself."""
_TURNS = 200
"""How often such a graph switches at most, until all are there."""
_SOLVED = 1e-6
"""Relative; what a solver may leave of L w = 1."""
_SLACK = 1e-9
"""m; more than floats leave of the sums."""


def arrival_of(run: StoppingRun, position: Sequence[int]) -> float | None:
    """Return when (s) all followers are within 1 cm for good; None where it is not known.

    Args:
        run: under the law.
        position: which outputs are one.
    """
    graph, law = run.parts.graph, run.law
    by_parents = law.feedforward is Feedforward.PARENT
    alone = by_parents or graph.schedule is not None
    if not position or run.apart or alone and len(graph.followers) > _FEW:
        return None
    moved = _all_together if graph.schedule is None else _in_turns
    moved = _along_links if by_parents else moved
    if run.network is None:
        return _first_within(run, position, lambda _: moved)
    if run.network.ages.first_packet is None:
        return None
    rates = run.network.rates or (None,)
    each = (partial(_late, run, run.network, rate) for rate in rates)
    times = [t for late in each if (t := _first_within(run, position, lambda k: partial(late, k)))]
    return min(times, default=None)


def _first_within(
    run: StoppingRun, position: Sequence[int], bounded: "Callable[[int], Callable[..., _Reach]]"
) -> float | None:
    """Return from when on all are within 1 cm by what bounds the stopping points of an output."""
    flat, graph, law, coupling = run.flat, run.parts.graph, run.law, run.coupling
    loop, followers = law.ready, list(graph.followers)
    away = flat[followers] - flat[list(graph.nearest_leader())][followers]
    times = _CELL * np.arange(_MOST + 1)
    square = np.zeros((len(followers), _MOST))
    for k in position:
        own = np.array(law.roots_for(loop.chains.degrees[k] - 1))
        stops = flat[:, :, k] @ loop.weights[:, k]
        reach = bounded(k)(stops, graph, law, coupling, law.speed_of(k), times)
        driven = np.stack([_behind(own, m, times) for m in reach.bounds])[reach.whose]
        # Agents start in few ways in number; all at once would be (N, cells) anyway.
        square += (reach.weights[:, None] * driven + _left(own, away[:, :, k], times)) ** 2
    # Not within is outside, and so is what is no number.
    outside = np.flatnonzero(~(np.sqrt(square) + _SLACK < _WITHIN).all(axis=0))
    if not len(outside):
        return 0.0
    last = int(outside[-1]) + 1
    return None if last >= _MOST else float(times[last])


class _Reach(NamedTuple):
    """Bounds (K, T) of |zeta_i|, falling; of follower i the weight w_i times bounds[whose[i]]."""

    bounds: Array
    whose: Array
    weights: Array


def _all_together(
    stops: Array, graph: Graph, law: StoppingPoint, c: float, speed: float, times: Array
) -> _Reach:
    """Return how far stopping points (N,) are off by the largest |zeta_i| / w_i."""
    followers, weights = list(graph.followers), _weights(graph, law.leaderward)
    away = np.abs(stops[followers] - stops[list(graph.nearest_leader())][followers])
    m = _falling((away / weights).max(), c, weights.max(), speed, times)
    return _Reach(m[None], np.zeros(len(followers), int), weights)


def _along_links(
    stops: Array, graph: Graph, law: StoppingPoint, c: float, speed: float, times: Array
) -> _Reach:
    """Return the same told by parents: each link e' = -sigma(c a e) is alone, and they add up."""
    links, parent = graph.exchange(leaderward=True), graph.parents()
    strength = dict(zip(links.receivers.tolist(), links.weights.tolist(), strict=True))
    followers, depths = list(graph.followers), graph.depths()
    bounds = {lead: np.zeros(len(times)) for lead in graph.leaders}
    for i in sorted(followers, key=lambda i: depths[i]):
        off = float(abs(stops[i] - stops[parent[i]]))
        link = _falling(off, c * strength[i], 1.0, speed, times)
        bounds[i] = bounds[parent[i]] + link
    count = len(followers)
    return _Reach(np.stack([bounds[i] for i in followers]), np.arange(count), np.ones(count))


def _in_turns(
    stops: Array, graph: Graph, law: StoppingPoint, c: float, speed: float, times: Array
) -> _Reach:
    """Return how far stopping points (N,) are off of a graph that switches, stretch by stretch."""
    followers = list(graph.followers)
    off = np.abs(stops[followers] - stops[list(graph.nearest_leader())][followers])
    weights = [*map(_solved, graph.stretches(law.leaderward)), None]
    bounds = np.zeros((len(followers), len(times)))
    for row, begin, end in _turns(graph, float(times[-1])):
        here, w = (times >= begin) & (times < end), weights[row]
        clock = np.concatenate([[0.0], times[here] - begin, [end - begin]])
        each = np.full((len(followers), len(clock)), off.max())
        if w is not None:
            m = _falling((off / w).max(), c, w.max(), speed, clock)
            each = np.minimum(w[:, None] * m, each)
        bounds[:, here], off = each[:, 1:-1], each[:, -1]
        # A bound holds all over the cell after its time, in which the turn may begin and even end.
        cell = max(int(np.searchsorted(times, begin, side="right")) - 1, 0)
        bounds[:, cell] = np.maximum(bounds[:, cell], each[:, 0])
    # It may rise where neighbours are farther off; what is seen from then on does not.
    bounds = np.maximum.accumulate(bounds[:, ::-1], axis=1)[:, ::-1]
    return _Reach(bounds, np.arange(len(followers)), np.ones(len(followers)))


def _turns(graph: Graph, horizon: float) -> Iterator[tuple[int, float, float]]:
    """Yield which graph holds, from when and until when (s), to beyond the horizon; -1 for any."""
    schedule = graph.schedule
    assert schedule is not None
    begin, count = 0.0, len(schedule.starts)
    ends = [*schedule.starts[1:].tolist(), schedule.period or np.inf]
    for k in range(_TURNS):
        end = k // count * (schedule.period or 0.0) + ends[k % count]
        yield k % count, begin, min(end, 2.0 * horizon)
        if end > horizon:
            return
        begin = end
    yield -1, begin, 2.0 * horizon


def _late(
    run: StoppingRun,
    network: LateMessages,
    rate: LateRate | None,
    output: int,
    stops: Array,
    graph: Graph,
    law: StoppingPoint,
    c: float,
    speed: float,
    times: Array,
) -> _Reach:
    """Return how far stopping points (N,) of an output are off over a network (T9).

    Until everybody has a packet nobody is farther off than at the start and the leader's own way.
    """
    begin, followers, weights = network.ages.first_packet, list(graph.followers), network.weights
    ways = np.ones(len(followers), int) if network.ways is None else network.ways
    assert begin is not None  # or there is no such bound
    off = np.abs(stops[followers] - stops[list(graph.nearest_leader())][followers]).max()
    off += begin * (run.path_speed(output, begin) + run.own_speed(output))
    if rate is not None:
        weights, c = rate.weights, rate.rate * float(rate.weights.max())
    # Later by the largest age for each link of the way but the first.
    links, whose = np.unique(ways, return_inverse=True)
    clocks = np.maximum(times - begin - (links[:, None] - 1) * network.age, 0.0)
    start, heaviest = float(off / weights.min()), float(weights.max())
    bounds = np.stack([_falling(start, c, heaviest, speed, clock) for clock in clocks])
    return _Reach(bounds, whose, weights)


def _weights(graph: Graph, leaderward: bool) -> Array:
    """Return w = L_g^-1 1 of the followers, all positive."""
    [L] = graph.stretches(leaderward)
    return spla.splu(sp.csc_array(L)).solve(np.ones(len(graph.followers)))


def _solved(L: sp.csr_array) -> Array | None:
    """Return a little more than L^-1 1, positive; None where the leader reaches not everybody."""
    try:
        w = spla.splu(sp.csc_array(L)).solve(np.ones_like(L.diagonal())) * (1.0 + _SOLVED)
    except RuntimeError:
        return None
    return w if np.isfinite(w).all() and (w > 0.0).all() and (L @ w >= 1.0).all() else None


def _falling(start: float, c: float, heaviest: float, speed: float, times: Array) -> Array:
    """Return m at times (T,), from above."""
    if not start:
        return np.zeros(len(times))
    if np.isinf(speed):
        return start * np.exp(-c * times / heaviest) * (1.0 + _SLACK)
    goal = _travel(np.log(c * start / speed)) - c * times / heaviest
    # In the logarithm of v, of which F rises at sqrt(1 + v^2) >= 1.
    high = np.full(len(times), np.log(c * start / speed))
    low = high - (goal[0] - goal) - 1.0
    for _ in range(80):
        middle = 0.5 * (low + high)
        above = _travel(middle) > goal
        low, high = np.where(above, low, middle), np.where(above, middle, high)
    return np.minimum(speed / c * np.exp(high) * (1.0 + _SLACK), start)


def _travel(log: Array | float) -> Array:
    """Return F(v) = sqrt(1 + v^2) - arsinh(1 / v) of v by its logarithm."""
    v = np.exp(log)
    # arsinh(1/v) = log(1 + sqrt(1 + v^2)) - log v, which no small v loses digits of.
    root = np.sqrt(1.0 + v**2)
    return root - np.log1p(root) + log


def _behind(roots: Array, m: Array, times: Array) -> Array:
    """Return a bound of (h * m)(t) all over each cell of time, (T - 1,)."""
    if not len(roots):
        return m[:-1]
    k0 = roots.prod()
    apart = np.array([np.prod(np.delete(roots, i) - root) for i, root in enumerate(roots)])
    # H = 1 - sum of c_i / rho_i exp(-rho_i t), the integral of h.
    whole = 1.0 - (k0 / apart / roots) @ np.exp(-np.outer(roots, times))
    steps = np.maximum(np.diff(whole), 0.0)
    # m falls, so in a cell of both times it is at most what it was at the earlier one.
    earlier = np.concatenate([m[:1], m[:-2]])
    # As many zeros as numbers, so that no end comes round to the other.
    size = 2 ** (2 * len(steps) - 1).bit_length()
    both = np.fft.rfft(steps, size) * np.fft.rfft(earlier, size)
    return np.fft.irfft(both, size)[: len(steps)] * (1.0 + _SLACK)


def _left(roots: Array, starts: Array, times: Array) -> Array:
    """Return a bound of what starts (K, r) leave in y all over each cell of time, (K, T - 1)."""
    if not len(roots):
        return np.zeros((len(starts), len(times) - 1))
    modes = np.linalg.solve(np.vander(-roots, increasing=True).T, starts[:, : len(roots)].T).T
    falls = np.exp(-np.outer(roots, times[:-1]))
    return np.abs(modes @ falls) + _CELL * (np.abs(modes) * roots) @ falls
