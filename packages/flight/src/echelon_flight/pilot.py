"""One agent's tick: from its state and its letters to its input and its own letter.

The numbers are those of the exported law. The rules about letters are those of echelon's
simulations; tests of echelon fly both beside each other.
"""

import math
from collections.abc import Collection, Mapping, Sequence
from types import ModuleType
from typing import Any, Final, NamedTuple, final

from echelon_flight.wire import Drop, LeaderPacket, Message

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
        backups: of those that may lead later, with a higher term.

    Attributes:
        letters: of each neighbour; None before the first.
        packet: None before the first.
    """

    def __init__(
        self,
        hears: Sequence[int],
        leaders: Collection[int],
        own: int | None,
        backups: Collection[int] = (),
    ) -> None:
        """Receive nothing yet."""
        self.letters = dict[int, Message | None].fromkeys(hears)
        self._leaders, self._own = frozenset(leaders), own
        self._backups = frozenset(backups)
        self.packet: LeaderPacket | None = None

    def receive(self, letter: Message, clock: float) -> Drop | None:
        """Store a letter at a time of the plan (s), or return why it is not used."""
        packet = letter.packet
        if letter.sender not in self.letters:
            return Drop.SENDER
        if packet is None:
            return Drop.PACKET
        if max(letter.time, packet.time) > clock + _AHEAD:
            return Drop.AHEAD
        if packet.leader not in (self._backups if packet.term else self._leaders):
            return Drop.PACKET
        # What is older says nothing new: an agent's packet is never an older one again.
        before = self.letters[letter.sender]
        if before is not None and not letter.time > before.time:
            return Drop.OLD
        if self._wins(packet):
            self.packet = packet
        self.letters[letter.sender] = letter
        return None

    def _wins(self, packet: LeaderPacket) -> bool:
        """Tell whether a packet is of a later term, a leader with a lower number, or newer."""
        if self._own is not None and packet.leader >= self._own and not packet.term:
            return False
        return self.packet is None or packet.rank > self.packet.rank

    def ages(self, clock: float) -> list[float]:
        """Return how old the newest letter of each neighbour is, s; infinite for none."""
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
        leadership: `backups`, who take the lead in this order, and the `timeout` (s) of each; None
            for nobody.
        hold: age (s) of the newest letter of anybody from which on a follower no longer flies by
            the plan, but holds the place where it would come to rest.

    Attributes:
        box: what it received.
    """

    def __init__(
        self,
        law: ModuleType,
        facts: Mapping[str, Any],
        leadership: Mapping[str, Any] | None = None,
        hold: float = math.inf,
    ) -> None:
        """Begin without a memory."""
        self._law, self._facts, self._hold = law, facts, hold
        self._number, self.leads = facts["agent"], facts["leads"]
        self._network = facts["network"]
        self._leaderward = self._network["uses"] == "leaderward"
        own = self._number if self.leads else None
        backups = [] if leadership is None else leadership["backups"]
        self.box = Letterbox(facts["hears"], self._network["leaders"], own, backups)
        self._patience = math.inf
        if leadership is not None and self._number in backups:
            self._patience = leadership["timeout"] * (backups.index(self._number) + 1)
        self._began: float | None = None
        self._late = False
        self._memory: list[float] | None = None
        self._estimate: list[float] | None = None
        self._last: TickResult | None = None

    def tick(self, t: float, y: list[float]) -> TickResult:
        """Return what the agent does at a time of the plan (s) where it measures a state (n,)."""
        if not hasattr(self._law, "measure"):
            return self._act(t, y)
        before = self._law.estimate(y) if self._estimate is None else self._estimate
        x, estimate, valid = self._law.measure(y, before)
        result = self._act(t, x)
        if valid and result.valid:
            self._estimate = self._law.deliver(result.u, estimate)
        return result

    def _act(self, t: float, x: list[float]) -> TickResult:
        """Return what the agent does in a state (n,)."""
        memory = self._law.begin(x) if self._memory is None else self._memory
        # Who begins late does not know how often the others have turned.
        late = self._began is None and t > 0.0 and hasattr(self._law, "face")
        self._late = self._late or late
        self._inherit(t)
        leader, forward = self._expected(t, x, memory)
        if self._late and leader is not None and self.box.packet is not None:
            memory, self._late = self._law.face(memory, leader), False
        ages = self.box.ages(t)
        hops = self._hops(ages)
        z = self._disagreement(t, x, memory, leader, ages, hops)
        if not self._in_lead and min(ages, default=0.0) > self._hold:
            z, forward = [0.0] * len(z), self._stillness(t, x, memory, len(forward))
        u, after, _, _, *content, valid = self._law.tick(t, x, z, forward, memory)
        if not valid:
            return self._last._replace(valid=False) if self._last else TickResult(u, None, False)
        letter = self._letter(t, x, memory, leader, hops, content)
        self._memory, self._last = after, TickResult(u, letter, True)
        return self._last

    def _stillness(self, t: float, x: list[float], memory: list[float], size: int) -> list[float]:
        """Return the feed-forward of one who holds its place, though its offset may move."""
        still, dt = [0.0] * size, self._facts["dt"]
        if self._network["moves"]:
            before, after = (self._law.signal(at, x, memory) for at in (t - dt, t + dt))
            still[: len(before)] = [(b - a) / (2 * dt) for a, b in zip(before, after, strict=True)]
        return still

    @property
    def leader(self) -> int:
        """Whom it follows: its own number if it leads, `NOBODY` before it has heard of a leader."""
        nobody = self._number if self.leads else NOBODY
        return nobody if self.box.packet is None else self.box.packet.leader

    @property
    def _in_lead(self) -> bool:
        """Whether it leads, from the beginning or as a backup leader."""
        return self.leads or self.leader == self._number

    def _inherit(self, t: float) -> None:
        """Take the lead by the plan, as a backup leader that has heard of no leader for long."""
        packet = self.box.packet
        self._began = t if self._began is None else self._began
        waited = t - (self._began if packet is None else packet.time)
        if self.leads or not (self._in_lead or waited > self._patience):
            return
        term = 0 if packet is None else packet.term
        plan = (0.0,) * self._network["content"]
        self.box.packet = LeaderPacket(self._number, t, plan, term if self._in_lead else term + 1)

    def _expected(
        self, t: float, x: list[float], memory: list[float]
    ) -> tuple[list[float] | None, list[float]]:
        """Return the leader's signal as expected, and its feed-forward; None if it is not known."""
        silence, packet = [0.0] * len(self._facts["message"]), self.box.packet
        if packet is None:
            return (self._law.signal(t, x, memory) if self.leads else None), silence
        content, age = list(packet.content), max(0.0, t - packet.time)
        if hasattr(self._law, "pace"):
            rounds, duration = self._law.pace(age)
            for _ in range(int(rounds)):
                content = self._law.carry(content, duration)[0]
        leader, forward, _ = self._law.expected(t, content, age)
        return leader, forward

    def _hops(self, ages: Sequence[float]) -> int:
        """Return the hops to a leader, as counted by letters that are not too old."""
        letters = zip(self.box.letters.values(), ages, strict=True)
        lasting = [x.hops for x, age in letters if x and age <= self._network["forget_hops"]]
        nearest = min(lasting, default=NOBODY)
        # Agents that are cut off together would count each other up for ever.
        if self._in_lead:
            return 0
        return nearest + 1 if nearest + 1 < self._network["agents"] else NOBODY

    def _disagreement(
        self,
        t: float,
        x: list[float],
        memory: list[float],
        leader: list[float] | None,
        ages: Sequence[float],
        hops: int,
    ) -> list[float]:
        """Return z, the sum of weights times differences to where neighbours are expected."""
        nothing = [0.0] * len(self._facts["signal"])
        if leader is None:
            return nothing
        terms = list[tuple[float, list[float]]]()
        letters, weights = self.box.letters.values(), self._facts["weights"]
        for letter, age, weight in zip(letters, ages, weights, strict=True):
            fresh = letter is not None and age <= self._network["forget"]
            away = letter.value if letter is not None and fresh else nothing
            near = letter is not None and letter.hops < hops and (fresh or letter.hops == 0)
            if near or not self._leaderward:
                place = [a + b for a, b in zip(leader, away, strict=True)]
                terms.append((weight, self._law.difference(t, x, memory, place)))
        if self._in_lead and not self.leads:
            # A backup leader follows the plan alone.
            terms = [(sum(self._facts["weights"]), self._law.difference(t, x, memory, leader))]
        if not self._leaderward:
            return _weighted(terms, nothing)
        total = sum(weight for weight, _ in terms)
        if not total > 0.0:
            return self._law.difference(t, x, memory, leader)
        return [value / total for value in _weighted(terms, nothing)]

    def _letter(
        self,
        t: float,
        x: list[float],
        memory: list[float],
        leader: list[float] | None,
        hops: int,
        content: list[list[float]],
    ) -> Message | None:
        """Return what the agent says; None if it has heard of no leader."""
        packet = self.box.packet
        if packet is None and content:
            packet = LeaderPacket(self._number, t, tuple(content[0]))
        if packet is None or leader is None:
            return None
        own = packet.leader == self._number
        away = self._law.difference(t, x, memory, leader)
        value = [0.0] * len(away) if own else away
        return Message(self._number, t, hops, tuple(value), packet)


def _weighted(terms: Sequence[tuple[float, list[float]]], nothing: list[float]) -> list[float]:
    return [sum(w * gap[k] for w, gap in terms) for k in range(len(nothing))]
