"""What an agent measures of its own state, late and with noise, and how it estimates it."""

import abc
import dataclasses
import math
from collections.abc import Mapping
from typing import Any, ClassVar, NamedTuple, Protocol, final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.linalg
from jaxtyping import Float

from echelon.agents.models.linearization import linearize
from echelon.agents.models.model import ControlAffine
from echelon.agents.part import Effects, WorldPart
from echelon.core.errors import SimulationError, is_number
from echelon.core.linear import discretize
from echelon.core.numerics import Draw, key_of, normals, rk4
from echelon.core.types import Array, Input, PyTree, State
from echelon.core.words import Estimation


class SensorClock(Protocol):
    """The step, and whether it is the first one."""

    @property
    def step(self) -> jax.Array: ...  # noqa: D102
    @property
    def first(self) -> jax.Array: ...  # noqa: D102


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
class Sensing(WorldPart):
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

    key = "sensing"

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

    def prepared(self, model: ControlAffine, dt: float, horizon: float, seed: int) -> "Sensors":
        """Return the sensing as arrays for a control step and a horizon (s) and a run's seed.

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
        stages = list[SensorStage]()
        if late:
            stages.append(DelayedSensor(late))
        if std.any():
            stages.append(NoisySensor(std, key_of(seed if self.seed is None else self.seed)))
        if stages and self.estimator is Estimation.CONSTANT_GAIN:
            stages.append(EstimatingSensor(Estimator.of(model, std, late, dt)))
        return Sensors(tuple(stages))

    def ignored(self) -> str:
        """Return that states are not exact."""
        return "" if self == Sensing() else "agents measure their states late or with noise"

    def ignored_at_rest(self) -> str:
        """Return that noise keeps agents from rest."""
        return "agents measure their states with noise" if any(self.noise.values()) else ""

    def presumed(self) -> str:
        """Return of what states theorems are."""
        late = self.delay or self.estimator is not Estimation.NONE
        return "agents that know their states now" if late else ""

    def effects(self) -> Effects:
        """Return the delay, and whether it is estimated away."""
        return Effects(self.delay, estimated=self.estimator is not Estimation.NONE)

    def unflown(self) -> str:
        """Return that a flight has no late sensors."""
        text = "`sensing.delay` has no counterpart in a flight; leave it out"
        return text if self.delay else ""

    def simulated(self, plant: ControlAffine, dt: float) -> dict[str, Any]:
        """Return the noise of each state."""
        return {"noise": plant.per_state(self.noise).tolist()}

    def sentences(self, result: Any) -> str:
        """Return what a report says of it."""
        return f"Sensing of own states: {self}."

    def __str__(self) -> str:
        parts = [f"{1e3 * self.delay:g} ms late"] if self.delay else []
        parts += ["noise " + ", ".join(f"`{k}` {v:g}" for k, v in self.noise.items())] * bool(
            self.noise
        )
        estimated = self.estimator is not Estimation.NONE
        parts += [f"estimated by {self.estimator.value}"] * estimated
        return "; ".join(parts) or "exact"


# ---- what sensors do, stage after stage ---------------------------------------------------------


class SensorStage(eqx.Module):
    """A stage of the sensing of one agent, which reads what the stage before returns."""

    on_board: ClassVar[bool] = False
    """Whether it is part of the agent; what a real sensor does is left to it."""
    random: ClassVar[bool] = False
    """Whether it adds noise, which a guarantee leaves out."""

    def begin(self, model: ControlAffine, x: State) -> PyTree:
        """Return what it remembers of an agent that begins at x; () of nothing."""
        return ()

    @abc.abstractmethod
    def read(
        self, model: ControlAffine, memory: PyTree, x: State, clock: SensorClock, number: jax.Array
    ) -> tuple[State, PyTree]:
        """Return what the agent of a number senses of x (n,) now, and the memory after it."""

    def acted(self, memory: PyTree, u: Input) -> PyTree:
        """Return the memory after the input (m,) that is delivered until the next step."""
        return memory


@final
class DelayedSensor(SensorStage):
    """The state `steps` steps ago; it remembers those since then, (steps, n)."""

    steps: int = eqx.field(static=True)

    def begin(self, model: ControlAffine, x: State) -> PyTree:
        """Return the start, as if it had lasted."""
        return jnp.repeat(x[None], self.steps, axis=0)

    def read(
        self, model: ControlAffine, memory: PyTree, x: State, clock: SensorClock, number: jax.Array
    ) -> tuple[State, PyTree]:
        """Return the oldest state, and the others."""
        rows = jnp.concatenate([memory, x[None]])
        return rows[0], rows[1:]


@final
class NoisySensor(SensorStage):
    """Normal noise of deviations `std` (n,), independent from step to step."""

    std: Array
    key: Array
    random = True

    def read(
        self, model: ControlAffine, memory: PyTree, x: State, clock: SensorClock, number: jax.Array
    ) -> tuple[State, PyTree]:
        """Return the state with the noise of this step."""
        draw = normals(self.key, Draw.SENSING, clock.step, number, size=len(x))
        return x + jnp.asarray(self.std, x.dtype) * draw.astype(x.dtype), memory


@final
class EstimatingSensor(SensorStage):
    """What the agent makes of its measurements; it remembers its `Estimate`."""

    estimator: Estimator
    on_board = True

    def begin(self, model: ControlAffine, x: State) -> PyTree:
        """Return the estimate at the start."""
        return self.estimator.begin(model, x)

    def read(
        self, model: ControlAffine, memory: PyTree, x: State, clock: SensorClock, number: jax.Array
    ) -> tuple[State, PyTree]:
        """Return the state that the agent assumes, and its estimate."""
        return self.estimator.measure(model, memory, x, clock.first)

    def acted(self, memory: PyTree, u: Input) -> PyTree:
        """Return the estimate with what is delivered."""
        return self.estimator.act(memory, u)


@final
class Sensors(eqx.Module):
    """The stages of an agent's sensing, one after the other; () senses the state exactly."""

    stages: tuple[SensorStage, ...] = ()

    @property
    def on_board(self) -> "Sensors":
        """The stages that are part of the agent."""
        return Sensors(tuple(stage for stage in self.stages if stage.on_board))

    @property
    def still(self) -> "Sensors":
        """The stages without noise."""
        return Sensors(tuple(stage for stage in self.stages if not stage.random))

    def begin(self, model: ControlAffine, x: State) -> PyTree:
        """Return what the stages remember of an agent that begins at x."""
        return tuple(stage.begin(model, x) for stage in self.stages)

    def read(
        self, model: ControlAffine, memory: PyTree, x: State, clock: SensorClock, number: jax.Array
    ) -> tuple[State, PyTree]:
        """Return what an agent at x knows of its state (n,), and what the stages then remember."""
        after = list[PyTree]()
        for stage, own in zip(self.stages, memory, strict=True):
            x, own = stage.read(model, own, x, clock, number)
            after.append(own)
        return x, tuple(after)

    def acted(self, memory: PyTree, u: Input) -> PyTree:
        """Return what the stages remember after the input (m,) that is delivered."""
        pairs = zip(self.stages, memory, strict=True)
        return tuple(stage.acted(own, u) for stage, own in pairs)
