"""What the law `stopping-point` promises, and what that rests on (theory page, T5)."""

import math
from collections.abc import Iterator, Sequence
from fractions import Fraction
from typing import Any, NamedTuple, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from echelon.certificates.responses import Chain
from echelon.certificates.tube import Push, Room, room_of
from echelon.core.errors import GainError, listing
from echelon.core.linear import held_radius
from echelon.core.types import Array
from echelon.core.words import Feedforward, Kind, Theorem, Verdict
from echelon.engine.laws import Laws
from echelon.engine.parts import Parts
from echelon.engine.settings import Settings
from echelon.laws.flat_loop import FlatLoop
from echelon.laws.stopping_point import StoppingLeader, StoppingPoint
from echelon.models.chains import flat_output, flatten
from echelon.models.model import ControlAffine, FlatBound
from echelon.promises.arrival import Arrival, arrival_of
from echelon.promises.paths import least_on_path
from echelon.promises.statement import Hypothesis, Statement

_ROUNDED = Fraction(1, 10**6)
"""Of a derivative of a flat output: a thousand times what floats leave of it at a start."""
_STARTS = 64
"""Starts of agents that are looked at one by one; those that differ in one speed alone are two."""
_PROOF = Kind.PROOF


class Tube(NamedTuple):
    """What is promised by T5.

    Attributes:
        kind: of the argument.
        rate: at which errors shrink in the end, 1/s.
        gains: of the longest chain, sup |v^(l)| over sup |w| for l = 0, 1, ...
        left: how far the nearest agent stays from the border of the chart, at least, in the unit of
            the bounded derivative; infinite where there is no border.
        steepest: how far the bounded output's speed may be off the leader's at the start.
        arrival: when all are within 1 cm, if it can be told.
        who: which starts are meant, in words.
        borders: what is claimed of each border, and of what it was computed; ready for JSON.
    """

    kind: Kind
    rate: float
    gains: tuple[float, ...]
    left: float
    steepest: float
    arrival: Arrival | None
    who: str
    borders: tuple[dict[str, Any], ...]

    @property
    def theorem(self) -> Theorem:
        """T5."""
        return Theorem.T5

    def sentence(self) -> str:
        """Return what is promised, in one sentence."""
        when = (
            ""
            if self.arrival is None
            else f"; these are within 1 cm from {self.arrival.time:.3g} s on"
        )
        return (
            f"{self.kind.value}: from {self.who}, errors go to zero, in the end at {self.rate:.3g} "
            "1/s or faster, for any number of agents and any graph in which the leader reaches "
            f"everybody, where the model is exact and zeta' is told at all times (T5){when}."
        )

    def as_mapping(self) -> dict[str, object]:
        """Return it ready for JSON."""
        finite = {name: getattr(self, name) for name in ("left", "steepest")}
        finite = {name: None if math.isinf(x) else x for name, x in finite.items()}
        when = None if self.arrival is None else self.arrival.time
        return {
            "format": "echelon tube 1",
            "who": self.who,
            "gains": list(self.gains),
            **finite,
            "within_1_cm_from": when,
            "borders": list(self.borders),
        }


class Stopping(NamedTuple):
    """A run under the law, as its theorem sees it.

    Attributes:
        parts: prepared.
        settings: how it is computed.
        states: (N, n) at the start.
        flat: (N, r, m) the same in flat coordinates, less the offsets.
        ahead: (r, m) of what the leader follows.
    """

    parts: Parts
    settings: Settings
    states: Array
    flat: Array
    ahead: Array

    @property
    def law(self) -> StoppingPoint:
        """The followers' law."""
        return self.parts.drive.follower  # pyright: ignore

    @property
    def leader(self) -> StoppingLeader:
        """The leader's law."""
        return self.parts.drive.leader  # pyright: ignore

    @property
    def coupling(self) -> float:
        """C."""
        return float(self.law.strength(self.settings.dt))

    @property
    def rate(self) -> float:
        """The slowest mode of the formation, 1/s, as a positive number."""
        assert self.law.reach is not None
        agreement = self.coupling * self.law.reach.slowest
        moves = max(self.law.ready.chains.degrees) > 1
        return min(self.law.slowest_root, agreement) if moves else agreement

    def chain(self, output: int) -> Chain:
        """Return the chain of an output.

        Raises:
            GainError: its roots have no common unit.
        """
        degree = self.law.ready.chains.degrees[output]
        return Chain.of(self.law.roots_for(degree - 1))

    def speed(self, output: int) -> float:
        """Return s of a follower against the leader: of each link on the way, told by parents."""
        return self.links * self.law.speed_of(output)

    @property
    def links(self) -> int:
        """How many speeds add up on the way from a leader."""
        told = self.law.feedforward is Feedforward.PARENT
        return int(self.parts.graph.depths().max()) if told else 1

    @property
    def longest_step(self) -> float:
        """The longest step (s) that keeps the largest stopping point from growing."""
        assert self.law.reach is not None
        return 1.0 / (self.coupling * self.law.reach.heaviest)

    def own_speed(self, output: int) -> float:
        """Return the speed against its path that a leader may have: what it starts off, or s_0."""
        leads = list(self.parts.graph.leaders)
        weights = self.leader.ready.weights[:, output]
        away = np.abs(weights @ (self.flat[leads] - self.ahead)[:, :, output].T).max()
        c = float(self.leader.strength(self.settings.dt))
        # Its distance never grows, and sigma(c zeta) is below c zeta.
        return min(self.leader.speed_of(output), c * float(away))


