"""A Crazyflie by Bitcraze's cflib, over radio, USB or UDP.

An address is `cflib://` and one of cflib, such as `cflib://radio://0/80/2M/E7E7E7E701`. Where the
motors' full thrust is not that of a Crazyflie 2.1+, `#0.72` behind it states that of all four, N.

Angles and rates of laws are right-handed about forward, left, up. What differs in cflib 0.1.34 and
the firmware of 2026:

- The log group `stateEstimate` negates pitch; `stateEstimateZ` has the attitude as a quaternion,
  which is right, and a `ratePitch` that is negated.
- `send_setpoint_manual` negates pitch and its rate itself; it takes degrees and percent.
- `send_setpoint` of port 3 is locked until a thrust of 0, and the firmware negates its yaw rate.
- `send_full_state_setpoint` says degrees per second and sends thousandths of what it is given,
  which the firmware takes for thousandths of a rad/s.
"""

import math
import threading
import time
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, Final, NamedTuple, final

from echelon_flight import FlightError, MissingLibraryError
from echelon_flight.links import Link, Reading, listing
from echelon_flight.links.attitude import Numbers, check_states, named_state, quaternion_of
from echelon_flight.parameters import DEFAULTS

_FULL_THRUST: Final = 0.48
"""Of four motors of a Crazyflie 2.1+ with the firmware's compensation of its battery, N."""
_KALMAN: Final = 2
"""The firmware's estimator that takes positions."""


class _Route(NamedTuple):
    """How inputs of some names are sent: the firmware's controller, and its setpoint.

    Attributes:
        controller: 1 the cascaded PID, 2 Mellinger's.
        full_state: whether by `send_full_state_setpoint`.
        rates: of `send_setpoint_manual`: whether roll and pitch are rates.
    """

    controller: int
    full_state: bool = False
    rates: bool = False


# Mellinger's controller takes rates for a request to hover, and the PID reads no acceleration.
_LAST = ("yaw_rate_command", "thrust")
_ROUTES: Final = {
    ("roll_command", "pitch_command", *_LAST): _Route(2),
    ("roll_rate_command", "pitch_rate_command", *_LAST): _Route(1, rates=True),
    ("ax", "ay", "az"): _Route(2, full_state=True),
}


