"""The Jacobians of a model on a domain: a hull that contains all, or else samples of them."""

from collections.abc import Callable
from fractions import Fraction
from typing import NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np

from echelon.agents.models.model import ControlAffine
from echelon.core.cache import memoize
from echelon.core.enclosure.atoms import OpenError
from echelon.core.enclosure.hull import Box, slope_columns, slope_hull
from echelon.core.enclosure.slopes import JumpError
from echelon.core.errors import GainError
from echelon.core.numerics import precision
from echelon.core.types import Array
from echelon.core.words import Kind
from echelon.synthesis.certificates.domain import Domain
from echelon.synthesis.certificates.sampling import check_secants, sample_jacobians, unbounded_error

_OfState: TypeAlias = Callable[[jax.Array, jax.Array], jax.Array]


class Jacobians(NamedTuple):
    """Matrices A with xdot = A x near each state of a domain.

    `kind` is either vertices of a polytope that contains every Jacobian, up to `error` (n, n) entry
    by entry, or samples, at random in the domain and at its corners. `why` is the reason for
    samples instead of vertices.
    """

    matrices: Array
    error: Array
    kind: Kind
    why: str = ""


@memoize
def jacobians(model: ControlAffine, domain: Domain) -> Jacobians:
    """Return the Jacobians of f + g (u* + S v) over a domain of states and normalized inputs.

    Where the model uses a function that has no enclosure, or the hull has too many vertices, they
    are sampled.

    Raises:
        GainError: the Jacobian depends on a state that the domain leaves unbounded, or the model
            jumps, or has derivatives that are not its slopes.
    """
    return _enclose(model, domain, velocity_of(model))


@memoize
def weighted_jacobians(model: ControlAffine, domain: Domain, R: Array) -> Jacobians:
    """Return the same with g S R^-1 (g S)' to the right of each Jacobian: (K, n, 2n).

    They are enclosed together, as the two turn with the same angles.

    Raises:
        GainError: as in `jacobians`.
    """
    inverse = np.linalg.inv(R)

    def weight(x: jax.Array, v: jax.Array) -> jax.Array:
        g = model.normalized_input_map(x)
        return g @ jnp.asarray(inverse, x.dtype) @ g.T

    return _enclose(model, domain, velocity_of(model), weight)


def velocity_of(model: ControlAffine) -> _OfState:
    """Return (x, v) -> f(x) + g(x) (u* + S v), v the normalized input."""
    return lambda x, v: model.normalized_drift(x) + model.normalized_input_map(x) @ v


def model_jacobian(model: ControlAffine) -> _OfState:
    """Return (x, v) -> d/dx [f(x) + g(x) (u* + S v)], v the normalized input."""
    return jax.jacfwd(velocity_of(model))


def _enclose(
    model: ControlAffine, domain: Domain, velocity: _OfState, weight: _OfState | None = None
) -> Jacobians:
    """Return the slopes of a model over a domain, with a weight to their right."""
    names = [*model.state_names, *model.input_names]
    with precision("float64"):
        try:
            hull = slope_hull(velocity, *_boxes(model, domain), names, weight)
        except OpenError as error:
            raise unbounded_error(model, error.name) from error
        except JumpError:
            # Samples would hardly meet the jump, and JAX's derivative there is 0.
            raise
        except GainError as error:
            samples, why = sample_jacobians(model, domain, velocity, weight), str(error).rstrip(".")
            return _freeze(Jacobians(samples, np.zeros(samples.shape[1:]), Kind.SAMPLES, why))
        check_secants(model, domain, velocity, hull)
    return _freeze(Jacobians(hull.vertices, hull.error, Kind.VERTICES))


def _freeze(result: Jacobians) -> Jacobians:
    """Return the Jacobians with read-only arrays, which many callers share."""
    for array in (result.matrices, result.error):
        array.setflags(write=False)
    return result


def has_constant_input_map(model: ControlAffine, domain: Domain) -> bool:
    """Tell whether g is proved constant on the domain: the condition of the nonlocal theorem T1."""
    return bool(constant_inputs(model, domain).all())


@memoize
def constant_inputs(model: ControlAffine, domain: Domain) -> Array:
    """Return (m,) for which normalized inputs the column of g is proved constant on the domain."""
    boxes, m = _boxes(model, domain), len(model.input_names)
    constant = np.zeros(m, bool)
    for k in range(m):

        def column(x: jax.Array, v: jax.Array, k: int = k) -> jax.Array:
            return model.normalized_input_map(x)[:, k]

        states = _constant_columns(column, *boxes)
        constant[k] = states is not None and bool(states.all())
    constant.setflags(write=False)
    return constant


def offsets_are_symmetries(model: ControlAffine, domain: Domain, offsets: Array) -> bool:
    """Tell whether f and g are proved invariant under offsets (N, n) of a formation on a domain.

    f(x + d) = f(x), and g likewise, wherever x lies in the domain: f and g have the slope 0 in
    every state that d moves, from x to x + d.
    """
    moved = (offsets != offsets[0]).any(axis=0)
    away = offsets - offsets[0]
    low, high = np.minimum(away.min(axis=0), 0.0), np.maximum(away.max(axis=0), 0.0)
    # Agents are in the domain; the states without offsets are in the domain shifted by offsets.
    wider = Domain(domain.lower - high, domain.upper - low, domain.input_lower, domain.input_upper)

    def entries(x: jax.Array, v: jax.Array) -> jax.Array:
        return jnp.concatenate([model.drift(x), model.input_map(x).reshape(-1)])

    constant = _constant_columns(entries, *_boxes(model, wider))
    return constant is not None and bool(constant[moved].all())


def _constant_columns(function: _OfState, states: Box, inputs: Box) -> Array | None:
    """Return (n,) the states in which a function is proved constant; None without an enclosure."""
    constant = np.zeros(len(states.lower), bool)
    try:
        with precision("float64"):
            zero = slope_columns(function, states, inputs)
    except GainError:
        return None
    constant[list(zero)] = True
    return constant


def _boxes(model: ControlAffine, domain: Domain) -> tuple[Box, Box]:
    """Return the domain as absolute states and normalized inputs, nothing rounded."""
    trim = np.asarray(model.trim[0], float)

    def shift(bounds: Array) -> list[float | Fraction]:
        # A sum of floats would round a box far from 0 to a point.
        return [
            Fraction(float(x)) + Fraction(float(b)) if np.isfinite(b) else float(b)
            for x, b in zip(trim, bounds, strict=True)
        ]

    states = Box(shift(domain.lower), shift(domain.upper))
    return states, Box(domain.input_lower, domain.input_upper)
