"""What a reference asks of the actuators, before anything is planned or simulated."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from echelon.core.numerics import precision
from echelon.core.types import Matrix
from echelon.models.model import ControlAffine
from echelon.references.reference import Reference


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
    asked = ", ".join(
        f"{name} {value:.3g} {unit}".rstrip()
        for name, value, unit in zip(
            model.input_names, inputs[worst], model.input_units, strict=True
        )
    )
    return (
        f"the reference `{type(reference).__name__}` is too fast for `{type(model).__name__}`: at "
        f"t = {times[worst]:.3g} s it needs {ratios[worst]:.3g} times what the actuators leave "
        f"beyond the trim ({asked}); make it slower or smaller.",
    )


def flat_inputs(model: ControlAffine, reference: Reference, times: Matrix) -> Matrix:
    """Return the inputs (T, m) that follow a reference exactly, by the model's flatness map."""
    with precision("float64"):
        return np.asarray(_flat_inputs(model, reference, jnp.asarray(times)))


@eqx.filter_jit
def _flat_inputs(model: ControlAffine, reference: Reference, times: jax.Array) -> jax.Array:
    order, names = model.flat_order, model.flat_outputs
    return jax.vmap(lambda t: model.flat(reference.derivatives(t, order, names))[1])(times)


def demand(model: ControlAffine, inputs: Matrix) -> Matrix:
    """Return for each input (T, m) how much of the actuators' room about the trim it takes, (T,).

    One is the limit; 0.5 leaves as much again. Without limits it is zero.
    """
    if model.input_limits is None:
        return np.zeros(len(inputs))
    G, low, high = (np.asarray(part, float) for part in model.input_limits)
    held = G @ np.asarray(model.trim[1], float)
    moved = (inputs - np.asarray(model.trim[1], float)) @ G.T
    room = np.where(moved > 0.0, high - held, held - low)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(moved == 0.0, 0.0, np.abs(moved) / np.maximum(room, 0.0)).max(axis=1)
