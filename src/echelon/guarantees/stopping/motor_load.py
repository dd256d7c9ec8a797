"""Whether the agents' motors suffice for the law, from the starts of a run (T5)."""

import functools
import math
from collections.abc import Callable, Sequence
from fractions import Fraction
from typing import NamedTuple

import numpy as np

from echelon.agents.models.declarations import is_by_user, undeclared
from echelon.agents.models.model import Airframe, ControlAffine, in_metres
from echelon.core.cache import memoize
from echelon.core.claim import Number, Rounding
from echelon.core.digits import at_least, at_most
from echelon.core.rational import (
    bisect,
    float_above,
    float_below,
    norm_above,
    root_bounds,
    round_up,
)
from echelon.core.statement import (
    NO_LIMIT,
    Hypothesis,
    Statement,
    holds,
    left_to_run,
    unneeded,
)
from echelon.core.types import Array
from echelon.core.words import Kind
from echelon.guarantees.promises.hypotheses import limits_act, other_limits
from echelon.guarantees.stopping.chain_response import Chain, TimeSlice, slices_of
from echelon.guarantees.stopping.flat_everywhere import airframe_fault
from echelon.guarantees.stopping.linear_load import linear_limits
from echelon.guarantees.stopping.path_bounds import Pieces, pieces_of
from echelon.guarantees.stopping.stopping_run import StoppingRun, of_leaders
from echelon.laws.stopping_point import StoppingLeader
from echelon_ranges import ELEMENTARY, point

# ---- bounds on the thrust of four motors ---------------------------------------------------------
# With F = p'' + g e3 the thrust is m |F| along F, and the derivatives of F turn it: R'F' and R'F''
# give the body rates and, with the yaw, all three torques (theory page). Only sizes are used, so
# that any heading will do.

_HALF = Fraction(1, 2)


class MotorDemand(NamedTuple):
    """Bounds of a path's derivatives, sizes all: horizontal (norm), vertical, and of the yaw.

    Attributes:
        sideways: of p'', p''' and p'''', the norm of the horizontal part; m/s^2 and so on.
        low, high: between which z'' is.
        upward: of z''' and z''''.
        turn: of yaw' and yaw''.
    """

    sideways: tuple[Fraction, Fraction, Fraction]
    low: Fraction
    high: Fraction
    upward: tuple[Fraction, Fraction]
    turn: tuple[Fraction, Fraction]


class Pushed(NamedTuple):
    """How an agent is moved off what it follows: sizes of its start, and bounds of |w|.

    Attributes:
        sideways: norms of the horizontal v, v', v''.
        upward: of the vertical ones.
        turn: of yaw'.
        speeds: s, horizontal (norm), vertical, of the yaw.
    """

    sideways: tuple[Fraction, ...]
    upward: tuple[Fraction, ...]
    turn: tuple[Fraction, ...]
    speeds: tuple[Fraction, Fraction, Fraction]


class Motors(NamedTuple):
    """Between what each motor's thrust (N) stays, and the tangent of the steepest tilt.

    `slope` is None where the thrust is not shown to stay positive, and then nothing is known.
    """

    least: Fraction
    largest: Fraction
    slope: Fraction | None

    @property
    def tilt(self) -> Fraction:
        """The steepest tilt, rad."""
        assert self.slope is not None
        return ELEMENTARY["atan"].range(point(self.slope)).hi

    def within(self, most: Fraction) -> bool:
        """Tell whether motors that give between 0 and `most` suffice."""
        return self.slope is not None and self.least > 0 and self.largest < most


def motors_of(
    frame: Airframe,
    slices: Sequence[TimeSlice],
    path: Sequence[MotorDemand],
    pushes: Sequence[Pushed],
) -> Motors:
    """Return what the motors of an agent give on a path, pushed off it.

    `path` is what is followed, slice by slice; `pushes` (the leader's, the agent's) add up.
    """
    least, largest, slope = None, Fraction(0), Fraction(0)
    for piece, demand in zip(slices, path, strict=True):
        motors = motors_for(frame, add_pushes(piece, demand, pushes))
        if motors.slope is None:
            return motors
        least = motors.least if least is None else min(least, motors.least)
        largest, slope = max(largest, motors.largest), max(slope, motors.slope)
    assert least is not None
    return Motors(least, largest, slope)


