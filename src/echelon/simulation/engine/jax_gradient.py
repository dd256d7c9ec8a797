"""The gradient of a cost of a run by JAX's reverse mode."""

import math
from collections.abc import Mapping
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from echelon.core.compiled import cached_jit
from echelon.core.types import Array
from echelon.simulation.engine.differentiable_run import (
    Cost,
    DifferentiableRun,
    Gradient,
    cost_number,
    symmetric,
)
from echelon.simulation.step.distances import distance_of
from echelon.simulation.step.loop import Loop, Moment
from echelon.simulation.step.meter import Sums
from echelon.simulation.step.sequence import begin, measured_step


def by_jax(run: DifferentiableRun, steps: int, cost: Cost, reason: str = "") -> Gradient:
    """Return the gradient by JAX's reverse mode; `reason` says why not by native code."""
    (value, sums), slopes = _differentiate(*run, steps, cost)
    by_variable = {name: symmetric(name, np.asarray(slope)) for name, slope in slopes.items()}
    warnings = (f"JAX differentiates the steps, since {reason}.",) * bool(reason)
    return Gradient(float(value), by_variable, jax.tree.map(np.asarray, sums), warnings=warnings)


@cached_jit
def _differentiate(
    loop: Loop,
    values: dict[str, Array],
    states: Array,
    reference: Array | None,
    steps: int,
    cost: Cost,
) -> tuple[tuple[jax.Array, Sums], dict[str, jax.Array]]:
    """Return the cost, the sums of the run, and the slopes."""

    def whole(values: dict[str, jax.Array]) -> tuple[jax.Array, Sums]:
        start = jnp.asarray(values.get("initial", states))
        changed = _with_offsets(_with_gain(loop, values), values)
        sums = _sums(changed, start, reference, steps)
        return cost_number(cost, sums), sums

    return jax.value_and_grad(whole, has_aux=True)(jax.tree.map(jnp.asarray, values))


def _with_gain(loop: Loop, values: Mapping[str, jax.Array]) -> Loop:
    """Return the loop with other numbers in the followers' gain."""
    numbers = {name: values[name] for name in ("P", "R", "coupling") if name in values}
    if "R" in numbers:
        numbers["R_inverse"] = jnp.linalg.inv(numbers["R"])

    def places(loop: Loop) -> list[Array]:
        law: Any = loop.follower
        return [getattr(law.gain, name) for name in numbers]

    return eqx.tree_at(places, loop, [*numbers.values()]) if numbers else loop


def _with_offsets(loop: Loop, values: Mapping[str, jax.Array]) -> Loop:
    """Return the loop with other offsets of the goals."""
    if "offsets" not in values:
        return loop
    offsets, meter = values["offsets"], loop.meter
    i, j = (offsets[ends][:, np.array(meter.measured)] for ends in meter.edges.T)
    spacings = distance_of(((i - j) ** 2).sum(axis=1))

    def places(loop: Loop) -> list[Array]:
        return [loop.offsets, loop.meter.offsets, loop.meter.spacings]

    return eqx.tree_at(places, loop, [offsets, offsets, spacings])


def _sums(loop: Loop, states: jax.Array, reference: Array | None, steps: int) -> Sums:
    """Return the sums over the steps of a run."""

    def one(carry: tuple[Moment, Sums], _: None) -> tuple[tuple[Moment, Sums], None]:
        now, sums = measured_step(loop, carry[0], reference, 0)
        return (now, carry[1].plus(sums)), None

    @jax.checkpoint
    def several(carry: tuple[Moment, Sums], _: None) -> tuple[tuple[Moment, Sums], None]:
        return jax.lax.scan(one, carry, None, length=few)

    # Checkpoints and the steps after each are then equally many: the least memory.
    few = max(1, math.isqrt(steps))
    carry = begin(loop, states), loop.meter.zero_sums()
    carry, _ = jax.lax.scan(several, carry, None, length=steps // few)
    return jax.lax.scan(one, carry, None, length=steps % few)[0][1]
