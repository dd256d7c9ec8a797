"""A reference by a model's flatness map: the states and inputs that follow it, and their demand."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from echelon.core.errors import LawError, PlanError, listing
from echelon.core.numerics import precision
from echelon.core.trace import check_array, traced
from echelon.core.types import Array, Input, Scalar, State
from echelon.models.model import ControlAffine
from echelon.references.reference import COORDINATES, Reference, check_reference


def follow(model: ControlAffine, reference: Reference, t: Scalar) -> tuple[State, Input]:
    """Return the state (n,) and input (m,) that follow a reference exactly, at time t (s)."""
    return model.flat(reference.derivatives(t, model.flat_order, model.flat_outputs))


_FEW = 512
"""Of so many times or fewer all are followed by one program, since compiling is what costs."""


def follow_at(
    model: ControlAffine, reference: Reference, times: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Return the states (T, n) and inputs (T, m) that follow a reference exactly at times (T,)."""
    count = len(times)
    padded = jnp.pad(times, (0, max(0, _FEW - count)), mode="edge")
    x, u = _follow_all(model, reference, padded)
    return x[:count], u[:count]


@eqx.filter_jit
def _follow_all(
    model: ControlAffine, reference: Reference, times: jax.Array
) -> tuple[jax.Array, jax.Array]:
    return jax.vmap(lambda t: follow(model, reference, t))(times)


def reference_warnings(
    model: ControlAffine, reference: Reference, horizon: float, samples: int = 1000
) -> tuple[str, ...]:
    """Return a sentence with the ratio if a reference needs more than the actuators can deliver.

    Args:
        model: the agent; it must have a flatness map.
        reference: to be followed exactly.
        horizon: how long, s.
        samples: how many times are looked at.
    """
    times = np.linspace(0.0, horizon, samples)
    inputs = flat_inputs(model, reference, times)
    ratios = demand(model, inputs)
    worst = int(np.argmax(ratios))
    if not ratios[worst] > 1.0:
        return ()
    needed = ", ".join(
        f"{name} {value:.3g} {unit}".rstrip()
        for name, value, unit in zip(
            model.input_names, inputs[worst], model.input_units, strict=True
        )
    )
    return (
        f"the reference `{type(reference).__name__}` is too fast for `{type(model).__name__}`: at "
        f"t = {times[worst]:.3g} s it needs {ratios[worst]:.3g} times what the actuators leave "
        f"beyond the trim ({needed}); make it slower or smaller.",
    )


def flat_inputs(model: ControlAffine, reference: Reference, times: Array) -> Array:
    """Return the inputs (T, m) that follow a reference exactly, by the model's flatness map."""
    # Up to four nested derivatives of a path leave float32 too few digits to judge limits by.
    with precision("float64"):
        return np.asarray(follow_at(model, reference, jnp.asarray(times))[1])


def demand(model: ControlAffine, inputs: Array) -> Array:
    """Return for each input (T, m) how much of the actuators' room about the trim it takes, (T,).

    One is the limit; 0.5 leaves as much again. Without limits it is zero.
    """
    if model.input_limits is None:
        return np.zeros(len(inputs))
    G, low, high = (np.asarray(part, float) for part in model.input_limits)
    # What the trim takes is not free: at hover only the thrust beyond m g is room.
    held = G @ np.asarray(model.trim[1], float)
    moved = (inputs - np.asarray(model.trim[1], float)) @ G.T
    room = np.where(moved > 0.0, high - held, held - low)
    # No room at all makes the demand infinite, and 0 / 0 is no demand.
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(moved == 0.0, 0.0, np.abs(moved) / np.maximum(room, 0.0)).max(axis=1)


class Targets(NamedTuple):
    """What a plan follows at T times.

    States (T, n) are a guess of the motion, outputs (T, q) are what counts, inputs (T, m) are
    normalized.
    """

    states: Array
    outputs: Array
    inputs: Array


def reference_targets(model: ControlAffine, reference: Reference | None, times: Array) -> Targets:
    """Return what a leader follows: its reference by the model's flatness map, or its trim.

    Raises:
        PlanError: the model has no such map, or the reference is not finite.
    """
    # Without a reference a leader stays at rest, which its trim is.
    if reference is None:
        x = np.tile(np.asarray(model.trim[0], float), (len(times), 1))
        return _targets(model, x, np.zeros((len(times), len(model.input_names))))
    check_reference(reference)
    unknown = [name for name in model.flat_outputs if name not in COORDINATES]
    if not model.flat_outputs or unknown:
        raise PlanError(
            f"`{type(model).__name__}` cannot be led along a reference: it needs `flat_outputs` "
            f"out of {listing(COORDINATES)}, `flat_order` and `flat`."
        )
    with precision("float64"):
        x, u = map(np.asarray, follow_at(model, reference, jnp.asarray(times)))
    if not (np.isfinite(x).all() and np.isfinite(u).all()):
        raise PlanError(
            f"the reference `{type(reference).__name__}` cannot be followed by "
            f"`{type(model).__name__}`: its flat state and input are not finite."
        )
    return _targets(model, x, model.normalized(u))


def shifted_targets(model: ControlAffine, targets: Targets, offset: Array) -> Targets:
    """Return the same targets an offset (n,) away."""
    return _targets(model, targets.states + offset, targets.inputs)


def mean_targets(model: ControlAffine, states: Array, inputs: Array, share: Array) -> Targets:
    """Return the mean of targets with states (J, T, n) and inputs (J, T, m), by shares (J,).

    A sum of squared errors to several targets is that to their mean and a constant.
    """
    return _targets(model, np.tensordot(share, states, 1), np.tensordot(share, inputs, 1))


def _targets(model: ControlAffine, x: Array, v: Array) -> Targets:
    with precision("float64"):
        outputs = np.asarray(_outputs(model, jnp.asarray(x)))
    return Targets(x, outputs, v)


@eqx.filter_jit
def _outputs(model: ControlAffine, states: jax.Array) -> jax.Array:
    return jax.vmap(model.output)(states)


def check_flat(model: ControlAffine) -> None:
    """Check that a model has a flatness map, of outputs that a reference gives.

    Raises:
        LawError: it has none.
    """
    if not model.flat_outputs:
        raise LawError(
            f"the law `tracking` cannot lead `{type(model).__name__}`, "
            "which defines no `flat` map; "
            "use `passive`, or add `flat_outputs`, `flat_order` and `flat` to the model."
        )
    unknown = [name for name in model.flat_outputs if name not in COORDINATES]
    if unknown:
        raise LawError(
            f"`flat_outputs` of `{type(model).__name__}` names {listing(unknown)}, "
            f"and a reference gives {listing(COORDINATES)}."
        )
    _check_map(model)


def _check_map(model: ControlAffine) -> None:
    """Trace the flatness map, and check the state and the input that it returns."""
    name, shapes = type(model).__name__, (len(model.state_names), len(model.input_names))
    with precision("float64"):
        found = traced(
            LawError,
            f"`flat` of `{name}`",
            model.flat,
            jnp.zeros((model.flat_order + 1, len(model.flat_outputs))),
            advice="it must be written with `jax.numpy` and take the outputs' derivatives",
        ).result
    if not isinstance(found, tuple | list) or len(found) != 2:
        raise LawError(f"`flat` of `{name}` must return two things, a state and an input.")
    for what, value, size in zip(("state", "input"), found, shapes, strict=True):
        check_array(LawError, f"the {what} that `flat` of `{name}` makes", value, (size,))
