"""What one agent keeps of the letters that it receives: the rules of `Stamps`, on plain floats.

`agents/network/inbox.py` states them for simulations; a test sends both the same letters.
"""

import math
from collections.abc import Collection, Sequence
from typing import Final, final

from echelon.core.packet import Packet
from echelon.flight.datagrams import Drop
from echelon.flight.wire import Letter

NOBODY: Final = 0xFFFF
"""Hops of an agent that no leader reaches, and the leader of one that knows none, as datagrams have
them."""
_AHEAD: Final = 0.05
"""s; by so much a letter may be ahead of the receiver."""


@final
class Letterbox:
    """The newest letter of each neighbour, and the newest packet of the leader with most rank.

    Args:
        hears: the numbers of the neighbours.
        leaders: of those whose packets count; the lowest one first.
        own: the agent's number, if it leads.
        heirs: of those that may lead later, with a higher epoch.

    Attributes:
        letters: of each neighbour; None before the first.
        packet: None before the first.
    """

    def __init__(
        self,
        hears: Sequence[int],
        leaders: Collection[int],
        own: int | None,
        heirs: Collection[int] = (),
    ) -> None:
        """Receive nothing yet."""
        self.letters = dict[int, Letter | None].fromkeys(hears)
        self._leaders, self._own = frozenset(leaders), own
        self._heirs = frozenset(heirs)
        self.packet: Packet | None = None

    def receive(self, letter: Letter, clock: float) -> Drop | None:
        """Store a letter at a time of the plan (s), or return why it is not used."""
        packet = letter.packet
        if letter.sender not in self.letters:
            return Drop.SENDER
        if packet is None:
            return Drop.PACKET
        if max(letter.time, packet.time) > clock + _AHEAD:
            return Drop.AHEAD
        if packet.leader not in (self._heirs if packet.epoch else self._leaders):
            return Drop.PACKET
        if self._wins(packet):
            self.packet = packet
        # A late letter may yet bring a newer packet, by another way.
        before = self.letters[letter.sender]
        if before is not None and not letter.time > before.time:
            return Drop.OLD
        self.letters[letter.sender] = letter
        return None

    def _wins(self, packet: Packet) -> bool:
        """Tell whether a packet is of a later epoch, a leader with a lower number, or newer."""
        if self._own is not None and packet.leader >= self._own and not packet.epoch:
            return False
        return self.packet is None or packet.rank > self.packet.rank

    def ages(self, clock: float) -> list[float]:
        """Return how old the newest letter of each neighbour is, s; infinite for none."""
        letters = self.letters.values()
        return [math.inf if x is None else max(0.0, clock - x.time) for x in letters]
