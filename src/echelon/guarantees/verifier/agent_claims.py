"""Checks with the agents' equations: trim, linearization, and Jacobians on the domain."""

import importlib
import itertools
from collections.abc import Callable, Iterator
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.optimize

from echelon.agents import models
from echelon.agents.models.model import ControlAffine
from echelon.core.digits import at_least
from echelon.core.numerics import precision
from echelon.core.types import Array
from echelon.guarantees.verifier.findings import (
    ROUNDING,
    TIGHT,
    ClaimCheck,
    Recomputed,
    decide,
    unchecked,
)
from echelon.guarantees.verifier.region_claims import needs_constant, slowest
from echelon.guarantees.verifier.saved_gain import SavedGain, SavedModel, SavedRegion

# ---- agents of a saved gain, rebuilt from its parameters -----------------------------------------

_TOGETHER = 384
"""States evaluated at once; a fixed number, so that a model is compiled once."""
_MOST_DIMENSIONS = 1000
"""A larger integer cannot be a dimension and is converted to a float."""


class Evaluated(NamedTuple):
    """A model evaluated at K states x and normalized inputs v.

    Attributes:
        velocities: f + g (u* + S v), (K, n).
        sizes: the sum of the absolute values of its terms, which bounds rounding, (K, n).
        jacobians: by reverse differentiation, (K, n, n).
        maps: g S, (K, n, m).
    """

    velocities: Array
    sizes: Array
    jacobians: Array
    maps: Array


class NoModel(NamedTuple):
    """Why there is no model; `broken` if the file names a bundled model that cannot be built."""

    reason: str
    broken: bool


def model_of(saved: SavedModel) -> ControlAffine | NoModel:
    """Return the bundled model named in a file.

    No other module is imported: reading a file must not execute code that it names.
    """
    module, _, name = saved.path.partition(":")
    # With the dot, since other packages may have the same prefix. Files of version 0.2 store the
    # module of a model, later ones its public name.
    if not (module + ".").startswith(("echelon.models.", "echelon.agents.models.")):
        return NoModel(
            f"`{name}` is not bundled; pass it by `--scenario` or `verify(path, model)`", False
        )
    if saved.parameters is None:
        return NoModel(f"the file holds no parameters of `{name}`", False)
    try:
        cls = getattr(models, name, None) or getattr(importlib.import_module(module), name)
        # Checked before the call: a module also contains other names.
        if not (isinstance(cls, type) and issubclass(cls, ControlAffine)):
            return NoModel(f"`{saved.path}` is not a model", True)
        return cls(**{key: _to_parameter(value) for key, value in saved.parameters.items()})
    # False parameters can raise any exception in a class.
    except Exception as error:
        return NoModel(f"`{saved.path}` cannot be built: {error}", True)


def _to_parameter(value: object) -> object:
    # As a dimension it would exhaust the memory; as a parameter a float is equivalent.
    if isinstance(value, int) and abs(value) > _MOST_DIMENSIONS:
        return float(value)
    return tuple(map(_to_parameter, value)) if isinstance(value, list) else value


def evaluate(model: ControlAffine, saved: SavedModel, x: Array, v: Array) -> Evaluated:
    """Evaluate a model at states (K, n) and normalized inputs (K, m), in float64."""
    parts = []
    with precision("float64"):
        u, S = jnp.asarray(saved.input), jnp.asarray(saved.scale)
        for k in range(0, len(x), _TOGETHER):
            some = x[k : k + _TOGETHER], v[k : k + _TOGETHER]
            # Padded to one shape, since another one would be compiled again.
            full = (np.resize(item, (_TOGETHER, item.shape[1])) for item in some)
            result = _evaluate(model, u, S, *map(jnp.asarray, full))
            parts.append([np.asarray(item)[: len(some[0])] for item in result])
    return Evaluated(*map(np.concatenate, zip(*parts, strict=True)))


