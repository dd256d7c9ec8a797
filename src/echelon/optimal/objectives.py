"""How the optimization method poses an agent's problem: follow targets, spend little input.

A leader's targets are its reference; a follower's are what the plans of its neighbours leave it.
"""

import dataclasses
import math
from collections.abc import Sequence
from typing import Any, Literal, NamedTuple, final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from echelon.core.errors import PlanError, listing
from echelon.core.numerics import precision
from echelon.core.types import Matrix
from echelon.models.model import ControlAffine
from echelon.optimal.problem import Constraint, OptimalControl, Stage
from echelon.references.reference import COORDINATES, Reference

SPECIFICATIONS = ("offset", "distance")
_INSIDE = 0.9
"""A plan keeps to this part of a chart's half-width: at its edge the equations are singular."""
_SUBSTEP = 0.025
"""Longest Runge-Kutta step of a first solution, s; a second one on the fine steps follows."""


@final
@dataclasses.dataclass(frozen=True)
class Planning:
    """How the plans of a formation are posed.

    Args:
        interval: how long an input is held, s; rounded to whole steps of the simulation.
        output_weight: weight of the squared error of each output, q numbers; ones when left out.
        input_weight: factor on the model's own input weights, for the normalized input's deviation
            from that of the reference or of the neighbours' plans.
        specification: what a follower keeps to: its `offset` from its neighbours, or its `distance`
            alone.
        solver: a nonlinear solver of CasADi.

    Raises:
        PlanError: one is out of range.
    """

    interval: float = 0.05
    output_weight: Sequence[float] | None = None
    input_weight: float = 1e-4
    specification: Literal["offset", "distance"] = "offset"
    solver: str = "ipopt"

    def __post_init__(self) -> None:
        """Refuse what is out of range."""
        if not 0.0 < self.interval < math.inf:
            raise PlanError(
                f"`interval` is {self.interval}, and must be a positive finite number of seconds."
            )
        if not 0.0 <= self.input_weight < math.inf:
            raise PlanError(
                f"`input_weight` is {self.input_weight}, and must be finite and not negative."
            )
        if self.specification not in SPECIFICATIONS:
            raise PlanError(
                f"`specification` is `{self.specification}`, allowed are {listing(SPECIFICATIONS)}."
            )
        if isinstance(self.output_weight, list | np.ndarray):
            # A law holds this, and JAX asks of it that it can be hashed.
            object.__setattr__(self, "output_weight", tuple(np.ravel(self.output_weight).tolist()))

    def weights(self, model: ControlAffine) -> Matrix:
        """Return the weights of the outputs, (q,).

        Raises:
            PlanError: they do not fit the model.
        """
        count = len(model.output_names)
        given = np.ones(count) if self.output_weight is None else self.output_weight
        try:
            weights = np.asarray(given, np.float64)
        except (TypeError, ValueError):
            weights = np.full(1, np.nan)
        if weights.shape != (count,) or not (np.isfinite(weights) & (weights >= 0.0)).all():
            raise PlanError(
                f"`output_weight` is {self.output_weight}, and must be {count} finite numbers that "
                f"are not negative, one for each of {listing(model.output_names)}."
            )
        return weights


class Grid(NamedTuple):
    """Times of a plan: `steps` intervals of `hold` steps of dt (s) each."""

    steps: int
    hold: int
    dt: float

    @property
    def interval(self) -> float:
        """Length of an interval, s."""
        return self.hold * self.dt

    @property
    def times(self) -> Matrix:
        """The ends of the intervals, (steps + 1,) s."""
        return self.interval * np.arange(self.steps + 1)


