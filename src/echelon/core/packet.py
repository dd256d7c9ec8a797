"""What a leader last said of itself, on simulated networks and in the air."""

from typing import NamedTuple


class Packet(NamedTuple):
    """What a leader last said of itself, passed on unchanged.

    Attributes:
        leader: its number.
        time: of the plan, when it said so, s.
        content: its deviation from its plan, or what else the prediction needs (p,).
        epoch: how often heirs took the lead over.
    """

    leader: int
    time: float
    content: tuple[float, ...]
    epoch: int = 0

    @property
    def rank(self) -> tuple[int, int, float]:
        """By which the greater of two packets is used: later epoch, lower leader, newer."""
        return self.epoch, -self.leader, self.time
