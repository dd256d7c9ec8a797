"""The last word on board: what ends a flight, with no control law inside.

It looks at one vehicle, and at nothing that other agents say but a signed stop. After its first
fault the vehicle levels and descends, whatever happens then.
"""

import enum
import math
from collections import deque
from collections.abc import Mapping, Sequence
from typing import Any, Final, NamedTuple, final

from echelon_flight.links import Reading
from echelon_flight.parameters import values_of

_STEPS: Final = 51
"""Between states, of which the median is compared with the law's period."""


class Fault(enum.Enum):
    """Why a vehicle descends, as a sentence with the number that says so."""

    NONE = "nothing is wrong"
    STALE = "the newest state is {:.3g} s old, more than `stale_state` allows"
    TILT = "the vehicle is tilted by {:.0f} degrees, more than `tilt` allows"
    FENCE = "the vehicle is {:.2f} m outside its fence"
    SPEED = "the vehicle moves at {:.2f} m/s, more than its fence allows"
    INPUT = "the law returned an input that is not finite"
    OVERRUN = "a step of the law takes {:.0%} of its period, more than `overrun_share` allows"
    PERIOD = "states arrive every {:.3g} s, too slowly for the law (`slow_states`)"
    STOP = "a signed stop command arrived"
    TWIN = "two agents have the number {:.0f}"
    BATTERY = "{:.0%} of the battery is left, less than `low_battery` asks for"
    LINK = "the link to the vehicle failed"
    SIGNAL = "the process was asked to end"
    END = "the flight is over"

    def sentence(self, amount: float) -> str:
        """Return the sentence, with its number."""
        return self.value.format(amount)


class Fence(NamedTuple):
    """Where a vehicle may be, and how fast.

    Attributes:
        low, high: corners of a box of positions, m.
        speed: m/s.
    """

    low: Sequence[float]
    high: Sequence[float]
    speed: float


@final
class Supervisor:
    """Watches one vehicle, and remembers its first fault.

    Args:
        facts: the content of flight.json: `dt`, `parameters`, and the indices of `position`,
            `velocity` and `tilt` (two angles) in the state.
        fence: where the vehicle may be.

    Attributes:
        fault: the first one.
        amount: the number in its sentence.
    """

    def __init__(self, facts: Mapping[str, Any], fence: Fence) -> None:
        """Begin without a fault."""
        self._dt, self._fence, self._limits = facts["dt"], fence, values_of(facts)
        self._places = [facts[name] for name in ("position", "velocity", "tilt")]
        self.fault, self.amount = Fault.NONE, 0.0
        self._steps, self._before, self._slow = deque[float](maxlen=_STEPS), math.nan, 0

    def trip(self, fault: Fault, amount: float = 0.0) -> None:
        """Remember a fault, unless there is one."""
        if self.fault is Fault.NONE:
            self.fault, self.amount = fault, amount

    @property
    def sentence(self) -> str:
        """The first fault in words."""
        return self.fault.sentence(self.amount)

    @property
    def step(self) -> float:
        """The median time (s) between states; the law's before there are enough."""
        return sorted(self._steps)[_STEPS // 2] if len(self._steps) == _STEPS else self._dt

    def look(self, age: float) -> None:
        """Judge the age (s) of the newest state."""
        if age > self._limits["stale_state"]:
            self.trip(Fault.STALE, age)

    def judge(self, reading: Reading, time: float) -> None:
        """Judge a state of a time (s)."""
        position, velocity, angles = ([reading.x[k] for k in part] for part in self._places)
        if angles:
            tilt = math.degrees(math.acos(math.prod(map(math.cos, angles))))
            if not tilt <= self._limits["tilt"]:
                self.trip(Fault.TILT, tilt)
        sides = zip(position, self._fence.low, self._fence.high, strict=True)
        outside = max((max(low - x, x - high) for x, low, high in sides), default=0.0)
        if not outside <= 0.0:
            self.trip(Fault.FENCE, outside)
        speed = math.hypot(*velocity)
        if not speed <= self._fence.speed:
            self.trip(Fault.SPEED, speed)
        if reading.battery is not None and not reading.battery >= self._limits["low_battery"]:
            self.trip(Fault.BATTERY, reading.battery)
        self._pace(time)

    def _pace(self, time: float) -> None:
        """Compare the time between states with the law's period."""
        if time > self._before:
            self._steps.append(time - self._before)
        self._before = time
        if self.step >= self._limits["slow_states"] * self._dt:
            self.trip(Fault.PERIOD, self.step)

    def spend(self, seconds: float) -> None:
        """Judge how long (s) the law took for a tick."""
        # Several in a row: one may share the processor.
        slow = seconds > self._limits["overrun_share"] * self._dt
        self._slow = self._slow + 1 if slow else 0
        if self._slow >= self._limits["overrun_ticks"]:
            self.trip(Fault.OVERRUN, seconds / self._dt)

    def check(self, u: Sequence[float], valid: bool) -> None:
        """Judge an input before it is sent."""
        if not valid or not all(map(math.isfinite, u)):
            self.trip(Fault.INPUT)
