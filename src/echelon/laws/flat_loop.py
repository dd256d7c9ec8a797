"""The inner loop of one agent under the law `stopping-point`, which uses no position.

In flat coordinates q(D) y' = k0 zeta', where zeta = q(D) y / k0 is where the agent would come to
rest without messages (theory page, T5). Integrators before inputs are part of the loop's memory.
"""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple, final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from echelon.agents.models.chains import (
    Chains,
    angles_among,
    flat_output,
    initial_integrators,
    to_flat,
)
from echelon.agents.models.model import ControlAffine, wrap_angles
from echelon.agents.network.formation_motion import OwnOffset
from echelon.core.errors import LawError, listing
from echelon.core.types import Array, Input, Scalar, State
from echelon.laws.law import LocalView

_LEAST_THRUST = 0.3
"""Of the thrust at rest; below it the thrust scale changes no faster."""
_SCALES = (0.5, 2.0)
"""Between which the thrust scale is searched."""


@final
@dataclasses.dataclass(frozen=True)
class Observer:
    """An estimate of what the model lacks, from an agent's own motion alone.

    Args:
        push: bandwidth of the estimated acceleration, 1/s: both modes of the observer are there; 0
            for no observer.
        scale: rate, 1/s, at which a push along the thrust is ascribed to the thrust: to an agent
            that is heavier, or motors that are weaker, than the model has it; 0 for never.

    Raises:
        LawError: a number is not finite, or negative; or a scale without a push.
    """

    push: float = 8.0
    scale: float = 0.0

    def __post_init__(self) -> None:
        for name in ("push", "scale"):
            value = getattr(self, name)
            if isinstance(value, bool) or not (0.0 <= value < math.inf):
                raise LawError(
                    f"`{name}` of the observer is {value}, and must be finite and not negative."
                )
        if self.scale and not self.push:
            raise LawError("`scale` of the observer needs its `push`, which is 0.")

    def __bool__(self) -> bool:
        return self.push > 0.0

    @classmethod
    def of(cls, choice: "bool | Mapping[str, float] | Observer") -> "Observer":
        """Return the observer of a choice: yes, no, or its numbers."""
        if isinstance(choice, Observer):
            return choice
        return cls(**choice) if isinstance(choice, Mapping) else cls(cls().push * bool(choice))

    @property
    def gains(self) -> tuple[float, float]:
        """2 L and L^2, 1/s and 1/s^2, of the bandwidth L."""
        return 2.0 * self.push, self.push**2


class FlatMemory(NamedTuple):
    """What an agent remembers.

    Attributes:
        chain: the states of the integrators before inputs, normalized (k,).
        rate: zeta' that it commands, (m,), less that of its offset, which followers may receive.
        delivered: the normalized input (m,) that the actuators delivered in the step before.
        base, push: of the observer (m,): the speed that the model predicts but for the last half
            step, and the acceleration that the model lacks.
        half: half of the step before, s; 0 at first.
        scale: of the observer: the thrust relative to the model's; None where it is not estimated.
        active: how many others changed the rate in the step before; None where none may.
        heading: the angles of zeta less the offset in the step before, rad, next to which the next
            ones are taken; None where no flat output is an angle.
        carried: zeta (m,) of outputs that the agent does not have; None where agents are alike.
    """

    chain: jax.Array
    rate: jax.Array
    delivered: jax.Array
    base: jax.Array
    push: jax.Array
    half: jax.Array
    scale: jax.Array | None = None
    active: jax.Array | None = None
    heading: jax.Array | None = None
    carried: jax.Array | None = None


