"""The time of the plan: that of the monotonic clock, since one signed command named its start."""

import time
from typing import final


@final
class PlanClock:
    """Times of the plan; none before `start`.

    Args:
        speed: seconds of the plan in one of this machine: 1 in the air; less lets a slow machine
            keep up with simulated vehicles.
    """

    def __init__(self, speed: float = 1.0) -> None:
        """Wait for the start."""
        self.speed, self._origin = speed, None

    _origin: float | None

    def start(self, at: float) -> None:
        """Let the plan start at a time, s since 1970. The first command counts.

        Later steps of this machine's clock change nothing.
        """
        if self._origin is None:
            self._origin = time.monotonic() + at - time.time()

    @property
    def started(self) -> bool:
        """Whether the time of the start is known; it may lie ahead."""
        return self._origin is not None

    def at(self, moment: float) -> float | None:
        """Return the time of the plan (s) at one of `time.monotonic`; None before the command."""
        return None if self._origin is None else (moment - self._origin) * self.speed

    @property
    def now(self) -> float | None:
        """The time of the plan, s."""
        return self.at(time.monotonic())
