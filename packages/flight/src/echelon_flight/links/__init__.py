"""Links from an agent's process to its vehicle, simulated or real, one file a kind.

A link is all that a new autopilot needs: one file with one class, and its line in `LINKS`. It may
import what its autopilot needs, inside that file; all else uses the standard library.
"""

import abc
import importlib
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, ClassVar, Final, NamedTuple

from echelon_flight import FlightError

LINKS: Final = {
    "udp": "echelon_flight.links.udp:UdpLink",
    "cflib": "echelon_flight.links.crazyflie:CflibLink",
    "px4": "echelon_flight.links.px4:Px4Link",
    "ros2": "echelon_flight.links.ros2:Ros2Link",
}
"""Scheme of an address -> `module:class`."""


class Reading(NamedTuple):
    """What a vehicle says of itself.

    Attributes:
        time: when it was measured, s of `time.monotonic` of this machine; when it arrived, where
            the vehicle does not say.
        x: the state (n,), in the order and units of the `states` of law.json, its angles too.
        battery: the share that is left, 0 to 1; None where it is not known.
    """

    time: float
    x: list[float]
    battery: float | None = None


class Link(abc.ABC):
    """The vehicle of one agent. All methods are called by one thread.

    Args:
        address: the text after `scheme://`; "" if there is none.
        facts: the content of law.json: `agent`, `dt`, `states` and `inputs` with their units; and
            `parameters` of the flight.

    Attributes:
        inputs: the names of the law's inputs that it can send, in order, such as
            `("roll", "pitch", "yaw_rate", "thrust")`; None for any.
        watchdog: whether the vehicle levels by itself when inputs no longer arrive.
        notice: what the ground should know of the link, a sentence without its full stop; or "".
        late: how many inputs were late, and not sent.
    """

    inputs: ClassVar[tuple[str, ...] | None] = None
    watchdog: ClassVar[bool] = False
    notice: str = ""
    late: int = 0

    @abc.abstractmethod
    def __init__(self, address: str, facts: Mapping[str, Any]) -> None:
        """Reach the vehicle.

        Raises:
            FlightError: it cannot be reached, or the link cannot serve such a law.
        """

    @abc.abstractmethod
    def read(self, wait: float) -> Reading | None:
        """Return the newest state that was not yet returned, after at most `wait` seconds.

        Older ones are skipped. None if no newer one has arrived; 0 s of `wait` does not block.

        Raises:
            FlightError: the link failed; it may be called again.
        """

    @abc.abstractmethod
    def send(self, u: Sequence[float]) -> None:
        """Send an input (m,) in the units of law.json; it holds until the next one.

        Raises:
            FlightError: the link failed; it may be called again.
        """

    @abc.abstractmethod
    def level_descend(self) -> None:
        """Let the vehicle level and descend, without any law; called every dt until it ends.

        It works without a state, keeps no promise of a place, and switches motors off at the
        ground.

        Raises:
            FlightError: the link failed; it may be called again.
        """

    @abc.abstractmethod
    def close(self) -> None:
        """Let go of the link; the vehicle is left to its watchdog. It never raises."""


def listing(names: Iterable[str]) -> str:
    """Return names in back-ticks, separated by commas, for use inside a message."""
    return ", ".join(f"`{name}`" for name in names)


def check_scheme(address: str) -> str:
    """Return the scheme of an address such as `udp` or `px4://udpin:127.0.0.1:14540`.

    Raises:
        FlightError: there is no such link.
    """
    scheme = address.partition("://")[0]
    if scheme not in LINKS:
        raise FlightError(f"`--link` is `{address}`, and must begin with {listing(LINKS)}.")
    return scheme


def open_link(address: str, facts: Mapping[str, Any]) -> Link:
    """Return the link of an address.

    Raises:
        FlightError: there is no such link, or it cannot serve the law.
    """
    scheme, inputs = check_scheme(address), tuple(facts["inputs"])
    module, _, name = LINKS[scheme].partition(":")
    link: type[Link] = getattr(importlib.import_module(module), name)
    if link.inputs is not None and link.inputs != inputs:
        raise FlightError(
            f"the link `{scheme}` sends {listing(link.inputs)}, and the law has the inputs "
            f"{listing(inputs)}; use a model with the link's inputs."
        )
    if not link.watchdog and any("torque" in each for each in inputs):
        raise FlightError(
            f"the law sends torques, and the vehicle of the link `{scheme}` has no watchdog that "
            "levels it when they stop; use a model with attitudes or rates as inputs."
        )
    return link(address.partition("://")[2], facts)
