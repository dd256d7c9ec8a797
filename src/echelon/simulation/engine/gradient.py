"""Gradients of a cost of a run by JAX's reverse-mode differentiation of the closed loop."""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from echelon.core.compiled import cached_jit
from echelon.core.errors import SimulationError, check_name
from echelon.core.numerics import precision
from echelon.core.trace import error_summary
from echelon.core.types import Array
from echelon.simulation.engine.law_drive import Laws
from echelon.simulation.engine.parts import Parts
from echelon.simulation.engine.prepare import prepare
from echelon.simulation.engine.simulate import sample_reference
from echelon.simulation.step.assembly import assemble
from echelon.simulation.step.distances import distance_of
from echelon.simulation.step.drive import Controller, Problem
from echelon.simulation.step.loop import Loop
from echelon.simulation.step.meter import Sums
from echelon.simulation.step.records import LoopState
from echelon.simulation.step.sequence import begin, measured_step, step
from echelon.simulation.step.settings import Settings

Cost: TypeAlias = Callable[[Sums], jax.Array]
"""A scalar cost of the sums over all steps of a run, written with `jax.numpy`."""

VARIABLES = ("P", "R", "coupling", "initial", "offsets")
"""What a cost can be differentiated by.

P, R and the coupling of the followers' gain; the initial states (N, n); the goals' offsets (N, n),
at fixed initial states.
"""


class Gradient(NamedTuple):
    """A cost, its derivative by each requested variable, and the sums of the run.

    The derivatives by P and R are symmetric, for symmetric changes.
    """

    value: float
    slopes: Mapping[str, Array]
    sums: Sums


def gradient(parts: Parts, settings: Settings, cost: Cost, wrt: Sequence[str]) -> Gradient:
    """Return a cost of a run and its derivatives by some of the run's parameters.

    JAX differentiates the steps backwards in float64, whatever `settings.engine` is. States are
    stored at checkpoints and the steps between are computed again, so that memory grows with the
    square root of the number of steps.

    Args:
        parts: agents, graph, formation, laws, starts and world.
        settings: horizon, step and the like.
        cost: of the sums over the run's steps, such as `lambda sums: sums.errors[0].sum()`. It is
            traced once, as by `jax.jit`: values that it reads from its closure or module stay as
            they were then; pass a new function for other values.
        wrt: of `VARIABLES`.

    Raises:
        EchelonError: a part is malformed or does not fit the others; the agents are not driven by
            laws, or these have no gain; the end of a loop depends on numbers, as in `safety`;
            a variable is unknown; the cost fails, or is not one number.
    """
    if isinstance(wrt, str):
        raise SimulationError(f"`wrt` is the text {wrt!r}, and must be a list, such as [{wrt!r}].")
    if parts.formation.motion is not None:
        raise SimulationError(
            "got a formation that changes, but derivatives are of constant ones; leave out "
            "`motion` here, and give it to the runs afterwards."
        )
    with precision("float64"):
        # No frame is stored, and no cost depends on who is closest.
        prepared = prepare(parts, settings._replace(store_every=1))
        problem, drive = prepared.problem, prepared.parts.drive
        values = _values_of(problem, drive, wrt)
        assert isinstance(drive, Laws)  # `_values_of` rejects all others
        loop = assemble(problem, drive.leader, drive.follower)
        reference = sample_reference(prepared, 0, settings.steps)
        try:
            (value, sums), slopes = _differentiate(
                loop, values, problem.states, reference, settings.steps, cost
            )
        except ValueError as error:
            if "Reverse-mode" not in str(error):
                raise
            raise SimulationError(_searching(problem, drive)) from error
    by_variable = {name: np.asarray(slope) for name, slope in slopes.items()}
    for name in {"P", "R"} & by_variable.keys():
        by_variable[name] = 0.5 * (by_variable[name] + by_variable[name].T)
    return Gradient(float(value), by_variable, jax.tree.map(np.asarray, sums))


def _searching(problem: Problem, drive: Laws) -> str:
    """Return that steps have no derivative, and since which part of a user's own."""
    parts = problem.parts
    first = (problem._replace(parts=parts[:k]) for k in range(1 + len(parts)))
    k = next((len(each.parts) for each in first if not _has_derivative(each, drive)), 0)
    whose = f"{parts[k - 1].words(problem.model)} has" if k else "the steps have"
    like = ", as `safety` has and `prediction: packet` of states" * (not k)
    return f"{whose} a loop whose end depends on numbers{like}, and JAX has no derivative of it."