@final
class FlatLoop(eqx.Module):
    """The inner loop of one agent.

    Attributes:
        weights: (r, m) k_l / k0 of each output, zero beyond its q.
        stiffness: (m,) k0.
        thrust: the number of the input whose scale is estimated; None for none.
        angles: which outputs are angles, such as a yaw.
    """

    chains: Chains = eqx.field(static=True)
    weights: Array
    stiffness: Array
    observer: Observer = eqx.field(static=True)
    thrust: int | None = eqx.field(static=True, default=None)
    angles: tuple[int, ...] = eqx.field(static=True, default=())

    @classmethod
    def of(
        cls, model: ControlAffine, chains: Chains, roots: tuple[float, ...], observer: Observer
    ) -> "FlatLoop":
        """Return the loop with the poles -roots; a shorter chain takes the first of them.

        Raises:
            LawError: the scale of the thrust is to be estimated, and the model has none.
        """
        weights, stiffness = chain_weights(chains.degrees, roots)
        thrust = thrust_of(model, chains) if observer.scale else None
        angles = angles_among(model, chains.outputs)
        return cls(chains, weights, stiffness, observer, thrust, angles)

    def of_leader(self, path: jax.Array) -> jax.Array:
        """Return a path (r + 1, m) in the outputs of the leader."""
        return path

    # ---- memory ----

    def begin(
        self, model: ControlAffine, x: State, ahead: jax.Array, moves: bool = False
    ) -> FlatMemory:
        """Return the memory of an agent that begins at x, with what is ahead (r, m)."""
        memory = self.initial_memory(model, x, initial_integrators(model, self.chains, x, ahead))
        # All take the turn that is next to one heading, so that it is a number like any other (T5).
        return self.beside(memory, self.stop(ahead))

    def zero_memory(self) -> FlatMemory:
        """Return a memory of zeros."""
        zero = jnp.zeros(len(self.stiffness))
        scale = None if self.thrust is None else jnp.ones(())
        memory = jnp.zeros(self.chains.size), zero, zero, zero, zero, jnp.zeros(()), scale
        return self.beside(FlatMemory(*memory), zero)

    def initial_memory(self, model: ControlAffine, x: State, chain: jax.Array) -> FlatMemory:
        """Return the memory of an agent that begins at x, with an exact model."""
        zero = jnp.zeros(len(self.stiffness), x.dtype)
        scale = None if self.thrust is None else jnp.ones((), x.dtype)
        memory = FlatMemory(chain, zero, zero, zero, zero, jnp.zeros((), x.dtype), scale)
        return memory._replace(base=self._observed(model, x, memory.delivered)[0])

    # ---- coordinates ----

    def place(self, model: ControlAffine, x: State, offset: State, memory: FlatMemory) -> jax.Array:
        """Return zeta less the offset, (m,): where the agent would come to rest."""
        return self._place(model, self.flat_values(model, x, memory), offset, memory)

    def _place(
        self, model: ControlAffine, values: jax.Array, offset: State, memory: FlatMemory
    ) -> jax.Array:
        place = self.stop(values) - self.shift(model, offset)
        return beside_turns(place, memory.heading, self.angles)

    def beside(self, memory: FlatMemory, place: jax.Array) -> FlatMemory:
        """Return the memory of an agent that takes its angles next to those of a place (m,)."""
        angles = np.array(self.angles, int)
        return memory._replace(heading=place[angles]) if self.angles else memory

    def shift(self, model: ControlAffine, offset: State) -> jax.Array:
        """Return the flat outputs (m,) of an offset."""
        outputs = self.chains.outputs
        return flat_output(model, outputs, offset) - flat_output(model, outputs, 0.0 * offset)

    def places_of(self, model: ControlAffine) -> list[int]:
        """Return which flat outputs are the position.

        Raises:
            LawError: a coordinate is none.
        """
        outputs = self.chains.outputs
        if not {*model.position} <= {*outputs}:
            raise LawError(
                "`safety` and formations that move need the position of "
                f"`{type(model).__name__}` among its flat outputs, {listing(outputs)}."
            )
        return [outputs.index(x) for x in model.position]

    def stopping_offset(
        self, model: ControlAffine, own: OwnOffset, t: Scalar
    ) -> tuple[State, State]:
        """Return q(D) xi / q(0) of an offset that moves, and its rate, (n,) each."""
        weights = jnp.asarray(self.weights, t.dtype)[:, np.array(self.places_of(model))]
        moved, axes = own.derivatives(t, len(weights)), np.array(own.motion.axes)
        stop = own.base.at[axes].set((weights * moved[:-1]).sum(axis=0))
        return stop, (0.0 * own.base).at[axes].set((weights * moved[1:]).sum(axis=0))

    def stop(self, values: jax.Array) -> jax.Array:
        """Return zeta (m,) of flat coordinates (r, m)."""
        return (jnp.asarray(self.weights, values.dtype) * values).sum(axis=0)

    def flat_values(self, model: ControlAffine, x: State, memory: FlatMemory) -> jax.Array:
        """Return the flat coordinates (r, m), corrected by the observer."""
        values = to_flat(model, self.chains, x, memory.chain).values
        if not self.observer:
            return values
        push_rate = self.observer.gains[1] * self._speed_error(model, x, memory)
        for order, more in ((2, memory.push), (3, push_rate)):
            inside = np.array(self.chains.degrees) > order
            if inside.any():
                values = values.at[order].add(jnp.where(inside, more, 0.0))
        return values

    # ---- a step ----

    def obey(
        self,
        model: ControlAffine,
        view: LocalView,
        rate: jax.Array,
        memory: FlatMemory,
        offset_rate: State | None = None,
    ) -> tuple[Input, FlatMemory]:
        """Return the physical input that makes zeta move at a rate (m,), and the next memory.

        The rate of the own offset (n,) is added to it.
        """
        x, period = view.x, view.period
        flat = to_flat(model, self.chains, x, memory.chain)
        values = self.flat_values(model, x, memory)
        degrees = np.array(self.chains.degrees)
        lower = np.arange(len(values))[:, None] < degrees - 1
        k = jnp.where(lower, jnp.asarray(self.weights, x.dtype), 0.0)
        tops = rate if offset_rate is None else rate + self.shift(model, offset_rate)
        tops = tops - (k[:-1] * values[1:]).sum(axis=0)
        tops = jnp.asarray(self.stiffness, x.dtype) * tops
        if self.observer:
            tops = tops - jnp.where(degrees <= 2, memory.push, 0.0)
        w = flat.invert(tops)
        chain, mean = self._integrate(memory.chain, w, period)
        command = self._scaled(model, mean, None if memory.scale is None else 1.0 / memory.scale)
        memory = self.beside(memory, self._place(model, values, view.offset, memory))
        return model.physical(command), memory._replace(chain=chain, rate=rate)

    def _integrate(self, e: jax.Array, w: Input, period: Scalar | float) -> tuple[jax.Array, Input]:
        """Return the integrators after a hold, and the mean (m,) of their outputs during it."""
        after, mean = list[jax.Array](), list[jax.Array]()
        for k, at in enumerate(self.chains.indices):
            tower = [*(e[i] for i in at), w[k]]
            # Polynomials of time; the actuator holds their mean, which moves the agent as far.
            mean.append(_moved(tower, period, 1))
            after += [_moved(tower[start:], period, 0) for start in range(len(at))]
        return (jnp.stack(after) if after else e), jnp.stack(mean)

    def settle(
        self,
        model: ControlAffine,
        x: State,
        desired: Input,
        delivered: Input,
        memory: FlatMemory,
        period: Scalar | float,
    ) -> FlatMemory:
        """Return the memory after the actuators delivered `delivered` of the `desired` input."""
        v = self._scaled(model, model.normalized(delivered), memory.scale)
        # An integrator that continues while an actuator is at its limit would wind up.
        asked = self._scaled(model, model.normalized(desired), memory.scale)
        shortfall = jnp.where(delivered == desired, 0.0, v - asked)
        first = [(at[0], k) for k, at in enumerate(self.chains.indices) if at]
        chain = memory.chain
        for place, k in first:
            chain = chain.at[place].add(shortfall[k])
        if not self.observer:
            return memory._replace(chain=chain)
        speed, pull = self._observed(model, x, v)
        error = self._speed_error(model, x, memory)
        half = 0.5 * period
        first, second = self.observer.gains
        base = speed - error + half * pull + period * (memory.push + first * error)
        push = memory.push + period * second * error
        after = memory._replace(
            chain=chain, delivered=v, base=base, push=push, half=half + 0.0 * error[0]
        )
        return after if self.thrust is None else self._ascribe(model, x, pull, period, after)

    # ---- the observer ----

    def _scaled(self, model: ControlAffine, v: Input, scale: jax.Array | None) -> Input:
        """Return normalized inputs with the whole thrust, that at rest included, times a scale."""
        if scale is None or self.thrust is None:
            return v
        rest = _at_rest(model, v)[self.thrust]
        return v.at[self.thrust].set(scale * (v[self.thrust] + rest) - rest)

    def _ascribe(
        self,
        model: ControlAffine,
        x: State,
        pull: jax.Array,
        period: Scalar | float,
        memory: FlatMemory,
    ) -> FlatMemory:
        """Their sum stays: the scale times the thrust, and the push, do not jump."""
        assert self.thrust is not None and memory.scale is not None
        v, rest = memory.delivered, _at_rest(model, memory.delivered)[self.thrust]
        # What one more unit of thrust adds to y'': inputs enter affinely.
        along = self._observed(model, x, v.at[self.thrust].add(1.0))[1] - pull
        thrust = (v[self.thrust] + rest) / memory.scale
        size = jnp.maximum(jnp.abs(thrust), _LEAST_THRUST * jnp.abs(rest))
        rate = self.observer.scale * (along @ memory.push) * thrust / size**2
        scale = jnp.clip(memory.scale + period * rate, *_SCALES)
        push = memory.push - (scale - memory.scale) * thrust * along
        return memory._replace(scale=scale, push=push)

    def _speed_error(self, model: ControlAffine, x: State, memory: FlatMemory) -> jax.Array:
        """Return the speed less what the model and the estimate predict, (m,)."""
        speed, pull = self._observed(model, x, memory.delivered)
        # A trapezoid from the start of the hold to its end, in which the input is the same.
        error = speed - (memory.base + memory.half * pull)
        jumps = [k for k in self.angles if self.chains.degrees[k] == 1]
        return wrap_angles(error, *jumps) if jumps else error

    def _observed(self, model: ControlAffine, x: State, v: Input) -> tuple[jax.Array, jax.Array]:
        """Return y' and its rate y'' under v, (m,); of an output that an input moves at once, y."""
        u = model.physical(v)

        def velocity(x: State) -> State:
            return model.velocity(x, u)

        def output(x: State) -> jax.Array:
            return flat_output(model, self.chains.outputs, x)

        def speed(x: State) -> jax.Array:
            return jax.jvp(output, (x,), (velocity(x),))[1]

        first, second = jax.jvp(speed, (x,), (velocity(x),))
        at_once = np.array(self.chains.degrees) == 1
        return jnp.where(at_once, output(x), first), jnp.where(at_once, first, second)


