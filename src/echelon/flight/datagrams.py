"""What datagrams there are, and why one is not used."""

import enum


class DatagramKind(enum.IntEnum):
    """What a datagram is."""

    LETTER = 1
    START = 2
    STOP = 3
    REPORT = 4
    NOTE = 5


class Drop(enum.Enum):
    """Why a datagram is not used."""

    LENGTH = "has a length that no datagram of this formation has"
    VERSION = "is of another version of the protocol"
    FORMATION = "is of another formation"
    SIGNATURE = "is signed with another key"
    NOT_FINITE = "has a number that is not finite"
    TOO_LARGE = "has a deviation larger than 1e6"
    CLOCK = "has a time stamp that differs from this clock by more than 1 s"
    OLD = "is not newer than the last one from its sender"
    SENDER = "is from a sender that this process does not listen to"
    AHEAD = "has a time stamp ahead of this clock"
    PACKET = "has no packet of a leader"
    EARLY = "came before the start"
    START = "gives the start by a clock that differs from this one by more than 0.1 s"
    FLIGHT = "is of another flight"
    CHALLENGE = "answers an earlier process of this agent"
