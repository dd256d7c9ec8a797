"""What T5 promises of a run: how far agents go, from which starts, and when they are there."""

import math
from collections.abc import Iterator, Sequence
from fractions import Fraction
from typing import Any, NamedTuple, cast

import numpy as np

from echelon.certificates.tube import Push, Room, room_of
from echelon.core.errors import GainError, listing
from echelon.core.types import Array
from echelon.core.words import Feedforward, Kind, Theorem, Verdict
from echelon.models.model import FlatBound
from echelon.promises.arrival import Arrival, arrival_of
from echelon.promises.motors import Strain, strain_of
from echelon.promises.paths import least_on_path
from echelon.promises.statement import Hypothesis, Statement
from echelon.promises.stopping import Stopping

_ROUNDED = Fraction(1, 10**6)
"""Of a derivative of a flat output: a thousand times what floats leave of it at a start."""
_STARTS = 64
"""Starts of agents that are looked at one by one; those that differ in one speed alone are two."""
_PROOF = Kind.PROOF


_ANY = ("any graph in which the leader reaches everybody", "this graph")


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
        strain: what the motors give; None where they have no limits, or may not suffice.
        graphs: which graphs are meant, and this one, in words.
    """

    kind: Kind
    rate: float
    gains: tuple[float, ...]
    left: float
    steepest: float
    arrival: Arrival | None
    who: str
    borders: tuple[dict[str, Any], ...]
    strain: Strain | None
    graphs: tuple[str, str] = _ANY

    @property
    def theorem(self) -> Theorem:
        """T5."""
        return Theorem.T5

    def sentence(self) -> str:
        """Return what is promised, in one sentence."""
        when = (
            ""
            if self.arrival is None
            else f"; these starts are within 1 cm from {self.arrival.time:.3g} s on"
        )
        return (
            f"{self.kind.value}: from {self.who}, errors go to zero for any number of agents and "
            f"{self.graphs[0]}, where the model is exact and zeta' "
            f"is told at all times (T5); on {self.graphs[1]} in the end at "
            f"{self.rate:.3g} 1/s or faster{when}."
            + ("" if self.strain is None else f" {self.strain.sentence()}")
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
            "motors": None if self.strain is None else self.strain.as_mapping(),
        }


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
    strain, line = strain_of(run)
    tube = Tube(kind, run.rate, gains, far, steepest, arrival, who, told, strain)
    return _Found(tube._replace(graphs=_graphs(run)), (*lines, line))


def _graphs(run: Stopping) -> tuple[str, str]:
    """Return of which graphs T5 speaks, and how this one is called."""
    schedule, law = run.parts.graph.schedule, run.law
    if law.feedforward is Feedforward.PARENT:
        # The speeds of the links add up in the tube.
        return f"any tree in which none is more than {run.links} links from a leader", "this one"
    if schedule is None:
        return _ANY
    every = "in the end" if schedule.period is None else "in every period"
    along = "along neighbours nearer to it " if law.leaderward else ""
    return f"any graphs that take turns and by which the leader reaches everybody {along}{every}", (
        "these"
    )


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


_NO_BORDER = "no border of flat coordinates can be met"


def _set_lines(run: Stopping, borders: Sequence[_Border], kind: Kind) -> Iterator[Statement]:
    """Yield what set of starts is certified, and whether this run's lie in it."""
    if not borders:
        text = "its flat coordinates have no border: any state is a start"
        yield Statement(Hypothesis.SET, Verdict.HOLDS, kind, math.inf, "everywhere", text)
        yield Statement(Hypothesis.STARTS, Verdict.HOLDS, kind, 0.0, "inside", _NO_BORDER)
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
    on = all(run.own_speed(_index(run, b.bound.output)) < 1e-9 for b in borders)
    outputs = listing(b.bound.output for b in borders)
    within = " and ".join(b.bound.within for b in borders)
    told = f"any position, heading, sideways speed and turning, with {within}"
    if not on:
        return f"{told}, and speeds in {outputs} as at these starts"
    off = f"within {min(b.steepest for b in borders):.3g} of the leader's"
    return f"{told}, a speed in {outputs} {off}, which keeps to its path there"


def _positions(run: Stopping) -> tuple[int, ...]:
    """Return which outputs are a position."""
    outputs, position = run.law.ready.chains.outputs, run.parts.model.position
    return tuple(k for k, name in enumerate(outputs) if name in position)
