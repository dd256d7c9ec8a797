"""The states and inputs of a model that follow a reference, and what that demands of the model."""

from collections.abc import Iterator
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Bool, Float

from echelon.agents.models.model import ControlAffine
from echelon.agents.models.relative_equilibrium import trim_velocity
from echelon.agents.references.reference import LeaderPath, Reference, check_reference
from echelon.core.cache import memoize
from echelon.core.compiled import cached_jit
from echelon.core.errors import LawError, PlanError
from echelon.core.numerics import precision
from echelon.core.types import Array, Input, State

# ---- states and inputs ---------------------------------------------------------------------------

_FEW, _MANY = 512, 4096
"""Up to `_MANY` times are computed in blocks of `_FEW` by one program, since compiling is slow."""


def follow_at(
    model: ControlAffine, reference: LeaderPath, times: Float[Array, " T"] | Float[jax.Array, " T"]
) -> tuple[Any, Any]:
    """Return the states (T, n) and inputs (T, m) that follow a reference exactly at times (T,)."""
    if isinstance(times, Tracer) or len(times) > _MANY:
        return _follow_all(model, reference, times)
    count = len(times)
    padded = np.pad(np.asarray(times), (0, -count % _FEW), mode="edge")
    blocks = np.split(padded, len(padded) // _FEW)
    paths = [_follow_all(model, reference, block) for block in blocks]
    x, u = (np.concatenate(parts)[:count] for parts in zip(*paths, strict=True))
    return x, u


def followed_states(
    model: ControlAffine, reference: LeaderPath, times: Array | jax.Array
) -> jax.Array:
    """Return the states (T, n) that follow a reference exactly at times (T,)."""
    # `asarray` would compile a program of its own.
    return jax.device_put(follow_at(model, reference, times)[0])


def first_state(model: ControlAffine, reference: LeaderPath) -> State:
    """Return the state (n,) that follows a reference at time zero."""
    return jax.device_put(follow_at(model, reference, np.zeros(1))[0][0])


@cached_jit
def _follow_all(
    model: ControlAffine, reference: LeaderPath, times: Array | jax.Array
) -> tuple[jax.Array, jax.Array]:
    return jax.vmap(lambda t: reference.follow(model, t))(times)


class Targets(NamedTuple):
    """The targets of a plan at T times.

    States (T, n) are an initial guess of the motion, outputs (T, q) enter the objective, inputs
    (T, m) are normalized.
    """

    states: Array
    outputs: Array
    inputs: Array


def reference_targets(model: ControlAffine, reference: LeaderPath | None, times: Array) -> Targets:
    """Return a leader's targets: its reference by `flat`, or its trim; else raise `PlanError`."""
    # Without a reference a leader stays at its trim, or moves with it.
    if reference is None:
        x = np.asarray(model.trim[0], float) + np.multiply.outer(times, trim_velocity(model))
        return _targets(model, x, np.zeros((len(times), len(model.input_names))))
    check_reference(reference)
    try:
        reference.fit(model)
    except LawError as error:
        raise PlanError(str(error)) from None
    with precision("float64"):
        x, u = follow_at(model, reference, times)
    if not (np.isfinite(x).all() and np.isfinite(u).all()):
        raise PlanError(
            f"the reference `{type(reference).__name__}` cannot be followed by "
            f"`{type(model).__name__}`: its flat state and input are not finite."
        )
    return _targets(model, x, model.normalized(u))


def shifted_targets(model: ControlAffine, targets: Targets, offset: Array) -> Targets:
    """Return the same targets an offset (n,) away."""
    return _targets(model, targets.states + offset, targets.inputs)


def mean_targets(model: ControlAffine, states: Array, inputs: Array, share: Array) -> Targets:
    """Return the mean of targets (J, T, ..) by shares (J,); squared errors differ by a constant."""
    return _targets(model, np.tensordot(share, states, 1), np.tensordot(share, inputs, 1))


def _targets(model: ControlAffine, x: Array, v: Array) -> Targets:
    with precision("float64"):
        outputs = np.asarray(_outputs(model, jnp.asarray(x)))
    return Targets(x, outputs, v)


@cached_jit
def _outputs(model: ControlAffine, states: jax.Array) -> jax.Array:
    return jax.vmap(model.output)(states)


# ---- speed, acceleration, share of the limits, feasibility ---------------------------------------


class ReferenceDemand(NamedTuple):
    """The demand of a reference on a model over a horizon, computed at samples.

    Attributes:
        speed, acceleration: the largest of the position, m/s and m/s^2; None without a position.
        share: largest share of the actuators' range about the trim; 1 is all, 0 without limits.
        at: time of the largest share, s.
        inputs: (m,) required at that time.
        defect: largest distance of xdot from f + g u as a share of the fastest motion, both in the
            model's weights.
        off: the largest distance in the unit of one state: index of the state, distance, time (s).
    """

    speed: float | None
    acceleration: float | None
    share: float
    at: float
    inputs: Array
    defect: float
    off: tuple[int, float, float]

    @property
    def feasible(self) -> bool:
        """Whether the agents can follow the reference, up to the resolution of knots."""
        return self.defect <= _FEASIBLE


_AT_REST = 1e-9
"""Of a rate; a path that is no faster rests, and the rest is rounding."""
_FEASIBLE = 0.05
"""Knots a tenth of the fastest period apart leave 0.02; a path of another model leaves 1."""
_SAMPLES = 1000
_NEAR = 1e-3
"""Time step of differences, s: errors of rounding and of curvature are 1e-6 each."""


@memoize
@np.errstate(over="ignore", invalid="ignore")
def reference_demand(
    model: ControlAffine, reference: LeaderPath, horizon: float
) -> ReferenceDemand:
    """Return the demand of a reference on a model that it can lead, over a horizon (s)."""
    near = min(_NEAR, 1e-2 * horizon)
    times = np.linspace(near, horizon - near, _SAMPLES)
    with precision("float64"):
        x, u = follow_at(model, reference, np.concatenate([times - near, times, times + near]))
        x = x.reshape(3, _SAMPLES, -1)
        inputs = u.reshape(3, _SAMPLES, -1)[1]
        rate = np.asarray(_rate(model, *x, near))
        velocities = np.asarray(_velocities(model, x[1], inputs))
    ratios = demand(model, inputs)
    k = int(np.argmax(ratios))
    speed, acceleration = _motion(model, x, near)
    root = np.sqrt(np.asarray(model.weights[0], float))
    away = root * np.abs(rate - velocities)
    j, i = np.unravel_index(int(away.argmax()), away.shape)
    fastest = float(np.linalg.norm(root * rate, axis=1).max())
    return ReferenceDemand(
        speed,
        acceleration,
        float(ratios[k]),
        float(times[k]),
        inputs[k],
        float(away[j, i]) / max(fastest, _AT_REST),
        (int(i), float(np.abs(rate - velocities)[j, i]), float(times[j])),
    )


def reference_warnings(
    model: ControlAffine, reference: LeaderPath, horizon: float, limits: bool = True
) -> tuple[str, ...]:
    """Return one sentence with its numbers for each fault of a reference that leads a model."""
    required, model_name = reference_demand(model, reference, horizon), type(model).__name__
    name, warnings = type(reference).__name__, [*reference.remarks()]
    if stops := stop_warnings(model, reference, horizon):
        return (*warnings, *stops)
    if limits and required.share > 1.0:
        warnings.append(
            f"the reference `{name}` is too fast for `{model_name}`: {too_fast(model, required)}"
            f"{_forced(model, reference, horizon, required.share)}."
        )
    if not required.feasible:
        warnings.append(
            f"the reference `{name}` is no motion of `{model_name}`: {infeasible(model, required)}."
        )
    return (*warnings, *_turned_over(model, reference, horizon))


def stop_warnings(model: ControlAffine, reference: LeaderPath, horizon: float) -> tuple[str, ...]:
    """Return when a path stops, of a model that has no heading at rest, a sentence."""
    times = np.linspace(0.0, horizon, _SAMPLES)
    still = times[without_heading(model, reference, times)][:1]
    return tuple(
        f"the reference `{type(reference).__name__}` cannot be followed by "
        f"`{type(model).__name__}` at t = {t:.4g} s: its speed is 0 there, and the model has no "
        f"heading at rest{moving(model, reference, still)}."
        for t in still
    )


def _forced(model: ControlAffine, reference: LeaderPath, horizon: float, share: float) -> str:
    """Return a clause on what forces a demand: without it, which is tried, it is half or less."""
    for why, key, path in reference.variants():
        other = reference_demand(model, path, horizon).share
        if other <= 0.5 * share:
            return f"; the path {why}, and with `{key}` it needs {other:.3g} times the range"
    return ""


def moving(model: ControlAffine, reference: LeaderPath, times: Float[Array, " T"]) -> str:
    """Return a clause on what stops a path at times, where it is known; see `without_heading`."""
    for why, key, path in reference.variants():
        if not without_heading(model, path, times).any():
            return f"; the path {why}, and moves then with `{key}`"
    return ""


def without_heading(
    model: ControlAffine, reference: LeaderPath, times: Float[Array, " T"]
) -> Bool[np.ndarray, " T"]:
    """Return when a path has speed 0, of a model that has no state at rest, such as a unicycle."""
    if not isinstance(reference, Reference) or model.flat_order < 1:
        return np.zeros(len(times), bool)
    with precision("float64"):
        rest = _flat(model, np.zeros((model.flat_order + 1, len(model.flat_outputs))))
        if all(np.isfinite(part).all() for part in rest):
            return np.zeros(len(times), bool)
        rates = [
            np.asarray(_derivative(reference, times, (name,), 1)) for name in model.flat_outputs
        ]
    return np.linalg.norm(rates, axis=0) <= _AT_REST


@cached_jit
def _flat(model: ControlAffine, derivatives: Array) -> tuple[State, Input]:
    # Compiled, since its derivatives one operation at a time take most of a second.
    return model.flat(jnp.asarray(derivatives))


def _turned_over(model: ControlAffine, reference: LeaderPath, horizon: float) -> Iterator[str]:
    """Yield where a derivative of a path passes a bound of the model, as a tilt beyond 90 deg."""
    # A bound on a length of several outputs is one on the speed, and holds at rest for no path.
    bounds = [bound for bound in model.flat_bounds or () if len(bound.outputs) == 1]
    if not isinstance(reference, Reference):
        return
    for bound in bounds:
        times = np.linspace(0.0, horizon, _SAMPLES)
        with precision("float64"):
            values = np.asarray(_derivative(reference, times, bound.outputs, bound.derivative))
        k = int(np.argmin(values))
        if values[k] <= bound.above:
            name = bound.outputs[0] + "'" * bound.derivative
            yield (
                f"the reference `{type(reference).__name__}` leaves the range of "
                f"`{type(model).__name__}`: at t = {times[k]:.3g} s `{name}` is {values[k]:.3g}, "
                f"and must be above {bound.above:.3g} ({bound.within})."
            )


def too_fast(model: ControlAffine, required: ReferenceDemand) -> str:
    """Return by how much a reference exceeds the limits, in words."""
    parts = zip(model.input_names, required.inputs, model.input_units, strict=True)
    inputs = ", ".join(f"{name} {value:.3g} {unit}".rstrip() for name, value, unit in parts)
    return (
        f"at t = {required.at:.3g} s it needs {required.share:.3g} times the range of the "
        f"actuators beyond the trim ({inputs})"
    )


def infeasible(model: ControlAffine, required: ReferenceDemand) -> str:
    """Return by how much a reference deviates from motions of the model, in words."""
    k, away, when = required.off
    return (
        f"at t = {when:.3g} s the rate of `{model.state_names[k]}` is {away:.3g} off f + g u "
        f"({100.0 * required.defect:.3g} % of the fastest motion)"
    )


def flat_inputs(model: ControlAffine, reference: LeaderPath, times: Array) -> Array:
    """Return the inputs (T, m) that follow a reference exactly, by the model's flatness map."""
    # Up to four nested derivatives of a path leave too few digits in float32 to judge limits.
    with precision("float64"):
        return np.asarray(follow_at(model, reference, times)[1])


def demand(model: ControlAffine, inputs: Array) -> Array:
    """Return the used share (T,) of the actuators' range about the trim; 0 without limits."""
    if model.input_limits is None:
        return np.zeros(len(inputs))
    G, low, high = (np.asarray(part, float) for part in model.input_limits)
    # The trim uses a part of the range: at hover only the thrust beyond m g is available.
    at_trim = G @ np.asarray(model.trim[1], float)
    change = (inputs - np.asarray(model.trim[1], float)) @ G.T
    margin = np.where(change > 0.0, high - at_trim, at_trim - low)
    # Without any margin the demand is infinite; 0 / 0 is no demand.
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(change == 0.0, 0.0, np.abs(change) / np.maximum(margin, 0.0)).max(axis=1)


@cached_jit
def _rate(
    model: ControlAffine, before: jax.Array, now: jax.Array, after: jax.Array, near: float
) -> jax.Array:
    """Return xdot (T, n) by central differences, with the model's difference of states."""
    return (jax.vmap(model.difference)(after, now) - jax.vmap(model.difference)(before, now)) / (
        2.0 * near
    )


@cached_jit
def _velocities(model: ControlAffine, states: jax.Array, inputs: jax.Array) -> jax.Array:
    return jax.vmap(model.velocity)(states, inputs)


@cached_jit
def _derivative(
    reference: Reference, times: jax.Array, names: tuple[str, ...], order: int
) -> jax.Array:
    return jax.vmap(lambda t: reference.derivatives(t, order, names)[order, 0])(times)


def _motion(model: ControlAffine, x: Array, near: float) -> tuple[float | None, float | None]:
    """Return the largest speed and acceleration, from states (3, T, n) before, at and after."""
    axes = list(model.position_indices())
    if not axes:
        return None, None
    before, now, after = x[..., axes]
    speed, bend = (after - before) / (2.0 * near), (after - 2.0 * now + before) / near**2
    fastest, most = (float(np.linalg.norm(part, axis=1).max()) for part in (speed, bend))
    return fastest, most