@eqx.filter_jit
def _evaluate(
    model: ControlAffine, u: jax.Array, S: jax.Array, states: jax.Array, inputs: jax.Array
) -> tuple[jax.Array, ...]:
    def velocity(x: jax.Array, v: jax.Array) -> jax.Array:
        return model.drift(x) + model.input_map(x) @ (u + S @ v)

    def all_of(x: jax.Array, v: jax.Array) -> tuple[jax.Array, ...]:
        f, g = model.drift(x), model.input_map(x)
        size = jnp.abs(f) + jnp.abs(g) @ (jnp.abs(u) + jnp.abs(S @ v))
        # Reverse mode, while the synthesis uses forward mode: an error in either is detected.
        return f + g @ (u + S @ v), size, jax.jacrev(velocity)(x, v), g @ S

    return jax.vmap(all_of)(states, inputs)


# ---- test states and pairs of states on a domain -------------------------------------------------

_COUNT = 128
"""States of each kind: corners of the domain, lattice points and random points."""
_FAR = (-2.0, 3.0)
"""Exponents: an unbounded state is tested from 10^-2 to 10^3 on both sides of the trim."""
_NEAR = -6.0
"""Exponent: pairs of states are as close as 10^-6 of the domain."""


class Points(NamedTuple):
    """Deviations (K, n) and inputs (K, m); the first `corners` are all corners of the domain."""

    states: Array
    inputs: Array
    corners: int


class _Box(NamedTuple):
    """Bounds (n + m,) of deviations and inputs; `used` are the bounded entries that vary."""

    low: Array
    high: Array
    used: Array

    def fill(self, some: Array, random: np.random.Generator) -> Array:
        """Return points (K, n + m) with the values `some` in the entries `used`."""
        size = (len(some), len(self.low))
        far = 10.0 ** random.uniform(*_FAR, size) * random.choice([-1.0, 1.0], size)
        # With a bound on one side, only the other side is unbounded.
        far = np.where(np.isfinite(self.low), self.low + np.abs(far), far)
        far = np.where(np.isfinite(self.high), self.high - np.abs(far), far)
        result = np.where(np.isfinite(self.low) & np.isfinite(self.high), self.low, far)
        result[:, self.used] = some
        return result


def _box(region: SavedRegion) -> _Box:
    low = np.concatenate([region.lower, region.input_lower])
    high = np.concatenate([region.upper, region.input_upper])
    return _Box(low, high, np.flatnonzero(np.isfinite(low) & np.isfinite(high) & (low < high)))


def points(saved: SavedGain, region: SavedRegion) -> Points:
    """Return corners of a domain, lattice points and random points."""
    # Fixed seed: a file must get the same verdict every time.
    random, box = np.random.default_rng(0), _box(region)
    ends = np.stack([box.low[box.used], box.high[box.used]])
    parts = [_corners(ends, random)]
    # Quarters of the ranges hold corners and middles, where symmetric functions are extreme.
    size = _COUNT, len(box.used)
    for fractions in (random.integers(0, 5, size) / 4.0, random.uniform(size=size)):
        parts.append(ends[0] + fractions * (ends[1] - ends[0]))
    result, n = box.fill(np.concatenate(parts), random), len(saved.P)
    # The trim, where many slopes are extreme.
    result[-1] = 0.0
    few = 2 ** len(box.used)
    return Points(result[:, :n], result[:, n:], few if few <= _COUNT else 0)


def _corners(ends: Array, random: np.random.Generator) -> Array:
    """Return all corners of a box, or random ones if there are too many."""
    count = ends.shape[1]
    if 2**count <= _COUNT:
        picks = np.array(list(itertools.product((0, 1), repeat=count)), int).reshape(
            2**count, count
        )
    else:
        picks = random.integers(0, 2, (_COUNT, count))
    return np.take_along_axis(ends, picks, axis=0)


class StatePairs(NamedTuple):
    """Pairs of deviations (K, n) in a domain, with one input (K, m) per pair."""

    ones: Array
    others: Array
    inputs: Array


