"""What one agent receives: messages that name their values, of each neighbour the last good one."""

import numbers
from collections.abc import Sequence
from typing import NamedTuple, final

import numpy as np
from jaxtyping import Float

from echelon.agents.network.channel import NEVER
from echelon.core.types import Array
from echelon.core.words import Word

LARGEST = 1e12
"""Of a value, in its own unit: a product of some of them is still finite."""


class Received(Word):
    """What becomes of a message."""

    TAKEN = "it is used until the next one of the same sender"
    NO_MESSAGE = "it is not a `Message` of names and numbers"
    NOT_HEARD = "its sender is not a neighbour of the receiver"
    WRONG_SIZE = "it has not one value for each name, or no name that the receiver uses"
    NOT_FINITE = "a value is not finite, or larger than 1e12"
    LATE = "a newer one of the same sender was received before"
    AHEAD = "its time is ahead of the receiver's clock"


class NamedValues(NamedTuple):
    """Values (s,) with their names, so that unlike agents use what both have."""

    names: tuple[str, ...]
    values: Array


class LeaderPacket(NamedTuple):
    """What a leader last said of itself, passed on unchanged.

    Attributes:
        leader: its number.
        time: when it said so, s.
        content: its deviation from its plan, or what else the prediction needs (p,).
        term: how often backup leaders took the lead over.
    """

    leader: int
    time: float
    content: tuple[float, ...]
    term: int = 0


class Message(NamedTuple):
    """What an agent sends.

    Attributes:
        sender: its number.
        signal: what its neighbours use: its state less its offset, or the signal of its law; over
            a network that is late, its deviation from where it expects the leader.
        feedforward: the feed-forward of its input, of the same step; None before it has acted, and
            over a network that is late.
        time: when it was sent, s; None in the ideal network.
        hops: to a leader, as counted by messages.
        packet: the newest of a leader; None before it has one.
        hull: where agents keep apart, the points in whose hull the sender's position stays; over a
            network that is late, less those of the leader as expected.
    """

    sender: int
    signal: NamedValues
    feedforward: NamedValues | None = None
    time: float | None = None
    hops: int = 0
    packet: LeaderPacket | None = None
    hull: NamedValues | None = None


class Inbox:
    """The last good message of each neighbour in the ideal network; NaN for what was not received.

    Args:
        senders: the neighbours, in the order of `signals`.
        source: whose feed-forward is used; None for nobody's.
        names: of the signal's values.
        forward_names: of the feed-forward's values.

    Attributes:
        signals: (K, s).
        feedforward: (k,).
        clock: the receiver's time, s.
    """

    signals: Float[Array, "K s"]
    feedforward: Float[Array, " k"]

    def __init__(
        self,
        senders: Sequence[int],
        source: int | None,
        names: tuple[str, ...],
        forward_names: tuple[str, ...],
    ) -> None:
        self._senders, self._source, self.clock = tuple(senders), source, 0.0
        self._names, self._forward_names = names, forward_names
        self.signals = np.full((len(senders), len(names)), np.nan)
        self.feedforward = np.full(len(forward_names), np.nan)

    def receive(self, message: object) -> Received:
        """Store a message whose values are finite numbers with names that this agent uses."""
        if not isinstance(message, Message) or not isinstance(message.sender, numbers.Integral):
            return Received.NO_MESSAGE
        if not self._hears(message.sender):
            return Received.NOT_HEARD
        # Both before either is stored, so that a message is taken as a whole.
        values = read_values(message.signal)
        forward = {} if message.feedforward is None else read_values(message.feedforward)
        if isinstance(values, Received) or isinstance(forward, Received):
            return next(part for part in (values, forward) if isinstance(part, Received))
        if not {*self._names} & {*values}:
            return Received.WRONG_SIZE
        taken = self._stamp(message)
        if taken is Received.TAKEN:
            place = [who == message.sender for who in self._senders]
            self.signals[place] = [values.get(name, np.nan) for name in self._names]
            if message.sender == self._source and forward:
                self.feedforward[:] = [forward.get(name, np.nan) for name in self._forward_names]
        return taken

    def newer(self, message: Message, before: float) -> bool:
        """Tell whether a message is newer than what came `before` (s): here all are."""
        return True

    def _hears(self, sender: object) -> bool:
        return sender in (*self._senders, self._source)

    def _stamp(self, message: Message) -> Received:
        """Store when a message was sent, and what else comes with it."""
        return Received.TAKEN


