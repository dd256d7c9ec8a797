"""The tube of theorem T5: how far agents go, from which starts, and when they arrive."""

import dataclasses
import math
from collections.abc import Iterator, Sequence
from fractions import Fraction
from typing import NamedTuple

import numpy as np

from echelon.agents.models.model import ControlAffine, in_metres
from echelon.core.digits import about, at_least, at_most
from echelon.core.errors import GainError
from echelon.core.statement import Hypothesis, Statement, fails, holds, unneeded
from echelon.core.types import JsonObject
from echelon.core.words import Feedforward, Kind, Theorem, amount
from echelon.guarantees.messages.late_messages import LateMessages
from echelon.guarantees.stopping.arrival import arrival_of
from echelon.guarantees.stopping.borders import Border, border_of
from echelon.guarantees.stopping.flat_everywhere import bounds_of
from echelon.guarantees.stopping.flat_states import flat_states_of
from echelon.guarantees.stopping.motor_load import MotorLoad, motor_load_of
from echelon.guarantees.stopping.moving_offsets import offsets_mapping
from echelon.guarantees.stopping.offset_smoothness import offset_fault
from echelon.guarantees.stopping.path_smoothness import path_fault
from echelon.guarantees.stopping.stopping_run import StoppingRun

_PROOF = Kind.PROOF


_ANY = ("any graph in which the leader reaches every agent", "this graph")


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
        who: which starts are meant, in words.
        borders: what is claimed of each border, and of what it was computed; ready for JSON.
        motor_load: None where motors have no limits, may not suffice, or were left out.
        graphs: which graphs are meant, and this one, in words.
        network: what T9 says; None for the ideal network.
        offsets: how they change with time, and bounds of that; None of constant ones.
        kind: of the argument: the chains' responses and the path are enclosed in rationals; what
            somebody's class states of its flat coordinates or its motors was seen at samples.
    """

    rate: float
    gains: tuple[float, ...]
    left: float
    steepest: float
    arrival: float | None
    who: str
    borders: tuple[dict[str, object], ...]
    motor_load: MotorLoad | None
    graphs: tuple[str, str] = _ANY
    network: LateMessages | None = None
    kind: Kind = _PROOF
    offsets: JsonObject | None = None

    @property
    def theorem(self) -> Theorem:
        """T5, and over a network T9."""
        return Theorem.T5 if self.network is None else Theorem.T9

    def sentence(self) -> str:
        """Return what is promised, in one sentence."""
        text = f"{self.kind.value}: errors converge to zero from {self.who}, for any number of "
        text += f"agents and {self.graphs[0]}, if the model is exact and {self._received()}"
        # Held inputs leave a rest where offsets go on changing.
        text += ". " if self.offsets is None else "; offsets may change as they do, and inputs of "
        text += "" if self.offsets is None else "continuous time follow them exactly. "
        text += f"On {self.graphs[1]} they decay at {at_most(self.rate)} 1/s or faster eventually"
        if self.network is not None:
            text += f"{self.network.faster()}. {self.network.sentence(self.arrival)}"
        elif self.arrival is not None:
            text += f"; from these starts all stay within 1 cm after {at_least(self.arrival)} s"
        return f"{text}." if self.motor_load is None else f"{text}. {self.motor_load.sentence()}"

    def _received(self) -> str:
        """Return what agents must receive, in words."""
        if self.network is None:
            return "zeta' is received at all times (T5)"
        text = "every agent receives one packet of a leader that follows its plan; all messages "
        text += "after it may be late, lost or out of order"
        if self.network.leaderward:
            ages = self.network.ages
            text += f" while no link is silent for {at_most(ages.hop_life * ages.dt)} s"
        return f"{text} (T9)"

    def as_mapping(self) -> dict[str, object]:
        """Return it ready for JSON."""
        finite = {name: getattr(self, name) for name in ("left", "steepest")}
        finite = {name: None if math.isinf(x) else x for name, x in finite.items()}
        return {
            "format": "echelon tube 1",
            "who": self.who,
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
    """Return a line that rests on what a model states of its flat coordinates."""
    if kind is Kind.PROOF:
        return line
    text = f"{line.text}, if its borders are those that `{type(model).__name__}` states"
    return dataclasses.replace(line, kind=kind, text=text)


def _graphs(run: StoppingRun) -> tuple[str, str]:
    """Return of which graphs T5 speaks, and how this one is called."""
    schedule, law = run.parts.graph.schedule, run.law
    if law.feedforward is Feedforward.PARENT:
        # The speeds of the links add up in the tube.
        return (
            f"any tree in which none is more than {amount(run.links, 'link')} from a leader",
            "this one",
        )
    if schedule is None:
        return _ANY
    every = "eventually" if schedule.period is None else "in every period"
    along = "along neighbours nearer to it " if law.leaderward else ""
    return f"any switching graphs over which the leader reaches every agent {along}{every}", (
        "these"
    )


def _nothing(text: str, remedy: str, *before: Statement) -> tuple[None, list[Statement]]:
    """Return that no tube is known, and why."""
    reason = f"{text}, so no tube is known"
    name = Hypothesis.SET if before else Hypothesis.REGION
    lines = [fails(name, _PROOF, text, None, "none", remedy=remedy, reason=reason)]
    others = (Hypothesis.SET, Hypothesis.STARTS) if not before else (Hypothesis.STARTS,)
    lines += [unneeded(each, _PROOF, "needs a tube") for each in others]
    return None, [*before, *lines]


_NO_BORDER = "flat coordinates have no border"


def _set_lines(run: StoppingRun, borders: Sequence[Border]) -> Iterator[Statement]:
    """Yield what set of starts is certified, and whether this run's lie in it."""
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
    """Say how far starts may be off behind a leader that keeps to its path."""
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


def _who(run: StoppingRun, borders: Sequence[Border]) -> str:
    """Return which starts are meant, in words."""
    if not borders:
        return "any state of any agent"
    within = " and ".join(b.bound.within for b in borders)
    free = "any position, heading, sideways speed and turning"
    free = "any position" if any(b.many for b in borders) else free
    if not all(b.led for b in borders):
        speeds = " and ".join(b.speeds for b in borders)
        # Of the leader's speed against its path no more is used than what these starts ask for.
        free = f"{free} of the followers, with {within}, their {speeds} as at these starts"
        return f"{free}, and the leader as at these starts"
    off = " and ".join(f"{b.speeds} within {at_most(b.steepest)}{_angle(b)}" for b in borders)
    return f"{free}, with {within}, and {off} of {_whose(borders)}, which keeps to its path there"


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