def pairs(saved: SavedGain, region: SavedRegion, known: Points) -> StatePairs:
    """Return pairs of states: arbitrary points, and close pairs at the trim and at the points."""
    random, n = np.random.default_rng(1), len(saved.P)
    box, count = _box(region), len(known.states)
    ones, others = known.states.copy(), known.states[random.permutation(count)]
    close = np.arange(count) % 2 == 1
    centre = np.clip(known.states, -(10.0 ** _FAR[1]), 10.0 ** _FAR[1])
    # Near the trim, where a switch is most likely, and near all other points.
    centre[close & (np.arange(count) % 4 == 1)] = 0.0
    width = np.where(np.isfinite(region.upper - region.lower), region.upper - region.lower, 1.0)
    step = 10.0 ** random.uniform(_NEAR, 0.0, (count, 1)) * random.normal(size=(count, n)) * width
    for result, sign in ((ones, 0.5), (others, -0.5)):
        result[close] = np.clip(centre + sign * step, box.low[:n], box.high[:n])[close]
    return StatePairs(ones, others, known.inputs)


# ---- whether Jacobians and secants lie in the stored hull ----------------------------------------

_HALVINGS = 16
"""Halvings of a pair of states; its distance shrinks to 2^-16, about 1e-5."""
_AT_ONCE = 256
"""Hull vertices processed at once; bounds the memory."""


def farthest_from_all(known: Array, samples: Array) -> float:
    """Return the largest relative distance of a sample to its nearest known matrix."""
    size = max(float(np.abs(known).max()), 1e-300)
    if not np.isfinite(samples).all():
        return np.inf
    gaps = [float(np.abs(known - sample).max(axis=(1, 2)).min()) for sample in samples]
    return max(gaps, default=0.0) / size


def farthest_outside(hull: Array, error: Array, samples: Array) -> float:
    """Return the largest distance of a sample to the convex hull of the corners.

    Distances are measured entry by entry beyond `error`, relative to the range of the entry over
    the corners (at least 1e-3 of its absolute value). The convex combination is found by
    nonnegative least squares (Lawson and Hanson) and normalized before the distance is measured.
    """
    if not np.isfinite(samples).all():
        return np.inf
    corners, target = hull.reshape(len(hull), -1), samples.reshape(len(samples), -1)
    low, spread = corners.min(axis=0), np.ptp(corners, axis=0)
    size = np.abs(corners).max(axis=0)
    # Entries that hardly vary are scaled by their absolute value; else rounding would count.
    unit = np.where(size > 0.0, np.maximum(spread, 1e-3 * size), 1.0)
    corners, target, allowed = (corners - low) / unit, (target - low) / unit, error.ravel() / unit
    moving = spread > 0.0
    # The row of ones makes the weights of a convex combination sum to one.
    system = np.vstack([corners[:, moving].T, np.ones(len(corners))])
    worst = float((np.abs(target - corners[0]) - allowed)[:, ~moving].max(initial=0.0))
    for sample in target[:, moving]:
        weights, _ = scipy.optimize.nnls(system, np.append(sample, 1.0), maxiter=100 * len(corners))
        mixed = weights @ corners[:, moving] / weights.sum() if weights.any() else np.inf
        worst = max(worst, float((np.abs(mixed - sample) - allowed[moving]).max(initial=0.0)))
    return worst


class SupportBounds(NamedTuple):
    """Bounds (K,) of p'(v(x) - v(y)) at K pairs; `size` is the magnitude of its terms."""

    low: Array
    high: Array
    size: Array


def support(hull: Array, error: Array, normals: Array, steps: Array) -> SupportBounds:
    """Return the range of p'A d over a hull (H, n, n) up to an error, for normals p and steps d.

    A velocity v with Jacobians in the hull has v(x) - v(y) = A (x - y), A a mean of Jacobians.
    """
    spread = np.einsum("kn,nm,km->k", np.abs(normals), error, np.abs(steps))
    low, high = np.full(len(steps), np.inf), np.full(len(steps), -np.inf)
    for k in range(0, len(hull), _AT_ONCE):
        result = np.einsum("km,hnm->khn", steps, hull[k : k + _AT_ONCE], optimize=True)
        result = np.einsum("khn,kn->kh", result, normals)
        low, high = np.minimum(low, result.min(axis=1)), np.maximum(high, result.max(axis=1))
    size = np.einsum("kn,nm,km->k", np.abs(normals), np.abs(hull).max(axis=0), np.abs(steps))
    return SupportBounds(low - spread, high + spread, size)


