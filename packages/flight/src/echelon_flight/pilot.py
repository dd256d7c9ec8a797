"""One agent's tick: from its state and the last letters of others to its input and its own letter.

What it does with both is in the exported law alone. Here is only which letters it may see.
"""

import itertools
import math
from collections.abc import Collection, Mapping
from types import ModuleType
from typing import Any, Final, NamedTuple, final

from echelon_flight.parameters import DEFAULTS
from echelon_flight.wire import Drop, Message

NOBODY: Final = 0xFFFF
"""The leader of an agent that knows none, as reports have it."""


@final
class Letterbox:
    """The newest letter of each agent whose letters the law uses.

    Args:
        facts: the content of law.json.
        backups: those that may take the lead, in a later term; any other leader has none.
        ahead: s; by so much a letter may be ahead of the receiver.

    Attributes:
        letters: by sender; None before the first.
    """

    def __init__(
        self,
        facts: Mapping[str, Any],
        backups: Collection[int] = (),
        ahead: float = DEFAULTS["letter_ahead"],
    ) -> None:
        """Receive nothing yet."""
        self._ahead = ahead
        self.letters = dict[int, Message | None].fromkeys(facts["hears"])
        sizes = facts["message"]
        places = dict(zip(sizes, itertools.accumulate(sizes.values(), initial=0), strict=False))
        self._leader, self._said, self._term = places["leader"], places["said"], places.get("term")
        self._leaders = frozenset(facts["network"]["leaders"]) - {*backups}
        self._backups, self._none = frozenset(backups), [math.nan] * sum(sizes.values())

    def receive(self, letter: Message, clock: float) -> Drop | None:
        """Store a letter at a time of the plan (s), or return why it is not used."""
        if letter.sender not in self.letters:
            return Drop.SENDER
        leader, said = self.leader_in(letter), letter.row[self._said]
        term = 0.0 if self._term is None else letter.row[self._term]
        if max(letter.time, said) > clock + self._ahead:
            return Drop.AHEAD
        # A term that is no whole number would win over the next one.
        if term % 1.0 or term < 0.0 or leader not in (self._backups if term else self._leaders):
            return Drop.PACKET
        # What is older says nothing new: an agent's packet is never an older one again.
        before = self.letters[letter.sender]
        if before is not None and not letter.time > before.time:
            return Drop.OLD
        self.letters[letter.sender] = letter
        return None

    def leader_in(self, letter: Message) -> int:
        """Return whose packet a letter has."""
        return int(letter.row[self._leader])

    @property
    def rows(self) -> list[float]:
        """What the law receives: the numbers of each sender's letter, NaN for none."""
        letters = self.letters.values()
        return [number for x in letters for number in (self._none if x is None else x.row)]

    def ages(self, clock: float) -> list[float]:
        """Return how old the newest letter of each sender is, s; infinite for none."""
        letters = self.letters.values()
        return [math.inf if x is None else max(0.0, clock - x.time) for x in letters]


class TickResult(NamedTuple):
    """What a tick gives: the input (m,), a letter where there is something to say, and faith in it.

    `valid` is False if anything that the input rests on is not finite: it is then the last one.
    """

    u: list[float]
    letter: Message | None
    valid: bool


@final
class Pilot:
    """Runs an exported law on what is received.

    Args:
        law: the module `law.py`.
        facts: the content of law.json.
        backups: those that may take the lead.
        ahead: as `Letterbox` has it.

    Attributes:
        box: what it received.
        leader: whom it follows: its own number if it leads, `NOBODY` before it knows a leader.
    """

    def __init__(
        self,
        law: ModuleType,
        facts: Mapping[str, Any],
        backups: Collection[int] = (),
        ahead: float = DEFAULTS["letter_ahead"],
    ) -> None:
        """Begin without a memory."""
        self._law, self._number = law, facts["agent"]
        self.box = Letterbox(facts, backups, ahead)
        self.leader = self._number if facts["leads"] else NOBODY
        self._memory: list[float] | None = None
        self._last: TickResult | None = None

    def tick(self, t: float, x: list[float]) -> TickResult:
        """Return what the agent does at a time of the plan (s) where it measures a state (n,)."""
        memory = self._law.begin(x) if self._memory is None else self._memory
        u, after, row, valid = self._law.step(t, x, self.box.rows, memory)
        if not valid:
            return self._last._replace(valid=False) if self._last else TickResult(u, None, False)
        # An agent that has heard of no leader says nothing: the time of its letter is NaN.
        letter = None if math.isnan(row[0]) else Message(self._number, tuple(row))
        if letter is not None:
            self.leader = self.box.leader_in(letter)
        self._memory, self._last = after, TickResult(u, letter, True)
        return self._last