def stopping_of(parts: Parts, settings: Settings, states: Array) -> Stopping | None:
    """Return what T5 speaks of; None under another law."""
    drive = parts.drive
    if not isinstance(drive, Laws) or not isinstance(drive.follower, StoppingPoint):
        return None
    assert isinstance(drive.leader, StoppingLeader)
    offsets = jnp.asarray(parts.formation.offsets)
    flat = np.asarray(_flat(parts.model, drive.follower, jnp.asarray(states), offsets))
    return Stopping(parts, settings, states, flat, np.asarray(drive.leader.begins(parts.model)))


@eqx.filter_jit
def _flat(
    model: ControlAffine, law: StoppingPoint, states: jax.Array, offsets: jax.Array
) -> jax.Array:
    chains = law.ready.chains

    def one(x: jax.Array, offset: jax.Array) -> jax.Array:
        values = flatten(model, chains, x, law.begin(model, x).chain).values
        shift = flat_output(model, chains.outputs, offset)
        return values.at[0].add(flat_output(model, chains.outputs, 0.0 * offset) - shift)

    return jax.vmap(one)(states, offsets)


# ---- the tube ------------------------------------------------------------------------------------


class _Found(NamedTuple):
    """The tube, if it holds, and the lines that say so."""

    tube: Tube | None
    lines: tuple[Statement, ...]


def tube_of(run: Stopping) -> _Found:
    """Return what T5 promises, and its lines: the inner gains, the set, and the starts."""
    model, chains = run.parts.model, run.law.ready.chains
    longest = int(np.argmax(chains.degrees))
    try:
        found = run.chain(longest)
        gains = tuple(float(found.gain(k)) for k in range(max(1, len(found.powers) + 1)))
        borders = None if model.flat_bounds is None else [_room(run, b) for b in model.flat_bounds]
    except GainError as error:
        return _nothing(str(error).rstrip("."), "choose `roots` of a larger common unit")
    shown = ", ".join(f"{gain:.4g}" for gain in gains)
    text = "of what agreement asks, at most, in speed and its derivatives: no size of the formation"
    inner = Statement(Hypothesis.REGION, Verdict.HOLDS, _PROOF, gains[-1], shown, f"T5: {text}")
    if borders is None or chains.sampled:
        name = f"`{type(model).__name__}`"
        text = f"{name} does not say where its flat coordinates end"
        return _nothing(text, "state `flat_chains` and `flat_bounds` in the model", inner)
    left = min((b.left for b in borders), default=Fraction(10**9))
    kind = min((b.kind for b in borders), key=lambda kind: kind.strength, default=_PROOF)
    steepest = min((b.steepest for b in borders), default=math.inf)
    lines = [inner, *_set_lines(run, borders, kind)]
    if any(line.fails for line in lines):
        return _Found(None, tuple(lines))
    who = _who(run, borders)
    arrival = arrival_of(run.flat, run.parts.graph, run.law, run.coupling, _positions(run))
    far = math.inf if not borders else float(left)
    told = tuple(border.told for border in borders)
    return _Found(Tube(kind, run.rate, gains, far, steepest, arrival, who, told), tuple(lines))


def _nothing(text: str, remedy: str, *before: Statement) -> _Found:
    """Return that no tube is known, and why."""
    reason = f"{text}, so no tube is known"
    name = Hypothesis.SET if before else Hypothesis.REGION
    lines = [Statement(name, Verdict.FAILS, _PROOF, None, "none", text, remedy, reason)]
    rest = {Hypothesis.REGION, Hypothesis.SET, Hypothesis.STARTS} - {name}
    rest -= {cast(Hypothesis, line.statement) for line in before}
    text = "needs a tube"
    lines += [Statement(each, Verdict.NOT_NEEDED, _PROOF, text=text) for each in rest]
    return _Found(None, (*before, *lines))


