"""The inner loop of one agent under the law `stopping-point`, which uses no position.

In flat coordinates q(D) y' = k0 zeta', where zeta = q(D) y / k0 is where the agent would come to
rest without messages (theory page, T5). Integrators before inputs are part of the loop's memory.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple, final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from echelon.agents.models.chains import Chains, flat_output, flatten
from echelon.agents.models.model import ControlAffine
from echelon.core.types import Array, Input, Scalar, State

_OBSERVER = (16.0, 64.0)
"""Of the observer, 1/s and 1/s^2: both its modes at 8 1/s, twice as fast as a quick inner loop."""


class FlatMemory(NamedTuple):
    """What an agent remembers.

    Attributes:
        chain: the states of the integrators before inputs, normalized (k,).
        rate: zeta' that it commands, (m,), which followers may receive.
        delivered: the normalized input (m,) that the actuators delivered in the step before.
        base, push: of the observer (m,): the speed that the model predicts but for the last half
            step, and the acceleration that the model lacks.
        half: half of the step before, s; 0 at first.
    """

    chain: jax.Array
    rate: jax.Array
    delivered: jax.Array
    base: jax.Array
    push: jax.Array
    half: jax.Array


@final
class FlatLoop(eqx.Module):
    """The inner loop of one agent.

    Attributes:
        chains: of the model.
        weights: (r, m) k_l / k0 of each output, zero beyond its q.
        stiffness: (m,) k0.
        observer: whether the acceleration that the model lacks is estimated and compensated.
    """

    chains: Chains = eqx.field(static=True)
    weights: Array
    stiffness: Array
    observer: bool = eqx.field(static=True)

    @classmethod
    def of(cls, chains: Chains, roots: tuple[float, ...], observer: bool) -> "FlatLoop":
        """Return the loop with the poles -roots; a shorter chain takes the first of them."""
        r, m = max(chains.degrees), len(chains.degrees)
        weights, stiffness = np.zeros((r, m)), np.ones(m)
        for k, degree in enumerate(chains.degrees):
            q = np.atleast_1d(np.poly(-np.array(roots[: degree - 1])))[::-1]
            weights[:degree, k], stiffness[k] = q / q[0], q[0]
        return cls(chains, weights, stiffness, observer)

    # ---- memory ----

    def zero_memory(self) -> FlatMemory:
        """Return a memory of zeros."""
        zero = jnp.zeros(len(self.stiffness))
        return FlatMemory(jnp.zeros(self.chains.size), zero, zero, zero, zero, jnp.zeros(()))

    def initial_memory(self, model: ControlAffine, x: State, chain: jax.Array) -> FlatMemory:
        """Return the memory of an agent that begins at x, with an exact model."""
        zero = jnp.zeros(len(self.stiffness), x.dtype)
        memory = FlatMemory(chain, zero, zero, zero, zero, jnp.zeros((), x.dtype))
        return memory._replace(base=self._observed(model, x, memory.delivered)[0])

    # ---- coordinates ----

    def place(self, model: ControlAffine, x: State, offset: State, memory: FlatMemory) -> jax.Array:
        """Return zeta less the offset, (m,): where the agent would come to rest."""
        outputs = self.chains.outputs
        shift = flat_output(model, outputs, offset) - flat_output(model, outputs, 0.0 * offset)
        return self.stop(self._flat_values(model, x, memory)) - shift

    def stop(self, values: jax.Array) -> jax.Array:
        """Return zeta (m,) of flat coordinates (r, m)."""
        return (jnp.asarray(self.weights, values.dtype) * values).sum(axis=0)

    def _flat_values(self, model: ControlAffine, x: State, memory: FlatMemory) -> jax.Array:
        """Return the flat coordinates (r, m), corrected by the observer."""
        values = flatten(model, self.chains, x, memory.chain).values
        if not self.observer:
            return values
        for order, more in zip(
            (2, 3), (memory.push, self._push_rate(model, x, memory)), strict=True
        ):
            inside = np.array(self.chains.degrees) > order
            if inside.any():
                values = values.at[order].add(jnp.where(inside, more, 0.0))
        return values

    # ---- a step ----

    def obey(
        self,
        model: ControlAffine,
        x: State,
        rate: jax.Array,
        memory: FlatMemory,
        period: Scalar | float,
    ) -> tuple[Input, FlatMemory]:
        """Return the physical input that makes zeta move at a rate (m,), and the next memory."""
        flat, values = (
            flatten(model, self.chains, x, memory.chain),
            self._flat_values(model, x, memory),
        )
        degrees = np.array(self.chains.degrees)
        lower = np.arange(len(values))[:, None] < degrees - 1
        k = jnp.where(lower, jnp.asarray(self.weights, x.dtype), 0.0)
        tops = rate - (k[:-1] * values[1:]).sum(axis=0)
        tops = jnp.asarray(self.stiffness, x.dtype) * tops
        if self.observer:
            tops = tops - jnp.where(degrees <= 2, memory.push, 0.0)
        w = flat.invert(tops)
        chain, mean = self._integrate(memory.chain, w, period)
        return model.physical(mean), memory._replace(chain=chain, rate=rate)

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
        v = model.normalized(delivered)
        # An integrator that continues while an actuator is at its limit would wind up.
        shortfall = jnp.where(delivered == desired, 0.0, v - model.normalized(desired))
        first = [(at[0], k) for k, at in enumerate(self.chains.indices) if at]
        chain = memory.chain
        for place, k in first:
            chain = chain.at[place].add(shortfall[k])
        if not self.observer:
            return memory._replace(chain=chain)
        speed, pull = self._observed(model, x, v)
        error = self._speed_error(model, x, memory)
        half = 0.5 * period
        base = speed - error + half * pull + period * (memory.push + _OBSERVER[0] * error)
        push = memory.push + period * _OBSERVER[1] * error
        return FlatMemory(chain, memory.rate, v, base, push, half + 0.0 * error[0])

    # ---- the observer ----

    def _speed_error(self, model: ControlAffine, x: State, memory: FlatMemory) -> jax.Array:
        """Return the speed less what the model and the estimate predict, (m,)."""
        speed, pull = self._observed(model, x, memory.delivered)
        # A trapezoid from the start of the hold to its end, in which the input is the same.
        return speed - (memory.base + memory.half * pull)

    def _push_rate(self, model: ControlAffine, x: State, memory: FlatMemory) -> jax.Array:
        """Return the rate of the estimated push, (m,)."""
        return _OBSERVER[1] * self._speed_error(model, x, memory)

    def _observed(self, model: ControlAffine, x: State, v: Input) -> tuple[jax.Array, jax.Array]:
        """Return what the observer measures of each output, and its rate under an input v, (m,).

        It is the speed y', whose rate is y''; and of an output that an input moves at once, y.
        """
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


def _moved(tower: Sequence[jax.Array], period: Scalar | float, more: int) -> jax.Array:
    """Return sum_i y_i T^i / (i + more)!, the value after a time T; for more = 1 the mean."""
    total = jnp.zeros_like(tower[0])
    for i, y in enumerate(tower):
        total = total + y * (period**i / math.factorial(i + more))
    return total
