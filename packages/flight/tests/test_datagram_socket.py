"""Sockets: unicast and multicast on this machine alone."""

import socket
import time

import pytest
from free_port import free_port

from echelon_flight import FlightError
from echelon_flight.datagram_socket import (
    LOOPBACK,
    DatagramSocket,
    bound,
    read_address,
    tell_once,
)


def heard(air):
    for _ in range(100):
        if datagrams := list(air.receive()):
            return datagrams
        time.sleep(0.01)
    return []


def test_a_datagram_reaches_the_others_and_not_its_sender():
    ways = [(LOOPBACK, free_port()) for _ in range(3)]
    airs = [DatagramSocket(way, ways) for way in ways]
    airs[0].send(b"hello")
    assert [heard(air) for air in airs[1:]] == [[b"hello"], [b"hello"]]
    assert not list(airs[0].receive())
    for air in airs:
        air.close()


def test_a_group_is_heard_on_the_loopback_interface_alone():
    way = "239.255.71.9", free_port()
    first, second = (DatagramSocket(way, [way]) for _ in range(2))
    assert first._socket.getsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_TTL) == 0
    first.send(b"to all")
    assert heard(second) == [b"to all"]
    first.close()
    second.close()


def test_a_port_in_use_is_one_sentence():
    way = LOOPBACK, free_port()
    first = DatagramSocket(way, [])
    used = r"is in use; a process with the same number, or another flight, may run here\.$"
    for listen in (lambda: DatagramSocket(way, []), lambda: bound(way[1])):
        with pytest.raises(FlightError, match=used):
            listen()
    first.close()
    with pytest.raises(FlightError, match=r"203\.0\.113\.1:\d+ cannot be used \(.*\)\.$"):
        DatagramSocket(("203.0.113.1", way[1]), [])


def test_who_has_no_port_is_heard_too():
    for host in (LOOPBACK, "239.255.71.9"):
        way = host, free_port()
        air = DatagramSocket(way, [])
        tell_once(b"no port", [way])
        assert heard(air) == [b"no port"]
        tell_once(b"old", [way])
        time.sleep(0.02)
        air.skip()
        assert not list(air.receive())
        air.close()


def test_a_flood_ends_each_time():
    way = LOOPBACK, free_port()
    air, source = DatagramSocket(way, []), DatagramSocket((LOOPBACK, free_port()), [way])
    for _ in range(1_000):
        source.send(b"x")
    assert len(list(air.receive())) <= 200
    air.close()
    source.close()


@pytest.mark.parametrize(
    "text", ["", "47100", "host:1", "1.2.3.4", "1.2.3.4:0", "1.2.3.4:70000", "1.2.3:5"]
)
def test_addresses_are_checked(text):
    with pytest.raises(FlightError, match="must be an IPv4 address and a port such as"):
        read_address(text, "--to")
    assert read_address("239.255.71.1:47100", "--to") == ("239.255.71.1", 47100)