def _has_derivative(problem: Problem, drive: Laws) -> bool:
    def stepped(states: jax.Array) -> jax.Array:
        loop = assemble(problem, drive.leader, drive.follower)
        return ravel_pytree(step(loop, begin(loop, states)))[0].sum()

    try:
        jax.eval_shape(jax.grad(stepped), jnp.asarray(problem.states))
    except ValueError:
        return False
    except Exception:  # somebody's own part may need those behind it
        return True
    return True


def _values_of(problem: Problem, drive: Controller, wrt: Sequence[str]) -> dict[str, Array]:
    gain = drive.gain
    if not isinstance(drive, Laws):
        raise SimulationError(
            f"a run driven by `{type(drive).__name__}` cannot be differentiated; use `Laws`."
        )
    available = {"initial": np.asarray(problem.states), "offsets": problem.formation.offsets}
    if gain is not None:
        available |= {"P": gain.P, "R": gain.R, "coupling": np.asarray(gain.coupling)}
    for name in wrt:
        if name in VARIABLES and name not in available:
            law = type(drive.follower).__name__
            raise SimulationError(f"the followers' law `{law}` has no gain, and so no `{name}`.")
        check_name("`wrt` names", name, VARIABLES, SimulationError)
    return {name: available[name] for name in wrt}


def _cost_number(cost: Cost, sums: Sums) -> jax.Array:
    try:
        value = cost(sums)
    # The cost is the user's code, which may raise whatever it likes.
    except Exception as error:
        raise SimulationError(
            f"the cost of a run fails with {error_summary(error)}; it must be a function of the "
            "run's sums, written with `jax.numpy`."
        ) from error
    if (shape := jnp.shape(value)) != ():
        raise SimulationError(
            f"the cost of a run has shape {shape}, and must be one number, such as a sum of it."
        )
    return value


@cached_jit
def _differentiate(
    loop: Loop,
    values: dict[str, Array],
    states: Array,
    reference: Array | None,
    steps: int,
    cost: Cost,
) -> tuple[tuple[jax.Array, Sums], dict[str, jax.Array]]:
    def whole(values: dict[str, jax.Array]) -> tuple[jax.Array, Sums]:
        start = jnp.asarray(values.get("initial", states))
        changed = _with_offsets(_with_gain(loop, values), values)
        sums = _sums(changed, start, reference, steps)
        return _cost_number(cost, sums), sums

    return jax.value_and_grad(whole, has_aux=True)(jax.tree.map(jnp.asarray, values))


def _with_gain(loop: Loop, values: Mapping[str, jax.Array]) -> Loop:
    numbers = {name: values[name] for name in ("P", "R", "coupling") if name in values}
    if "R" in numbers:
        numbers["R_inverse"] = jnp.linalg.inv(numbers["R"])

    def places(loop: Loop) -> list[Array]:
        law: Any = loop.laws.follower
        return [getattr(law.gain, name) for name in numbers]

    return eqx.tree_at(places, loop, [*numbers.values()]) if numbers else loop


def _with_offsets(loop: Loop, values: Mapping[str, jax.Array]) -> Loop:
    if "offsets" not in values:
        return loop
    offsets, meter = values["offsets"], loop.meter
    i, j = (offsets[ends][:, np.array(meter.measured)] for ends in meter.edges.T)
    spacings = distance_of(((i - j) ** 2).sum(axis=1))

    def places(loop: Loop) -> list[Array]:
        return [loop.places.offsets, loop.meter.offsets, loop.meter.spacings]

    return eqx.tree_at(places, loop, [offsets, offsets, spacings])


def _sums(loop: Loop, states: jax.Array, reference: Array | None, steps: int) -> Sums:
    def one(carry: tuple[LoopState, Sums], _: None) -> tuple[tuple[LoopState, Sums], None]:
        now, sums = measured_step(loop, carry[0], reference, 0)
        return (now, carry[1].plus(sums)), None

    @jax.checkpoint
    def several(carry: tuple[LoopState, Sums], _: None) -> tuple[tuple[LoopState, Sums], None]:
        return jax.lax.scan(one, carry, None, length=few)

    # Checkpoints and the steps after each are then equally many: the least memory.
    few = max(1, math.isqrt(steps))
    carry = begin(loop, states), loop.meter.zero_sums()
    carry, _ = jax.lax.scan(several, carry, None, length=steps // few)
    return jax.lax.scan(one, carry, None, length=steps % few)[0][1]
