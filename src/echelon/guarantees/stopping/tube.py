"""The tube of theorem T5: how far agents go, from which starts, and when they arrive."""

import dataclasses
import math
from collections.abc import Callable, Iterator, Sequence
from fractions import Fraction
from functools import partial
from typing import NamedTuple

import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg as spla

from echelon.agents.models.model import ControlAffine, in_metres
from echelon.agents.network.graph import Graph
from echelon.core.claim import Claim, ClaimKind, Number, Rounding
from echelon.core.digits import about, at_least, at_most
from echelon.core.errors import GainError
from echelon.core.statement import Hypothesis, Statement, fails, holds, unneeded
from echelon.core.types import Array, JsonObject
from echelon.core.words import Feedforward, Kind, Theorem, amount
from echelon.guarantees.messages.late_messages import LateMessages, LateRate
from echelon.guarantees.stopping.borders import Border, border_of
from echelon.guarantees.stopping.flat_everywhere import bounds_of
from echelon.guarantees.stopping.motor_load import MotorLoad, motor_load_of
from echelon.guarantees.stopping.moving_offsets import offset_fault, offsets_mapping
from echelon.guarantees.stopping.path_bounds import path_fault
from echelon.guarantees.stopping.stopping_run import StoppingRun, flat_states_of
from echelon.laws.stopping_point import StoppingPoint

# ---- arrival within 1 cm, by the closed form of T5.3 ---------------------------------------------
# With w = L_g^-1 1 the largest |zeta_i| / w_i falls as m' = -sigma(c m) / max w or faster. For
# sigma(x) = x / sqrt(1 + (x/s)^2) that is solved by F(c m / s) = F(c m(0) / s) - c t / max w with
# F(v) = sqrt(1 + v^2) - arsinh(1 / v). Behind it comes the inner loop, delta y = h * zeta and what
# the start leaves, where h is positive. Fed by parents each link is e' = -sigma(c a e) by itself,
# so that m is its |e| with w = 1, and what is off the leader is at most the sum along the way. Of
# graphs that take turns each has its w, and while the leader does not reach everybody the largest
# |zeta_i| at least does not grow.

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

    `position` says which outputs are one.
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
    followers, [L] = list(graph.followers), graph.stretches(law.leaderward)
    # L_g^-1 1, all positive.
    weights = spla.splu(sp.csc_array(L)).solve(np.ones(len(followers)))
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
    """Until all have a packet nobody is farther off than at the start and the leader's own way."""
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


# ---- the tube ------------------------------------------------------------------------------------

_PROOF, _UP = Kind.PROOF, Rounding.UP

_ANY = "any graph in which the leader reaches every agent"


class Tube(NamedTuple):
    """What T5 guarantees.

    Attributes:
        rate: at which errors decay eventually, 1/s.
        gains: of the longest chain, sup |v^(l)| over sup |w| for l = 0, 1, ...
        left: how far the nearest agent stays from the border of the chart, at least, in the unit of
            the bounded derivative; infinite where there is no border.
        steepest: how far the bounded output's speed may be off the leader's at the start.
        arrival: the time (s) from which on all followers are within 1 cm of their goals; None where
            it is not known, or was left out.
        borders: what is claimed of each border, and of what it was computed; ready for JSON.
        motor_load: None where motors have no limits, may not suffice, or were left out.
        graphs: which graphs are meant, in words.
        offsets: how they change with time, and bounds of that; None of constant ones.
        kind: of the argument: the chains' responses and the path are enclosed in rationals; what
            somebody's class states of its flat coordinates or its motors was seen at samples.
    """

    rate: float
    gains: tuple[float, ...]
    left: float
    steepest: float
    arrival: float | None
    who: tuple[str, ...]
    borders: tuple[dict[str, object], ...]
    motor_load: MotorLoad | None
    graphs: str = _ANY
    network: LateMessages | None = None
    kind: Kind = _PROOF
    offsets: JsonObject | None = None

    @property
    def theorem(self) -> Theorem:
        """T5, and over a network T9."""
        return Theorem.T5 if self.network is None else Theorem.T9

    def claim(self) -> Claim:
        """Return what is claimed."""
        motors, network = self.motor_load, self.network
        premises = ("the model is exact", "time is continuous", *self._received())
        if self.offsets is not None:
            # Held inputs leave a rest where offsets go on changing.
            premises += ("inputs follow the offsets exactly",)
        numbers = {} if self.arrival is None else {"within_1_cm": Number(self.arrival, "s", _UP)}
        notes = ()
        if network is not None:
            numbers |= network.numbers()
            notes += network.notes()
        if motors is not None:
            numbers |= motors.numbers()
            notes += motors.notes()
        graphs = ("any number of agents", self.graphs)
        return Claim(ClaimKind.CONVERGES, self.who, graphs, premises, numbers, notes)

    def _received(self) -> tuple[str, ...]:
        if self.network is None:
            return ("zeta' is received at all times",)
        silence = ()
        if self.network.leaderward:
            ages = self.network.ages
            silence = (f"no link is silent for {at_most(ages.hop_life * ages.dt)} s",)
        return ("every agent receives one packet of a leader that follows its plan", *silence)

    def as_mapping(self) -> dict[str, object]:
        """Return it ready for JSON."""
        finite = {name: getattr(self, name) for name in ("left", "steepest")}
        finite = {name: None if math.isinf(x) else x for name, x in finite.items()}
        return {
            "format": "echelon tube 1",
            "who": list(self.who),
            "gains": list(self.gains),
            **finite,
            "within_1_cm_from": self.arrival,
            "borders": list(self.borders),
            "motors": None if self.motor_load is None else self.motor_load.as_mapping(),
            **({} if self.network is None else {"network": self.network.as_mapping()}),
            **({} if self.offsets is None else {"offsets": self.offsets}),
        }


