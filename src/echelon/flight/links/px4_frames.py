"""From echelon's frames (east, north, up; forward, left, up) to PX4's and back.

PX4's are north, east, down and forward, right, down.
"""

import math
from collections.abc import Sequence
from typing import Final

from echelon.flight.links.attitude_numbers import (
    Numbers,
    named_state,
    product,
    quaternion_of,
    rotate,
)

_HALF: Final = math.sqrt(0.5)
_WORLD: Final = (0.0, _HALF, _HALF, 0.0)
"""Half a turn about the line between east and north, which swaps the frames of the world."""
_BODY: Final = (0.0, -1.0, 0.0, 0.0)
"""Half a turn about the forward axis, which swaps the frames of the body; of its two signs the one
that keeps w positive where the vehicle is level and heads east."""


def swap_world(vector: Sequence[float]) -> Numbers:
    """Return a vector of one frame of the world in the other one."""
    return vector[1], vector[0], -vector[2]


def swap_body(vector: Sequence[float]) -> Numbers:
    """Return a vector of one frame of the body in the other one."""
    return vector[0], -vector[1], -vector[2]


def swap_attitude(quaternion: Sequence[float]) -> Numbers:
    """Return the quaternion, body to world, of the other frames."""
    return product(product(_WORLD, quaternion), _BODY)


def state_of_odometry(
    position: Sequence[float],
    quaternion: Sequence[float],
    velocity: Sequence[float],
    rates: Sequence[float],
    of_body: bool,
) -> dict[str, float]:
    """Return the state, by name, of a message `ODOMETRY`.

    Args:
        position: north, east, down, m.
        quaternion: (w, x, y, z) from the body's frame to the world's.
        velocity: in the frame of the world, or of the body, m/s.
        rates: about forward, right, down, rad/s.
        of_body: whether the velocity is in the frame of the body.
    """
    speed = rotate(quaternion, velocity) if of_body else velocity
    attitude = swap_attitude(quaternion)
    return named_state(swap_world(position), swap_world(speed), attitude, swap_body(rates))


def attitude_target(
    u: Sequence[float], yaw: float, hover_thrust: float, trim_thrust: float
) -> tuple[Numbers, float, float]:
    """Return the attitude, the yaw rate and the thrust of `SET_ATTITUDE_TARGET`.

    The attitude has the measured yaw, so that PX4 turns at the commanded rate alone.

    Args:
        u: roll, pitch (rad), yaw rate (rad/s), thrust (N).
        yaw: the measured one, rad.
        hover_thrust: PX4's `MPC_THR_HOVER`, 0 to 1.
        trim_thrust: which the law takes for that of hovering, N.
    """
    share = max(0.0, min(1.0, u[3] / trim_thrust * hover_thrust))
    return swap_attitude(quaternion_of(u[0], u[1], yaw)), -u[2], share
