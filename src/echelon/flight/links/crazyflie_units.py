"""The units and signs of a Crazyflie's packets, by cflib 0.1.34 and the firmware of 2026.

Angles and rates of echelon are right-handed about forward, left, up. What differs:

- The log group `stateEstimate` negates pitch; `stateEstimateZ` has the attitude as a quaternion,
  which is right, and a `ratePitch` that is negated.
- `send_setpoint_manual` negates pitch and its rate itself; it takes degrees and percent.
- `send_setpoint` of port 3 is locked until a thrust of 0, and the firmware negates its yaw rate.
- `send_full_state_setpoint` says degrees per second and sends thousandths of what it is given,
  which the firmware takes for thousandths of a rad/s.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Final

from echelon.flight.links.attitude_numbers import Numbers, named_state, quaternion_of

LOG: Final = {
    **{name: "int16_t" for name in ("x", "y", "z", "vx", "vy", "vz")},
    "quat": "uint32_t",
    **{name: "int16_t" for name in ("rateRoll", "ratePitch", "rateYaw")},
}
"""Variables of the log group `stateEstimateZ`, 22 of the 26 bytes of a packet: mm, mm/s, mrad/s."""
_LOWEST, _HIGHEST, _FULL = 10001.0, 60000.0, 65535.0
"""What 0 and 100 % of `send_setpoint_manual` mean, and what all four motors' thrust is."""


def unpack_quaternion(packed: int) -> Numbers:
    """Return the quaternion (w, x, y, z) of a firmware's 32 bits (`quatcompress.h`)."""
    # Two bits name the largest of (x, y, z, w); a sign and 9 bits of 1/sqrt 2 for each other one.
    largest, values = packed >> 30, [0.0] * 4
    for k in reversed([k for k in range(4) if k != largest]):
        size = (packed & 511) / 511 * math.sqrt(0.5)
        values[k], packed = -size if packed & 512 else size, packed >> 10
    values[largest] = math.sqrt(max(0.0, 1.0 - sum(value * value for value in values)))
    return values[3], *values[:3]


def state_of_log(values: Mapping[str, int]) -> dict[str, float]:
    """Return the state, by name, that a packet with the variables of `LOG` holds."""
    numbers = {name: values[f"stateEstimateZ.{name}"] for name in LOG}
    place, speed = ([1e-3 * numbers[v + axis] for axis in "xyz"] for v in ("", "v"))
    p, q, r = (1e-3 * numbers[name] for name in ("rateRoll", "ratePitch", "rateYaw"))
    return named_state(place, speed, unpack_quaternion(numbers["quat"]), (p, -q, r))


def manual_setpoint(u: Sequence[float], full_thrust: float) -> Numbers:
    """Return the first four arguments of `send_setpoint_manual`.

    Args:
        u: roll and pitch (rad, or rad/s in its rate mode), yaw rate (rad/s), thrust (N).
        full_thrust: of all four motors, at 65535, N.
    """
    # cflib rounds the thrust down.
    number = max(_LOWEST, min(_HIGHEST, u[3] / full_thrust * _FULL)) + 0.5
    percent = (number - _LOWEST) / (_HIGHEST - _LOWEST) * 100.0
    return *(math.degrees(angle) for angle in u[:3]), min(percent, 100.0)


def full_state_setpoint(
    x: Mapping[str, float], acceleration: Sequence[float]
) -> tuple[list[float], list[float], list[float], list[float], float, float, float]:
    """Return the arguments of `send_full_state_setpoint` that ask for an acceleration (m/s^2).

    Place and velocity are the measured ones, so that the firmware corrects neither.
    """
    w, *vector = quaternion_of(0.0, 0.0, x["yaw"])
    place, speed = ([x[v + axis] for axis in "xyz"] for v in ("", "v"))
    return place, speed, [*acceleration], [*vector, w], 0.0, 0.0, 0.0
