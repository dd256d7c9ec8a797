"""The states and inputs of a model that follow a reference."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Float

from echelon.agents.models.model import ControlAffine
from echelon.agents.references.guide import Guide
from echelon.agents.references.reference import check_reference
from echelon.core.compiled import cached_jit
from echelon.core.errors import LawError, PlanError
from echelon.core.numerics import precision
from echelon.core.types import Array, State

_FEW, _MANY = 512, 4096
"""Up to `_MANY` times are computed in blocks of `_FEW` by one program, since compiling is slow."""


def follow_at(
    model: ControlAffine, reference: Guide, times: Float[Array, " T"] | Float[jax.Array, " T"]
) -> tuple[Any, Any]:
    """Return the states (T, n) and inputs (T, m) that follow a reference exactly at times (T,)."""
    if isinstance(times, Tracer) or len(times) > _MANY:
        return _follow_all(model, reference, times)
    count = len(times)
    padded = np.pad(np.asarray(times), (0, -count % _FEW), mode="edge")
    blocks = np.split(padded, len(padded) // _FEW)
    paths = [_follow_all(model, reference, block) for block in blocks]
    x, u = (np.concatenate(parts)[:count] for parts in zip(*paths, strict=True))
    return x, u


def followed_states(model: ControlAffine, reference: Guide, times: Array | jax.Array) -> jax.Array:
    """Return the states (T, n) that follow a reference exactly at times (T,)."""
    # `asarray` would compile a program of its own.
    return jax.device_put(follow_at(model, reference, times)[0])


def first_state(model: ControlAffine, reference: Guide) -> State:
    """Return the state (n,) that follows a reference at time zero."""
    return jax.device_put(follow_at(model, reference, np.zeros(1))[0][0])


@cached_jit
def _follow_all(
    model: ControlAffine, reference: Guide, times: Array | jax.Array
) -> tuple[jax.Array, jax.Array]:
    return jax.vmap(lambda t: reference.follow(model, t))(times)


class Targets(NamedTuple):
    """The targets of a plan at T times.

    States (T, n) are an initial guess of the motion, outputs (T, q) enter the objective, inputs
    (T, m) are normalized.
    """

    states: Array
    outputs: Array
    inputs: Array


def reference_targets(model: ControlAffine, reference: Guide | None, times: Array) -> Targets:
    """Return the targets of a leader: its reference by the model's flatness map, or its trim.

    Raises:
        PlanError: the model has no such map, or the reference is not finite.
    """
    # Without a reference a leader stays at rest, at its trim.
    if reference is None:
        x = np.tile(np.asarray(model.trim[0], float), (len(times), 1))
        return _targets(model, x, np.zeros((len(times), len(model.input_names))))
    check_reference(reference)
    try:
        reference.fit(model)
    except LawError as error:
        raise PlanError(str(error)) from None
    with precision("float64"):
        x, u = follow_at(model, reference, times)
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

    A sum of squared errors to several targets equals that to their mean plus a constant.
    """
    return _targets(model, np.tensordot(share, states, 1), np.tensordot(share, inputs, 1))


def _targets(model: ControlAffine, x: Array, v: Array) -> Targets:
    with precision("float64"):
        outputs = np.asarray(_outputs(model, jnp.asarray(x)))
    return Targets(x, outputs, v)


@cached_jit
def _outputs(model: ControlAffine, states: jax.Array) -> jax.Array:
    return jax.vmap(model.output)(states)
