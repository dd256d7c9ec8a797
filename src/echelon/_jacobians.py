"""The Jacobians of a model on a domain: a hull that holds them all, or else samples of them."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from echelon._certificates import Kind
from echelon._domain import Domain
from echelon._errors import GainError
from echelon._hull import Box, Hull, jacobian_hull, model_jacobian
from echelon._types import Matrix
from echelon.models.model import ControlAffine

_SAMPLES = 400


class Jacobians(NamedTuple):
    """Matrices A with xdot = A x near each state of a domain.

    `kind` says what they stand for: `vertices` of a polytope that holds every Jacobian, up to
    `error` (n, n) entry by entry, or `samples` taken at random.
    """

    matrices: Matrix
    error: Matrix
    kind: Kind


def jacobians(model: ControlAffine, domain: Domain) -> Jacobians:
    """Return the Jacobians of f + g (u* + S v) over a domain of states and normalized inputs.

    Where the model uses a function that has no enclosure, or the hull has too many vertices, they
    are sampled.

    Raises:
        GainError: the Jacobian depends on a state that the domain leaves unbounded.
    """
    try:
        hull = _hull(model, domain)
    except GainError:
        return Jacobians(_sampled(model, domain), np.zeros((len(domain.lower),) * 2), "samples")
    _check_bounded(model, domain, hull)
    return Jacobians(hull.vertices, hull.error, "vertices")


def has_constant_input_map(model: ControlAffine, domain: Domain) -> bool:
    """Tell whether g is proved constant on the domain: the condition of the nonlocal theorem T1."""

    def slope(x: jax.Array, v: jax.Array) -> jax.Array:
        n = len(model.state_names)
        return jax.jacfwd(model.normalized_input_map)(x).reshape(-1, n)

    try:
        hull = jacobian_hull(slope, *_boxes(model, domain))
    except GainError:
        return False
    return not (hull.vertices.any() or hull.error.any())


def _boxes(model: ControlAffine, domain: Domain) -> tuple[Box, Box]:
    """Return the domain as absolute states and normalized inputs; unbounded states in +-1."""
    trim = np.asarray(model.trim[0], float)
    low = np.where(np.isfinite(domain.lower), domain.lower, -1.0)
    high = np.where(np.isfinite(domain.upper), domain.upper, 1.0)
    return Box(trim + low, trim + high), Box(domain.input_lower, domain.input_upper)


def _hull(model: ControlAffine, domain: Domain) -> Hull:
    names = [*model.state_names, *model.input_names]
    return jacobian_hull(model_jacobian(model), *_boxes(model, domain), names)


def _check_bounded(model: ControlAffine, domain: Domain, hull: Hull) -> None:
    """Refuse a domain that leaves open a state on which the Jacobian depends."""
    used = {atom.name for atom in hull.atoms}
    for k, name in enumerate(model.state_names):
        if name in used and not np.isfinite([domain.lower[k], domain.upper[k]]).all():
            raise GainError(
                f"the domain leaves `{name}` unbounded, and the Jacobian of "
                f"`{type(model).__name__}` depends on it; give it a bound."
            )


def _sampled(model: ControlAffine, domain: Domain) -> Matrix:
    states, inputs = domain.sample(_SAMPLES)
    base = np.asarray(model.trim[0], float)
    return np.asarray(_at(model, jnp.asarray(base + states), jnp.asarray(inputs)))


@eqx.filter_jit
def _at(model: ControlAffine, states: jax.Array, inputs: jax.Array) -> jax.Array:
    return jax.vmap(model_jacobian(model))(states, inputs)
