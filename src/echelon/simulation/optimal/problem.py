"""An optimal control problem: a model, a cost and constraints over a horizon."""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Literal, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np

from echelon.agents.models.model import ControlAffine, Limits
from echelon.core.errors import PlanError
from echelon.core.types import Input, Scalar, State
from echelon.simulation.optimal.problem_check import check_choice, check_seconds, check_whole

Stage: TypeAlias = Callable[[State, Input, jax.Array], Scalar]
"""(x (n,), u (m,), p (k,)) -> cost per second."""

Terminal: TypeAlias = Callable[[State, jax.Array], Scalar]
"""(x (n,), p (k,)) -> cost at the horizon."""

TRANSCRIPTIONS = ("shooting", "collocation")


class Constraint(NamedTuple):
    """low <= function(x, p) <= high at all times of the grid except the first, whose state is data.

    Attributes:
        name: for messages.
        function: written with `jax.numpy`, of the state (n,) and the time's parameters (k,); it
            returns a number or an array.
        low, high: a number, or one for each entry; equal ones make an equation.
        end: whether it holds at the horizon only.
    """

    name: str
    function: Callable[[State, jax.Array], jax.Array]
    low: float | Sequence[float] = -np.inf
    high: float | Sequence[float] = 0.0
    end: bool = False


def _nothing(x: State, p: jax.Array) -> Scalar:
    return jnp.zeros((), x.dtype)


@dataclasses.dataclass(frozen=True)
class OptimalControl:
    """min of the integral of stage(x, u, p) dt, plus terminal(x(T), p(T)).

    Subject to xdot = f(x) + g(x) u, to a start state, to the actuators' limits and to constraints
    on the state. Cost and constraints are functions written with `jax.numpy`. p is the data
    that differs between times or solutions, such as a reference or a neighbour's plan.

    Args:
        model: the agent.
        horizon: T, s.
        steps: of the grid, on which the integral is taken by the trapezoidal rule.
        stage: cost per second of state (n,), physical input (m,) and parameters (k,).
        terminal: cost of the last state and parameters; none when left out.
        constraints: on the state.
        limits: on the input: those of the model (True), none (False), or others.
        parameters: k, how many numbers p holds at one time.
        transcription: `shooting`, with the input held over a step and Runge-Kutta steps between, or
            `collocation`, the trapezoidal rule with an input at every time.
        substeps: Runge-Kutta steps within a step of the grid.

    Raises:
        PlanError: one is out of range.
    """

    model: ControlAffine
    horizon: float
    steps: int
    stage: Stage
    terminal: Terminal = _nothing
    constraints: tuple[Constraint, ...] = ()
    limits: Limits | bool = True
    parameters: int = 0
    transcription: Literal["shooting", "collocation"] = "shooting"
    substeps: int = 1

    def __post_init__(self) -> None:
        if not isinstance(self.model, ControlAffine):
            raise PlanError(
                f"the model is {self.model!r}, and must be an instance of a `ControlAffine` class."
            )
        check_seconds("horizon", self.horizon)
        check_whole("steps", self.steps, 1, "; the horizon must hold at least one step")
        check_whole("substeps", self.substeps, 1)
        check_whole("parameters", self.parameters, 0)
        check_choice("transcription", self.transcription, TRANSCRIPTIONS)
        if self.limits is True:
            _check_has_limits(self.model)
        _check_limits(self.bounds, len(self.model.input_names))

    @property
    def dt(self) -> float:
        """Length of a step of the grid, s."""
        return self.horizon / self.steps

    @property
    def nodes(self) -> int:
        """The number of inputs of a plan: one per step, or one per time."""
        # The trapezoidal rule needs the input at both ends of a step.
        return self.steps + (self.transcription == "collocation")

    @property
    def bounds(self) -> Limits | None:
        """The limits on the input; None without any."""
        if isinstance(self.limits, Limits):
            return self.limits
        return self.model.input_limits if self.limits else None


def _check_has_limits(model: ControlAffine) -> None:
    # A plan needs inequalities, which cannot be derived from a function that clips.
    if model.input_limits is None and type(model).limit is not ControlAffine.limit:
        raise PlanError(
            f"`{type(model).__name__}` has a `limit`, and plans need it as `input_limits` too; add "
            "them to the model, or give `limits`."
        )


def _check_limits(limits: Limits | None, m: int) -> None:
    if limits is None:
        return
    matrix, low, high = (np.asarray(part, float) for part in limits)
    if matrix.shape != (len(matrix), m) or {low.shape, high.shape} != {(len(matrix),)}:
        raise PlanError(
            f"the input limits have shapes {matrix.shape}, {low.shape} and {high.shape}, "
            f"and must have (k, {m}), (k,) and (k,)."
        )
    if not (low <= high).all():
        raise PlanError(f"the input limits {low.tolist()} to {high.tolist()} hold no number.")
