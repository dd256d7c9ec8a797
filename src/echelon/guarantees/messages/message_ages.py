"""How old the messages in use become on a network, in all but one run in a million.

A message that arrives is never replaced by an older one. So if a link loses at most L messages in a
row, the newest one that arrived was sent at most delay + jitter + (L + 1) periods ago.
"""

from typing import NamedTuple

import numpy as np

from echelon.agents.network.channel import Channel
from echelon.core.types import Array
from echelon.simulation.step.knowledge import HOP_LIFE

RARE = 1e-6
"""The share of runs in which a link may lose more messages in a row."""
_GRID = 2.0**-23
"""Of the draws, which are floats of 24 bits: so much more is lost at most."""


class AgeLimits(NamedTuple):
    """Ages in control steps, of messages while they are in use; an input is held for one more.

    Attributes:
        lost: how many messages a link loses in a row at most; None where a link may lose all of a
            run.
        arrived: of the newest message on a link; None likewise.
        forgotten: from which on a deviation is not used.
        hops: how far the farthest agent is from a leader.
        dt: a step, s.
        mean: of the newest message, s, on average.
    """

    lost: int | None
    arrived: int | None
    forgotten: int
    hops: int
    dt: float
    mean: float

    @property
    def oldest(self) -> int:
        """The age beyond which no deviation is used, in steps."""
        return self.forgotten if self.arrived is None else min(self.arrived, self.forgotten)

    @property
    def first_packet(self) -> float | None:
        """The time (s) after which everybody has a packet, none older than this; None for never."""
        return None if self.arrived is None else self.hops * self.arrived * self.dt

    @property
    def hop_life(self) -> int:
        """The age, in steps, to which hop counts are used."""
        return HOP_LIFE * (self.forgotten - 1)

    @property
    def hops_last(self) -> bool:
        """Whether a link delivers before the hop counts that it delivered are forgotten."""
        return self.arrived is not None and self.arrived <= self.hop_life


def ages_of(channel: Channel, dt: float, steps: int, links: int, hops: int) -> AgeLimits:
    """Return the ages on a number of links in a run of so many steps (dt in s)."""
    every, delay, jitter = (int(x) for x in (channel.every, channel.delay, channel.jitter))
    lost = losses_in_a_row(channel, links, -(-steps // every))
    arrived = None if lost is None else delay + jitter + every * (lost + 1)
    starts, step = _outages(channel)
    # One for each number of messages that are lost in a row at the end.
    rest = np.eye(2) - step
    # What is lost for good is as old as the run, as in an outage that does not end.
    ends = channel.loss < 1.0 and step[1, 1] < 1.0
    again = float((starts[0] @ np.linalg.inv(rest)).sum()) if ends else steps / every
    mean = dt * (delay + 0.5 * jitter + 0.5 * (every - 1) + every * again)
    return AgeLimits(lost, arrived, int(channel.forget) + 1, hops, dt, mean)


def losses_in_a_row(channel: Channel, links: int, messages: int) -> int | None:
    """Return how many messages a link loses in a row at most, in all but `RARE` of runs.

    With pi the shares of a link that works or is out, P the chances of its next message and D the
    chances that one is lost, L + 1 given messages are lost with probability pi'D (P D)^L 1, and
    there are fewer places for them than messages on all links.

    Args:
        channel: of the run.
        links: how many.
        messages: on each of them.
    """
    starts, step = _outages(channel)

    def fits(more: int) -> bool:
        chance = (starts @ np.linalg.matrix_power(step, more)).sum(axis=1).max()
        return links * messages * float(chance) <= RARE

    # What can be lost is, now and then, however seldom.
    low, high = -1 + bool(channel.loss > 0.0 or channel.bursty), messages - 1
    if not fits(high):
        return None
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (low, middle) if fits(middle) else (middle, high)
    return high


def _outages(channel: Channel) -> tuple[Array, Array]:
    """Return pi'D (2, 2), a row for each of two moments, and P D (2, 2) of the same."""
    loss, share, begins, ends = (
        float(x) for x in (channel.loss, channel.share, channel.begins, channel.ends)
    )
    if not channel.bursty:
        begins, share, ends = 0.0, 0.0, 1.0
    loss, stays = min(1.0, loss + _GRID * (loss > 0.0)), min(1.0, 1.0 - ends + _GRID)
    begins = min(1.0, begins + _GRID * (begins > 0.0))
    step = np.array([[1.0 - begins, begins], [1.0 - stays, stays]]) @ np.diag([loss, 1.0])
    # The share of links that are out ends between its first two values, or at the first.
    later = (1.0 - share) * begins + share * stays
    return np.array([[1.0 - out, out] for out in (share, later)]) * [loss, 1.0], step