def motors_suffice(
    frame: Airframe, slices: Sequence[TimeSlice], path: Sequence[MotorDemand], push: Pushed
) -> bool:
    """Tell whether the motors give all that is asked of an agent on a path, pushed off it."""
    most, pairs = Fraction(frame.motor_thrust), zip(slices, path, strict=True)
    return all(motors_for(frame, add_pushes(*pair, (push,))).within(most) for pair in pairs)


def add_pushes(piece: TimeSlice, demand: MotorDemand, pushes: Sequence[Pushed]) -> MotorDemand:
    """Return what is asked on a slice of agents that are pushed off the path."""
    aside, up, turn = list(demand.sideways), [Fraction(0)] * 3, list(demand.turn)
    for push in pushes:
        along, upward, around = push.speeds
        for k in range(3):
            aside[k] += piece.whole.of(k + 1, push.sideways, along)
            up[k] += piece.whole.of(k + 1, push.upward, upward)
        for k in range(2):
            turn[k] += piece.first.of(k, push.turn, around)
    return MotorDemand(
        (aside[0], aside[1], aside[2]),
        demand.low - up[0],
        demand.high + up[0],
        (demand.upward[0] + up[1], demand.upward[1] + up[2]),
        (turn[0], turn[1]),
    )


def motors_for(frame: Airframe, demand: MotorDemand) -> Motors:
    """Return what the motors give while a path's derivatives are within bounds."""
    low = demand.low + Fraction(frame.gravity)
    if low <= 0:
        return Motors(Fraction(-1), Fraction(-1), None)
    Jx, Jy, Jz = map(Fraction, frame.inertia)
    tan = round_up(demand.sideways[0] / low)
    sec2 = 1 + tan * tan
    low_sec, high_sec = root_bounds(sec2)
    sec, sine = round_up(high_sec), round_up(tan / low_sec)
    jerk, snap = (norm_above(demand.sideways[k + 1], demand.upward[k]) for k in range(2))
    turn, turning = demand.turn
    # Of roll and pitch, rad/s, and what turns them but for what the yaw does, rad/s^2.
    rate = round_up(jerk / low)
    bend = round_up((snap + jerk * jerk / low) / low)
    spin = round_up(sec * turn + tan * rate)
    spinning = sec * turning + 2 * turn * sec2 * (sine * rate + (1 - 1 / sec) * turn)
    spinning += (2 * sec2 - 1) * _HALF * rate * rate + tan * bend
    tilting = max(Jx, Jy) * bend + max(Jx + Jz - Jy, Jy + Jz - Jx) * rate * spin
    yawing = Jz * spinning + abs(Jy - Jx) * _HALF * rate * rate
    root = root_bounds(2)[1]
    more = root * tilting / Fraction(frame.arm) + yawing / Fraction(frame.torque_per_thrust)
    mass, more = Fraction(frame.mass), round_up(more) / 4
    high = norm_above(demand.high + Fraction(frame.gravity), demand.sideways[0])
    return Motors(mass * low / 4 - more, mass * high / 4 + more, tan)


# ---- the motors of a run -------------------------------------------------------------------------

_OUTPUTS, _DEGREES = ("x", "y", "z", "yaw"), (4, 4, 4, 2)
"""Of the body that the motors move, as its flat coordinates."""
_ROUNDED = Fraction(1, 10**6)
"""Of a start in flat coordinates: a thousand times what floats leave of it."""
_PROOF = Kind.PROOF
_STARTS = 64
"""Starts that are looked at one by one where all together are too many for the motors."""
_STEPS = 8
"""Of a bisection for how far a start may be off: a 250th of where it begins."""
_ZERO = Fraction(0)
_UNKNOWN = "no certificate is known for these limits"
_STILL = Pushed((), (), (), (_ZERO, _ZERO, _ZERO))


class Alone(NamedTuple):
    """How far one thing may be off at a start, at any place and heading, the rest as the leader's.

    Attributes:
        tilt: rad, at the leader's velocity, without a body rate.
        sideways, upward: a velocity off the leader's, m/s.
        rate: a body rate of roll and pitch of a level agent at the leader's velocity, rad/s.
        rest: whether agents may begin level and at rest.
    """

    tilt: float
    sideways: float
    upward: float
    rate: float
    rest: bool

    def notes(self) -> tuple[str, ...]:
        """Return the same in phrases."""
        return (
            "motors suffice also from any place and heading, behind a leader on its path, if one "
            "of these alone differs",
            f"a tilt of {at_most(math.degrees(self.tilt))} deg at the leader's velocity",
            f"{at_most(self.sideways)} m/s sideways, or {at_most(self.upward)} m/s upward",
            f"{at_most(self.rate)} rad/s of roll and pitch when level",
            *["level and at rest"] * bool(self.rest),
        )


