"""Disturbances: wind on the agents and noise on their inputs.

Each random draw depends only on the seed, the time and the agent's number; not on the law, the
number of agents, the stored frames or the precision.
"""

import dataclasses
import math
from collections.abc import Mapping
from typing import Any, final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from echelon.agents.models.model import ControlAffine
from echelon.agents.part import WorldPart
from echelon.core.errors import ModelError, SimulationError, did_you_mean, is_number, listing
from echelon.core.numerics import Draw, Field, key_of, normals
from echelon.core.types import Array, Input, PyTree, State
from echelon.core.words import amount


@final
@dataclasses.dataclass(frozen=True)
class Disturbance(WorldPart):
    """xdot = f(x) + g(x) (u + S noise) + wind, with both held over a step as the input is.

    Args:
        constant: the constant part of the wind, by state or group: it is added to the rate of each
            state, in its unit per second, so m/s^2 for a velocity.
        rms: root mean square of the random part of the wind, by state or group, for each state.
        input_rms: root mean square of the noise, by input, in normalized inputs. It acts after the
            actuators, so limits do not apply to it.
        hold: duration of a draw, s; rounded to whole steps, and at least one. Not with `time`.
        time: time constant, s, of the random wind as a Gauss-Markov process, drawn for every step
            in place of `hold`; None for independent draws.
        air: velocity of the air by coordinate of the position, m/s, which acts by `drag`.
        drag: acceleration of an agent by the air, 1/s times the velocity that it has through it.
        common: whether one random wind acts on all agents; otherwise each has its own.
        seed: of the draws; by default that of the run.

    Draws are normal, and independent from one hold to the next and from state to state. The same
    seed gives the same draws at any rms, so twice the rms is exactly twice the wind.

    Raises:
        SimulationError: a number is not finite, an rms is negative, or `hold` is not positive.
    """

    key, needs_laws = "disturbance", False

    constant: Mapping[str, float] = dataclasses.field(default_factory=dict)
    rms: Mapping[str, float] = dataclasses.field(default_factory=dict)
    input_rms: Mapping[str, float] = dataclasses.field(default_factory=dict)
    hold: float = 0.5
    common: bool = False
    seed: int | None = None
    time: float | None = None
    air: tuple[float, ...] = ()
    drag: float = 0.0

    def __post_init__(self) -> None:
        for what in ("constant", "rms", "input_rms"):
            least = -math.inf if what == "constant" else 0.0
            for name, value in getattr(self, what).items():
                if not (is_number(value) and math.isfinite(value) and value >= least):
                    allowed = "finite" if what == "constant" else "finite and not negative"
                    raise SimulationError(
                        f"`{what}` of the disturbance is {value} for `{name}`, "
                        f"and must be {allowed}."
                    )
        if not (is_number(self.hold) and 0.0 < self.hold < math.inf):
            raise SimulationError(
                f"`hold` of the disturbance is {self.hold}, and must be a positive finite number "
                "of seconds."
            )
        for name, value, fits in (
            ("time", self.time, lambda value: value is None or is_number(value) and value > 0.0),
            ("drag", self.drag, lambda value: is_number(value) and value >= 0.0),
        ):
            if not fits(value) or not math.isfinite(value or 0.0):
                raise SimulationError(
                    f"`{name}` of the disturbance is {value}, and must be finite and "
                    f"{'positive' if name == 'time' else 'not negative'}."
                )
        if not all(is_number(value) and math.isfinite(value) for value in self.air):
            raise SimulationError(
                f"`air` of the disturbance is {list(self.air)}, and must be finite."
            )
        if self.air and not self.drag:
            raise SimulationError(
                f"got `air` {list(self.air)} of the disturbance without `drag`, by which it acts; "
                "give a `drag` above 0."
            )
        if self.time is not None and not self.rms:
            raise SimulationError(
                f"got `time` {self.time} of the disturbance without `rms`, the size of the gusts; "
                "give an `rms`."
            )
        if self.seed is not None and (self.seed != int(self.seed) or self.seed < 0):
            raise SimulationError(
                f"`seed` of the disturbance is {self.seed}, and must be a whole number from 0 on."
            )

    def ignored(self) -> str:
        """Return that wind acts."""
        return "wind or noise acts on the agents"

    ignored_at_rest = ignored

    def presumed(self) -> str:
        """Return nothing: agents in wind are the same agents."""
        return ""

    def unflown(self) -> str:
        """Return that simulated vehicles have no noise on their inputs."""
        text = "`disturbance.input_rms` has no counterpart in a flight; leave it out"
        return text if any(self.input_rms.values()) else ""

    def simulated(self, plant: ControlAffine, dt: float) -> dict[str, Any]:
        """Return the push on each state, and its gusts."""
        constant, rms = (plant.per_state(x).tolist() for x in (self.constant, self.rms))
        return {"constant": constant, "rms": rms, "fade": math.exp(-dt / (self.time or self.hold))}

    def sentences(self, result: Any) -> str:
        """Return what a report says of it."""
        return f"Disturbance: {self}; unknown to the laws."

    def __str__(self) -> str:
        parts = [
            f"{what} " + ", ".join(f"`{name}` {value:g}" for name, value in named.items())
            for what, named in (
                ("constant", self.constant),
                ("rms", self.rms),
                ("rms of the normalized input", self.input_rms),
            )
            if named
        ]
        if self.rms or self.input_rms:
            whose = ", one for all agents" if self.common and self.rms else ""
            how = f"drawn every {self.hold:g} s"
            how = how if self.time is None else f"correlated over {self.time:g} s"
            parts.append(f"{how}{whose}")
        if self.drag:
            parts.append(f"drag {self.drag:g} 1/s in air of {list(self.air)} m/s")
        return "; ".join(parts) or "none"

    def prepared(self, plant: ControlAffine, dt: float, seed: int) -> "Wind":
        """Return the disturbance as arrays for a plant, a step (s) and the seed of a run.

        Raises:
            ModelError: a name is no state, group or input of the plant.
        """
        seed = seed if self.seed is None else self.seed
        rms = plant.per_state(self.rms)
        # Column j is the effect of noise on the normalized input j on the physical inputs.
        noise = plant.physical(np.diag(_by_input(plant, self.input_rms)), trim=False).T
        return Wind(
            constant=plant.per_state(self.constant),
            # None and not zeros, so that a step without draws is compiled without them.
            rms=rms if rms.any() else None,
            noise=noise if noise.any() else None,
            key=key_of(seed),
            # Whole steps: a wind that changed within one would cost the integrator its order.
            # A draw longer than any run need not be counted further.
            window=np.asarray(max(1, round(min(self.hold / dt, 2**31 - 1))), np.int32),
            common=self.common,
            fade=None
            if self.time is None or not rms.any()
            else np.asarray(np.exp(-dt / self.time)),
            air=self._in_air(plant),
        )

    def _in_air(self, plant: ControlAffine) -> Array | None:
        """Return the drag (1/s) and the velocity of the air for each state, (2, n)."""
        if not self.drag:
            return None
        velocity = plant.state_groups.get("velocity", ())
        if len(velocity) != len(plant.position) or len(self.air) not in (0, len(velocity)):
            raise SimulationError(
                f"got `drag` with an `air` of {amount(len(self.air), 'number')}, and "
                f"`{type(plant).__name__}` has {len(velocity)} states in its group `velocity` for "
                f"{len(plant.position)} coordinates; allowed is a number for each."
            )
        air = dict(zip(velocity, self.air, strict=False))
        return np.stack([plant.per_state(dict.fromkeys(velocity, self.drag)), plant.per_state(air)])