class _Border(NamedTuple):
    """A border of the chart: what is left to it, and by which kind of argument."""

    bound: FlatBound
    left: Fraction
    steepest: float
    kind: Kind
    fastest: float
    told: dict[str, Any]


def _room(run: Stopping, bound: FlatBound) -> _Border:
    """Return how near to a border the agents of a run may come."""
    chains = run.law.ready.chains
    k, order = chains.outputs.index(bound.output), bound.derivative - 1
    chain = run.chain(k)
    least = least_on_path(run.leader, run.parts.model, run.settings.horizon, k, bound.derivative)
    allowed = Fraction(least.value) - Fraction(bound.above) - _ROUNDED
    own, s = run.own_speed(k), run.speed(k)
    fastest = float(allowed / chain.gain(order)) if order else math.inf
    if math.isinf(s) or math.isinf(own):
        return _Border(bound, Fraction(-1), 0.0, least.kind, fastest, {})
    leads, p = list(run.parts.graph.leaders), len(chain.powers)
    led = run.flat[leads, :, k] - run.ahead[:, k]
    away = run.flat[:, :, k] - run.flat[list(run.parts.graph.nearest_leader()), :, k]
    ahead = [Push(_exact(start[1 : p + 1]), Fraction(own)) for start in _few(led)]
    rooms = list[Room]()
    for lead in ahead:
        for start in _few(away):
            push = Push(_exact(start[1 : p + 1]), Fraction(s))
            rooms.append(room_of(chain, order, (lead, push), allowed))
    left = min(allowed - room.fall for room in rooms)
    # Said of agents behind a leader that keeps to the height and the climb of its path.
    quiet = room_of(chain, order, (Push((), Fraction(0)), Push((), Fraction(s))), allowed)
    told = {
        "output": bound.output,
        "derivative": bound.derivative,
        "above": bound.above,
        "path": least.value,
        "roots": list(run.law.roots_for(p)),
        "speed": s,
        "leader_speed": own,
        "starts": [start[1 : p + 1].tolist() for start in _few(away)],
        "leader_starts": [start[1 : p + 1].tolist() for start in _few(led)],
        "gains": [float(chain.gain(order)) for order in range(p + 1)],
        "left": float(left),
        "steepest": float(quiet.steepest),
    }
    return _Border(bound, left, float(quiet.steepest), least.kind, fastest, told)


def _exact(values: Array) -> tuple[Fraction, ...]:
    return tuple(map(Fraction, values.tolist()))


def _few(starts: Array) -> Array:
    """Return starts (K, r) that stand for all: the extreme ones where the speed alone differs.

    Raises:
        GainError: there are too many.
    """
    starts = starts.copy()
    starts[:, 0] = 0.0
    # What floats leave of a level start is far below the slack of the room.
    starts[np.abs(starts) < 1e-9] = 0.0
    if not starts[:, 2:].any() and starts.shape[1] > 1:
        low, high = starts[:, 1].argmin(), starts[:, 1].argmax()
        return starts[sorted({int(low), int(high)})]
    found = np.unique(starts, axis=0)
    if len(found) > _STARTS:
        raise GainError(
            f"{len(found)} starts differ in more than a speed, and {_STARTS} are tried."
        )
    return found


