"""What a reference asks of a model: speed, acceleration, a share of the limits.

And whether it is a motion of the model at all.
"""

from typing import NamedTuple

import jax
import numpy as np

from echelon.agents.models.model import ControlAffine
from echelon.agents.references.flatness import follow_at
from echelon.agents.references.guide import Guide
from echelon.core.compiled import cached_jit
from echelon.core.memoize import memoize
from echelon.core.numerics import precision
from echelon.core.types import Array


class ReferenceDemand(NamedTuple):
    """What a reference asks of a model over a horizon, seen at samples.

    Attributes:
        speed, acceleration: the largest of the position, m/s and m/s^2; None without a position.
        share: of the actuators' room about the trim, at most; 1 is all of it, 0 without limits.
        at: when that is, s.
        inputs: (m,) asked for then.
        defect: how far xdot is from f + g u at most, as a share of the fastest motion, both in the
            model's weights.
        off: the same in one state's own unit: its number, how far, and when.
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
        """Whether the agents can move so, but for the coarseness of knots."""
        return self.defect <= _FEASIBLE


_FEASIBLE = 0.05
"""Knots a tenth of the fastest period apart leave 0.02; a path that is another model's leaves 1."""
_NEAR = 1e-3
"""Between times of which differences are taken, s: rounding and curvature each leave 1e-6."""


@memoize
def asked(
    model: ControlAffine, reference: Guide, horizon: float, samples: int = 1000
) -> ReferenceDemand:
    """Return what a reference asks of a model that can be led along it.

    Args:
        model: the agent.
        reference: to be followed exactly.
        horizon: how long, s.
        samples: how many times are looked at.
    """
    near = min(_NEAR, 1e-2 * horizon)
    times = np.linspace(near, horizon - near, samples)
    with precision("float64"):
        x, u = follow_at(model, reference, np.concatenate([times - near, times, times + near]))
        before, now, after = x.reshape(3, samples, -1)
        inputs = u.reshape(3, samples, -1)[1]
        rate = np.asarray(_rate(model, before, now, after, near))
        wanted = np.asarray(_velocities(model, now, inputs))
    ratios = demand(model, inputs)
    k = int(np.argmax(ratios))
    speed, acceleration = _motion(model, x.reshape(3, samples, -1), near)
    root = np.sqrt(np.asarray(model.weights[0], float))
    away = root * np.abs(rate - wanted)
    j, i = np.unravel_index(int(away.argmax()), away.shape)
    fastest = float(np.linalg.norm(root * rate, axis=1).max())
    return ReferenceDemand(
        speed,
        acceleration,
        float(ratios[k]),
        float(times[k]),
        inputs[k],
        float(away[j, i]) / max(fastest, np.finfo(float).tiny),
        (int(i), float(np.abs(rate - wanted)[j, i]), float(times[j])),
    )


def reference_warnings(
    model: ControlAffine, reference: Guide, horizon: float, limits: bool = True
) -> tuple[str, ...]:
    """Return a sentence with its number for each thing that agents cannot do on a reference.

    Args:
        model: the agent; it can be led along the reference.
        reference: to be followed exactly.
        horizon: how long, s.
        limits: whether the actuators' limits hold.
    """
    found, name, path = asked(model, reference, horizon), type(model).__name__, type(reference)
    told = []
    if limits and found.share > 1.0:
        told.append(
            f"the reference `{path.__name__}` is too fast for `{name}`: {too_fast(model, found)}; "
            "make it slower or smaller."
        )
    if not found.feasible:
        told.append(
            f"the reference `{path.__name__}` is no motion of `{name}`: {infeasible(model, found)}."
        )
    return tuple(told)


def too_fast(model: ControlAffine, found: ReferenceDemand) -> str:
    """Return what a reference asks for beyond the limits, in words."""
    parts = zip(model.input_names, found.inputs, model.input_units, strict=True)
    needed = ", ".join(f"{name} {value:.3g} {unit}".rstrip() for name, value, unit in parts)
    return (
        f"at t = {found.at:.3g} s it needs {found.share:.3g} times what the actuators leave beyond "
        f"the trim ({needed})"
    )


def infeasible(model: ControlAffine, found: ReferenceDemand) -> str:
    """Return by how much a reference is no motion of the model, in words."""
    k, away, when = found.off
    return (
        f"at t = {when:.3g} s the rate of `{model.state_names[k]}` is {away:.3g} off f + g u "
        f"({100.0 * found.defect:.3g} % of the fastest motion)"
    )


def flat_inputs(model: ControlAffine, reference: Guide, times: Array) -> Array:
    """Return the inputs (T, m) that follow a reference exactly, by the model's flatness map."""
    # Up to four nested derivatives of a path leave float32 too few digits to judge limits by.
    with precision("float64"):
        return np.asarray(follow_at(model, reference, times)[1])


def demand(model: ControlAffine, inputs: Array) -> Array:
    """Return for each input (T, m) how much of the actuators' room about the trim it takes, (T,).

    One is the limit; 0.5 leaves as much again. Without limits it is zero.
    """
    if model.input_limits is None:
        return np.zeros(len(inputs))
    G, low, high = (np.asarray(part, float) for part in model.input_limits)
    # What the trim takes is not free: at hover only the thrust beyond m g is room.
    held = G @ np.asarray(model.trim[1], float)
    moved = (inputs - np.asarray(model.trim[1], float)) @ G.T
    room = np.where(moved > 0.0, high - held, held - low)
    # No room at all makes the demand infinite, and 0 / 0 is no demand.
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(moved == 0.0, 0.0, np.abs(moved) / np.maximum(room, 0.0)).max(axis=1)


@cached_jit
def _rate(
    model: ControlAffine, before: jax.Array, now: jax.Array, after: jax.Array, near: float
) -> jax.Array:
    """Return xdot (T, n) by central differences, in the model's own difference of states."""
    return (jax.vmap(model.difference)(after, now) - jax.vmap(model.difference)(before, now)) / (
        2.0 * near
    )


@cached_jit
def _velocities(model: ControlAffine, states: jax.Array, inputs: jax.Array) -> jax.Array:
    return jax.vmap(model.velocity)(states, inputs)


def _motion(model: ControlAffine, x: Array, near: float) -> tuple[float | None, float | None]:
    """Return the largest speed and acceleration, from states (3, T, n) before, at and after."""
    axes = list(model.position_indices())
    if not axes:
        return None, None
    before, now, after = x[..., axes]
    speed, bend = (after - before) / (2.0 * near), (after - 2.0 * now + before) / near**2
    return tuple(float(np.linalg.norm(part, axis=1).max()) for part in (speed, bend))  # pyright: ignore
