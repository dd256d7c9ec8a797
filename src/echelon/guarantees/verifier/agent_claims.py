"""Claims that rest on the agents' equations: their trim, their slopes, and those on the domain."""

from collections.abc import Iterator

import numpy as np

from echelon.agents.models.model import ControlAffine
from echelon.core.types import Array
from echelon.guarantees.verifier import enclosed
from echelon.guarantees.verifier.agent_equations import Evaluated, NoModel, evaluate, model_of
from echelon.guarantees.verifier.findings import ROUNDING, TIGHT, Facts, Finding, said, unchecked
from echelon.guarantees.verifier.points import Points, pairs, points
from echelon.guarantees.verifier.region_claims import needs_constant, slowest
from echelon.guarantees.verifier.saved_gain import SavedModel, SavedRegion

_AT_REST = 1e-9
"""What a model may be off at its trim, as echelon asks it of every model."""
_SAMPLED = 0.02
"""New samples may be this part slower than a rate that samples promised."""
_STEPS = 10.0 ** -np.arange(1.0, 8.0)
"""Of difference quotients at the trim; that of the least error counts."""
_QUOTIENT = 1e-5
"""A derivative differs from the best of its quotients by less than this part."""
_LOST = 256.0 * float(np.finfo(float).eps)
"""What a model's own arithmetic may lose, as a part of its terms."""


def equations(facts: Facts, given: ControlAffine | None) -> Iterator[Finding]:
    """Check what rests on the model, made again from the file where none is given."""
    saved, claim = facts.saved.model, "equations of the model"
    model = model_of(saved) if given is None else given
    if isinstance(model, NoModel):
        broken = said(claim, False, saved.path, "", model.reason)
        yield broken if model.broken else unchecked(claim, saved.path, model.reason)
        return
    try:
        yield from _checked(facts, model)
    # What a model of the user's own raises is of any kind.
    except Exception as error:
        text = f"{type(model).__name__} cannot be evaluated: {str(error).splitlines()[0]}"
        yield said(claim, False, saved.path, "", text)


def _checked(facts: Facts, model: ControlAffine) -> Iterator[Finding]:
    saved, name = facts.saved.model, type(model).__name__
    if (tuple(model.state_names), tuple(model.input_names)) != (
        saved.state_names,
        saved.input_names,
    ):
        yield said("equations of the model", False, saved.path, name, "names differ")
        return
    # The law flies about the model's own trim, in the model's own units.
    of_model = (*map(np.asarray, model.trim), np.asarray(model.input_scale))
    of_file = (saved.state, saved.input, saved.scale)
    fine = all(_alike(one, other) for one, other in zip(of_file, of_model, strict=True))
    yield said("trim and units of the inputs", fine, "", "", f"those of `{name}`")
    yield from _at_the_trim(facts, model)
    if facts.saved.region is not None:
        yield from _on_the_domain(facts, facts.saved.region, model)


def _alike(stored: Array, found: Array) -> bool:
    fits = stored.shape == found.shape
    return fits and bool((np.abs(stored - found) <= TIGHT * np.abs(found)).all())


def _at_the_trim(facts: Facts, model: ControlAffine) -> Iterator[Finding]:
    """Check that the trim is one, A and B there, and A by the differences of velocities too."""
    saved, n = facts.saved.model, len(facts.saved.P)
    sizes = np.multiply.outer(_STEPS, np.maximum(1.0, np.abs(saved.state)))
    displaced = saved.state + np.stack([sizes, -sizes])[..., None] * np.eye(n)
    x = np.concatenate([saved.state[None], displaced.reshape(-1, n)])
    at = evaluate(model, saved, x, np.zeros((len(x), len(saved.input))))
    rest, rounding = np.abs(at.velocities[0]), _LOST * at.sizes[0]
    fine = bool((rest <= _AT_REST + rounding).all())
    yield said("the trim is an equilibrium", fine, "at most 1e-09", float(rest.max()))
    for name, stored, result in (
        ("A at the trim", saved.A, at.jacobians[0]),
        ("B at the trim", saved.B, at.maps[0]),
    ):
        gap, size = float(np.abs(stored - result).max()), float(np.abs(result).max())
        yield said(name, gap <= TIGHT * size, "", f"{gap:.3g} apart")
    gap = _quotients_off(saved, at, np.diagonal(displaced - saved.state, axis1=2, axis2=3))
    text = "in parts of the quotients"
    yield said("A at the trim, by differences", gap <= _QUOTIENT, "", gap, text)


def _quotients_off(saved: SavedModel, at: Evaluated, steps: Array) -> float:
    """Return how far difference quotients of both sides stay from A, in parts of themselves.

    Entry by entry, the step of the least error counts, since a longer one bends and a shorter one
    rounds. At a kink one of the two sides is off, at a jump every step.

    Args:
        saved: what the file says of the model.
        at: the trim, and each state moved by each step.
        steps: (2, J, n), of both sides.
    """
    # Axes: side, step, the state that was moved, the velocity that answers.
    shape = (*steps.shape, -1)
    quotients = (at.velocities[1:] - at.velocities[0]).reshape(shape) / steps[..., None]
    lost = _LOST * (at.sizes[1:] + at.sizes[0]).reshape(shape) / np.abs(steps)[..., None]
    gaps = (np.abs(quotients - saved.A.T) - lost).min(axis=1)
    # Those of the longest step, which a jump makes no larger.
    sizes = np.maximum(np.abs(quotients[:, 0]), np.abs(saved.A.T))
    return float((gaps / np.where(sizes > 0.0, sizes, 1.0)).max())