def _set_lines(run: Stopping, borders: Sequence[_Border], kind: Kind) -> Iterator[Statement]:
    """Yield what set of starts is certified, and whether this run's lie in it."""
    if not borders:
        text = "its flat coordinates have no border: any state is a start"
        yield Statement(Hypothesis.SET, Verdict.HOLDS, kind, math.inf, "everywhere", text)
        yield Statement(Hypothesis.STARTS, Verdict.HOLDS, kind, 0.0, "inside", "every start does")
        return
    nearest = min(borders, key=lambda b: b.left)
    bound = nearest.bound
    name, s = f"`{bound.output}`", run.speed(_index(run, bound.output))
    prime = "'" * bound.derivative
    text = f"any place, with {bound.within}, and `{bound.output}'` so far off that of the leader, "
    text, remedy, reason = f"which keeps to its path in {name}", "", ""
    if not nearest.steepest > 0.0:
        text = f"at a `speed` of {s:.3g} agreement alone may take {bound.output}{prime} to "
        text = f"{text}{bound.above:.3g}, where the chart ends"
        remedy = f"lower the `speed` of {name} below {_each(run, nearest.fastest):.3g}"
        reason = text
    holds, shown = Verdict.of(nearest.steepest > 0.0), f"{nearest.steepest:.3g} off"
    yield Statement(Hypothesis.SET, holds, kind, nearest.steepest, shown, text, remedy, reason)
    if not nearest.steepest > 0.0:
        yield Statement(Hypothesis.STARTS, Verdict.NOT_NEEDED, kind, text="there is no set")
        return
    far, remedy, reason = float(nearest.left), "", ""
    text = f"{bound.output}{prime} stays {far:.3g} above {bound.above:.4g}, with {bound.within}"
    if not nearest.left > 0:
        text = (
            f"from these starts {bound.output}{prime} is not proved to stay above {bound.above:.4g}"
        )
        remedy = (
            f"start nearer to the leader's speed in {name}, start the leader on its path there, "
        )
        remedy += f"or lower `speed` of {name}, of the leader and the followers"
        reason = text
    shown, holds = f"{far:.3g} left", Verdict.of(nearest.left > 0)
    yield Statement(Hypothesis.STARTS, holds, kind, far, shown, text, remedy, reason)


def _each(run: Stopping, total: float) -> float:
    """Return what speed of one link a speed against the leader leaves."""
    return total / run.links


def _index(run: Stopping, output: str) -> int:
    return run.law.ready.chains.outputs.index(output)


def _who(run: Stopping, borders: Sequence[_Border]) -> str:
    """Return which starts are meant, in words."""
    if not borders:
        return "any state of any agent"
    told = [
        f"{b.bound.within}, `{b.bound.output}'` within {b.steepest:.3g} of the leader's"
        for b in borders
    ]
    on = all(run.own_speed(_index(run, b.bound.output)) < 1e-9 for b in borders)
    outputs = listing(b.bound.output for b in borders)
    keeps = f"while the leader keeps to its path in {outputs}" if on else "for these starts"
    return f"any position, heading, sideways speed and turning, with {' and '.join(told)}, {keeps}"


def _positions(run: Stopping) -> tuple[int, ...]:
    """Return which outputs are a position."""
    outputs, position = run.law.ready.chains.outputs, run.parts.model.position
    return tuple(k for k, name in enumerate(outputs) if name in position)


# ---- what else it rests on -----------------------------------------------------------------------


def condition_lines(run: Stopping) -> Iterator[Statement]:
    """Yield the conditions of T5 beside the tube."""
    n = len(run.parts.model.state_names)
    text = "of the flat outputs they are; those of other states are none"
    broken = _moves_others(run)
    remedy, reason = "", ""
    if broken:
        text, remedy = (
            f"the offset of `{broken}` is none of a flat output",
            "offset flat outputs only",
        )
        reason = "an offset is no symmetry of the law"
    verdict = Verdict.of(not broken)
    yield Statement(Hypothesis.SYMMETRY, verdict, _PROOF, None, "", text, remedy, reason)
    text = "in flat coordinates every agent is linear, with or without a trim"
    yield Statement(Hypothesis.SMOOTH, Verdict.NOT_NEEDED, _PROOF, text=text)
    text = f"feedback makes chains of all {n} states and the integrators before inputs"
    yield Statement(Hypothesis.DETECTABLE, Verdict.NOT_NEEDED, _PROOF, text=text)
    yield Statement(Hypothesis.MATCHED, Verdict.HOLDS, _PROOF, text=f"{run.law.information[1]}")
    c = run.coupling
    shown = f"c {c:.4g}, edge 0"
    yield Statement(Hypothesis.COUPLED, Verdict.HOLDS, _PROOF, c, shown, "any coupling will do")
    text = "the slower of the slowest root and c lambda_min; far off, the `speed` is what counts"
    shown = f"{-run.rate:.3g} 1/s"
    yield Statement(Hypothesis.DECAYS, Verdict.HOLDS, _PROOF, -run.rate, shown, text)
    text = "the law is linear in flat coordinates wherever it goes"
    yield Statement(Hypothesis.ALONG, Verdict.NOT_NEEDED, _PROOF, text=text)
    yield _step_line(run)
    yield Statement(Hypothesis.CLAIMS, Verdict.NOT_NEEDED, _PROOF, text="there is no gain")


