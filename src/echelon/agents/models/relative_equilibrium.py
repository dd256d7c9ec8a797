"""Trims that move: relative equilibria, f(x*) + g(x*) u* = w with w along translations alone.

A translation is a state on which neither f nor g depends. Differences between agents that all move
at w stay as they are, so all that is known near a trim at rest is known near one that moves.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from echelon.agents.models.linearization import at_trim
from echelon.agents.models.model import ControlAffine
from echelon.core.cache import memoize
from echelon.core.compiled import cached_jit
from echelon.core.errors import ModelError
from echelon.core.numerics import precision
from echelon.core.types import Array, State

# Far above the rounding of T/m - g, far below the error of a trim typed with a few digits.
_TRIM_TOLERANCE = 1e-9
_SHIFTS = 48
_SAME = 1e-9
"""Relative; what a shift leaves of values, and of differences."""


@memoize
def trim_velocity(model: ControlAffine) -> Array:
    """Return w = f(x*) + g(x*) u* (n,), 0 where it is rounding; zero of a trim at rest."""
    trim = at_trim(model)
    residual = trim.drift + trim.input_map @ np.asarray(model.trim[1], float)
    velocity = np.where(np.abs(residual) > _TRIM_TOLERANCE, residual, 0.0)
    velocity.setflags(write=False)
    return velocity


def moves(model: ControlAffine) -> bool:
    """Tell whether the trim of a model moves."""
    return bool(trim_velocity(model).any())


def path_states(model: ControlAffine) -> tuple[int, ...]:
    """Return the indices of the states along which a trim that moves has its speed."""
    moving = np.flatnonzero(trim_velocity(model)).tolist()
    position = model.position_indices()
    return position if {*moving} <= {*position} else tuple(moving)


def trim_speed(model: ControlAffine) -> float:
    """Return the speed of the trim along `path_states`; 0 at rest."""
    return float(np.linalg.norm(trim_velocity(model)))


def check_trim(model: ControlAffine, name: str) -> None:
    """Raise `ModelError` unless the trim rests, or moves along translations alone."""
    velocity = trim_velocity(model)
    bound = [k for k in np.flatnonzero(velocity).tolist() if not is_translation(model, k)]
    if not bound:
        return
    k = max(bound, key=lambda k: abs(velocity[k]))
    state = model.state_names[k]
    free = f", or leave `{state}` out of f and g, along which a trim may then move"
    raise ModelError(
        f"the trim of `{name}` is no equilibrium: f(x*) + g(x*) u* is {velocity[k]:.3g} "
        f"in state `{state}`, and must be within {_TRIM_TOLERANCE:g} "
        f"of zero; replace `trim`{free if state in model.position else ''}."
    )


@memoize
def is_translation(model: ControlAffine, k: int) -> bool:
    """Tell whether shifts of a state change neither f nor g, nor differences between agents.

    The output may move with it. It is tried at random states and shifts, from a hundredth to a
    million.
    """
    draw, trim = np.random.default_rng(k), np.asarray(model.trim[0], float)
    x, y = trim + draw.uniform(-0.5, 0.5, (2, _SHIFTS, len(trim)))
    sizes = np.geomspace(1e-2, 1e6, _SHIFTS) * draw.choice([-1.0, 1.0], _SHIFTS)
    shift = sizes[:, None] * np.eye(len(trim))[k]
    with precision("float64"):
        here, there = (map(np.asarray, _told(model, x + s, y + s)) for s in (0.0 * shift, shift))
    *same, (output, moved) = zip(here, there, strict=True)
    # A difference of states that were shifted far is rounded in their size.
    rounding = (1.0, 1.0, np.abs(sizes)[:, None])
    still = all(
        (np.abs(b - a) <= _SAME * np.maximum(size, np.abs(a))).all()
        for (a, b), size in zip(same, rounding, strict=True)
    )
    gained = (moved - output) / sizes[:, None]
    steady = np.abs(gained - gained[-1]) <= _SAME * np.maximum(1.0, 1e3 / np.abs(sizes[:, None]))
    return bool(still and steady.all())


@cached_jit
def _told(
    model: ControlAffine, x: Float[jax.Array, "S n"], y: Float[jax.Array, "S n"]
) -> tuple[jax.Array, ...]:
    """Return f, g and the output at states, and their difference to others, a row each."""
    count = len(x)
    rows = functools.partial(jnp.reshape, shape=(count, -1))
    f, g, h = (jax.vmap(part)(x) for part in (model.drift, model.input_map, model.output))
    return rows(f), rows(g), jax.vmap(model.difference)(x, y), rows(h)


def separation(model: ControlAffine, offset: Array) -> Array:
    """Return how fast an agent at the trim with an offset (n,) leaves one at the trim, (n,)."""
    with precision("float64"):
        x, u = (np.asarray(part, float) for part in model.trim)
        there = np.asarray(_velocity(model, x + offset, u))
    return there - trim_velocity(model)


@cached_jit
def _velocity(model: ControlAffine, x: State, u: jax.Array) -> State:
    return model.velocity(x, u)