def _on_the_domain(facts: Facts, region: SavedRegion, model: ControlAffine) -> Iterator[Finding]:
    """Try to contradict the promise at states of the domain."""
    saved = facts.saved
    yield said("the domain stays inside the chart", _charted(saved.model, region, model))
    some = points(saved, region)
    result = evaluate(model, saved.model, saved.model.state + some.states, some.inputs)
    count = f"{len(result.jacobians)} states"
    weighted = result.maps @ np.linalg.solve(saved.R, result.maps.swapaxes(1, 2))
    if needs_constant(facts, region):
        gap = float(np.abs(result.maps - saved.model.B).max())
        fine = gap <= ROUNDING * float(np.abs(saved.model.B).max())
        yield said(f"g is constant ({region.theorem})", fine, "", f"{gap:.3g} apart", count)
    # Under T2 the hull is of pairs, since A and g turn together.
    both = [result.jacobians, weighted] if region.theorem == "T2" else [result.jacobians]
    if region.kind == "samples":
        gap = enclosed.farthest_from_all(region.hull, np.dstack(both)[: some.corners])
        text = f"{some.corners} corners of the domain"
        yield said("samples reach the corners", gap <= TIGHT, "", f"{gap:.3g} apart", text)
    else:
        outside = enclosed.farthest_outside(region.hull, region.error, np.dstack(both))
        text = f"of {count}, in ranges of the entries"
        yield said("Jacobians lie in the hull", outside <= TIGHT, "0", outside, text)
    yield _secants(facts, region, model, some)
    rate, slack, decided = slowest(facts, region, result.jacobians, weighted)
    # Samples promise nothing between them, and new ones may be a little worse.
    slower = _SAMPLED * abs(region.rate) if region.kind == "samples" else 0.0
    least = region.rate * (1.0 - TIGHT) - slack - slower
    fine = decided and rate >= least
    yield said(f"rate at {count}, 1/s", fine, region.rate, rate, "with their own g")


def _charted(saved: SavedModel, region: SavedRegion, model: ControlAffine) -> bool:
    """Tell whether bounded states stay where the equations hold."""
    for name, (low, high) in model.chart.items():
        k = saved.state_names.index(name)
        least, most = saved.state[k] + region.lower[k], saved.state[k] + region.upper[k]
        if np.isfinite(most - least) and not low < least <= most < high:
            return False
    return True


def _secants(facts: Facts, region: SavedRegion, model: ControlAffine, some: Points) -> Finding:
    """Check that velocities of pairs of states differ as the hull, or the rate, lets them.

    A velocity that jumps, or whose derivatives are none of it, gives itself away.
    """
    saved, at = facts.saved, pairs(facts.saved, region, some)
    x, y = saved.model.state + at.ones, saved.model.state + at.others
    steps = x - y
    n, slope = len(saved.P), np.abs(region.hull[:, :, : len(saved.P)]).max(axis=0)

    def velocity(states: Array) -> tuple[Array, Array]:
        result = evaluate(model, saved.model, states, at.inputs)
        return result.velocities, _LOST * (result.sizes + np.abs(states) @ slope.T)

    if region.kind == "samples":
        normals, claim = steps @ saved.P, "pairs come together as promised"
        bounds = _decay(facts, region, steps)
    else:
        normals, claim = (
            _normals(steps @ saved.P, np.abs(steps) @ slope.T),
            "secants lie in the hull",
        )
        bounds = enclosed.support(region.hull[:, :, :n], region.error[:, :n], normals, steps)
    worst = enclosed.steepest(velocity, x, y, normals, bounds)
    text = f"of {len(x)} pairs of states, in parts of their size"
    return said(claim, worst <= TIGHT, "0", max(worst, 0.0), text)


def _normals(metric: Array, sizes: Array) -> Array:
    """Return directions to look in: of single velocities, of random ones, and of the metric."""
    random, (count, n) = np.random.default_rng(2), metric.shape
    single = np.eye(n)[random.integers(0, n, count)]
    mixed = random.normal(size=(count, n)) / np.where(sizes > 0.0, sizes, np.inf)
    which = np.arange(count)[:, None] % 3
    return np.where(which == 0, single, np.where(which == 1, mixed, metric))


def _decay(facts: Facts, region: SavedRegion, steps: Array) -> enclosed.SupportBounds:
    """Return what d'P (v(x) - v(y)) may be at most, by a rate and the strongest of the feedbacks.

    P A + A'P - strength P W P + 2 rate P <= 0, integrated from y to x = y + d.
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
