"""Objectives of the optimization method: tracking of targets, or keeping of distances.

A leader's targets are its reference; a follower's are computed from its neighbours' plans.
"""

import dataclasses
import math
from collections.abc import Callable, Iterator, Sequence
from typing import Literal, NamedTuple, final

import jax
import jax.numpy as jnp
import numpy as np

from echelon.agents.models.model import ControlAffine
from echelon.core.errors import PlanError
from echelon.core.types import Array
from echelon.simulation.optimal.problem import Constraint, OptimalControl, Stage
from echelon.simulation.optimal.problem_check import check_choice, check_seconds, read_weights

SPECIFICATIONS = ("offset", "distance")
_INSIDE = 0.9
"""The share of a chart's half-width that plans use: at its edge the equations are singular."""
_SUBSTEP = 0.025
"""Longest Runge-Kutta step of the coarse solution, s; a solution on fine steps follows it."""


@final
@dataclasses.dataclass(frozen=True)
class TrackingOptions:
    """Options of the planning problems of a formation.

    Args:
        interval: how long an input is held, s; rounded to whole steps of the simulation.
        output_weight: weight of the squared error of each output, q numbers; ones when left out.
        input_weight: factor on the model's own input weights, for the normalized input's deviation
            from that of the reference or of the neighbours' plans.
        specification: what a follower regulates: its `offset` from its neighbours, or only its
            `distance`.
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
        check_seconds("interval", self.interval)
        if not 0.0 <= self.input_weight < math.inf:
            raise PlanError(
                f"`input_weight` is {self.input_weight}, and must be finite and not negative."
            )
        check_choice("specification", self.specification, SPECIFICATIONS)
        if isinstance(self.output_weight, list | np.ndarray):
            # A law has this in a static field, which JAX compares by its hash.
            object.__setattr__(self, "output_weight", tuple(np.ravel(self.output_weight).tolist()))

    def weights(self, model: ControlAffine) -> Array:
        """Return the weights of the outputs, (q,).

        Raises:
            PlanError: they do not fit the model.
        """
        weights, names = self.output_weight, model.output_names
        weights = np.ones(len(names)) if weights is None else weights
        return read_weights("output_weight", weights, names)


class PlanTimes(NamedTuple):
    """Times of a plan: `steps` intervals of `hold` steps of dt (s) each."""

    steps: int
    hold: int
    dt: float

    @property
    def interval(self) -> float:
        """Length of an interval, s."""
        return self.hold * self.dt

    @property
    def times(self) -> Array:
        """The ends of the intervals, (steps + 1,) s."""
        return self.interval * np.arange(self.steps + 1)


def grid(horizon: float, dt: float, interval: float) -> PlanTimes:
    """Return intervals of whole steps that cover a horizon; `PlanError` if it is below a step."""
    if not dt <= horizon < math.inf:
        raise PlanError(
            f"`horizon` is {horizon} s, and must be finite and at least one step of {dt} s."
        )
    count = max(1, round(horizon / dt))
    hold = min(count, max(1, round(interval / dt)))
    # Rounded up, since a run that ends within an interval needs an input there.
    return PlanTimes(-(-count // hold), hold, dt)


def tracking(
    model: ControlAffine, planning: TrackingOptions, times: PlanTimes, limits: bool, fine: bool
) -> OptimalControl:
    """Return an agent's problem; parameters: outputs (q,), normalized input (m,), a factor."""
    W, q = planning.weights(model), len(model.output_names)
    input_cost = _input_cost(model)

    def stage(x: jax.Array, u: jax.Array, p: jax.Array) -> jax.Array:
        e = model.output(x) - p[:q]
        return jnp.sum(jnp.asarray(W, x.dtype) * e * e) + input_cost(u, p[q:])

    return _problem(model, times, limits, fine, stage, q + len(model.input_names) + 1)


def spacing(
    model: ControlAffine,
    times: PlanTimes,
    limits: bool,
    fine: bool,
    distances: Array,
) -> OptimalControl:
    """Return the problem of a follower with desired distances (J,) from J neighbours.

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
    input_cost, count = _input_cost(model), len(distances) * len(axes)

    def stage(x: jax.Array, u: jax.Array, p: jax.Array) -> jax.Array:
        displacement = p[:count].reshape(len(distances), len(axes)) - x[None, np.array(axes)]
        # It has no derivative where two agents coincide, far from any desired distance.
        error = jnp.sqrt(jnp.sum(displacement * displacement, axis=1)) - jnp.asarray(
            distances, x.dtype
        )
        return jnp.sum(error * error) + input_cost(u, p[count:])

    return _problem(model, times, limits, fine, stage, count + len(model.input_names) + 1)


def _input_cost(model: ControlAffine) -> Callable[[jax.Array, jax.Array], jax.Array]:
    """Return the cost of an input u; its data p is the target's normalized input and a factor."""
    # In normalized inputs, as deviations: a formation in motion costs nothing (theory page).
    R = np.asarray(model.weights[1])

    def cost(u: jax.Array, p: jax.Array) -> jax.Array:
        d = model.normalized(u) - p[:-1]
        return p[-1] * jnp.sum(jnp.asarray(R, u.dtype) * d * d)

    return cost


def _problem(
    model: ControlAffine, times: PlanTimes, limits: bool, fine: bool, stage: Stage, parameters: int
) -> OptimalControl:
    return OptimalControl(
        model,
        times.steps * times.interval,
        times.steps,
        stage,
        constraints=tuple(_chart_constraints(model)),
        limits=limits,
        parameters=parameters,
        # The fine steps are those of `simulate`, so that the plan is the run.
        substeps=times.hold if fine else coarse(times),
    )


def coarse(times: PlanTimes) -> int:
    """Return the Runge-Kutta steps within an interval of a first solution."""
    # Less 1e-9, so that a quotient one rounding above a whole number is not one more.
    return min(times.hold, max(1, math.ceil(times.interval / _SUBSTEP - 1e-9)))


def _chart_constraints(model: ControlAffine) -> Iterator[Constraint]:
    for name, (low, high) in model.chart.items():
        middle, half = 0.5 * (low + high), 0.5 * _INSIDE * (high - low)
        k = model.state_names.index(name)
        # k=k, since a function made in a loop would see the last k.
        yield Constraint(f"range of {name}", lambda x, p, k=k: x[k], middle - half, middle + half)
