"""Bounds on four motors' thrust along a path with bounded derivatives, in rationals (T5).

With F = p'' + g e3 the thrust is m |F| along F, and the derivatives of F turn it: R'F' and R'F''
give the body rates and, with the yaw, all three torques (theory page). Only sizes are used, so that
any heading will do.
"""

from collections.abc import Sequence
from fractions import Fraction
from typing import NamedTuple

from echelon.agents.models.airframe import Airframe
from echelon.core.enclosure.interval import ELEMENTARY, point
from echelon.core.rational import norm_above, root_bounds, round_up
from echelon.guarantees.stopping.time_slices import TimeSlice

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

    Args:
        frame: of the agent.
        slices: of time.
        path: what is followed asks on each slice.
        pushes: the leader's off its path, and the agent's off the leader; all add up.
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
