"""The Jacobians of a model on a domain: a hull that contains all, or else samples of them."""

from collections.abc import Callable
from fractions import Fraction
from typing import NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np

from echelon.agents.models.model import ControlAffine
from echelon.agents.models.secants import find_gap, find_jump
from echelon.core.cache import memoize
from echelon.core.errors import GainError
from echelon.core.numerics import precision
from echelon.core.types import Array
from echelon.core.words import Kind
from echelon.synthesis.certificates.domain import Domain
from echelon_ranges import (
    Box,
    Hull,
    JumpError,
    RangeError,
    UnboundedError,
    slope_columns,
    slope_hull,
)

# ---- samples -------------------------------------------------------------------------------------

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


@memoize
def unfelt_states(model: ControlAffine, domain: Domain) -> Array:
    """Return (n,) the states that change no slope of f + g u, nor g, at samples of a domain."""
    n = len(model.state_names)
    inside = np.concatenate(domain.sample(_FEW), axis=1)
    base = np.append(np.asarray(model.trim[0], float), np.zeros(inside.shape[1] - n)) + inside

    def entries(z: jax.Array) -> jax.Array:
        slopes = jax.jacfwd(velocity_of(model))(z[:n], z[n:])
        return jnp.append(slopes.ravel(), model.input_map(z[:n]).ravel())

    with precision("float64"):
        at = jax.jit(jax.vmap(entries))
        here = np.asarray(at(jnp.asarray(base)))
        moved = (base + far * np.eye(len(base[0]))[k] for k in range(n) for far in _FAR[:2])
        there = np.asarray([at(jnp.asarray(z)) for z in moved]).reshape(n, -1, here.shape[1])
    gaps = np.abs(there - np.tile(here, (2, 1))).max(axis=1)
    return (gaps <= 1e-12 * np.abs(here).max(axis=0)).all(axis=1)


def _units(domain: Domain) -> Array:
    """Return (n + m,) half of the width of the domain in each state and input; 1 where open."""
    low = np.concatenate([domain.lower, domain.input_lower])
    high = np.concatenate([domain.upper, domain.input_upper])
    wide = 0.5 * (high - low)
    return np.where(np.isfinite(wide) & (wide > 0.0), wide, 1.0)


def _check_finite(model: ControlAffine, points: Array, matrices: Array) -> None:
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


# ---- hulls ---------------------------------------------------------------------------------------


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
    names = [*model.state_names, *model.input_names]
    with precision("float64"):
        try:
            hull = slope_hull(velocity, *_boxes(model, domain), names, weight)
        except UnboundedError as error:
            raise unbounded_error(model, error.name) from error
        except JumpError as error:
            # Samples would hardly meet the jump, and JAX's derivative there is 0.
            raise GainError(str(error)) from error
        except RangeError as error:
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
        zero = slope_columns(function, states, inputs)
    except RangeError:
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
