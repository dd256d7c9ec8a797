"""Checks with the agents' equations: trim, linearization, and Jacobians on the domain."""

from collections.abc import Iterator

import numpy as np

from echelon.agents.models.model import ControlAffine
from echelon.core.digits import at_least
from echelon.core.types import Array
from echelon.guarantees.verifier import enclosed
from echelon.guarantees.verifier.agent_equations import Evaluated, NoModel, evaluate, model_of
from echelon.guarantees.verifier.findings import ROUNDING, TIGHT, Facts, Finding, decide, unchecked
from echelon.guarantees.verifier.points import Points, pairs, points
from echelon.guarantees.verifier.region_claims import needs_constant, slowest
from echelon.guarantees.verifier.saved_gain import SavedModel, SavedRegion

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


def check_equations(facts: Facts, user_model: ControlAffine | None) -> Iterator[Finding]:
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


def _check_model(facts: Facts, model: ControlAffine) -> Iterator[Finding]:
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


def _check_trim(facts: Facts, model: ControlAffine) -> Iterator[Finding]:
    """Check the equilibrium, A and B at the trim, and A also by difference quotients."""
    saved, n = facts.saved.model, len(facts.saved.P)
    sizes = np.multiply.outer(_STEPS, np.maximum(1.0, np.abs(saved.state)))
    displaced = saved.state + np.stack([sizes, -sizes])[..., None] * np.eye(n)
    x = np.concatenate([saved.state[None], displaced.reshape(-1, n)])
    at = evaluate(model, saved, x, np.zeros((len(x), len(saved.input))))
    rest, rounding = np.abs(at.velocities[0]), _ROUNDING * at.sizes[0]
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
    """Return the largest relative distance of A to its one-sided difference quotients.

    For each entry the step with the least error counts: longer steps have curvature, shorter ones
    rounding. At a kink one of the two sides differs, at a jump every step.

    Args:
        saved: the model as stored in the file.
        at: the model at the trim and at each state displaced by each step.
        steps: (2, J, n), for both sides.
    """
    # Axes: side, step, displaced state, velocity.
    shape = (*steps.shape, -1)
    quotients = (at.velocities[1:] - at.velocities[0]).reshape(shape) / steps[..., None]
    lost = _ROUNDING * (at.sizes[1:] + at.sizes[0]).reshape(shape) / np.abs(steps)[..., None]
    gaps = (np.abs(quotients - saved.A.T) - lost).min(axis=1)
    # Scaled by the longest step: at a jump, quotients of short steps are arbitrarily large.
    sizes = np.maximum(np.abs(quotients[:, 0]), np.abs(saved.A.T))
    return float((gaps / np.where(sizes > 0.0, sizes, 1.0)).max())


def _check_domain(facts: Facts, region: SavedRegion, model: ControlAffine) -> Iterator[Finding]:
    """Search the domain for states that contradict the guarantee."""
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
        gap = enclosed.farthest_from_all(region.hull, np.dstack(both)[: some.corners])
        text, shown = f"{some.corners} corners of the domain", f"{at_least(gap)} apart"
        yield decide("samples include the corners", gap <= TIGHT, "", shown, text)
    else:
        outside = enclosed.farthest_outside(region.hull, region.error, np.dstack(both))
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
    """Return whether all bounded states lie inside the chart of the model."""
    for name, (low, high) in model.chart.items():
        k = saved.state_names.index(name)
        least, most = saved.state[k] + region.lower[k], saved.state[k] + region.upper[k]
        if np.isfinite(most - least) and not low < least <= most < high:
            return False
    return True


def _check_secants(
    facts: Facts, region: SavedRegion, model: ControlAffine, some: Points
) -> Finding:
    """Check velocity differences of pairs of states against the hull or the rate.

    This detects a discontinuous velocity and wrong derivatives.
    """
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
        normals, claim = (
            _normals(steps @ saved.P, np.abs(steps) @ slope.T),
            "secants lie in the hull",
        )
        bounds = enclosed.support(region.hull[:, :, :n], region.error[:, :n], normals, steps)
    worst = enclosed.steepest(velocity, x, y, normals, bounds)
    text = f"of {len(x)} pairs of states, relative"
    return decide(claim, worst <= TIGHT, "0", max(worst, 0.0), text)


def _normals(metric: Array, sizes: Array) -> Array:
    """Return test directions: single velocities, random directions and the metric direction."""
    random, (count, n) = np.random.default_rng(2), metric.shape
    single = np.eye(n)[random.integers(0, n, count)]
    mixed = random.normal(size=(count, n)) / np.where(sizes > 0.0, sizes, np.inf)
    which = np.arange(count)[:, None] % 3
    return np.where(which == 0, single, np.where(which == 1, mixed, metric))


def _decay(facts: Facts, region: SavedRegion, steps: Array) -> enclosed.SupportBounds:
    """Return bounds of d'P (v(x) - v(y)) that follow from the rate and the strongest feedback.

    They follow from P A + A'P - strength P W P + 2 rate P <= 0, integrated from y to x = y + d.
    """
    saved, n = facts.saved, len(facts.saved.P)
    W = region.hull[:, :, n:] if region.theorem == "T2" else facts.weighted[None]
    metric_step, rate = steps @ saved.P, region.rate * (1.0 - _SAMPLED)
    feedback = (
        0.5 * region.strength * np.einsum("kn,hnm,km->kh", metric_step, W, metric_step).max(axis=1)
    )
    size = np.einsum("kn,kn->k", metric_step, steps)
    return enclosed.SupportBounds(
        np.full(len(steps), -np.inf), feedback - rate * size, feedback + rate * size
    )