def steepest(
    velocity: Callable[[Array], tuple[Array, Array]],
    x: Array,
    y: Array,
    normals: Array,
    bounds: SupportBounds,
) -> float:
    """Return the largest relative violation of the bounds of p'(v(x) - v(y)).

    Each pair is bisected repeatedly, and the steeper half is continued: at a jump the slope doubles
    each time. Rounding is subtracted.

    Args:
        velocity: maps states (K, n) to velocities (K, n) and their rounding (K, n).
        x: states (K, n).
        y: states (K, n).
        normals: p (K, n).
        bounds: for the pairs x, y.
    """
    unit = np.where(bounds.size > 0.0, bounds.size, 1.0)
    (at_x, lost_x), (at_y, lost_y) = velocity(x), velocity(y)
    part, worst = 1.0, -np.inf

    def excess(one: Array, other: Array) -> Array:
        slope = np.einsum("kn,kn->k", normals, one - other) / part
        return np.maximum(slope - bounds.high, bounds.low - slope)

    for _ in range(_HALVINGS):
        lost = np.einsum("kn,kn->k", np.abs(normals), lost_x + lost_y) / part
        result = (excess(at_x, at_y) - lost) / unit
        # NaN counts as a violation of every bound.
        worst = max(worst, float(np.where(np.isfinite(result), result, np.inf).max()))
        middle, part = 0.5 * (x + y), 0.5 * part
        at, lost_at = velocity(middle)
        first = (excess(at_x, at) >= excess(at, at_y))[:, None]
        x, y = np.where(first, x, middle), np.where(first, middle, y)
        at_x, at_y = np.where(first, at_x, at), np.where(first, at, at_y)
        lost_x, lost_y = np.where(first, lost_x, lost_at), np.where(first, lost_at, lost_y)
    return worst


# ---- the claims ----------------------------------------------------------------------------------

MODEL = "equations of the model"
"""The claim that is open without the agents' model."""
_TRIM_TOLERANCE = 1e-9
"""Largest velocity at the trim; echelon requires it of every model."""
_SAMPLED = 0.02
"""Fraction by which new samples may be slower than a rate found from samples."""
_STEPS = 10.0 ** -np.arange(1.0, 8.0)
"""Steps of the difference quotients at the trim; the step with the least error counts."""
_QUOTIENT = 1e-5
"""Relative difference allowed between a derivative and its best quotient."""
_ROUNDING = 256.0 * float(np.finfo(float).eps)
"""Rounding of a model's own arithmetic relative to its terms."""


def check_equations(facts: Recomputed, user_model: ControlAffine | None) -> Iterator[ClaimCheck]:
    """Check the claims about the model; without `user_model` it is rebuilt from the file."""
    saved, claim = facts.saved.model, MODEL
    model = model_of(saved) if user_model is None else user_model
    if isinstance(model, NoModel):
        broken = decide(claim, False, saved.path, "", model.reason)
        yield broken if model.broken else unchecked(claim, saved.path, model.reason)
        return
    try:
        yield from _check_model(facts, model)
    # A user's model may raise any exception.
    except Exception as error:
        text = f"{type(model).__name__} cannot be evaluated: {str(error).splitlines()[0]}"
        yield decide(claim, False, saved.path, "", text)


def _check_model(facts: Recomputed, model: ControlAffine) -> Iterator[ClaimCheck]:
    saved, name = facts.saved.model, type(model).__name__
    if (tuple(model.state_names), tuple(model.input_names)) != (
        saved.state_names,
        saved.input_names,
    ):
        yield decide(MODEL, False, saved.path, name, "names differ")
        return
    # The law uses the trim and the input units of the model, so stored ones must agree.
    of_model = (*map(np.asarray, model.trim), np.asarray(model.input_scale))
    of_file = (saved.state, saved.input, saved.scale)
    fine = all(_is_close(one, other) for one, other in zip(of_file, of_model, strict=True))
    yield decide("trim and input units", fine, "", "", f"those of `{name}`")
    yield from _check_trim(facts, model)
    if facts.saved.region is not None:
        yield from _check_domain(facts, facts.saved.region, model)