@final
class LateInbox(Inbox):
    """The same over a late network, with times, hops and packets.

    Which packet counts is decided where the messages are read.

    Args:
        leaders: the numbers of those that lead or may.
        size: of a packet's content.
        needs_packet: whether a message says nothing without one.
        terms: whether the lead is handed over, in later terms.

    Attributes:
        time: (K,) when each was sent, s; `NEVER` for none.
        hops: (K,) of its sender.
        leader, said, term: (K,) of its packet: whose, of when (s; `NEVER` for none), of which term.
        content: (K, p) of its packet.
    """

    def __init__(
        self,
        senders: Sequence[int],
        source: int | None,
        names: tuple[str, ...],
        forward_names: tuple[str, ...],
        leaders: Sequence[int],
        size: int,
        needs_packet: bool,
        terms: bool,
    ) -> None:
        super().__init__(senders, source, names, forward_names)
        links, self._needs_packet = len(senders), needs_packet
        self.time, self.hops = np.full(links, float(NEVER)), np.full(links, _FAR, np.int32)
        self.leader, self.said = self.hops.copy(), self.time.copy()
        self.term, self.content = np.zeros(links, np.int32), np.zeros((links, size))
        # Where nobody hands the lead over, a packet of a later term would win for ever.
        self._leaders, self._last_term = frozenset(leaders), _FAR * terms

    def newer(self, message: Message, before: float) -> bool:
        """Tell whether a message is newer than what came `before` (s), and not of the future."""
        sent = message.time
        return _is_time(sent) and before < sent <= self.clock + _AHEAD  # pyright: ignore

    def _hears(self, sender: object) -> bool:
        return sender in self._senders

    def _stamp(self, message: Message) -> Received:
        packet = message.packet
        if not (isinstance(packet, LeaderPacket) or packet is None and not self._needs_packet):
            return Received.NO_MESSAGE
        times = [message.time, *([] if packet is None else [packet.time])]
        if not all(map(_is_time, times)) or not isinstance(message.hops, numbers.Integral):
            return Received.NO_MESSAGE
        if max(times) > self.clock + _AHEAD:  # pyright: ignore - numbers, as just checked
            return Received.AHEAD
        values = () if packet is None else self._content_of(packet)
        if isinstance(values, Received):
            return values
        # What is older says nothing new: an agent's packet is never an older one again.
        place = self._senders.index(message.sender)
        if not self.newer(message, self.time[place]):
            return Received.LATE
        self.time[place] = message.time
        self.hops[place] = min(max(int(message.hops), 0), _FAR)
        if packet is not None:
            self.leader[place], self.said[place] = packet.leader, packet.time
            self.term[place], self.content[place] = packet.term, values
        return Received.TAKEN

    def _content_of(self, packet: LeaderPacket) -> tuple[float, ...] | Received:
        whole = all(isinstance(x, numbers.Integral) for x in (packet.leader, packet.term))
        if not (whole and packet.leader in self._leaders and 0 <= packet.term <= self._last_term):
            return Received.NO_MESSAGE
        size = self.content.shape[1]
        values = read_values((tuple(map(str, range(size))), packet.content))
        return values if isinstance(values, Received) else tuple(values.values())


@final
class Surroundings:
    """The last good hull of every other agent, whatever the graph.

    Args:
        senders: the others.
        names: of the numbers of a hull.
        inbox: which tells newer messages from older ones.

    Attributes:
        names: likewise.
        hulls: (K, h), NaN for what was not received.
    """

    hulls: Float[Array, "K h"]

    def __init__(self, senders: Sequence[int], names: tuple[str, ...], inbox: Inbox) -> None:
        self._places, self.names = {who: k for k, who in enumerate(senders)}, names
        self.hulls, self._inbox = np.full((len(senders), len(names)), np.nan), inbox
        self._time = np.full(len(senders), float(NEVER))

    def take(self, message: object) -> bool:
        """Store a hull, and tell whether it is of use."""
        if not isinstance(message, Message) or not isinstance(message.sender, numbers.Integral):
            return False
        place = self._places.get(int(message.sender))
        values = {} if message.hull is None else read_values(message.hull)
        if place is None or isinstance(values, Received) or {*values} != {*self.names}:
            return False
        if not self._inbox.newer(message, self._time[place]):
            return False
        self._time[place] = NEVER if message.time is None else message.time
        self.hulls[place] = [values[name] for name in self.names]
        return True


_FAR = 2**23
"""Hops of a sender that no leader reaches."""
_AHEAD = 0.05
"""s; by so much clocks may differ."""


def _is_time(value: object) -> bool:
    # Compared before it is a float, which a whole number of 400 digits cannot be.
    return isinstance(value, numbers.Real) and bool(-LARGEST < value < LARGEST)  # pyright: ignore


def read_values(part: object) -> dict[str, float] | Received:
    """Return the named values of a part of a message, or what is wrong with it."""
    if not isinstance(part, tuple) or len(part) != 2 or not isinstance(part[0], list | tuple):
        return Received.NO_MESSAGE
    try:
        values = np.asarray(part[1])
    except ValueError:  # lists of unequal lengths
        return Received.NO_MESSAGE
    if values.dtype.kind not in "iuf":
        return Received.NO_MESSAGE
    names = [*map(str, part[0])]
    if values.shape != (len(names),) or len({*names}) != len(names):
        return Received.WRONG_SIZE
    # As floats: the least whole number of 64 bits has no absolute value of its own kind.
    values = values.astype(float)
    if not (np.abs(values) <= LARGEST).all():
        return Received.NOT_FINITE
    return dict(zip(names, values.tolist(), strict=True))
