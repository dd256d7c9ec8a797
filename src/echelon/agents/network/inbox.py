"""What one agent receives: messages that name their values, of each neighbour the last good one."""

import numbers
from collections.abc import Sequence
from typing import NamedTuple, final

import numpy as np
from jaxtyping import Float

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


class NamedValues(NamedTuple):
    """Values (s,) with their names, so that unlike agents use what both have."""

    names: tuple[str, ...]
    values: Array


class Message(NamedTuple):
    """What an agent sends.

    Attributes:
        sender: its number.
        signal: what its neighbours use: its state less its offset, or the signal of its law.
        feedforward: the feed-forward of its input, of the same step; None before it has acted.
    """

    sender: int
    signal: NamedValues
    feedforward: NamedValues | None = None


@final
class Inbox:
    """The last good message of each neighbour; NaN for what was not received.

    Args:
        senders: the neighbours, in the order of `signals`.
        source: whose feed-forward is used; None for nobody's.
        names: of the signal's values.
        forward_names: of the feed-forward's values.

    Attributes:
        signals: (K, s).
        feedforward: (k,).
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
        """Receive nothing yet."""
        self._senders, self._source = tuple(senders), source
        self._names, self._forward_names = names, forward_names
        self.signals = np.full((len(senders), len(names)), np.nan)
        self.feedforward = np.full(len(forward_names), np.nan)

    def receive(self, message: object) -> Received:
        """Store a message whose values are finite numbers with names that this agent uses."""
        if not isinstance(message, Message) or not isinstance(message.sender, numbers.Integral):
            return Received.NO_MESSAGE
        if message.sender not in (*self._senders, self._source):
            return Received.NOT_HEARD
        # Both before either is stored, so that a message is taken as a whole.
        values = _read(message.signal)
        forward = {} if message.feedforward is None else _read(message.feedforward)
        if isinstance(values, Received) or isinstance(forward, Received):
            return next(part for part in (values, forward) if isinstance(part, Received))
        if not {*self._names} & {*values}:
            return Received.WRONG_SIZE
        place = [who == message.sender for who in self._senders]
        self.signals[place] = [values.get(name, np.nan) for name in self._names]
        if message.sender == self._source and forward:
            self.feedforward[:] = [forward.get(name, np.nan) for name in self._forward_names]
        return Received.TAKEN


def _read(part: object) -> dict[str, float] | Received:
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
    if not (np.abs(values) <= LARGEST).all():
        return Received.NOT_FINITE
    return dict(zip(names, values.tolist(), strict=True))
