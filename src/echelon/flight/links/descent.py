"""The descent of a vehicle that no law flies any more."""

from typing import Final, final

_SHARE: Final = 0.93
"""Of the weight, with which a vehicle sinks at 0.7 m/s^2: 1.2 m/s after 1 m."""
_GROUND: Final = 0.05
"""m above the place where z is 0."""
_LONGEST: Final = 5.0
"""s; with a share that is true, 8 m."""


@final
class Descent:
    """The thrust of a level descent: less than the weight, and none once it ended.

    It ends at the ground, where the height is known, or after 5 s.

    Args:
        weight: the thrust of hovering, N.
        dt: between two calls, s.
    """

    def __init__(self, weight: float, dt: float) -> None:
        """Begin with the first call of `thrust`."""
        self._weight, self._dt, self._calls = weight, dt, 0

    def thrust(self, height: float | None) -> float | None:
        """Return the thrust of now, N; None from the end on.

        Args:
            height: z, m, if it is known.
        """
        self._calls += 1
        if self._calls * self._dt > _LONGEST or (height is not None and height < _GROUND):
            self._calls = int(_LONGEST / self._dt) + 1
            return None
        return _SHARE * self._weight