class MotorLoad(NamedTuple):
    """What the motors give from the starts of a run, and from which others they would do.

    Attributes:
        least, largest: of a motor's thrust, N.
        most: that it has, N.
        tilt: the steepest, rad.
    """

    least: float
    largest: float
    most: float
    tilt: float
    alone: Alone | None
    data: dict[str, object]

    def numbers(self) -> dict[str, Number]:
        """Return what is claimed of motors."""
        return {
            "motor_least": Number(self.least, "N", Rounding.DOWN),
            "motor_largest": Number(self.largest, "N", Rounding.UP),
            "motor_limit": Number(self.most, "N", Rounding.UP),
            "tilt": Number(math.degrees(self.tilt), "deg", Rounding.UP),
        }

    def notes(self) -> tuple[str, ...]:
        """Return from which other starts motors suffice."""
        return () if self.alone is None else self.alone.notes()

    def as_mapping(self) -> dict[str, object]:
        """Return it ready for JSON."""
        alone = None if self.alone is None else self.alone._asdict()
        numbers = {"least": self.least, "largest": self.largest, "tilt": self.tilt}
        return {**numbers, "most": self.most, "alone": alone, **self.data}


class _MotorCase(NamedTuple):
    """`demands` are of the leader's path on each slice, `base` those of agents that start as it."""

    frame: Airframe
    chain: Chain
    demands: tuple[MotorDemand, ...]
    leader: Pushed
    speeds: tuple[Fraction, Fraction, Fraction]
    base: tuple[MotorDemand, ...]
    starts: Sequence[Pushed]

    @classmethod
    def of(cls, run: StoppingRun, frame: Airframe) -> "_MotorCase":
        graph = run.parts.graph
        away = (run.flat - run.flat[list(graph.nearest_leader())])[list(graph.followers)]
        starts = [_start(flat) for flat in np.unique(away, axis=0)]
        return _led(run, frame)._replace(starts=starts)


@of_leaders
def _led(run: StoppingRun, frame: Airframe) -> _MotorCase:
    """Return what is asked of agents that start as their leader."""
    chain = run.chain(0)
    speeds = _speeds([run.speed(k) for k in range(4)])
    off = run.flat[list(run.parts.graph.leaders)] - run.ahead
    leader = _largest([_start(flat) for flat in off])
    leader = leader._replace(speeds=_speeds([run.own_speed(k) for k in range(4)]))
    demands = _path_demands(run.leader, run.parts.model, run.settings.horizon, chain)
    if run.shifted is not None:
        demands = tuple(_beside(run, demand) for demand in demands)
    base = _pushed(chain, demands, leader, speeds)
    return _MotorCase(frame, chain, demands, leader, speeds, base, ())


_at_limits = functools.partial(left_to_run, Hypothesis.LIMITS, NO_LIMIT)


def motor_load_of(run: StoppingRun, brief: bool = False) -> tuple[MotorLoad | None, Statement]:
    """Return the load of the motors of a run's agents, if they suffice, and its line.

    `brief` leaves out the numbers of motors that do not suffice from the leader's own start.
    """
    frame, reason = _airframe(run)
    if frame is None:
        if not limits_act(run.parts, run.settings):
            return None, unneeded(Hypothesis.LIMITS, _PROOF, reason)
        bounded = None if other_limits(run.parts) else linear_limits(run)
        return None, bounded or _at_limits(reason)
    if other_limits(run.parts):
        return None, _at_limits("the motors of an agent have other limits than the model's")
    kind = Kind.SAMPLES if is_by_user(run.parts.model, "airframe") else Kind.PROOF
    case = _MotorCase.of(run, frame)
    if brief and not _suffice_at_rest(run, frame):
        return None, _at_limits("the motors are not proved to suffice from any start", kind=kind)
    motors, starts = _from(case)
    most = Fraction(frame.motor_thrust)
    number = None if motors.slope is None else float(motors.least), _thrust_text(motors)
    if not motors.within(most):
        text = "the motors are not proved to suffice from these starts"
        need = f": they need {number[1]}, and have 0 .. {at_most(float(most), 4)} N"
        text += need if number[1] else ", and the thrust is not proved to stay positive"
        remedy = "choose gentler `roots`, such as [2, 2.5, 3], or a lower `speed`, or start nearer "
        remedy += "to the leader's velocity and attitude"
        return None, _at_limits(text, *number, remedy, kind)
    ahead = _ahead(frame, run.ahead)
    load = MotorLoad(
        float_below(motors.least),
        float_above(motors.largest),
        float(most),
        float_above(motors.tilt),
        # Of an agent that starts as its leader but for one thing, offsets that change are another.
        None if run.shifted is not None else _alone(frame, case.chain, case.base, ahead),
        _data(case, run.law.roots_for(3), starts, ahead),
    )
    text = "the motors suffice from these starts at all times"
    return load, holds(Hypothesis.LIMITS, kind, text, *number)


