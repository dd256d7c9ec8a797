"""A saved gain's agents, made again from their equations, and states at which to doubt it."""

import importlib
import itertools
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.optimize

from echelon.core.errors import EchelonError
from echelon.core.numerics import precision
from echelon.core.types import Array
from echelon.models.model import ControlAffine
from echelon.verifier.file import SavedGain, SavedModel, SavedRegion

_EACH = 128
"""States of each sort: corners of the domain, points of a lattice, and random ones."""
_MOST_DIMENSIONS = 1000
"""A whole number above it counts no dimensions, and is made a float."""
_FAR = 10.0
"""A state without bounds is looked at up to this far from the trim."""


class Slopes(NamedTuple):
    """At each of K points: velocity's Jacobian (K, n, n) and normalized input map (K, n, m)."""

    jacobians: Array
    maps: Array


class NoModel(NamedTuple):
    """Why there is no model; `broken` where the file promised one that cannot be made."""

    reason: str
    broken: bool


def model_of(saved: SavedModel) -> ControlAffine | NoModel:
    """Return the bundled model of a file.

    A class of any other module is not imported: reading a file must not run what it names.
    """
    module, _, name = saved.path.partition(":")
    # With the dot, since other packages may begin with the same letters.
    if not (module + ".").startswith("echelon.models."):
        return NoModel(f"`{name}` is not bundled; `verify(path, model)` takes it", False)
    if saved.parameters is None:
        return NoModel(f"the file holds no parameters of `{name}`", False)
    try:
        cls = getattr(importlib.import_module(module), name)
        made = cls(**{key: _frozen(value) for key, value in saved.parameters.items()})
    except (
        ImportError,
        AttributeError,
        ArithmeticError,
        TypeError,
        ValueError,
        EchelonError,
    ) as error:
        return NoModel(f"`{saved.path}` cannot be made: {error}", True)
    if not isinstance(made, ControlAffine):
        return NoModel(f"`{saved.path}` is no model", True)
    return made


def _frozen(value: object) -> object:
    # As a dimension it would be a model too large to hold; as a parameter its float is the same.
    if isinstance(value, int) and abs(value) > _MOST_DIMENSIONS:
        return float(value)
    return tuple(map(_frozen, value)) if isinstance(value, list) else value


def velocity_at_trim(model: ControlAffine, saved: SavedModel) -> Array:
    """Return f(x*) + g(x*) u*, which is zero at an equilibrium."""
    with precision("float64"):
        x, u = jnp.asarray(saved.state), jnp.asarray(saved.input)
        return np.asarray(model.drift(x) + model.input_map(x) @ u)


def slopes(model: ControlAffine, saved: SavedModel, states: Array, inputs: Array) -> Slopes:
    """Differentiate f + g (u* + S v) backwards, at K deviations and normalized inputs."""
    with precision("float64"):
        x, v = jnp.asarray(saved.state + states), jnp.asarray(inputs)
        u, S = jnp.asarray(saved.input), jnp.asarray(saved.scale)
        return Slopes(*map(np.asarray, _slopes(model, u, S, x, v)))


@eqx.filter_jit
def _slopes(
    model: ControlAffine, u: jax.Array, S: jax.Array, states: jax.Array, inputs: jax.Array
) -> tuple[jax.Array, jax.Array]:
    def velocity(x: jax.Array, v: jax.Array) -> jax.Array:
        return model.drift(x) + model.input_map(x) @ (u + S @ v)

    def both(x: jax.Array, v: jax.Array) -> tuple[jax.Array, jax.Array]:
        # The synthesis differentiates forwards: a fault of either mode would show.
        return jax.jacrev(velocity)(x, v), model.input_map(x) @ S

    return jax.vmap(both)(states, inputs)


class Points(NamedTuple):
    """Deviations (K, n) and inputs (K, m) of a domain; the first `corners` are all of its own."""

    states: Array
    inputs: Array
    corners: int


def points(saved: SavedGain, region: SavedRegion) -> Points:
    """Return points at which to doubt a promise: corners of its domain, a lattice, and others."""
    # A file must be judged alike every time.
    random = np.random.default_rng(0)
    low = np.concatenate([region.lower, region.input_lower])
    high = np.concatenate([region.upper, region.input_upper])
    used = np.flatnonzero(np.isfinite(low) & np.isfinite(high) & (low < high))
    ends = np.stack([low[used], high[used]])
    parts = [_corners(ends, random)]
    # Quarters of the ranges hold corners and middles, where symmetric functions are extreme.
    for fractions in (random.integers(0, 5, (_EACH, len(used))) / 4.0, None):
        some = random.uniform(size=(_EACH, len(used))) if fractions is None else fractions
        parts.append(ends[0] + some * (ends[1] - ends[0]))
    bounded = np.concatenate(parts)
    free = random.uniform(-_FAR, _FAR, (len(bounded), len(low)))
    found = np.where(np.isfinite(low) & np.isfinite(high), low, free)
    found[:, used] = bounded
    n = len(saved.P)
    few = 2 ** len(used)
    return Points(found[:, :n], found[:, n:], few if few <= _EACH else 0)


def _corners(ends: Array, random: np.random.Generator) -> Array:
    """Return all corners of a box, or random ones of many."""
    count = ends.shape[1]
    if 2**count <= _EACH:
        picks = np.array(list(itertools.product((0, 1), repeat=count)), int).reshape(
            2**count, count
        )
    else:
        picks = random.integers(0, 2, (_EACH, count))
    return np.take_along_axis(ends, picks, axis=0)


def farthest_from_all(known: Array, samples: Array) -> float:
    """Return how far the worst sample is from the nearest of the known matrices, relative."""
    size = max(float(np.abs(known).max()), 1e-300)
    gaps = [float(np.abs(known - sample).max(axis=(1, 2)).min()) for sample in samples]
    return max(gaps, default=0.0) / size


def farthest_outside(hull: Array, error: Array, samples: Array) -> float:
    """Return how far the worst sample is from every convex combination of the corners.

    Each entry is measured beyond `error`, in units of its range over the corners, or of a
    thousandth of its size where that is larger. Least squares with weights that are not negative
    decide (Lawson and Hanson); the weights are made to add to one before anything is measured.
    """
    corners, wanted = hull.reshape(len(hull), -1), samples.reshape(len(samples), -1)
    low, spread = corners.min(axis=0), np.ptp(corners, axis=0)
    size = np.abs(corners).max(axis=0)
    # An entry that hardly varies is measured by its size, or rounding would look like distance.
    unit = np.where(size > 0.0, np.maximum(spread, 1e-3 * size), 1.0)
    corners, wanted, allowed = (corners - low) / unit, (wanted - low) / unit, error.ravel() / unit
    moving = spread > 0.0
    # The row of ones asks for weights that add to one.
    system = np.vstack([corners[:, moving].T, np.ones(len(corners))])
    worst = float((np.abs(wanted - corners[0]) - allowed)[:, ~moving].max(initial=0.0))
    for sample in wanted[:, moving]:
        weights, _ = scipy.optimize.nnls(system, np.append(sample, 1.0), maxiter=100 * len(corners))
        mixed = weights @ corners[:, moving] / weights.sum() if weights.any() else np.inf
        worst = max(worst, float((np.abs(mixed - sample) - allowed[moving]).max(initial=0.0)))
    return worst
