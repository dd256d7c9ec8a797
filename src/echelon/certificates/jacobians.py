"""The Jacobians of a model on a domain: a hull that holds them all, or else samples of them."""

from collections.abc import Callable
from typing import NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np

from echelon.certificates.domain import Domain
from echelon.core.errors import GainError
from echelon.core.kept import kept
from echelon.core.numerics import precision
from echelon.core.types import Array
from echelon.core.words import Kind
from echelon.enclosure.hull import Box, Hull, jacobian_hull
from echelon.models.model import ControlAffine

_SAMPLES = 400
_FEW = 7
"""Up to so many bounded states and inputs, every corner of a domain is among the samples."""
_OfState: TypeAlias = Callable[[jax.Array, jax.Array], jax.Array]


class Jacobians(NamedTuple):
    """Matrices A with xdot = A x near each state of a domain.

    `kind` says what they stand for: vertices of a polytope that holds every Jacobian, up to
    `error` (n, n) entry by entry, or samples taken at random in the domain and at its corners.
    `why` says what kept samples from being vertices.
    """

    matrices: Array
    error: Array
    kind: Kind
    why: str = ""


@kept
def jacobians(model: ControlAffine, domain: Domain) -> Jacobians:
    """Return the Jacobians of f + g (u* + S v) over a domain of states and normalized inputs.

    Where the model uses a function that has no enclosure, or the hull has too many vertices, they
    are sampled.

    Raises:
        GainError: the Jacobian depends on a state that the domain leaves unbounded.
    """
    return _enclose(model_jacobian(model), model, domain)


@kept
def weighted_jacobians(model: ControlAffine, domain: Domain, R: Array) -> Jacobians:
    """Return the same with g S R^-1 (g S)' to the right of each Jacobian: (K, n, 2n).

    They are enclosed together, as the two turn with the same angles.

    Raises:
        GainError: either depends on a state that the domain leaves unbounded.
    """
    jacobian, inverse = model_jacobian(model), np.linalg.inv(R)

    def pair(x: jax.Array, v: jax.Array) -> jax.Array:
        g = model.normalized_input_map(x)
        return jnp.concatenate([jacobian(x, v), g @ jnp.asarray(inverse, x.dtype) @ g.T], axis=1)

    return _enclose(pair, model, domain)


def _enclose(function: _OfState, model: ControlAffine, domain: Domain) -> Jacobians:
    """Return a matrix function of state and normalized input over a domain."""
    names = [*model.state_names, *model.input_names]
    with precision("float64"):
        try:
            hull = jacobian_hull(function, *_boxes(model, domain), names)
        except GainError as error:
            samples, why = _sample(function, model, domain), str(error).rstrip(".")
            return _freeze(Jacobians(samples, np.zeros(samples.shape[1:]), Kind.SAMPLES, why))
    _check_bounded(model, domain, hull)
    return _freeze(Jacobians(hull.vertices, hull.error, Kind.VERTICES))


def _freeze(found: Jacobians) -> Jacobians:
    """Return Jacobians that nobody can write to, since many callers share them."""
    for array in (found.matrices, found.error):
        array.setflags(write=False)
    return found


@kept
def has_constant_input_map(model: ControlAffine, domain: Domain) -> bool:
    """Tell whether g is proved constant on the domain: the condition of the nonlocal theorem T1."""

    def slope(x: jax.Array, v: jax.Array) -> jax.Array:
        n = len(model.state_names)
        return jax.jacfwd(model.normalized_input_map)(x).reshape(-1, n)

    try:
        with precision("float64"):
            hull = jacobian_hull(slope, *_boxes(model, domain))
    except GainError:
        return False
    # g is proved constant where the hull of its slopes is the matrix 0 alone.
    return not (hull.vertices.any() or hull.error.any())


def _boxes(model: ControlAffine, domain: Domain) -> tuple[Box, Box]:
    """Return the domain as absolute states and normalized inputs; unbounded states in +-1."""
    trim = np.asarray(model.trim[0], float)
    # Any stand-in will do: a Jacobian that depends on such a state is refused afterwards.
    low = np.where(np.isfinite(domain.lower), domain.lower, -1.0)
    high = np.where(np.isfinite(domain.upper), domain.upper, 1.0)
    return Box(trim + low, trim + high), Box(domain.input_lower, domain.input_upper)


def _check_bounded(model: ControlAffine, domain: Domain, hull: Hull) -> None:
    """Refuse a domain that leaves open a state on which the Jacobian depends."""
    used = {atom.name for atom in hull.atoms}
    for k, name in enumerate(model.state_names):
        if name in used and not np.isfinite([domain.lower[k], domain.upper[k]]).all():
            raise _unbounded_error(model, name)


def _unbounded_error(model: ControlAffine, name: str) -> GainError:
    return GainError(
        f"the domain leaves `{name}` unbounded, and the Jacobian of "
        f"`{type(model).__name__}` depends on it; give it a bound."
    )


def _sample(function: _OfState, model: ControlAffine, domain: Domain) -> Array:
    """Return the matrices inside the domain and at its corners, all of them where they are few.

    Raises:
        GainError: they depend on a state that the domain leaves unbounded.
    """
    states, inputs = domain.sample(2 * _SAMPLES)
    box = np.array([[*domain.lower, *domain.input_lower], [*domain.upper, *domain.input_upper]])
    used = np.flatnonzero(np.isfinite(box).all(axis=0) & (box[0] < box[1]))
    both = np.concatenate([states, inputs], axis=1)
    sides = np.random.default_rng(1).integers(0, 2, (_SAMPLES, len(used)))
    if len(used) <= _FEW:
        few = np.arange(2 ** len(used))[:, None] >> np.arange(len(used)) & 1
        sides[: len(few)] = few
    both[_SAMPLES:, used] = np.take_along_axis(box[:, used], sides, axis=0)
    base = np.append(np.asarray(model.trim[0], float), np.zeros(len(model.input_names)))
    n, at = len(model.state_names), jax.jit(jax.vmap(function))

    def matrices(points: Array) -> Array:
        return np.asarray(at(jnp.asarray((base + points)[:, :n]), jnp.asarray(points[:, n:])))

    found = matrices(both)
    for k in np.flatnonzero(~np.isfinite(box).all(axis=0)):
        # 3 is no multiple of pi, so that no sine hides its state.
        far = both + np.where(np.arange(len(base)) == k, 3.0, 0.0)
        if np.abs(matrices(far) - found).max() > 1e-12 * np.abs(found).max():
            raise _unbounded_error(model, model.state_names[k])
    return found


def model_jacobian(model: ControlAffine) -> Callable[[jax.Array, jax.Array], jax.Array]:
    """Return (x, v) -> d/dx [f(x) + g(x) (u* + S v)], v the normalized input."""

    def jacobian(x: jax.Array, v: jax.Array) -> jax.Array:
        def velocity(x: jax.Array) -> jax.Array:
            return model.normalized_drift(x) + model.normalized_input_map(x) @ v

        return jax.jacfwd(velocity)(x)

    return jacobian