def _is_close(stored: Array, expected: Array) -> bool:
    fits = stored.shape == expected.shape
    return fits and bool((np.abs(stored - expected) <= TIGHT * np.abs(expected)).all())


def _check_trim(facts: Recomputed, model: ControlAffine) -> Iterator[ClaimCheck]:
    saved, n = facts.saved.model, len(facts.saved.P)
    sizes = np.multiply.outer(_STEPS, np.maximum(1.0, np.abs(saved.state)))
    displaced = saved.state + np.stack([sizes, -sizes])[..., None] * np.eye(n)
    x = np.concatenate([saved.state[None], displaced.reshape(-1, n)])
    at = evaluate(model, saved, x, np.zeros((len(x), len(saved.input))))
    rest, rounding = np.abs(at.velocities[0]), _ROUNDING * at.sizes[0]
    # It may move along states on which nothing depends, here as far as a unit.
    there = np.concatenate([at.velocities[..., None], at.maps], axis=2)
    there = there[1:].reshape(-1, n, n, there.shape[2]) == there[0]
    rest = np.where(there.all(axis=(0, 2, 3)), 0.0, rest)
    fine = bool((rest <= _TRIM_TOLERANCE + rounding).all())
    yield decide("the trim is an equilibrium", fine, "at most 1e-09", float(rest.max()))
    for name, stored, result in (
        ("A at the trim", saved.A, at.jacobians[0]),
        ("B at the trim", saved.B, at.maps[0]),
    ):
        gap, size = float(np.abs(stored - result).max()), float(np.abs(result).max())
        yield decide(name, gap <= TIGHT * size, "", f"{at_least(gap)} apart")
    gap = _quotients_off(saved, at, np.diagonal(displaced - saved.state, axis1=2, axis2=3))
    text = "relative to the quotients"
    yield decide("A at the trim, by difference quotients", gap <= _QUOTIENT, "", gap, text)


def _quotients_off(saved: SavedModel, at: Evaluated, steps: Array) -> float:
    """Of `steps` (2, J, n) the best counts: long ones have curvature, short ones rounding."""
    # Axes: side, step, displaced state, velocity.
    shape = (*steps.shape, -1)
    quotients = (at.velocities[1:] - at.velocities[0]).reshape(shape) / steps[..., None]
    lost = _ROUNDING * (at.sizes[1:] + at.sizes[0]).reshape(shape) / np.abs(steps)[..., None]
    gaps = (np.abs(quotients - saved.A.T) - lost).min(axis=1)
    # Scaled by the longest step: at a jump, quotients of short steps are arbitrarily large.
    sizes = np.maximum(np.abs(quotients[:, 0]), np.abs(saved.A.T))
    return float((gaps / np.where(sizes > 0.0, sizes, 1.0)).max())


