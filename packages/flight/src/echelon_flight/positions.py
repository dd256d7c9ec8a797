"""Positions of vehicles from outside, such as motion capture, forwarded to their estimators.

A file of the user's has a class `Positions`, made without arguments, whose `poses()` yields
`(agent, x, y, z)` or `(agent, x, y, z, qx, qy, qz, qw)` for ever, in m and world axes x, y, z up.
"""

import math
import threading
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final, Protocol, final

from echelon_flight import FlightError
from echelon_flight.mission import load_module

_RATE: Final = 50.0
"""Positions a second that a vehicle is sent at most; others are left out."""


class Located(Protocol):
    """A link whose vehicle takes positions."""

    def expect_positions(self, within: float) -> None:
        """Fail if no position came within a time (s)."""

    def locate(self, pose: Sequence[float]) -> None:
        """Send place (m), with or without a quaternion (x, y, z, w)."""

    def lose(self, why: str) -> None:
        """Let the link fail, and so the vehicle descend."""


def load_positions(file: Path) -> Any:
    """Return the source that a file has.

    Raises:
        FlightError: it cannot be read, or has no class `Positions` with `poses`.
    """
    try:
        source = load_module(file).Positions()
        # Whatever the user's code raises is what is wrong with it.
    except Exception as error:
        raise FlightError(
            f"`{file}` gives no positions: {type(error).__name__}: {error}."
        ) from None
    if not callable(getattr(source, "poses", None)):
        raise FlightError(f"the class `Positions` in `{file}` has no method `poses`.")
    return source


@final
class PositionForwarder:
    """Forwards positions from a source to vehicles, by a thread of its own.

    Args:
        source: as `load_positions` returns it.
        links: of the agents of this process, by number; other agents are left out.
        patience: until the first position of each vehicle, s.
    """

    def __init__(self, source: Any, links: Mapping[int, Located], patience: float) -> None:
        """Forward nothing yet."""
        self._source, self._links, self._patience = source, links, patience
        self._next = dict.fromkeys(links, -math.inf)

    def start(self) -> None:
        """Begin; a source that fails or ends lets all vehicles descend."""
        for link in self._links.values():
            link.expect_positions(self._patience)
        threading.Thread(target=self.run, daemon=True).start()

    def run(self) -> None:
        """Forward until the source ends."""
        why = "the source of positions ended"
        try:
            for agent, *pose in self._source.poses():
                self._take(agent, pose)
        # Of the user's code, which may raise anything.
        except Exception as error:
            why = f"the source of positions failed: {type(error).__name__}: {error}"
        for link in self._links.values():
            link.lose(why)

    def _take(self, agent: int, pose: Sequence[float]) -> None:
        if len(pose) not in (3, 7):
            raise ValueError(f"a pose has 3 or 7 numbers, and this one {len(pose)}")
        now, link = time.monotonic(), self._links.get(agent)
        # Motion capture says NaN of a body that it does not see.
        if link is not None and now >= self._next[agent] and all(map(math.isfinite, pose)):
            self._next[agent] = now + 1.0 / _RATE
            link.locate(pose)
