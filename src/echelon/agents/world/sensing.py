"""What an agent measures of its own state: late, and with noise."""

import dataclasses
import math
from collections.abc import Mapping
from typing import final

import equinox as eqx
import jax
import jax.numpy as jnp

from echelon.agents.models.model import ControlAffine
from echelon.agents.world.estimator import Estimator
from echelon.core.errors import SimulationError, is_number
from echelon.core.numerics import Draw, key_of, normals
from echelon.core.types import Array, State, States
from echelon.core.words import Estimation


@final
@dataclasses.dataclass(frozen=True)
class Sensing:
    """How all agents measure their own states; laws and messages use nothing else.

    Args:
        delay: age of the measurement, s; rounded to control steps.
        noise: standard deviation of each measurement, by state or group, in the states' units;
            independent from one control step to the next.
        seed: of the noise; by default that of the run.
        estimator: what agents make of it: `none`, they use it as it is; `constant-gain`, a
            prediction by the model, to which a part of each measurement's difference is added. It
            pays from some centimetres of noise of the position on, or where states are late.

    Raises:
        SimulationError: a number is not finite, or negative; or exact states are to be estimated.
    """

    delay: float = 0.0
    noise: Mapping[str, float] = dataclasses.field(default_factory=dict)
    seed: int | None = None
    estimator: Estimation = Estimation.NONE

    def __post_init__(self) -> None:
        """Check every number."""
        for name, value in (("delay", self.delay), *self.noise.items()):
            if not (is_number(value) and 0.0 <= float(value) < math.inf):
                what = "`delay`" if name == "delay" else f"`noise` of `{name}`"
                raise SimulationError(
                    f"{what} of the sensing is {value}, and must be finite and not negative."
                )

        estimator = Estimation.checked(self.estimator, "`estimator` of the sensing")
        object.__setattr__(self, "estimator", estimator)
        exact = not self.delay and not any(self.noise.values())
        if exact and self.estimator is not Estimation.NONE:
            raise SimulationError(
                f"`estimator` of the sensing is `{self.estimator}`, but the states are exact; give "
                "a `noise` or a `delay`, or leave it out."
            )

    def prepared(
        self, model: ControlAffine, dt: float, horizon: float, seed: int
    ) -> "Sensors | None":
        """Return the sensing as arrays for a control step and a horizon (s) and a run's seed.

        None if it is exact.

        Raises:
            ModelError: a name is no state or group of the model.
            SimulationError: no state is measured within the horizon.
        """
        if self.delay > horizon:
            raise SimulationError(
                f"`delay` of the sensing is {self.delay:g} s, and must be at most the horizon, "
                f"{horizon:g} s, within which otherwise agents know only their starts."
            )
        std, late = model.per_state(self.noise), round(self.delay / dt)
        if not late and not std.any():
            return None
        key = key_of(seed if self.seed is None else self.seed)
        estimator = None
        if self.estimator is Estimation.CONSTANT_GAIN:
            estimator = Estimator.of(model, std, late, dt)
        return Sensors(std if std.any() else None, key, late, estimator)

    def __str__(self) -> str:
        """Return the sensing in words."""
        parts = [f"{1e3 * self.delay:g} ms late"] if self.delay else []
        parts += ["noise " + ", ".join(f"`{k}` {v:g}" for k, v in self.noise.items())] * bool(
            self.noise
        )
        estimated = self.estimator is not Estimation.NONE
        parts += [f"estimated by {self.estimator.value}"] * estimated
        return "; ".join(parts) or "exact"


@final
class Sensors(eqx.Module):
    """Sensing as arrays.

    Attributes:
        std: (n,); None without noise.
        key: of the draws.
        delay: steps.
        estimator: None where measurements are used as they are.
    """

    std: Array | None
    key: Array
    delay: int = eqx.field(static=True)
    estimator: Estimator | None = None

    def begin(self, states: States) -> jax.Array:
        """Return the last states (delay, N, n), all as at the start."""
        return jnp.repeat(states[None], self.delay, axis=0)

    def read(self, last: jax.Array, states: States, step: jax.Array) -> tuple[States, jax.Array]:
        """Return what agents measure at a step, and the last states afterwards."""
        rows = jnp.concatenate([last, states[None]])
        late = rows[0]
        if self.std is None:
            return late, rows[1:]

        def one(x: State, agent: jax.Array) -> State:
            draw = normals(self.key, Draw.SENSING, step, agent, size=len(x))
            return x + jnp.asarray(self.std, x.dtype) * draw.astype(x.dtype)

        return jax.vmap(one)(late, jnp.arange(len(late))), rows[1:]
