"""The datagrams of one process: a socket to hear with, and whom to tell."""

import contextlib
import errno
import ipaddress
import socket
from collections.abc import Iterator, Sequence
from typing import Final, Protocol, TypeAlias, final

from echelon_flight import FlightError

Address: TypeAlias = tuple[str, int]
LOOPBACK: Final = "127.0.0.1"
PORT: Final = 47100
"""Of agent 0; others have the next ones, and the ground station the last of them."""
_LONGEST: Final = 2048
_MOST: Final = 200


def read_address(text: str, option: str) -> Address:
    """Return host and port of a text such as `239.255.71.1:47100`.

    Raises:
        FlightError: it is none.
    """
    host, _, port = text.rpartition(":")
    try:
        ipaddress.IPv4Address(host)
    except ValueError:
        host = ""
    if not host or not port.isdecimal() or not 0 < int(port) < 65536:
        raise FlightError(
            f"`{option}` is `{text}`, and must be an IPv4 address and a port such as "
            "`239.255.71.1:47100`."
        )
    return host, int(port)


def ports_of(agents: int, base: int = PORT) -> list[Address]:
    """Return where processes on this machine listen: each agent, and the ground station."""
    return [(LOOPBACK, base + k) for k in range(agents + 1)]


class Datagrams(Protocol):
    """What an agent sends datagrams to others with."""

    def send(self, datagram: bytes) -> None:
        """Send a datagram to all."""

    def receive(self) -> Iterator[bytes]:
        """Yield the datagrams that have arrived."""
        ...

    def skip(self) -> None:
        """Skip what arrived while nobody listened."""

    def close(self) -> None:
        """Close the socket."""


@final
class DatagramSocket:
    """Sends and receives datagrams.

    Args:
        listen: an address of this machine, or a multicast group.
        to: where datagrams go.
        interface: the address of this machine on the network of a multicast group; on the loopback
            interface nothing leaves the machine.

    Raises:
        FlightError: the address is in use, or is not this machine's.
    """

    def __init__(self, listen: Address, to: Sequence[Address], interface: str = LOOPBACK) -> None:
        """Open the socket."""
        self._to = [each for each in to if each != listen or _is_group(listen)]
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        try:
            self._open(listen, interface)
        except OSError as error:
            self._socket.close()
            raise _refusal(listen, error) from None

    def _open(self, listen: Address, interface: str) -> None:
        if not _is_group(listen):
            self._socket.bind(listen)
            return
        # Several agents on one machine share the group.
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        self._socket.bind(listen)
        own = socket.inet_aton(interface)
        member = {socket.IP_ADD_MEMBERSHIP: socket.inet_aton(listen[0]) + own}
        for option, value in (member | _to_group(interface)).items():
            self._socket.setsockopt(socket.IPPROTO_IP, option, value)

    def send(self, datagram: bytes) -> None:
        """Send a datagram to all; who cannot be reached now gets the next one."""
        for address in self._to:
            with contextlib.suppress(OSError):
                self._socket.sendto(datagram, address)

    def receive(self) -> Iterator[bytes]:
        """Yield the datagrams that have arrived, some hundred at most."""
        # Whoever floods the port delays no tick for ever.
        with contextlib.suppress(OSError):
            for _ in range(_MOST):
                yield self._socket.recv(_LONGEST)

    def skip(self) -> None:
        """Skip what arrived while nobody listened."""
        while any(True for _ in self.receive()):
            pass

    def fileno(self) -> int:
        """Return what `select` waits for."""
        return self._socket.fileno()

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()


def _is_group(address: Address) -> bool:
    return ipaddress.IPv4Address(address[0]).is_multicast


def _to_group(interface: str) -> dict[int, bytes | int]:
    """Return the options of a socket that sends to a group by an interface."""
    alone = ipaddress.IPv4Address(interface).is_loopback
    return {
        socket.IP_MULTICAST_IF: socket.inet_aton(interface),
        socket.IP_MULTICAST_TTL: 0 if alone else 1,
        socket.IP_MULTICAST_LOOP: 1,
    }


def tell_once(datagram: bytes, to: Sequence[Address], interface: str = LOOPBACK) -> None:
    """Send a datagram from no port of the flight, as a process does that cannot begin."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as out, contextlib.suppress(OSError):
        for option, value in _to_group(interface).items():
            out.setsockopt(socket.IPPROTO_IP, option, value)
        for address in to:
            out.sendto(datagram, address)


def bound(port: int) -> socket.socket:
    """Return a socket at a port of this machine.

    Raises:
        FlightError: it is in use.
    """
    result = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        result.bind((LOOPBACK, port))
    except OSError as error:
        result.close()
        raise _refusal((LOOPBACK, port), error) from None
    return result


def _refusal(address: Address, error: OSError) -> FlightError:
    why = f"cannot be used ({(error.strerror or '').lower()})"
    if error.errno == errno.EADDRINUSE:
        why = "is in use; a process with the same number, or another flight, may run here"
    return FlightError(f"the address {address[0]}:{address[1]} {why}.")
