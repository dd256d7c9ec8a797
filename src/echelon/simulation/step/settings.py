"""How a run is computed."""

import functools
import math
import numbers
from typing import Any, NamedTuple, TypeVar

import numpy as np

from echelon.core.errors import SimulationError, did_you_mean, is_number, listing
from echelon.core.limits import MOST_STEPS, horizon_fault
from echelon.core.numerics import INTEGRATORS, Precision
from echelon.core.words import ENGINES

_T = TypeVar("_T", bound="Settings")


def _checked(cls: type[_T]) -> type[_T]:
    """Check numbers and make them plain: JAX has no derivative by an integer."""
    create = cls.__new__

    @functools.wraps(create)
    def new(own: type[_T], *arguments: Any, **named: Any) -> _T:
        settings = create(own, *arguments, **named)
        settings = create(own, *(_plain(field, getattr(settings, field)) for field in own._fields))
        settings.check()
        return settings

    setattr(cls, "__new__", new)
    return cls


@_checked
class Settings(NamedTuple):
    """How a run is computed.

    Attributes:
        horizon: length of the run, s; a whole number of steps.
        dt: step, s.
        integrator: `rk4`, `euler` or `printed`; the input is held over a step.
        limits: whether the actuators' limits act.
        store_every: steps between stored frames; the last state is always stored. Means are over
            all steps, whatever is stored.
        seed: of the random starts, and of the disturbance unless it has its own.
        precision: `float64` or `float32`, whatever the flags of JAX are.
        engine: what steps agents under laws. `jax`; `native`, code for this machine's vectors; or
            `auto`, native code for long runs where possible.
        devices: over how many of JAX's devices the agents are spread; more than one where JAX
            steps them.
        steady_window: the last part of the run that counts as steady, s; a fifth when left out.
        substeps: steps of the integrator in each `dt`, over which the inputs are held.

    Raises:
        SimulationError: a number is out of range.
    """

    horizon: float
    dt: float
    integrator: str = "rk4"
    limits: bool = True
    store_every: int = 1
    seed: int = 0
    precision: Precision = "float64"
    engine: str = "auto"
    devices: int = 1
    steady_window: float | None = None
    substeps: int = 1

    @property
    def steps(self) -> int:
        """The number of steps."""
        # Rounded, since 0.3 / 0.1 is a little less than 3.
        return max(1, round(self.horizon / self.dt))

    @property
    def held(self) -> tuple[float, str, int]:
        """Over what an input is held, s, with the integrator and its substeps in it."""
        return self.dt, self.integrator, self.substeps

    @property
    def window(self) -> float:
        """The last part of the run that counts as steady, s."""
        return self.horizon / 5.0 if self.steady_window is None else self.steady_window

    @property
    def first_steady(self) -> int:
        """The first step that begins in the steady window."""
        # A step that rounding has left just before the window belongs to it.
        return max(0, math.ceil(self.steps - self.window / self.dt - 1e-6))

    def check(self) -> None:
        """Check every number.

        Raises:
            SimulationError: one is out of range.
        """
        for name in ("horizon", "dt"):
            value = getattr(self, name)
            if not (is_number(value) and 0.0 < float(value) < math.inf):
                raise SimulationError(
                    f"`{name}` is {_shown(value)}, and must be a positive finite number of seconds."
                )
        # Any text that is not empty would count as true.
        if not isinstance(self.limits, bool):
            raise SimulationError(f"`limits` is {self.limits!r}, and must be True or False.")
        fault = horizon_fault(self.horizon, self.dt)
        if fault is not None:
            raise SimulationError(f"`horizon` is {self.horizon} s, and {fault}.")
        window = self.window
        if not (is_number(window) and 0.0 < window <= self.horizon):
            raise SimulationError(
                f"`steady_window` is {window} s, and must be above 0 and at most the horizon, "
                f"{self.horizon} s."
            )
        for name, allowed in (
            ("integrator", tuple(INTEGRATORS)),
            ("precision", ("float64", "float32")),
            ("engine", ENGINES),
        ):
            _check_name(name, getattr(self, name), allowed)
        if self.engine == "native" and self.devices != 1:
            raise SimulationError(
                f"`devices` is {self.devices}, and must be 1 where `engine` is `native`, which"
                " computes on processors, a thread each."
            )
        for name, least, most in (
            ("seed", 0, 2**63 - 1),
            ("store_every", 1, MOST_STEPS),
            ("substeps", 1, 1000),
            ("devices", 1, 2**31 - 1),
        ):
            value = getattr(self, name)
            # By its type: neither a seed nor a count of list entries may be 2.0, or NaN.
            whole = isinstance(value, numbers.Integral) and not isinstance(value, bool)
            if not whole or not least <= int(value) <= most:
                end = f"to {most}" if whole and int(value) > most else "on"
                raise SimulationError(
                    f"`{name}` is {_shown(value)}, and must be a whole number from {least} {end}."
                )


def _plain(name: str, value: Any) -> Any:
    if name in ("horizon", "dt", "steady_window") and is_number(value):
        try:
            return float(value)
        except OverflowError:  # a whole number beyond every float
            return math.inf
    return int(value) if isinstance(value, np.integer) else value


def _shown(value: object) -> str:
    """Return a value as in a message: text in its quotes, so that it is no number."""
    return repr(value) if isinstance(value, str) else str(value)


def _check_name(what: str, name: str, allowed: tuple[str, ...]) -> None:
    if name not in allowed:
        raise SimulationError(
            f"`{what}` is `{name}`, allowed are {listing(allowed)}{did_you_mean(name, allowed)}."
        )
