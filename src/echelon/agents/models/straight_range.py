"""How far apart states may be while laws take x - y for their difference.

Theorems on a domain are of x - y. A model may take differences of angles the shorter way round, by
`wrap_angles` or by its own formula, whose period nobody states.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from echelon.agents.models.model import ControlAffine, wrap_angles
from echelon.core.cache import memoize
from echelon.core.compiled import cached_jit
from echelon.core.numerics import precision
from echelon.core.trace import trace_digest
from echelon.core.types import Array, State

_FARTHEST = 1e12
"""Beyond it nothing is tried, and so nothing is said."""
_DISTANCES = np.geomspace(1e-9, _FARTHEST, 3000)
_PAIRS = 2000
_CLOSE = 1e-6
_SAME = 1e-9  # relative
_ROUNDING = 1e-8  # what a formula such as (d + T/2) % T - T/2 is off, T below 1e8


class StraightRange(NamedTuple):
    """Up to which distance (n,) the difference of each state is x - y; infinite where it always is.

    `proved` says whether that follows from what `difference` computes, or from samples of it.
    """

    reach: Array
    proved: bool


@memoize
def straight_range(model: ControlAffine) -> StraightRange:
    """Return how far apart states of a model may be while their difference is x - y."""
    n = len(model.state_names)
    with precision("float64"):
        if _is_traced_as(model, ()):
            return StraightRange(np.full(n, np.inf), True)
        reach = _tried(model)
        angles = tuple(np.flatnonzero(np.abs(reach - np.pi) < 0.02 * np.pi).tolist())
        if _is_traced_as(model, angles):
            return StraightRange(np.where(np.isin(range(n), angles), np.pi, np.inf), True)
    return StraightRange(reach, False)


def is_straight(model: ControlAffine) -> bool:
    """Tell whether the difference of states that are close is x - y, on which modes rest."""
    return bool(straight_range(model).reach.min() > _CLOSE)


def _is_traced_as(model: ControlAffine, angles: tuple[int, ...]) -> bool:
    """Tell whether a model computes x - y, with these angles wrapped by `wrap_angles`."""
    x = jnp.zeros(len(model.state_names))

    def plain(x: State, y: State) -> State:
        return wrap_angles(x - y, *angles) if angles else x - y

    return trace_digest(model.difference, x, x) == trace_digest(plain, x, x)


def _tried(model: ControlAffine) -> Array:
    """Return the distances (n,) up to which a difference was x - y wherever it was tried."""
    draw, n = np.random.default_rng(0), len(model.state_names)
    trim = np.asarray(model.trim[0], float)
    reach = np.full(n, _FARTHEST)
    for base in (trim, trim + draw.uniform(-1.0, 1.0, n), trim + draw.uniform(-50.0, 50.0, n)):
        for far in np.concatenate([_DISTANCES, -_DISTANCES]).reshape(2, -1):
            reach = np.minimum(reach, _first_lost(model, base, np.tile(far, (n, 1))))
    # Closer together where it matters, and all states at once.
    even = np.linspace(0.0, 1.0, len(_DISTANCES) + 1)[1:]
    for sign in (1.0, -1.0):
        reach = np.minimum(reach, _first_lost(model, trim, sign * reach[:, None] * even))
    steps = draw.uniform(-1.0, 1.0, (_PAIRS, n)) * reach
    lost = _lost(model, np.tile(trim, (_PAIRS, 1)), trim + steps).any(axis=0)
    return np.where(lost, 0.0, reach)


def _first_lost(model: ControlAffine, base: Array, far: Float[Array, "n k"]) -> Array:
    """Return the last distance (n,) before the first at which a difference is not x - y."""
    n, count = far.shape
    steps = np.eye(n)[:, None, :] * far[:, :, None]
    y = np.tile(base, (n * count, 1))
    lost = _lost(model, y, base + steps.reshape(-1, n)).any(axis=1).reshape(n, count)
    first = np.where(lost.any(axis=1), lost.argmax(axis=1), count)
    sizes = np.concatenate([np.zeros((n, 1)), np.abs(far)], axis=1)
    return sizes[range(n), first] if count else sizes[:, 0]


def _lost(model: ControlAffine, y: Array, x: Array) -> Array:
    """Return (K, n) whether differences of states (K, n) are not x - y."""
    plain = x - y
    gap = np.abs(np.asarray(_differences(model, x, y)) - plain)
    return ~(gap <= _SAME * np.abs(plain).max(axis=1, keepdims=True) + _ROUNDING)


@cached_jit
def _differences(model: ControlAffine, x: jax.Array, y: jax.Array) -> jax.Array:
    return jax.vmap(model.difference)(x, y)