@of_leaders
def _airframe(run: StoppingRun) -> tuple[Airframe | None, str]:
    model, reason = run.parts.model, _beyond(run)
    frame = None if undeclared(model, "airframe") else model.airframe
    if frame is not None and not reason and is_by_user(model, "airframe"):
        reason = airframe_fault(model, run.law.ready.chains, frame)
    return (None, reason) if reason else (frame, _UNKNOWN)


def _beyond(run: StoppingRun) -> str:
    """Return why nothing is to be asked of motors, or nothing is known; empty where it is."""
    chains = run.law.ready.chains
    if not limits_act(run.parts, run.settings):
        return "the inputs have no limits"
    if not in_metres(run.parts.model):
        return "motors are judged where positions are in m"
    if (chains.outputs, chains.degrees) != (_OUTPUTS, _DEGREES):
        return _UNKNOWN
    speeds = [*map(run.speed, range(4)), *map(run.own_speed, range(4))]
    return "a `speed` is infinite" if any(map(math.isinf, speeds)) else ""


def _thrust_text(motors: Motors) -> str:
    if motors.slope is None:
        return ""
    tilt = at_least(math.degrees(motors.tilt))
    return f"{at_most(float(motors.least))} .. {at_least(float(motors.largest), 4)} N, {tilt} deg"


# ---- the path ------------------------------------------------------------------------------------


@memoize
def _path_demands(
    leader: StoppingLeader, model: ControlAffine, horizon: float, chain: Chain
) -> tuple[MotorDemand, ...]:
    pieces = pieces_of(leader, model, horizon, _OUTPUTS, max(_DEGREES))
    spans = ((piece.begin, piece.end) for piece in slices_of(chain))
    return tuple(_demand(pieces, *span) for span in spans)


def _beside(run: StoppingRun, demand: MotorDemand) -> MotorDemand:
    """Return the demand of a path with offsets that change with time."""
    aside, up = ([run.offset_size(k, *axes) for k in (2, 3, 4)] for axes in ((0, 1), (2,)))
    x, y, z = (a + b for a, b in zip(demand.sideways, aside, strict=True))
    upward = demand.upward[0] + up[1], demand.upward[1] + up[2]
    low, high = demand.low - up[0], demand.high + up[0]
    return demand._replace(sideways=(x, y, z), low=low, high=high, upward=upward)


def _demand(pieces: Pieces, begin: Fraction, end: Fraction | None) -> MotorDemand:
    rows = pieces.between(begin, end)

    def most(order: int, *outputs: int) -> Fraction:
        ends = ([(row[order][k].lo, row[order][k].hi) for k in outputs] for row in rows)
        return max(norm_above(*(max(abs(low), abs(high)) for low, high in row)) for row in ends)

    low = min(row[2][2].lo for row in rows)
    high = max(row[2][2].hi for row in rows)
    sideways = (most(2, 0, 1), most(3, 0, 1), most(4, 0, 1))
    return MotorDemand(sideways, low, high, (most(3, 2), most(4, 2)), (most(1, 3), most(2, 3)))


# ---- agents --------------------------------------------------------------------------------------


def _speeds(values: Sequence[float]) -> tuple[Fraction, Fraction, Fraction]:
    x, y, z, yaw = map(Fraction, values)
    return norm_above(x, y), z, yaw


def _start(flat: Array) -> Pushed:
    """Return the sizes of a start off what an agent follows, (4, 4) in flat coordinates."""
    sizes = [[abs(Fraction(x)) + _ROUNDED for x in row] for row in flat[1:].tolist()]
    sideways = tuple(norm_above(*row[:2]) for row in sizes)
    return Pushed(sideways, tuple(row[2] for row in sizes), (sizes[0][3],), _STILL.speeds)


