"""What an agent measures of its own state, late and with noise, and how it estimates it."""

import dataclasses
import math
from collections.abc import Mapping
from typing import NamedTuple, final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.linalg
from jaxtyping import Float

from echelon.agents.models.linearization import linearize
from echelon.agents.models.model import ControlAffine
from echelon.core.errors import SimulationError, is_number
from echelon.core.linear import discretize
from echelon.core.numerics import Draw, key_of, normals, rk4
from echelon.core.types import Array, Input, State, States
from echelon.core.words import Estimation

_INPUT, _PUSH, _DRIFT = 0.1, 1.0, 0.01
"""Densities, by the root of a second: of what acts beside the inputs, in normalized ones; of how
fast a push on the velocity changes; and of all states, in their units."""
_EXACT = 1e-6
"""Standard deviation in place of none, which the Riccati equation needs."""


class Estimate(NamedTuple):
    """What an agent knows of itself as of its last measurement, and what it has done since.

    Attributes:
        x: (n,) its state.
        push: (k,) what acts on its velocity and is not in the model.
        inputs: (d + 1, m) delivered in the steps since the measurement before.
    """

    x: State
    push: Float[jax.Array, " k"]
    inputs: Float[jax.Array, "D m"]


@final
class Estimator(eqx.Module):
    """Predicts the state by the model, and corrects it by a constant gain.

    The gain is that of the Kalman filter of the model linearized at its trim, with a push on the
    velocity that changes slowly. The prediction is the nonlinear model's.

    Attributes:
        gain: (n + k, n).
        pushed: (k,) the states on whose rate a push acts.
        late: age of a measurement, in steps.
        dt: of a step, s.
    """

    gain: Array
    pushed: tuple[int, ...] = eqx.field(static=True)
    late: int = eqx.field(static=True)
    dt: float = eqx.field(static=True)

    @classmethod
    def of(cls, model: ControlAffine, std: Float[Array, " n"], late: int, dt: float) -> "Estimator":
        """Return the filter for measurements with deviations (n,), else raise `SimulationError`."""
        n, names = len(model.state_names), model.state_groups.get("velocity", ())
        pushed = tuple(model.state_names.index(name) for name in names)
        A, B = linearize(model)
        size, m = n + len(pushed), B.shape[1]
        rates, entries = np.zeros((size, size)), np.zeros((size, m))
        rates[:n, :n], entries[:n] = A, B
        rates[list(pushed), range(n, size)] = 1.0
        F, G = discretize(rates, entries, dt)
        drift = np.append(np.full(n, _DRIFT), np.full(len(pushed), _PUSH))
        Q = _INPUT**2 / dt * G @ G.T + np.diag(dt * drift**2)
        C, R = np.eye(n, size), np.diag(np.maximum(std, _EXACT) ** 2)
        try:
            P = scipy.linalg.solve_discrete_are(F.T, C.T, Q, R)
        except (np.linalg.LinAlgError, ValueError) as error:
            raise SimulationError(
                f"no constant gain estimates the states of `{type(model).__name__}` "
                f"({error}); set `estimator: none`."
            ) from error
        gain = np.linalg.solve(P[:n, :n] + R, P[:n]).T
        return cls(gain, pushed, late, dt)

    def begin(self, model: ControlAffine, x: State) -> Estimate:
        """Return the estimate of an agent at x before it has measured anything."""
        trim = jnp.asarray(np.asarray(model.trim[1], float), x.dtype)
        push = jnp.zeros(len(self.pushed), x.dtype)
        return Estimate(x, push, jnp.tile(trim, (self.late + 1, 1)))

    def measure(
        self, model: ControlAffine, before: Estimate, y: State, first: jax.Array
    ) -> tuple[State, Estimate]:
        """Return the state now and the estimate at a measurement y (n,), the `first` as it is."""
        x = jnp.where(first, y, self._moved(model, before.x, before.push, before.inputs[0]))
        more = jnp.asarray(self.gain, x.dtype) @ model.difference(y, x)
        x, push = x + more[: len(x)], before.push + more[len(x) :]
        now = x
        for u in before.inputs[1:]:
            now = self._moved(model, now, push, u)
        return now, before._replace(x=x, push=push)

    def act(self, estimate: Estimate, u: Input) -> Estimate:
        """Return the estimate with the input (m,) that is delivered until the next step."""
        return estimate._replace(inputs=jnp.concatenate([estimate.inputs[1:], u[None]]))

    def _moved(self, model: ControlAffine, x: State, push: jax.Array, u: Input) -> State:
        def velocity(x: State, u: Input) -> State:
            return model.velocity(x, u).at[np.array(self.pushed, int)].add(push)

        return rk4(velocity, x, u, self.dt)


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