def tube_of(run: StoppingRun, brief: bool = False) -> tuple[Tube | None, list[Statement]]:
    """Return the tube, if it holds, and its lines: the inner gains, the set, and the starts.

    Arrival is most of the work and nothing rests on it: `brief` leaves it out.
    """
    model, chains = run.parts.model, run.law.ready.chains
    longest = int(np.argmax(chains.degrees))
    fault = path_fault(run.leader.reference, chains, run.settings.horizon)
    if fault:
        remedy = "choose a smooth path: sines of time need no remainder, and `waypoints` pass "
        return _nothing(fault, f"{remedy}smoothly through the entries of a table")
    motion = run.parts.formation.motion
    fault = offset_fault(motion, max(chains.degrees), run.settings.horizon)
    if fault:
        remedy = "write the motion without branches, remainders and jumps"
        return _nothing(fault, "use a shorter chain" if "reshape" in fault else remedy)
    try:
        chain = run.chain(longest)
        gains = tuple(float(chain.gain(k)) for k in range(max(1, len(chain.powers) + 1)))
        known = bounds_of(model, chains)
        borders = None if known.bounds is None else [border_of(run, b) for b in known.bounds]
    except GainError as error:
        text = str(error).rstrip(".")
        remedy = "choose `roots` of a larger common unit" if "unit" in text else "use equal starts"
        remedy = "use `rotate`, `scale` and `reshape`" if "motion" in text else remedy
        return _nothing(text, remedy)
    text = "T5: largest speed and derivatives of outputs per speed that agreement asks, for any "
    number = gains[-1], ", ".join(at_least(gain, 4) for gain in gains)
    inner = holds(Hypothesis.REGION, _PROOF, f"{text}size of the formation", *number)
    if borders is None:
        remedy = "state `flat_chains` and `flat_bounds` in the model"
        return _nothing(known.fault, remedy, inner)
    left = min((b.left for b in borders), default=Fraction(10**9))
    steepest = min((b.steepest for b in borders), default=math.inf)
    lines = [inner, *(_by(known.kind, model, line) for line in _set_lines(run, borders))]
    if any(line.fails for line in lines):
        return None, lines
    tube = Tube(
        run.rate,
        gains,
        math.inf if not borders else float(left),
        steepest,
        None,
        _who(run, borders),
        tuple(border.data for border in borders),
        None,
        _graphs(run),
        run.network,
        known.kind,
        motion and offsets_mapping(motion),
    )
    # Agents that hold each other back come later than they would alone.
    late = brief or run.law.safety is not None
    arrival = None if late else arrival_of(run, _positions(run))
    motor_load, line = motor_load_of(run, brief)
    tube = tube._replace(arrival=arrival, motor_load=motor_load)
    if motor_load is not None and line.kind is Kind.SAMPLES:
        tube = tube._replace(kind=line.kind)
    return tube, [*lines, line]


def _by(kind: Kind, model: ControlAffine, line: Statement) -> Statement:
    if kind is Kind.PROOF:
        return line
    text = f"{line.text}, if its borders are those that `{type(model).__name__}` states"
    return dataclasses.replace(line, kind=kind, text=text)


def _graphs(run: StoppingRun) -> str:
    schedule, law = run.parts.graph.schedule, run.law
    if law.feedforward is Feedforward.PARENT:
        # The speeds of the links add up in the tube.
        return f"any tree in which none is more than {amount(run.links, 'link')} from a leader"
    if schedule is None:
        return _ANY
    every = "eventually" if schedule.period is None else "in every period"
    along = "along neighbours nearer to it " if law.leaderward else ""
    text = "any switching graphs over which the leader reaches every agent "
    return f"{text}{along}{every}"


