"""The link to a simulated vehicle on this machine, by UDP; its other end: `simulated_vehicles`."""

import contextlib
import math
import select
import socket
import struct
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, Final, final

from echelon_flight import FlightError
from echelon_flight.links import Link, Reading

PORT: Final = 47500
HELLO: Final = 0
INPUT: Final = 1
DESCEND: Final = 2
HEAD: Final = struct.Struct("<BH")
"""Of what a link sends: what it is, and the number of the agent; inputs follow."""


@final
class UdpLink(Link):
    """A simulated vehicle; its address is `HOST:PORT`, by default that of this machine."""

    watchdog: ClassVar[bool] = True

    def __init__(self, address: str, facts: Mapping[str, Any]) -> None:
        """Say hello."""
        host, _, port = (address or f"127.0.0.1:{PORT}").rpartition(":")
        if not port.isdecimal():
            raise FlightError(f"`--link` is `udp://{address}`, and must be as `udp://HOST:PORT`.")
        self._number, self._n = facts["agent"], len(facts["states"])
        self._input = struct.Struct(f"<{len(facts['inputs'])}d")
        self._state = struct.Struct(f"<{2 + self._n}d")
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        self._time = -math.inf
        try:
            self._socket.connect((host or "127.0.0.1", int(port)))
        except (OSError, OverflowError):
            raise FlightError(f"the vehicle at `udp://{address}` cannot be reached.") from None
        self._say(HELLO)

    def read(self, wait: float) -> Reading | None:
        """Return the newest state that was not yet returned."""
        newest = self._newest()
        if newest is None and wait > 0.0:
            select.select([self._socket], [], [], wait)
            newest = self._newest()
            if newest is None:
                self._say(HELLO)
        return newest

    def _newest(self) -> Reading | None:
        reading = None
        # A simulation that has not yet begun refuses.
        with contextlib.suppress(OSError):
            while True:
                datagram = self._socket.recv(2048)
                if len(datagram) != self._state.size:
                    continue
                time, battery, *x = self._state.unpack(datagram)
                if time > self._time:
                    self._time = time
                    reading = Reading(time, x, None if math.isnan(battery) else battery)
        return reading

    def send(self, u: Sequence[float]) -> None:
        """Send an input."""
        self._say(INPUT, self._input.pack(*u))

    def level_descend(self) -> None:
        """Let the simulated autopilot level and descend."""
        self._say(DESCEND)

    def _say(self, what: int, rest: bytes = b"") -> None:
        with contextlib.suppress(ConnectionRefusedError, BlockingIOError):
            self._socket.send(HEAD.pack(what, self._number) + rest)

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()