def grid(horizon: float, dt: float, interval: float) -> Grid:
    """Return the grid of a horizon: intervals of whole steps, the last of which covers its end.

    Raises:
        PlanError: the horizon is shorter than a step.
    """
    if not dt <= horizon < math.inf:
        raise PlanError(
            f"`horizon` is {horizon} s, and must be finite and at least one step of {dt} s."
        )
    count = max(1, round(horizon / dt))
    hold = min(count, max(1, round(interval / dt)))
    return Grid(-(-count // hold), hold, dt)


class Targets(NamedTuple):
    """What a plan follows at T times.

    States (T, n) are a guess of the motion, outputs (T, q) are what counts, inputs (T, m) are
    normalized.
    """

    states: Matrix
    outputs: Matrix
    inputs: Matrix


def reference_targets(model: ControlAffine, reference: Reference | None, times: Matrix) -> Targets:
    """Return what a leader follows: its reference by the model's flatness map, or its trim.

    Raises:
        PlanError: the model has no such map, or the reference is not finite.
    """
    if reference is None:
        x = np.tile(np.asarray(model.trim[0], float), (len(times), 1))
        return _targets(model, x, np.zeros((len(times), len(model.input_names))))
    unknown = [name for name in model.flat_outputs if name not in COORDINATES]
    if not model.flat_outputs or unknown:
        raise PlanError(
            f"`{type(model).__name__}` cannot be led along a reference: it needs `flat_outputs` "
            f"out of {listing(COORDINATES)}, `flat_order` and `flat`."
        )
    with precision("float64"):
        x, u = (np.asarray(part) for part in _flat(model, reference, jnp.asarray(times)))
    if not (np.isfinite(x).all() and np.isfinite(u).all()):
        raise PlanError(
            f"the reference `{type(reference).__name__}` cannot be followed by "
            f"`{type(model).__name__}`: its flat state and input are not finite."
        )
    return _targets(model, x, normalized(model, u))


@eqx.filter_jit
def _flat(
    model: ControlAffine, reference: Reference, times: jax.Array
) -> tuple[jax.Array, jax.Array]:
    def at(t: jax.Array) -> tuple[jax.Array, jax.Array]:
        return model.flat(reference.derivatives(t, model.flat_order, model.flat_outputs))

    return jax.vmap(at)(times)


def shifted_targets(model: ControlAffine, targets: Targets, offset: Matrix) -> Targets:
    """Return the same targets an offset (n,) away."""
    return _targets(model, targets.states + offset, targets.inputs)


def mean_targets(model: ControlAffine, states: Matrix, inputs: Matrix, share: Matrix) -> Targets:
    """Return the mean of targets with states (J, T, n) and inputs (J, T, m), by shares (J,).

    A sum of squared errors to several targets is that to their mean and a constant.
    """
    return _targets(model, np.tensordot(share, states, 1), np.tensordot(share, inputs, 1))


def _targets(model: ControlAffine, x: Matrix, v: Matrix) -> Targets:
    with precision("float64"):
        outputs = np.asarray(_outputs(model, jnp.asarray(x)))
    return Targets(x, outputs, v)


@eqx.filter_jit
def _outputs(model: ControlAffine, states: jax.Array) -> jax.Array:
    return jax.vmap(model.output)(states)


def normalized(model: ControlAffine, u: Matrix) -> Matrix:
    """Return the normalized inputs (..., m) of physical ones."""
    deviation = np.asarray(u) - np.asarray(model.trim[1], float)
    return deviation @ np.linalg.inv(np.asarray(model.input_scale, float)).T


def physical(model: ControlAffine, v: Matrix) -> Matrix:
    """Return the physical inputs (..., m) of normalized ones."""
    return np.asarray(model.trim[1], float) + v @ np.asarray(model.input_scale, float).T


# ---- problems ------------------------------------------------------------------------------------


def tracking(
    model: ControlAffine, planning: Planning, times: Grid, limits: bool, fine: bool
) -> OptimalControl:
    """Return the problem of an agent with targets.

    Its parameters at a time are the target's outputs (q,), its normalized input (m,), and the
    factor on the input weights.
    """
    W, q = planning.weights(model), len(model.output_names)
    spent = _spending(model)

    def stage(x: jax.Array, u: jax.Array, p: jax.Array) -> jax.Array:
        e = model.output(x) - p[:q]
        return jnp.sum(jnp.asarray(W, x.dtype) * e * e) + spent(u, p[q:])

    return _problem(model, times, limits, fine, stage, q + len(model.input_names) + 1)


def spacing(
    model: ControlAffine,
    times: Grid,
    limits: bool,
    fine: bool,
    distances: Matrix,
) -> OptimalControl:
    """Return the problem of a follower with wanted distances (J,) from J neighbours.

    Its parameters at a time are the neighbours' positions (J d,), the normalized input (m,) and the
    factor on the input weights.

    Raises:
        PlanError: the model has no position.
    """
    axes = list(model.position_indices())
    if not axes:
        raise PlanError(
            f"`{type(model).__name__}` has no position, so a distance has no meaning for it; "
            "use the specification `offset`."
        )
    spent, count = _spending(model), len(distances) * len(axes)

    def stage(x: jax.Array, u: jax.Array, p: jax.Array) -> jax.Array:
        apart = p[:count].reshape(len(distances), len(axes)) - x[None, np.array(axes)]
        off = jnp.sqrt(jnp.sum(apart * apart, axis=1)) - jnp.asarray(distances, x.dtype)
        return jnp.sum(off * off) + spent(u, p[count:])

    return _problem(model, times, limits, fine, stage, count + len(model.input_names) + 1)


def _spending(model: ControlAffine) -> Any:
    """Return the cost of an input u given (its target's normalized input, factor)."""
    inverse, R = np.linalg.inv(np.asarray(model.input_scale, float)), np.asarray(model.weights[1])
    trim = np.asarray(model.trim[1], float)

    def spent(u: jax.Array, p: jax.Array) -> jax.Array:
        v = jnp.asarray(inverse, u.dtype) @ (u - jnp.asarray(trim, u.dtype))
        d = v - p[:-1]
        return p[-1] * jnp.sum(jnp.asarray(R, u.dtype) * d * d)

    return spent


def _problem(
    model: ControlAffine, times: Grid, limits: bool, fine: bool, stage: Stage, parameters: int
) -> OptimalControl:
    return OptimalControl(
        model,
        times.steps * times.interval,
        times.steps,
        stage,
        constraints=tuple(_within_chart(model)),
        limits=limits,
        parameters=parameters,
        substeps=times.hold if fine else coarse(times),
    )


def coarse(times: Grid) -> int:
    """Return the Runge-Kutta steps within an interval of a first solution."""
    return min(times.hold, max(1, math.ceil(times.interval / _SUBSTEP - 1e-9)))


def _within_chart(model: ControlAffine) -> Any:
    for name, (low, high) in model.chart.items():
        middle, half = 0.5 * (low + high), 0.5 * _INSIDE * (high - low)
        k = model.state_names.index(name)
        yield Constraint(f"range of {name}", lambda x, p, k=k: x[k], middle - half, middle + half)
