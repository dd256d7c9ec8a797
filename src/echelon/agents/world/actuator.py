"""Actuators that lag behind their commands, and motors with levels and a least thrust."""

import dataclasses
import math
from collections.abc import Iterator
from typing import Any, final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from echelon.agents.models.model import ControlAffine
from echelon.agents.part import Effects, WorldPart
from echelon.core.errors import SimulationError, is_number
from echelon.core.numerics import precision
from echelon.core.types import Array, Input

_SETTLES = 3.0
"""Time constants after which an actuator has made 95 % of a step."""


@final
@dataclasses.dataclass(frozen=True)
class Actuator(WorldPart):
    """How the actuators of all agents differ from ideal ones; the laws know nothing of it.

    Args:
        lag: time constant with which every actuator follows its command, s; 0 at once.
        levels: number of values that a motor can be commanded, from one limit to the other; 0 for
            any value.
        minimum: least thrust of a motor, in the units of the rows of the model's limits, mostly N;
            None for the lower limit.

    Raises:
        SimulationError: a number is out of its range.
    """

    key, needs_laws = "actuator", False

    lag: float = 0.0
    levels: int = 0
    minimum: float | None = None

    def __post_init__(self) -> None:
        for name, value in (("lag", self.lag), ("minimum", self.minimum or 0.0)):
            if not (is_number(value) and 0.0 <= float(value) < math.inf):
                raise SimulationError(
                    f"`{name}` of the actuator is {value}, and must be finite and not negative."
                )
        if not isinstance(self.levels, int) or self.levels < 0 or self.levels == 1:
            raise SimulationError(
                f"`levels` of the actuator is {self.levels}, and must be 0 for any value, or a "
                "whole number from 2 on."
            )

    def remarks(self, model: ControlAffine, horizon: float) -> Iterator[str]:
        """Yield that the actuators are too slow for the horizon (s)."""
        if _SETTLES * self.lag > horizon:
            yield (
                f"the actuators need {_SETTLES * self.lag:.3g} s for 95 % of a command, since "
                f"their lag is {self.lag:.3g} s, and the horizon is {horizon:g} s."
            )

    def ignored(self) -> str:
        """Return that inputs act late, or are others."""
        return "" if self == Actuator() else "the actuators lag or have levels"

    def ignored_at_rest(self) -> str:
        """Return that levels round the inputs at rest."""
        return "the actuators have levels" if self.levels else ""

    def presumed(self) -> str:
        """Return of what inputs theorems are."""
        return "inputs that act at once" if self.lag or self.levels else ""

    def effects(self) -> Effects:
        """Return the lag, that motors have a least thrust, and that they have levels."""
        limits = "" if self.minimum is None else "the motors have a least thrust"
        return Effects(lag=self.lag, limits=limits, rounded=bool(self.levels))

    def off_trim(self, plant: ControlAffine, trim: Array) -> tuple[str, str]:
        """Return that the least thrust of a motor is more than its share of the trim input."""
        if self.minimum is None:
            return "", ""
        with precision("float64"):
            motors = dataclasses.replace(self, levels=0).prepared(plant)
            given = trim if motors is None else np.asarray(motors.command(jnp.asarray(trim)))
        if np.allclose(given, trim, rtol=1e-9, atol=1e-9 * float(np.abs(trim).max())):
            return "", ""
        return "the motors' `minimum` is more than the trim needs", "lower `minimum`"

    def sentences(self, result: Any) -> str:
        """Return what a report says of it."""
        return f"Actuators: {self}; unknown to the laws."

    def prepared(self, plant: ControlAffine) -> "MotorArrays | None":
        """Return the actuators of a plant as arrays; None if they are ideal.

        Raises:
            SimulationError: motors are asked for whose thrusts the plant does not limit.
        """
        if self == Actuator():
            return None
        lag = np.asarray(self.lag) if self.lag else None
        limits = plant.input_limits
        if not self.levels and self.minimum is None:
            return MotorArrays(lag, None, None, None, None, None)
        mixing = np.zeros((0, 0)) if limits is None else np.asarray(limits.matrix, float)
        square = mixing.ndim == 2 and mixing.shape[0] == mixing.shape[1] > 0
        if limits is None or not square or not np.isfinite([limits.low, limits.high]).all():
            key = "levels" if self.levels else "minimum"
            raise SimulationError(
                f"got `{key}` of the actuator, but `{type(plant).__name__}` has no motors: its "
                "`input_limits` are not as many as its inputs, with finite bounds."
            )
        low, high = np.asarray(limits.low, float), np.asarray(limits.high, float)
        if self.minimum is not None and (self.minimum >= high).any():
            raise SimulationError(
                f"`minimum` of the actuator is {self.minimum:g}, and must be below the largest "
                f"thrust of a motor of `{type(plant).__name__}`, {high.min():g}."
            )
        step = (high - low) / (self.levels - 1) if self.levels else None
        least = low if self.minimum is None else np.maximum(low, self.minimum)
        return MotorArrays(lag, mixing, np.linalg.inv(mixing), low, least, step)

    def __str__(self) -> str:
        parts = [f"lag {1e3 * self.lag:g} ms"] if self.lag else []
        parts += [f"{self.levels} levels"] if self.levels else []
        parts += [f"at least {self.minimum:g} a motor"] if self.minimum is not None else []
        return ", ".join(parts) or "none"


@final
class MotorArrays(eqx.Module):
    """Actuators as arrays; a part without effect is None.

    Attributes:
        lag: time constant, s.
        mixing, unmixing: (m, m) from inputs to thrusts, and back.
        low, least: (m,) of the thrusts: the lower limits, and what a motor gives at least.
        step: (m,) between two levels.
    """

    lag: Array | None
    mixing: Array | None
    unmixing: Array | None
    low: Array | None
    least: Array | None
    step: Array | None

    def command(self, u: Input) -> Input:
        """Return the input that the motors are commanded for a delivered one."""
        if self.mixing is None:
            return u
        f = jnp.asarray(self.mixing, u.dtype) @ u
        if self.step is not None:
            low, step = jnp.asarray(self.low, u.dtype), jnp.asarray(self.step, u.dtype)
            f = low + step * jnp.round((f - low) / step)
        f = jnp.maximum(f, jnp.asarray(self.least, u.dtype))
        return jnp.asarray(self.unmixing, u.dtype) @ f

    def after(self, start: Input, command: Input, time: Float[jax.Array, ""] | float) -> Input:
        """Return the input that acts a time (s) after a command, from where the actuators stood."""
        if self.lag is None:
            return command
        # Every motor has the same lag, and inputs are linear in thrusts.
        return command + (start - command) * jnp.exp(-time / jnp.asarray(self.lag, start.dtype))