def _check_domain(
    facts: Recomputed, region: SavedRegion, model: ControlAffine
) -> Iterator[ClaimCheck]:
    saved = facts.saved
    yield decide("the domain lies inside the chart", _is_inside_chart(saved.model, region, model))
    some = points(saved, region)
    result = evaluate(model, saved.model, saved.model.state + some.states, some.inputs)
    count = f"{len(result.jacobians)} states"
    weighted = result.maps @ np.linalg.solve(saved.R, result.maps.swapaxes(1, 2))
    if needs_constant(facts, region):
        gap = float(np.abs(result.maps - saved.model.B).max())
        fine = gap <= ROUNDING * float(np.abs(saved.model.B).max())
        yield decide(f"g is constant ({region.theorem})", fine, "", f"{at_least(gap)} apart", count)
    # Under T2 the hull contains pairs, since A and g vary together.
    both = [result.jacobians, weighted] if region.theorem == "T2" else [result.jacobians]
    if region.kind == "samples":
        gap = farthest_from_all(region.hull, np.dstack(both)[: some.corners])
        text, shown = f"{some.corners} corners of the domain", f"{at_least(gap)} apart"
        yield decide("samples include the corners", gap <= TIGHT, "", shown, text)
    else:
        outside = farthest_outside(region.hull, region.error, np.dstack(both))
        text = f"of {count}, relative to the ranges of the entries"
        yield decide("Jacobians lie in the hull", outside <= TIGHT, "0", outside, text)
    yield _check_secants(facts, region, model, some)
    rate, slack, decided = slowest(facts, region, result.jacobians, weighted)
    # Samples guarantee nothing between them, so new ones may be slightly slower.
    slower = _SAMPLED * abs(region.rate) if region.kind == "samples" else 0.0
    least = region.rate * (1.0 - TIGHT) - slack - slower
    fine = decided and rate >= least
    yield decide(f"rate at {count}, 1/s", fine, region.rate, rate, "with g of each state")


def _is_inside_chart(saved: SavedModel, region: SavedRegion, model: ControlAffine) -> bool:
    for name, (low, high) in model.chart.items():
        k = saved.state_names.index(name)
        least, most = saved.state[k] + region.lower[k], saved.state[k] + region.upper[k]
        if np.isfinite(most - least) and not low < least <= most < high:
            return False
    return True


def _check_secants(
    facts: Recomputed, region: SavedRegion, model: ControlAffine, some: Points
) -> ClaimCheck:
    """Differences of velocities reveal a discontinuous velocity and wrong derivatives."""
    saved, at = facts.saved, pairs(facts.saved, region, some)
    x, y = saved.model.state + at.ones, saved.model.state + at.others
    steps = x - y
    n, slope = len(saved.P), np.abs(region.hull[:, :, : len(saved.P)]).max(axis=0)

    def velocity(states: Array) -> tuple[Array, Array]:
        result = evaluate(model, saved.model, states, at.inputs)
        return result.velocities, _ROUNDING * (result.sizes + np.abs(states) @ slope.T)

    if region.kind == "samples":
        normals, claim = steps @ saved.P, "pairs converge at the rate"
        bounds = _decay(facts, region, steps)
    else:
        normals = _normals(steps @ saved.P, np.abs(steps) @ slope.T)
        claim = "secants lie in the hull"
        bounds = support(region.hull[:, :, :n], region.error[:, :n], normals, steps)
    worst = steepest(velocity, x, y, normals, bounds)
    text = f"of {len(x)} pairs of states, relative"
    return decide(claim, worst <= TIGHT, "0", max(worst, 0.0), text)


def _normals(metric: Array, sizes: Array) -> Array:
    """Return test directions: single velocities, random directions and the metric direction."""
    random, (count, n) = np.random.default_rng(2), metric.shape
    single = np.eye(n)[random.integers(0, n, count)]
    mixed = random.normal(size=(count, n)) / np.where(sizes > 0.0, sizes, np.inf)
    which = np.arange(count)[:, None] % 3
    return np.where(which == 0, single, np.where(which == 1, mixed, metric))


def _decay(facts: Recomputed, region: SavedRegion, steps: Array) -> SupportBounds:
    """By P A + A'P - strength P W P + 2 rate P <= 0, integrated from y to x = y + d."""
    saved, n = facts.saved, len(facts.saved.P)
    W = region.hull[:, :, n:] if region.theorem == "T2" else facts.weighted[None]
    metric_step, rate = steps @ saved.P, region.rate * (1.0 - _SAMPLED)
    most = np.einsum("kn,hnm,km->kh", metric_step, W, metric_step).max(axis=1)
    feedback = 0.5 * region.strength * most
    size = np.einsum("kn,kn->k", metric_step, steps)
    return SupportBounds(
        np.full(len(steps), -np.inf), feedback - rate * size, feedback + rate * size
    )