@final
class Wind(eqx.Module):
    """A disturbance as arrays; a part without randomness is None.

    Attributes:
        constant: (n,).
        rms: (n,).
        noise: (m, m), S times the rms of the inputs.
        key: (2,), the halves of the seed.
        window: duration of a draw in steps.
        common: whether all agents share one random wind.
        fade: what is left of a correlated wind after a step; None for independent draws.
        air: (2, n) the drag (1/s) and the velocity of the air for each state.
    """

    constant: Array
    rms: Array | None
    noise: Array | None
    key: np.ndarray
    window: np.ndarray
    common: bool = eqx.field(static=True)
    fade: np.ndarray | None = None
    air: Array | None = None

    @property
    def memoryless(self) -> "Wind":
        """The wind without what is correlated."""
        return self if self.fade is None else dataclasses.replace(self, rms=None, fade=None)

    def begin(self, x: State) -> PyTree:
        """Return the gust of the step before the first, (n,); () of independent draws."""
        return () if self.fade is None else jnp.zeros_like(x)

    def on(
        self, field: Field, gust: PyTree, step: jax.Array, agent: jax.Array
    ) -> tuple[Field, PyTree]:
        """Return the field (x, u) -> xdot of an agent during a step, and the gust of the step."""
        push, noise = self.on_state(step, agent), self.on_input(step, agent)
        if self.fade is not None:
            gust = self.gusts(gust, step, agent)
            push = push + gust
        return self.under(field, push, noise), gust

    def under(self, field: Field, push: State, noise: Input | None) -> Field:
        """Return the field under wind on the rate, noise on the input and the air, all held."""

        def velocity(x: State, u: Input) -> State:
            xdot = field(x, u if noise is None else u + noise) + push
            if self.air is None:
                return xdot
            drag, wind = jnp.asarray(self.air, x.dtype)
            return xdot + drag * (wind - x)

        return velocity

    def gusts(self, last: State, step: jax.Array, agent: jax.Array) -> State:
        """Return the correlated part of the wind of an agent at a step, from that of the last."""
        fade = jnp.asarray(self.fade, last.dtype)
        agent = 0 * agent if self.common else agent
        draw = normals(self.key, Draw.GUST, step, agent, size=len(last)).astype(last.dtype)
        # Of the same size at all times: at the first step it is drawn as at any other.
        size = jnp.where(step == 0, 1.0, jnp.sqrt(1.0 - fade**2))
        return fade * last + size * jnp.asarray(self.rms, last.dtype) * draw

    def on_state(self, step: jax.Array, agent: jax.Array) -> State:
        """Return the wind on xdot of an agent during a step, without what is correlated."""
        constant = jnp.asarray(self.constant)
        if self.rms is None or self.fade is not None:
            return constant
        # The draw of agent 0 for all; the product keeps the number traced.
        draw = self._draw(Draw.WIND, step, 0 * agent if self.common else agent, len(self.rms))
        return constant + jnp.asarray(self.rms) * draw

    def on_input(self, step: jax.Array, agent: jax.Array) -> Input | None:
        """Return the noise on the physical input of an agent during a step."""
        if self.noise is None:
            return None
        return jnp.asarray(self.noise) @ self._draw(Draw.NOISE, step, agent, len(self.noise))

    def _draw(self, kind: Draw, step: jax.Array, agent: jax.Array, size: int) -> jax.Array:
        return normals(self.key, kind, step // jnp.asarray(self.window), agent, size=size)


def _by_input(model: ControlAffine, named: Mapping[str, float]) -> Array:
    for name in named:
        if name not in model.input_names:
            raise ModelError(
                f"`{name}` is no input of `{type(model).__name__}`, which has "
                f"{listing(model.input_names)}{did_you_mean(name, model.input_names)}."
            )
    return np.array([named.get(name, 0.0) for name in model.input_names])