def _largest(starts: Sequence[Pushed]) -> Pushed:
    """Return one that is as large as each in everything."""
    parts = zip(*(start[:3] for start in starts), strict=True)
    sideways, upward, turn = (tuple(map(max, zip(*part, strict=True))) for part in parts)
    return Pushed(sideways, upward, turn, _STILL.speeds)


@memoize
def _pushed(
    chain: Chain, path: tuple[MotorDemand, ...], leader: Pushed, speeds: tuple[Fraction, ...]
) -> tuple[MotorDemand, ...]:
    """Return what is asked of agents that start as their leader, on each slice."""
    own = _STILL._replace(speeds=speeds)
    pairs = zip(slices_of(chain), path, strict=True)
    return tuple(add_pushes(piece, demand, (leader, own)) for piece, demand in pairs)


@of_leaders
def _suffice_at_rest(run: StoppingRun, frame: Airframe) -> bool:
    case = _led(run, frame)
    return motors_suffice(frame, slices_of(case.chain), case.base, _STILL)


def _from(case: _MotorCase) -> tuple[Motors, Sequence[Pushed]]:
    frame, slices, starts = case.frame, slices_of(case.chain), case.starts
    largest = _largest(starts)
    whole = motors_of(frame, slices, case.base, (largest,))
    if whole.within(Fraction(frame.motor_thrust)) or len(starts) > _STARTS:
        return whole, [largest]
    each = [motors_of(frame, slices, case.base, (start,)) for start in starts]
    slopes = [one.slope for one in each if one.slope is not None]
    if len(slopes) < len(each):
        return whole, [largest]
    least, most = min(one.least for one in each), max(one.largest for one in each)
    return Motors(least, most, max(slopes)), starts


class _Ahead(NamedTuple):
    """How a path begins, m and s: horizontal v, v', v''; v_z, g + v_z', v_z''; the yaw's rate."""

    speed: Fraction
    push: Fraction
    jerk: Fraction
    rise: Fraction
    lift: Fraction
    climb: Fraction
    turn: Fraction


def _ahead(frame: Airframe, path: Array) -> _Ahead:
    start = _start(path)
    (speed, push, jerk), (rise, up, climb) = start.sideways, start.upward
    lift = Fraction(frame.gravity) + up
    return _Ahead(speed, push, jerk, rise, lift, climb, start.turn[0])


@memoize
def _alone(
    frame: Airframe, chain: Chain, base: tuple[MotorDemand, ...], path: _Ahead
) -> Alone | None:
    """Return how far one thing may be off at a start that is else the leader's."""
    slices = slices_of(chain)

    def fits(sideways: tuple[Fraction, ...], upward: Fraction = _ZERO) -> bool:
        start = Pushed(sideways, (upward,), (path.turn,), _STILL.speeds)
        return motors_suffice(frame, slices, base, start)

    # The thrust is set level, so that z'' and its rate are the path's: a tilt of tangent t
    # accelerates by (g + z'') t, at a rate of t times the path's; a body rate w of a level agent
    # adds (g + z'') w to that.
    if not fits((_ZERO,)):
        return None
    _, a, j, rise, lift, climb, _ = path

    def farthest(fits: Callable[[Fraction], bool], most: int) -> float:
        return float(bisect(fits, _ZERO, Fraction(most), _STEPS))

    tilt = farthest(lambda t: fits((_ZERO, lift * t + a, climb * t + j)), 4)
    return Alone(
        math.atan(tilt),
        farthest(lambda x: fits((x,)), 40),
        farthest(lambda x: fits((_ZERO,), x), 20),
        farthest(lambda w: fits((_ZERO, a, j + lift * w)), 40),
        fits((path.speed, a, j), rise),
    )


def _data(
    case: _MotorCase, roots: Sequence[float], starts: Sequence[Pushed], ahead: _Ahead
) -> dict[str, object]:
    return {
        "airframe": case.frame._asdict(),
        "roots": list(roots),
        "speeds": [float(s) for s in case.speeds],
        "leader": _numbers(case.leader),
        "starts": [_numbers(start) for start in starts],
        "ahead": {name: float(x) for name, x in ahead._asdict().items()},
        "path": [
            [float(piece.begin), *(float(x) for part in demand for x in _flat(part))]
            for piece, demand in zip(slices_of(case.chain), case.demands, strict=True)
        ],
    }


def _flat(part: Fraction | tuple[Fraction, ...]) -> tuple[Fraction, ...]:
    return part if isinstance(part, tuple) else (part,)


def _numbers(push: Pushed) -> dict[str, list[float]]:
    return {name: [float(x) for x in part] for name, part in push._asdict().items()}