def _nothing(text: str, remedy: str, *before: Statement) -> tuple[None, list[Statement]]:
    reason = f"{text}, so no tube is known"
    name = Hypothesis.SET if before else Hypothesis.REGION
    lines = [fails(name, _PROOF, text, None, "none", remedy=remedy, reason=reason)]
    others = (Hypothesis.SET, Hypothesis.STARTS) if not before else (Hypothesis.STARTS,)
    lines += [unneeded(each, _PROOF, "needs a tube") for each in others]
    return None, [*before, *lines]


_NO_BORDER = "flat coordinates have no border"


def _set_lines(run: StoppingRun, borders: Sequence[Border]) -> Iterator[Statement]:
    if not borders:
        text = "its flat coordinates have no border: any start is allowed"
        yield holds(Hypothesis.SET, _PROOF, text, math.inf, "everywhere")
        yield holds(Hypothesis.STARTS, _PROOF, _NO_BORDER, 0.0, "inside")
        return
    nearest = min(borders, key=lambda b: b.left)
    yield _set_line(run, nearest)
    if not nearest.steepest > 0.0:
        yield unneeded(Hypothesis.STARTS, _PROOF, "there is no set")
        return
    far, bound, where = float(nearest.left), nearest.bound, nearest.outputs
    number = far, f"{at_most(far)} left"
    if nearest.left > 0:
        text = f"{nearest.what()} stays {at_most(far)} above {at_most(bound.above, 4)}, with "
        text += bound.within
        yield holds(Hypothesis.STARTS, _PROOF, text, *number)
        return
    text = f"from these starts {nearest.what()} is not proved to stay above {about(bound.above, 4)}"
    remedy = f"start nearer to the leader's speed in {where}, start the leader on its path there, "
    remedy += f"or lower `speed` of {where}, of the leader and the followers"
    yield fails(Hypothesis.STARTS, _PROOF, text, *number, remedy=remedy, reason=text)


def _set_line(run: StoppingRun, border: Border) -> Statement:
    bound, steepest = border.bound, border.steepest
    number = steepest, f"{at_most(steepest)} off"
    if border.fastest > 0.0 and steepest > 0.0:
        text = f"any place, with {bound.within}, and {border.speeds} so far off {_whose([border])}"
        text = f"{text}, which keeps to its path in {border.outputs}"
        return holds(Hypothesis.SET, _PROOF, text, *number)
    if not border.fastest > 0.0:
        text = f"on the leader's path {border.what()} reaches {about(border.path)}, and the "
        text = f"{text}equations hold above {about(bound.above)}"
        remedy = "choose a gentler path, which keeps away from this limit"
    else:
        s = run.speed(run.law.ready.chains.outputs.index(bound.outputs[0]))
        text = f"at a `speed` of {about(s)} agreement alone may take {border.what()} to "
        text = f"{text}{about(bound.above)}, where the equations end"
        # What one link may have of a speed against the leader.
        least = border.fastest / run.links
        remedy = f"lower the `speed` of {border.outputs} below {at_most(least)}"
        if run.network is not None:
            text += "; before their first packet agents stand still against the leader's path"
            remedy += ", or choose a slower path"
    return fails(Hypothesis.SET, _PROOF, text, *number, remedy=remedy, reason=text)


def _who(run: StoppingRun, borders: Sequence[Border]) -> tuple[str, ...]:
    if not borders:
        return ("any state of any agent",)
    within = [b.bound.within for b in borders]
    free = "any position, heading, sideways speed and turning"
    free = "any position" if any(b.many for b in borders) else free
    if not all(b.led for b in borders):
        # Of the leader's speed against its path no more is used than what these starts ask for.
        speeds = [f"their {b.speeds} as at these starts" for b in borders]
        return (f"{free} of the followers", *within, *speeds, "the leader as at these starts")
    whose = f"{_whose(borders)}, which keeps to its path there"
    off = [f"{b.speeds} within {at_most(b.steepest)}{_angle(b)} of {whose}" for b in borders]
    return (free, *within, *off)


def _whose(borders: Sequence[Border]) -> str:
    """Return off whose speed starts are measured."""
    beside = any(border.beside for border in borders)
    return "that of the own offset and the leader's" if beside else "the leader's"


def _angle(border: Border) -> str:
    """Return by what angle a velocity of the leader's size may be off it, in words."""
    if math.isinf(border.turn):
        return ""
    return f" (at its speed, {at_most(border.turn)} deg to either side)"


def _positions(run: StoppingRun) -> tuple[int, ...]:
    """Return which outputs are the position; none where a part of it is no output, or not in m."""
    chains, position = run.law.ready.chains, run.parts.model.position
    if not in_metres(run.parts.model):
        return ()
    if not set(position) <= {*flat_states_of(run.parts.model, chains).outputs}:
        return ()
    return tuple(map(chains.outputs.index, position))
