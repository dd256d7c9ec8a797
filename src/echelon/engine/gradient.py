"""How a cost of a run changes with its gain and its starts: the closed loop differentiated."""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from echelon.core.errors import SimulationError, did_you_mean, listing
from echelon.core.numerics import precision
from echelon.core.types import Array
from echelon.engine.laws import Laws
from echelon.engine.loop import Loop, Moment, assemble, begin, control, step
from echelon.engine.parts import Parts
from echelon.engine.prepare import Prepared, prepare
from echelon.engine.settings import Settings
from echelon.engine.simulate import sample_reference
from echelon.engine.sums import Sums, reference_at

Cost: TypeAlias = Callable[[Sums], jax.Array]
"""What is to be small, a number made of the sums over all steps of a run, in JAX."""

VARIABLES = ("P", "R", "coupling", "initial")
"""What a cost can be differentiated by: of the followers' gain, and the starts (N, n)."""


class Gradient(NamedTuple):
    """A cost, its slope along each of the variables that were asked for, and the sums of the run.

    The slope along P or R is symmetric, that of a change that is.
    """

    value: float
    slopes: Mapping[str, Array]
    sums: Sums


def gradient(parts: Parts, settings: Settings, cost: Cost, wrt: Sequence[str]) -> Gradient:
    """Return a cost of a run and how it changes with some of what the run is made of.

    The steps of JAX are differentiated backwards, in float64. Of every some of them the states are
    kept and the steps between computed again, so that memory grows with the root of their number.

    Args:
        parts: agents, graph, formation, laws, starts and world.
        settings: horizon, step and the like.
        cost: of the sums over the run's steps, such as `lambda sums: sums.errors[0].sum()`.
        wrt: of `VARIABLES`.

    Raises:
        EchelonError: a part is malformed or does not fit the others; what drives the agents are no
            laws, or have no gain; a variable is unknown.
    """
    prepared = prepare(parts, settings)
    values = _values(prepared, wrt)
    drive = prepared.parts.drive
    assert isinstance(drive, Laws)
    with precision("float64"):
        loop = assemble(prepared.problem, drive.leader, drive.follower)
        reference = sample_reference(prepared, 0, settings.steps)
        (value, sums), slopes = _differentiate(
            loop, values, prepared.problem.states, reference, settings.steps, cost
        )
    found = {name: _symmetric(name, np.asarray(slope)) for name, slope in slopes.items()}
    return Gradient(float(value), found, jax.tree.map(np.asarray, sums))


def _values(prepared: Prepared, wrt: Sequence[str]) -> dict[str, Array]:
    """Return what a cost is differentiated by, by name."""
    drive, gain = prepared.parts.drive, prepared.parts.drive.gain
    if not isinstance(drive, Laws):
        raise SimulationError(
            f"a run driven by `{type(drive).__name__}` cannot be differentiated, one by `Laws` can."
        )
    known: dict[str, Array] = {"initial": np.asarray(prepared.problem.states)}
    if gain is not None:
        known |= {"P": gain.P, "R": gain.R, "coupling": np.asarray(gain.coupling)}
    for name in wrt:
        if name in VARIABLES and name not in known:
            law = type(drive.follower).__name__
            raise SimulationError(f"the followers' law `{law}` has no gain, and so no `{name}`.")
        if name not in known:
            raise SimulationError(
                f"`wrt` names `{name}`, allowed are {listing(VARIABLES)}"
                f"{did_you_mean(name, VARIABLES)}."
            )
    return {name: known[name] for name in wrt}


def _symmetric(name: str, slope: Array) -> Array:
    return 0.5 * (slope + slope.T) if name in ("P", "R") else slope


@eqx.filter_jit
def _differentiate(
    loop: Loop,
    values: dict[str, Array],
    states: Array,
    reference: Array | None,
    steps: int,
    cost: Cost,
) -> Any:
    """Return the cost, the sums of the run, and the slopes."""

    def whole(values: dict[str, Any]) -> tuple[jax.Array, Sums]:
        start = jnp.asarray(values.get("initial", states))
        sums = _sums(_with_gain(loop, values), start, reference, steps)
        return cost(sums), sums

    return jax.value_and_grad(whole, has_aux=True)(jax.tree.map(jnp.asarray, values))


def _with_gain(loop: Loop, values: Mapping[str, Any]) -> Loop:
    """Return the loop with other numbers in the followers' gain."""
    given = {name: values[name] for name in ("P", "R", "coupling") if name in values}
    if "R" in given:
        given["R_inverse"] = jnp.linalg.inv(given["R"])

    def places(loop: Loop) -> list[Any]:
        gain: Any = loop.follower
        return [getattr(gain.gain, name) for name in given]

    return eqx.tree_at(places, loop, [*given.values()]) if given else loop


def _sums(loop: Loop, states: jax.Array, reference: Array | None, steps: int) -> Sums:
    """Return the sums over the steps of a run."""

    def one(done: tuple[Moment, Sums], _: None) -> tuple[tuple[Moment, Sums], None]:
        now, sums = done
        acted = control(loop, now)
        wanted = reference_at(reference, now.step, now.states)
        # What is counted has no slope, and needs no look at who went from limit to limit.
        read = loop.meter.read(
            now.step, now.states, acted.inputs, acted.limited, jnp.zeros_like(acted.limited), wanted
        )
        return (step(loop, now, acted), sums.plus(read)), None

    @jax.checkpoint
    def several(done: tuple[Moment, Sums], _: None) -> tuple[tuple[Moment, Sums], None]:
        return jax.lax.scan(one, done, None, length=few)

    few = max(1, math.isqrt(steps))
    done = begin(loop, states), loop.meter.nothing()
    done, _ = jax.lax.scan(several, done, None, length=steps // few)
    return jax.lax.scan(one, done, None, length=steps % few)[0][1]