def chain_weights(degrees: tuple[int, ...], roots: tuple[float, ...]) -> tuple[Array, Array]:
    """Return k_l / k0 (r, m) and k0 (m,) of q, of which a shorter chain takes the first roots."""
    weights, stiffness = np.zeros((max(degrees), len(degrees))), np.ones(len(degrees))
    for k, degree in enumerate(degrees):
        q = np.atleast_1d(np.poly(-np.array(roots[: degree - 1])))[::-1]
        weights[:degree, k], stiffness[k] = q / q[0], q[0]
    return weights, stiffness


def beside_turns(place: jax.Array, heading: jax.Array | None, angles: tuple[int, ...]) -> jax.Array:
    """Return a place (m,) with its angles next to those of a step before; None for no angles."""
    if heading is None:
        return place
    # A measured angle may jump by a whole turn, and this one does not. Without a turn to subtract
    # no bit changes.
    where = np.array(angles)
    turns = jnp.round((place[where] - heading) / (2.0 * jnp.pi))
    return place.at[where].add(-2.0 * jnp.pi * turns)


def _moved(tower: Sequence[jax.Array], period: Scalar | float, more: int) -> jax.Array:
    """Return sum_i y_i T^i / (i + more)!, the value after a time T; for more = 1 the mean."""
    total = jnp.zeros_like(tower[0])
    for i, y in enumerate(tower):
        total = total + y * (period**i / math.factorial(i + more))
    return total


def _at_rest(model: ControlAffine, v: Input) -> Input:
    """Return the normalized inputs at the trim, S^-1 u*."""
    trim = jnp.asarray(model.trim[1], v.dtype)
    return model.normalized(2.0 * trim)


def thrust_of(model: ControlAffine, chains: Chains) -> int:
    """Return the number of the input whose scale can be estimated: what holds an agent at rest.

    Raises:
        LawError: no input acts at rest.
    """
    trim = np.asarray(model.trim[1], float)
    acting = [k for k in np.flatnonzero(trim).tolist() if chains.integrators[k]]
    if not acting:
        raise LawError(
            f"got `scale` of the observer, but no input of `{type(model).__name__}` holds it at "
            "rest, whose scale could be estimated; set it to 0."
        )
    return acting[0]