@final
class CflibLink(Link):
    """Sends attitudes, rates or accelerations; the firmware levels after 0.5 s without any.

    Args:
        address: of cflib.
        facts: law.json.
        crazyflie: an open `Crazyflie`, such as one of cflib's `Swarm`; otherwise it is opened here.

    Raises:
        FlightError: the law has other inputs, such as torques, or no Crazyflie answers.
        MissingLibraryError: cflib is not installed.
    """

    watchdog: ClassVar[bool] = True

    def __init__(self, address: str, facts: Mapping[str, Any], crazyflie: Any = None) -> None:
        """Connect, choose the controller, start the log."""
        self._route = _route_of(tuple(facts["inputs"]))
        self._states = check_states(facts["states"])
        self._limits = limits = facts.get("parameters", DEFAULTS)
        uri, _, thrust = address.partition("#")
        self._full_thrust = _newtons(thrust) if thrust else _FULL_THRUST
        self._weight = facts["trim"].get("thrust", 0.5 * self._full_thrust)
        self._end, self._down, self._locked = math.inf, False, True
        self._arrival = threading.Condition()
        self._newest: Reading | None = None
        self._known: dict[str, float] = {}
        self._failure, self._placed = "", math.inf
        self._owns = crazyflie is None
        self._crazyflie = crazyflie or _connected(uri, limits["cflib_patience"])
        self._crazyflie.connection_lost.add_callback(lambda _, why: self._fail(why))
        self._prepare()

    def read(self, wait: float) -> Reading | None:
        """Return the newest state that was not yet returned."""
        if time.monotonic() > self._placed + (age := self._limits["position_age"]):
            self.lose(f"no position came from outside for {age:g} s")
        with self._arrival:
            if self._newest is None and wait > 0.0 and not self._failure:
                self._arrival.wait(wait)
            reading, self._newest = self._newest, None
        if (reading is None or self._placed < math.inf) and self._failure:
            raise FlightError(f"the link to the Crazyflie failed: {self._failure}.")
        return reading

    def send(self, u: Sequence[float]) -> None:
        """Send an input."""
        if self._locked:
            self._unlock()
        if not self._route.full_state:
            self._manual(u, self._route.rates)
        # Before the first state there is nothing to accelerate from.
        elif self._known:
            setpoint = full_state_setpoint(self._known, u)
            self._crazyflie.commander.send_full_state_setpoint(*setpoint)

    def hover(self, place: Sequence[float], yaw: float) -> None:
        """Let the firmware hold a place (m) and a yaw (rad) by its own position controller."""
        if self._locked:
            self._unlock()
        self._crazyflie.commander.send_position_setpoint(*place, math.degrees(yaw))

    def expect_positions(self, within: float) -> None:
        """Fail if no position came from outside within a time (s), and choose the estimator."""
        self._crazyflie.param.set_value("stabilizer.estimator", _KALMAN)
        self._placed = time.monotonic() + within - self._limits["position_age"]

    def locate(self, pose: Sequence[float]) -> None:
        """Send a place (m), with or without a quaternion (x, y, z, w), to the estimator."""
        self._placed, sender = time.monotonic(), self._crazyflie.extpos
        (sender.send_extpos if len(pose) == 3 else sender.send_extpose)(*pose)

    def lose(self, why: str) -> None:
        """Let the link fail, and so the vehicle descend; states no longer count."""
        with self._arrival:
            self._newest = None
        self._fail(why)

    def level_descend(self) -> None:
        """Let the vehicle sink level, then switch its motors off."""
        now, limits = time.monotonic(), self._limits
        self._end = min(self._end, now + limits["sinking_time"])
        low = self._known.get("z", math.inf) < limits["landed_height"]
        self._down |= low or now > self._end
        if self._down:
            self._crazyflie.commander.send_stop_setpoint()
        else:
            self._manual((0.0, 0.0, 0.0, limits["sinking_thrust"] * self._weight), rates=False)

    def close(self) -> None:
        """Let go of the link."""
        if self._owns:
            # `close_link` would send a zero thrust, which is no level flight.
            link, self._crazyflie.link = self._crazyflie.link, None
            if link is not None:
                link.close()

    def _manual(self, u: Sequence[float], rates: bool) -> None:
        numbers = manual_setpoint(u, self._full_thrust)
        self._crazyflie.commander.send_setpoint_manual(*numbers, rates)

    def _prepare(self) -> None:
        """Choose the controller, and start the log."""
        from cflib.crazyflie.log import LogConfig  # pyright: ignore[reportMissingImports]

        self._choose(self._route.controller)
        log = LogConfig("echelon", period_in_ms=10)
        for name, kind in LOG.items():
            log.add_variable(f"stateEstimateZ.{name}", kind)
        log.add_variable("pm.vbat", "FP16")
        try:
            self._crazyflie.log.add_config(log)
        except KeyError as error:
            raise FlightError(f"the Crazyflie has no log of its state: {error}.") from None
        log.data_received_cb.add_callback(self._receive)
        log.start()

    def _choose(self, controller: int) -> None:
        """Set the firmware's controller, and wait until it is set: inputs are for that one."""
        chosen, parameters = threading.Event(), self._crazyflie.param

        def confirm(_: str, value: str) -> None:
            if value == str(controller):
                chosen.set()

        parameters.add_update_callback(group="stabilizer", name="controller", cb=confirm)
        parameters.set_value("stabilizer.controller", controller)
        if not chosen.wait(self._limits["cflib_patience"]):
            raise FlightError(
                "the Crazyflie does not confirm its parameter `stabilizer.controller`."
            )

    def _unlock(self) -> None:
        """Arm, and unlock the thrust; not before the first input, since a dry run sends none."""
        self._locked = False
        self._crazyflie.supervisor.send_arming_request(True)
        self._crazyflie.commander.send_setpoint(0.0, 0.0, 0.0, 0)

    def _receive(self, _: int, values: Mapping[str, Any], __: object) -> None:
        known = state_of_log(values)
        empty, full = self._limits["empty_battery"], self._limits["full_battery"]
        battery = max(0.0, min(1.0, (values["pm.vbat"] - empty) / (full - empty)))
        reading = Reading(time.monotonic(), [known[name] for name in self._states], battery)
        with self._arrival:
            self._newest, self._known = reading, known
            self._arrival.notify()

    def _fail(self, why: str) -> None:
        with self._arrival:
            self._failure = why.partition("\n")[0].rstrip(".")
            self._arrival.notify()


def _route_of(inputs: tuple[str, ...]) -> _Route:
    if inputs in _ROUTES:
        return _ROUTES[inputs]
    if any(name.startswith("torque") for name in inputs):
        raise FlightError(
            "the law commands torques, which a Crazyflie would keep when the law stops; "
            "use the model `crazyflie-attitude`, whose commands its firmware levels after 0.5 s."
        )
    routes = "; or ".join(listing(names) for names in _ROUTES)
    raise FlightError(f"the law has the inputs {listing(inputs)}, and a Crazyflie takes {routes}.")


def _newtons(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0.0 < value < math.inf:
        raise FlightError(f"`#{text}` of `--link` must be the thrust of all motors, in N.")
    return value


def _connected(uri: str, patience: float) -> Any:
    """Return the open Crazyflie at an address of cflib."""
    try:
        import cflib.crtp  # pyright: ignore[reportMissingImports]
        from cflib.crazyflie import Crazyflie  # pyright: ignore[reportMissingImports]
    except ImportError:
        raise MissingLibraryError(
            "a Crazyflie needs cflib, which is not installed; `pip install 'cflib>=0.1.34'`."
        ) from None
    if not cflib.crtp.CLASSES:
        cflib.crtp.init_drivers()
    crazyflie, done, failures = Crazyflie(), threading.Event(), list[str]()
    crazyflie.fully_connected.add_callback(lambda _: done.set())
    crazyflie.connection_failed.add_callback(lambda _, why: (failures.append(why), done.set()))
    crazyflie.open_link(uri)
    if not done.wait(patience) or failures:
        why = failures[0].partition("\n")[0] if failures else f"no answer for {patience:g} s"
        raise FlightError(f"there is no Crazyflie at `{uri}`: {why.rstrip('.')}.")
    return crazyflie


# ---- units and signs -----------------------------------------------------------------------------

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
