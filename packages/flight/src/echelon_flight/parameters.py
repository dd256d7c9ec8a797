"""The numbers of a flight that a laboratory may change, as the parameters of an autopilot.

flight.json has them under `parameters`; what it leaves out has its default. The fence, which has a
box, is checked here too.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any, Final, NamedTuple

from echelon_flight import FlightError


class Parameter(NamedTuple):
    """One number.

    Attributes:
        name: its key in flight.json.
        default: which is used where flight.json leaves it out; a whole number allows no other.
        unit: `1` for shares.
        low, high: the range that is allowed, ends included.
        sentence: what it does.
    """

    name: str
    default: float
    unit: str
    low: float
    high: float
    sentence: str


PARAMETERS: Final = tuple(
    Parameter(*row)
    for row in (
        ("stale_state", 0.1, "s", 0.01, 2.0,
         "The vehicle descends when its newest state is older."),
        ("tilt", 70.0, "deg", 5.0, 180.0, "The vehicle descends when it is tilted by more."),
        ("low_battery", 0.15, "1", 0.0, 0.9,
         "The vehicle descends when a smaller share of its battery is left."),
        ("overrun_share", 0.5, "1", 0.05, 1.0,
         "A step of the law is too slow when it takes a larger share of its period."),
        ("overrun_ticks", 10, "ticks", 1, 1000,
         "The vehicle descends after so many slow steps of the law in a row."),
        ("slow_states", 2.0, "periods", 1.2, 20.0,
         "The vehicle descends when the median time between states is so long or longer."),
        ("made_up_ticks", 5, "ticks", 0, 100,
         "The law makes up for so many missed ticks at most, and skips all of a longer gap."),
        ("rest_speed", 0.05, "m/s", 0.001, 1.0,
         "A vehicle that descends rests when it moves no faster."),
        ("rest_time", 1.0, "s", 0.1, 30.0,
         "A process ends after its descended vehicle has rested for so long."),
        ("longest_descent", 20.0, "s", 1.0, 600.0,
         "A process ends after this time of descent at the latest."),
        ("report_period", 0.1, "s", 0.02, 0.5, "The time between two reports to the ground."),
        ("start_difference", 0.1, "s", 0.001, 1.0,
         "A start is refused if the station's clock differs by more, without network delay."),
        ("stamp_difference", 1.0, "s", 0.05, 10.0,
         "A datagram is dropped if its time stamp differs by more from the own clock."),
        ("letter_ahead", 0.05, "s", 0.0, 1.0,
         "A letter is dropped if its time stamp is ahead of the own clock by more."),
        ("command_period", 0.2, "s", 0.02, 1.0,
         "The time between two repetitions of the ground station's command."),
        ("silent_agent", 1.0, "s", 0.6, 60.0,
         "The ground station calls an agent silent after this time without a report."),
        ("start_delay", 2.0, "s", 0.5, 60.0,
         "The plan starts this time after the button on the page is pressed."),
        ("ready_patience", 20.0, "s", 1.0, 600.0,
         "`--all` gives up when an agent is not ready after this time."),
        ("state_patience", 5.0, "s", 0.5, 120.0,
         "`--dry-run` gives up when no state has arrived after this time."),
        ("mavlink_patience", 10.0, "s", 0.5, 120.0,
         "The link `px4` waits so long for a heartbeat, and for an answer."),
        ("offboard_lead", 1.0, "s", 0.5, 10.0,
         "The link `px4` sends setpoints for this time before it asks for OFFBOARD."),
        ("cflib_patience", 20.0, "s", 1.0, 300.0,
         "The link `cflib` waits so long for the variables and parameters of a Crazyflie."),
        ("empty_battery", 3.0, "V", 2.5, 3.6,
         "The link `cflib` takes a Crazyflie's battery for empty at this voltage in flight."),
        ("full_battery", 4.1, "V", 3.7, 4.5,
         "The link `cflib` takes a Crazyflie's battery for full at this voltage in flight."),
        ("sinking_thrust", 0.93, "1", 0.5, 0.99,
         "A Crazyflie of the link `cflib` descends with this share of its weight as thrust."),
        ("sinking_time", 5.0, "s", 0.5, 60.0,
         "The link `cflib` switches motors off after this time of descent at the latest."),
        ("sinking_speed", 0.3, "m/s", 0.05, 2.0,
         "A Crazyflie of the link `ros2` descends so fast."),
        ("landed_height", 0.05, "m", 0.01, 0.3,
         "A Crazyflie that descends below this z has landed, and its motors stop."),
        ("position_age", 0.5, "s", 0.05, 5.0,
         "With `--positions`, the vehicle descends when its newest position is older."),
        ("first_position", 5.0, "s", 0.5, 120.0,
         "With `--positions`, the vehicle descends without a first position after this time."),
        ("radio_setpoints", 300.0, "1/s", 10.0, 10000.0,
         "The vehicles on one dongle share so many setpoints a second."),
        ("late_setpoints", 0.5, "1", 0.05, 1.0,
         "A vehicle on a shared dongle hovers on the plan when a larger share of them is late."),
        ("ros2_patience", 5.0, "s", 0.5, 120.0,
         "The link `ros2` waits so long for the topics of its vehicle."),
    )
)  # fmt: skip
"""All of them, in the order of flight.json and of the documentation."""

DEFAULTS: Final[Mapping[str, float]] = {each.name: each.default for each in PARAMETERS}


def values_of(facts: Mapping[str, Any]) -> dict[str, float]:
    """Return the value of every parameter.

    Args:
        facts: the content of flight.json.

    Raises:
        FlightError: a key is unknown, or a value is no number or outside its range.
    """
    given = facts.get("parameters", {})
    if not isinstance(given, Mapping):
        raise FlightError(f"`parameters` in flight.json is {given!r}, and must have keys.")
    for name in given:
        if name not in DEFAULTS:
            raise FlightError(
                f"`parameters` in flight.json has the unknown key `{name}`; allowed are "
                f"{', '.join(f'`{each}`' for each in DEFAULTS)}."
            )
    return {each.name: _checked(each, given.get(each.name, each.default)) for each in PARAMETERS}


def _checked(parameter: Parameter, value: Any) -> float:
    whole = isinstance(parameter.default, int)
    fits = isinstance(value, int | float) and not isinstance(value, bool)
    fits = fits and parameter.low <= value <= parameter.high
    if not fits or (whole and value != int(value)):
        kind = "a whole number" if whole else "a number"
        raise FlightError(
            f"`parameters.{parameter.name}` in flight.json is {value!r}, and must be {kind} from "
            f"{parameter.low:g} to {parameter.high:g} {parameter.unit}".removesuffix(" 1")
            + "."
        )
    return value


def check_fence(facts: Mapping[str, Any]) -> None:
    """Check the fence of flight.json: two corners with a number for each coordinate, and a speed.

    Raises:
        FlightError: a key is missing or unknown, a value is of a wrong type, or the box is empty.
    """
    fence, count = facts.get("fence"), len(facts["position"])
    keys = ("low", "high", "speed")
    if not isinstance(fence, Mapping) or {*fence} != {*keys}:
        raise FlightError(f"`fence` in flight.json is {fence!r}, and must have {', '.join(keys)}.")
    for name in keys[:2]:
        corner = fence[name]
        if not (isinstance(corner, Sequence) and len(corner) == count and all(map(_real, corner))):
            raise FlightError(
                f"`fence.{name}` in flight.json is {corner!r}, and must be {count} numbers, m."
            )
    if not all(a < b for a, b in zip(fence["low"], fence["high"], strict=True)):
        raise FlightError(
            f"`fence` in flight.json is empty: `low` is {fence['low']}, and must be below `high`, "
            f"{fence['high']}."
        )
    if not (_real(fence["speed"]) and fence["speed"] > 0.0):
        raise FlightError(
            f"`fence.speed` in flight.json is {fence['speed']!r}, and must be above 0 m/s."
        )


def _real(value: Any) -> bool:
    number = isinstance(value, int | float) and not isinstance(value, bool)
    return number and math.isfinite(value)


def table() -> str:
    """Return the parameters as a table of Markdown, as the documentation has it."""
    rows = [
        f"| `{x.name}` | {x.default:g} | {x.unit} | {x.low:g} to {x.high:g} | {x.sentence} |"
        for x in PARAMETERS
    ]
    head = "| `parameters` | default | unit | allowed | meaning |\n|---|---|---|---|---|\n"
    return head + "\n".join(rows) + "\n"
