"""A vehicle with PX4, by MAVLink.

An address is `px4://` and one of pymavlink, such as `px4://udpin:127.0.0.1:14540`. The link enters
OFFBOARD and never arms: a person does.

PX4's frames are north, east, down and forward, right, down; those of laws are east, north, up
and forward, left, up.
"""

import math
import os
import time
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, Final, final

from echelon_flight import FlightError, MissingLibraryError
from echelon_flight.links import Link, Reading
from echelon_flight.links.attitude import (
    Numbers,
    check_states,
    named_state,
    product,
    quaternion_of,
    rotate,
)
from echelon_flight.parameters import DEFAULTS

_OFFBOARD, _LAND = (6, 0), (4, 6)
"""PX4's main and sub modes."""
_SET_INTERVAL, _SET_MODE, _ODOMETRY = 511, 176, 331
"""Of MAVLink: two commands and a message."""
_PX4, _NO_AUTOPILOT, _ONBOARD = 12, 8, 18
"""Of heartbeats: kinds of autopilots, and the kind of this program, a computer on board."""
_RATES_IGNORED: Final = 3
"""Of `SET_ATTITUDE_TARGET`: the rates of roll and pitch; that of yaw is used."""
_OF_BODY: Final = (8, 12)
"""Frames of a message `ODOMETRY` whose velocity is in the frame of the body."""


@final
class Px4Link(Link):
    """Sends attitudes, a yaw rate and a thrust; PX4 leaves OFFBOARD after 1 s without any.

    Raises:
        FlightError: no vehicle answers, or it does not tell its hover thrust.
        MissingLibraryError: pymavlink is not installed.
    """

    inputs: ClassVar[tuple[str, ...] | None] = (
        "roll_command", "pitch_command", "yaw_rate_command", "thrust",
    )  # fmt: skip
    watchdog: ClassVar[bool] = True

    def __init__(self, address: str, facts: Mapping[str, Any]) -> None:
        """Connect, ask for the state every `dt`, read the thrust of hovering."""
        self._states, self._trim = check_states(facts["states"]), facts["trim"]["thrust"]
        limits = facts.get("parameters", DEFAULTS)
        # PX4 wants two setpoints a second before.
        self._patience, self._lead = limits["mavlink_patience"], limits["offboard_lead"]
        self._wire = _connected(address, self._patience)
        self._yaw = 0.0
        self._mode: tuple[int, int] | None = None
        self._first, self._beat = math.inf, -math.inf
        self._asked: tuple[tuple[int, int], float] = (0, 0), -math.inf
        self._hover = self._parameter(b"MPC_THR_HOVER")
        self._command(_SET_INTERVAL, _ODOMETRY, 1e6 * facts["dt"])

    def read(self, wait: float) -> Reading | None:
        """Return the newest state that was not yet returned."""
        message, until = None, time.monotonic() + wait
        while (newer := self._next("ODOMETRY", 0.0)) is not None:
            message = newer
        if message is None and wait > 0.0:
            message = self._next("ODOMETRY", until - time.monotonic())
        return None if message is None else self._reading(message)

    def send(self, u: Sequence[float]) -> None:
        """Send an input, and see to OFFBOARD."""
        now = time.monotonic()
        attitude, rate, thrust = attitude_target(u, self._yaw, self._hover, self._trim)
        self._target(attitude, rate, thrust)
        self._first = min(self._first, now)
        if now > self._first + self._lead:
            self._enter(_OFFBOARD)

    def level_descend(self) -> None:
        """Let PX4 land by its own mode, which descends level where it knows no place."""
        self._next("", 0.0)
        self._enter(_LAND)

    def close(self) -> None:
        """Let go of the link."""
        self._wire.close()

    def _reading(self, message: Any) -> Reading:
        m, of_body = message, message.child_frame_id in _OF_BODY
        speed, rates = (m.vx, m.vy, m.vz), (m.rollspeed, m.pitchspeed, m.yawspeed)
        known = state_of_odometry((m.x, m.y, m.z), m.q, speed, rates, of_body)
        self._yaw = known["yaw"]
        return Reading(time.monotonic(), [known[name] for name in self._states])

    def _next(self, kind: str, wait: float) -> Any:
        """Return the next message of a kind within a time (s), or None; all others are read."""
        until = time.monotonic() + wait
        try:
            while True:
                message = self._wire.recv_msg()
                if message is None:
                    if (left := until - time.monotonic()) <= 0.0:
                        return None
                    self._wire.select(left)
                elif message.get_type() == kind:
                    return message
                elif message.get_type() == "HEARTBEAT" and message.autopilot == _PX4:
                    self._mode = message.custom_mode >> 16 & 255, message.custom_mode >> 24
        except OSError as error:
            raise FlightError(f"the link to PX4 failed: {error.strerror}.") from None

    def _target(self, attitude: Sequence[float], yaw_rate: float, thrust: float) -> None:
        now, wire = time.monotonic(), self._wire
        if now > self._beat + 1.0:
            self._beat = now
            wire.mav.heartbeat_send(_ONBOARD, _NO_AUTOPILOT, 0, 0, 0)
        stamp = int(1e3 * now) % 2**32
        to = wire.target_system, wire.target_component
        rates = 0.0, 0.0, yaw_rate
        wire.mav.set_attitude_target_send(stamp, *to, _RATES_IGNORED, attitude, *rates, thrust)

    def _enter(self, mode: tuple[int, int]) -> None:
        """Ask for a mode twice a second, until it is there."""
        again = mode != self._asked[0] or time.monotonic() > self._asked[1] + 0.5
        if mode != self._mode and again:
            self._asked = mode, time.monotonic()
            self._command(_SET_MODE, 1, *mode)

    def _command(self, number: int, *values: float) -> None:
        wire, padded = self._wire, (*values, *(0.0,) * (7 - len(values)))
        wire.mav.command_long_send(wire.target_system, wire.target_component, number, 0, *padded)

    def _parameter(self, name: bytes) -> float:
        """Return the value of a parameter of PX4."""
        wire, until = self._wire, time.monotonic() + self._patience
        while time.monotonic() < until:
            wire.mav.param_request_read_send(wire.target_system, wire.target_component, name, -1)
            value = self._next("PARAM_VALUE", 0.5)
            if value is not None and value.param_id == name.decode():
                return float(value.param_value)
        raise FlightError(f"PX4 does not send its parameter `{name.decode()}`.")


