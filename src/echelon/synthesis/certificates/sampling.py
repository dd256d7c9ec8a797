"""Samples of a model on a domain: its Jacobians, and a check of a hull by secants."""

from collections.abc import Callable
from typing import TypeAlias

import jax
import jax.numpy as jnp
import numpy as np

from echelon.agents.models.model import ControlAffine
from echelon.agents.models.secants import find_gap, find_jump
from echelon.core.enclosure.hull import Hull
from echelon.core.errors import GainError
from echelon.core.types import Array
from echelon.synthesis.certificates.domain import Domain

_SAMPLES = 400
_SEGMENTS = 64
_FEW = 7
"""Largest number of bounded states and inputs for which every corner is sampled."""
_FAR = (3.0, -3.0, 40.0, -40.0, 1e3, -1e3)
"""Changes of an unbounded state; no multiples of pi, at which a sine would not change."""
_OfState: TypeAlias = Callable[[jax.Array, jax.Array], jax.Array]


def unbounded_error(model: ControlAffine, name: str) -> GainError:
    """Return the error of a domain that leaves a state unbounded on which the slopes depend."""
    return GainError(
        f"the domain leaves `{name}` unbounded, and the Jacobian of "
        f"`{type(model).__name__}` depends on it; give it a bound."
    )


def sample_jacobians(
    model: ControlAffine, domain: Domain, velocity: _OfState, weight: _OfState | None
) -> Array:
    """Return the matrices inside a domain and at its corners, all of them where they are few.

    Raises:
        GainError: they depend on a state that the domain leaves unbounded; the model jumps; or the
            derivatives that JAX finds are not its slopes.
    """
    inside, corners = _points(domain)
    both = np.concatenate([inside, corners])
    base = np.append(np.asarray(model.trim[0], float), np.zeros(len(model.input_names)))
    n = len(model.state_names)

    def matrix(z: jax.Array) -> jax.Array:
        jacobian = jax.jacfwd(velocity)(z[:n], z[n:])
        if weight is None:
            return jacobian
        return jnp.concatenate([jacobian, weight(z[:n], z[n:])], axis=1)

    at = jax.jit(jax.vmap(matrix))
    samples = np.asarray(at(jnp.asarray(base + both)))
    _check_finite(model, base + both, samples)
    for k in np.flatnonzero(~np.isfinite(domain.lower) | ~np.isfinite(domain.upper)):
        for far in _FAR:
            moved = base + both + np.where(np.arange(len(base)) == k, far, 0.0)
            there = np.asarray(at(jnp.asarray(moved)))
            # Entry by entry, since their units may be decades apart.
            size = np.maximum(np.abs(there), np.abs(samples)).max(axis=0)
            if (np.abs(there - samples).max(axis=0) > 1e-12 * size).any():
                raise unbounded_error(model, model.state_names[k])
    _check_samples(model, base + inside, velocity, _units(domain))
    return samples


def _units(domain: Domain) -> Array:
    """Return (n + m,) half of the width of the domain in each state and input; 1 where open."""
    low = np.concatenate([domain.lower, domain.input_lower])
    high = np.concatenate([domain.upper, domain.input_upper])
    wide = 0.5 * (high - low)
    return np.where(np.isfinite(wide) & (wide > 0.0), wide, 1.0)


def _check_finite(model: ControlAffine, points: Array, matrices: Array) -> None:
    """Refuse matrices (K, n, n) that are not numbers, at points (K, n + m)."""
    bad = np.flatnonzero(~np.isfinite(matrices).all(axis=(1, 2)))
    if len(bad):
        names = (*model.state_names, *model.input_names)
        pairs = zip(names, points[bad[0]].tolist(), strict=True)
        where = ", ".join(f"{name} {value:.4g}" for name, value in pairs)
        raise GainError(
            f"the Jacobian of `{type(model).__name__}` is not finite inside the domain, for one at "
            f"{where}; make the domain smaller."
        )


