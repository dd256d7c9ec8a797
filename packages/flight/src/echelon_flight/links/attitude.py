"""Attitudes as plain numbers: quaternions (w, x, y, z) from body to world, and ZYX Euler angles.

World axes are east, north, up, and body axes forward, left, up, as in exported laws.
"""

import math
from collections.abc import Mapping, Sequence
from typing import TypeAlias

from echelon_flight import FlightError
from echelon_flight.links import listing

Numbers: TypeAlias = tuple[float, ...]


def quaternion_of(roll: float, pitch: float, yaw: float) -> Numbers:
    """Return the quaternion of Rz(yaw) Ry(pitch) Rx(roll), angles in rad."""
    (a, b, c), (d, e, f) = (
        [turn(0.5 * angle) for angle in (roll, pitch, yaw)] for turn in (math.cos, math.sin)
    )
    return (
        a * b * c + d * e * f,
        d * b * c - a * e * f,
        a * e * c + d * b * f,
        a * b * f - d * e * c,
    )


def angles_of(quaternion: Sequence[float]) -> Numbers:
    """Return roll, pitch and yaw (rad) of a quaternion of length 1."""
    w, x, y, z = quaternion
    # Rounding may leave a sine just above 1.
    pitch = math.asin(max(-1.0, min(1.0, 2.0 * (w * y - z * x))))
    roll = math.atan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y))
    return roll, pitch, math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))


def product(p: Sequence[float], q: Sequence[float]) -> Numbers:
    """Return the quaternion of q's turn followed by p's."""
    (a, b, c, d), (w, x, y, z) = p, q
    return (
        a * w - b * x - c * y - d * z,
        a * x + b * w + c * z - d * y,
        a * y - b * z + c * w + d * x,
        a * z + b * y - c * x + d * w,
    )


def rotate(quaternion: Sequence[float], vector: Sequence[float]) -> Numbers:
    """Return a vector of the body in the world's axes."""
    w, x, y, z = quaternion
    return product(product(quaternion, (0.0, *vector)), (w, -x, -y, -z))[1:]


def angle_rates(angles: Sequence[float], body: Sequence[float]) -> Numbers:
    """Return the rates of the Euler angles from the body's rates (p, q, r), rad/s."""
    (roll, pitch, _), (p, q, r) = angles, body
    turn = (math.sin(roll) * q + math.cos(roll) * r) / math.cos(pitch)
    return p + math.sin(pitch) * turn, math.cos(roll) * q - math.sin(roll) * r, turn


def named_state(
    position: Sequence[float],
    velocity: Sequence[float],
    quaternion: Sequence[float],
    body: Sequence[float],
) -> dict[str, float]:
    """Return all that is known of a rigid body, by the names that laws have for states."""
    angles = angles_of(quaternion)
    names = ("x", "y", "z", "vx", "vy", "vz", "roll", "pitch", "yaw", "p", "q", "r")
    rates = ("roll_rate", "pitch_rate", "yaw_rate")
    numbers = *position, *velocity, *angles, *body, *angle_rates(angles, body)
    return dict(zip((*names, *rates), numbers, strict=True))


KNOWN_STATES = tuple(named_state((0, 0, 0), (0, 0, 0), (1, 0, 0, 0), (0, 0, 0)))
"""The names of the states that an autopilot measures."""


def check_states(states: Mapping[str, str]) -> tuple[str, ...]:
    """Return the names of a law's states, all of which an autopilot measures.

    Raises:
        FlightError: it does not measure one.
    """
    for name in states:
        if name not in KNOWN_STATES:
            raise FlightError(
                f"the law has the state `{name}`, which no autopilot measures; "
                f"it measures {listing(KNOWN_STATES)}."
            )
    return tuple(states)