def _moves_others(run: Stopping) -> str:
    """Return the first state with an offset that is no flat output; empty without one."""
    outputs, model = run.law.ready.chains.outputs, run.parts.model
    for k in np.flatnonzero(np.ptp(run.parts.formation.offsets, axis=0)):
        if model.state_names[k] not in outputs:
            return model.state_names[k]
    return ""


def _step_line(run: Stopping) -> Statement:
    """Return whether a held step keeps the largest stopping point from growing, c d_max dt <= 1."""
    assert run.law.reach is not None
    name, dt, c = Hypothesis.STEP, run.settings.dt, run.coupling
    share = c * run.law.reach.heaviest * dt
    radius, shown = _radius(run), f"c d_max dt = {share:.3g}"
    if share <= 1.0 + 1e-12 and radius < 1.0:
        text = f"Euler's step of zeta grows nowhere; spectral radius {radius:.4g} a step"
        return Statement(name, Verdict.HOLDS, Kind.LINEARIZATION, share, shown, text)
    text = f"the step `dt` = {dt:g} s is too long: c d_max dt = {share:.3g} is above 1"
    remedy = f"lower `coupling` to {1.0 / (run.law.reach.heaviest * dt):.4g}, or shorten "
    remedy += f"`simulation.dt` to {1.0 / (c * run.law.reach.heaviest):.3g} s"
    if share <= 1.0:
        text = f"the step `dt` = {dt:g} s is too long for this coupling and these roots: spectral "
        text, remedy = f"{text}radius {radius:.4g}", "lower `coupling` or `roots`, or shorten "
        remedy += "`simulation.dt`"
    return Statement(name, Verdict.FAILS, Kind.LINEARIZATION, share, shown, text, remedy, text)


def _radius(run: Stopping) -> float:
    """Return the spectral radius of a step in flat coordinates, the highest derivatives held."""
    assert run.law.reach is not None
    loop, found = run.law.ready, 0.0
    for k, degree in enumerate(loop.chains.degrees):
        A, B = np.eye(degree, k=1), np.eye(degree)[:, -1:]
        stop = loop.stiffness[k] * loop.weights[:degree, k]
        inner = np.append(0.0, stop[:-1])
        # By Gershgorin none is larger than 2 d_max; heard one way none than d_max.
        most = (1.0 if run.law.leaderward else 2.0) * run.law.reach.heaviest
        ends = np.array([run.law.reach.slowest, most])
        gains = inner + run.coupling * ends[:, None] * stop
        dt, how = run.settings.dt, run.settings.integrator
        found = max(found, held_radius(A, B, gains[:, None], dt, how))
    return found


def drift_reason(run: Stopping) -> Statement | None:
    """Return why a lasting push carries the leader away for ever; None where it does not."""
    world, model = run.parts.world, run.parts.model
    if run.leader.observer or world.ideal:
        return None
    loop = run.leader.ready
    push = np.zeros(len(model.state_names))
    if world.disturbance is not None:
        push = model.per_state(world.disturbance.constant)
    found = _pushed(model, world.plant_for(model), loop, jnp.asarray(push))
    for k, d in enumerate(np.abs(np.asarray(found)).tolist()):
        s, degree = run.leader.speed_of(k), loop.chains.degrees[k]
        asked = d * float(loop.weights[1, k]) if degree > 1 else d
        if asked >= s:
            name = loop.chains.outputs[k]
            text = f"a push of {d:.3g} along `{name}` asks agreement for {asked:.3g} of speed, the "
            text += f"leader's is {s:.3g}, and it can drift away for ever"
            remedy = f"set `observer: true`, or `speed` above {asked:.3g}"
            return Statement(
                Hypothesis.EXACT, Verdict.FAILS, _PROOF, asked, f"{asked:.3g}", text, remedy, text
            )
    return None


@eqx.filter_jit
def _pushed(
    model: ControlAffine, plant: ControlAffine, loop: FlatLoop, push: jax.Array
) -> jax.Array:
    """Return what outputs' accelerations differ by at the trim (m,), as an agent is pushed."""
    chains = loop.chains
    x, u = (jnp.asarray(np.asarray(part, float)) for part in model.trim)

    def output(x: jax.Array) -> jax.Array:
        return flat_output(model, chains.outputs, x)

    def speed(x: jax.Array) -> jax.Array:
        return jax.jvp(output, (x,), (model.velocity(x, u),))[1]

    more = plant.velocity(x, u) + push - model.velocity(x, u)
    at_once = np.array(chains.degrees) == 1
    return jnp.where(at_once, jax.jvp(output, (x,), (more,))[1], jax.jvp(speed, (x,), (more,))[1])