def _points(domain: Domain) -> tuple[Array, Array]:
    """Return deviations of states and inputs inside a domain, and at its corners, as many each."""
    states, inputs = domain.sample(2 * _SAMPLES)
    box = np.array([[*domain.lower, *domain.input_lower], [*domain.upper, *domain.input_upper]])
    used = np.flatnonzero(np.isfinite(box).all(axis=0) & (box[0] < box[1]))
    both = np.concatenate([states, inputs], axis=1)
    sides = np.random.default_rng(1).integers(0, 2, (_SAMPLES, len(used)))
    if len(used) <= _FEW:
        few = np.arange(2 ** len(used))[:, None] >> np.arange(len(used)) & 1
        sides[: len(few)] = few
    both[_SAMPLES:, used] = np.take_along_axis(box[:, used], sides, axis=0)
    return both[:_SAMPLES], both[_SAMPLES:]


def _check_samples(model: ControlAffine, points: Array, velocity: _OfState, units: Array) -> None:
    """Refuse a model whose Jacobians say less than its values, at points (K, n + m)."""
    n, name = len(model.state_names), type(model).__name__

    def entries(z: jax.Array) -> jax.Array:
        """F + g (u* + S v), and g itself, which inputs multiply."""
        g = model.normalized_input_map(z[:n]).reshape(-1)
        return jnp.concatenate([velocity(z[:n], z[n:]), g])

    jump = find_jump(entries, points[:_SEGMENTS], points[_SEGMENTS : 2 * _SEGMENTS])
    if jump is not None:
        state = model.state_names[int(np.argmax(np.abs(jump.after - jump.before)[:n]))]
        raise GainError(
            f"`{name}` jumps by {jump.size:.3g} inside the domain, near `{state}` = "
            f"{jump.after[model.state_names.index(state)]:.4g}, and nothing is guaranteed across a "
            "jump; make the domain smaller, or the model continuous."
        )
    gap = find_gap(entries, points[:_SEGMENTS], units)
    if gap is not None:
        raise GainError(
            f"the derivative of `{name}` inside the domain is {gap.derivative:.4g} by JAX and "
            f"{gap.slope:.4g} by its values, so no guarantee can rest on it; write the model "
            "without `stop_gradient` and without derivatives of its own."
        )


def check_secants(model: ControlAffine, domain: Domain, velocity: _OfState, hull: Hull) -> None:
    """Reject a hull that a secant of the model leaves: an independent check of the hull.

    A matrix H of the hull has H (x - y) = f(x, v) - f(y, v) for all x and y of the domain, so no
    functional of the left side exceeds its largest value at a vertex.

    Raises:
        GainError: a secant leaves the hull, which is a fault of echelon.
    """
    n = len(model.state_names)
    inside, corners = _points(domain)
    trim = np.asarray(model.trim[0], float)
    x, y = inside[:, :n], np.where(np.arange(n) % 2, corners[:, :n], inside[::-1, :n])
    value = jax.jit(jax.vmap(velocity))
    v = jnp.asarray(inside[:, n:])
    at_x, at_y = (np.asarray(value(jnp.asarray(trim + part), v)) for part in (x, y))
    change = at_x - at_y
    # Steps are those between the rounded points trim + x.
    step = (trim + x) - (trim + y)
    C = np.random.default_rng(2).normal(size=(32, len(change[0])))
    rows = np.einsum("cr,krn->ckn", C, hull.vertices[:, :, :n])
    reach = np.stack([(row @ step.T).max(axis=0) for row in rows])
    slack = np.abs(C) @ hull.error[:, :n] @ np.abs(step).T
    size = np.abs(C) @ np.abs(at_x).T
    if (C @ change.T > reach + slack + 1e-9 * (np.abs(reach) + size)).any():
        raise GainError(
            f"a secant of `{type(model).__name__}` leaves the hull of its slopes, so nothing is "
            "guaranteed for it; please report this model."
        )