def _connected(address: str, patience: float) -> Any:
    """Return the open connection of pymavlink to a vehicle that sent a heartbeat."""
    # Otherwise pymavlink speaks version 1, which has no `ODOMETRY`.
    os.environ["MAVLINK20"] = "1"
    try:
        from pymavlink import mavutil  # pyright: ignore[reportMissingImports]
    except ImportError:
        raise MissingLibraryError(
            "PX4 needs pymavlink, which is not installed; `pip install 'pymavlink>=2.4.40'`."
        ) from None
    try:
        wire = mavutil.mavlink_connection(address, dialect="common")
    # What is no address of a network is taken for a serial port, which needs pyserial.
    except (ImportError, OSError, ValueError) as error:
        raise FlightError(f"`px4://{address}` cannot be opened: {error}.") from None
    if wire.wait_heartbeat(timeout=patience) is None:
        wire.close()
        raise FlightError(f"there is no PX4 at `{address}`: no heartbeat for {patience:g} s.")
    return wire


# ---- frames --------------------------------------------------------------------------------------

_SWAP_WORLD: Final = (0.0, math.sqrt(0.5), math.sqrt(0.5), 0.0)
"""Half a turn about the line between east and north, which swaps the frames of the world."""
_SWAP_BODY: Final = (0.0, -1.0, 0.0, 0.0)
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
    return product(product(_SWAP_WORLD, quaternion), _SWAP_BODY)


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
