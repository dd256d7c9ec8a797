"""The optimal control problem of model predictive control, solved by real-time iteration.

In each period the motion is linearized along the last plan, and one quadratic program is solved.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from types import ModuleType
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, final

import jax
import jax.numpy as jnp
import numpy as np
import scipy.linalg
import scipy.sparse

from echelon.agents.models.linearization import linearize
from echelon.agents.models.model import ControlAffine
from echelon.core.errors import PlanError
from echelon.core.linear import discretize, without_warnings
from echelon.core.numerics import precision, rk4
from echelon.core.types import Array
from echelon.simulation.optimal.casadi import casadi, casadi_function
from echelon.simulation.optimal.problem_check import (
    check_choice,
    check_seconds,
    check_whole,
    read_weights,
)

if TYPE_CHECKING:  # it comes with an extra
    from casadi import DM, Function, Sparsity

ON_FAILURE = ("shift", "stop")
SOLVERS = ("piqp", "proxqp", "osqp", "qrqp", "qpoases", "daqp", "highs")
_SILENT: dict[str, dict[str, object]] = {
    # Its own tolerance is 1e-3, of metres and of metres per second squared alike.
    "osqp": {"osqp": {"verbose": False, "eps_abs": 1e-7, "eps_rel": 1e-7}},
    "qrqp": {"print_iter": False, "print_header": False},
    "qpoases": {"printLevel": "none", "sparse": True},
}


@final
@dataclasses.dataclass(frozen=True)
class MPC:
    """A receding horizon: plan from the measured state, apply the first input, plan again.

    The cost is that of the paper's gains: the integral of e'Q e + w'R w over the horizon, plus the
    cost of the Riccati gain from its end on. e is the deviation from the targets' states, w that
    from their normalized inputs. Default weights are the model's own for the states that its
    output depends on, 1/25 of them for all others, and 1/100 of them for the inputs: errors should
    be small, and the limits bound the inputs anyway.

    Args:
        period: how long an input is held before the next plan, and the step of the horizon's grid,
            s; rounded to whole steps of the simulation.
        horizon: s.
        state_weight: diagonal of Q, n numbers.
        input_weight: diagonal of R, m numbers.
        iterations: quadratic programs a period.
        on_failure: when a solver fails, `shift` continues with the agent's last plan, and `stop`
            ends the run.
        solver: a quadratic solver of CasADi.
        options: for it, by CasADi's names.

    Raises:
        PlanError: one is out of range.
    """

    period: float = 0.02
    horizon: float = 1.0
    state_weight: Sequence[float] | None = None
    input_weight: Sequence[float] | None = None
    iterations: int = 1
    on_failure: Literal["shift", "stop"] = "shift"
    solver: str = "piqp"
    options: Mapping[str, Any] = dataclasses.field(default_factory=dict)

    def __post_init__(self) -> None:
        for name in ("period", "horizon"):
            check_seconds(name, getattr(self, name))
        if self.horizon < self.period:
            raise PlanError(
                f"`horizon` is {self.horizon} s, and must be at least one `period` of "
                f"{self.period} s."
            )
        check_whole("iterations", self.iterations, 1)
        check_choice("on_failure", self.on_failure, ON_FAILURE)
        check_choice("solver", self.solver, SOLVERS)

    def weights(self, model: ControlAffine) -> tuple[Array, Array]:
        """Return the diagonals of Q (n,) and R (m,).

        Raises:
            PlanError: they do not fit the model.
        """
        Q, R = (np.asarray(weights, float) for weights in model.weights)
        Q = Q * np.where(_output_states(model), 1.0, 1.0 / 25.0)
        Q = Q if self.state_weight is None else self.state_weight
        R = R / 100.0 if self.input_weight is None else self.input_weight
        Q = read_weights("state_weight", Q, model.state_names)
        R = read_weights("input_weight", R, model.input_names)
        # Without a cost on every input the quadratic program has no unique solution.
        if not (R > 0.0).all():
            raise PlanError(f"`input_weight` is {R.tolist()}, and must be positive.")
        return Q, R


def _output_states(model: ControlAffine) -> Array:
    """Tell which states the output depends on at the trim, (n,)."""
    with precision("float64"):
        slopes = jax.jacfwd(model.output)(jnp.asarray(np.asarray(model.trim[0], float)))
    return np.array(np.asarray(slopes).any(axis=0))


class Course(NamedTuple):
    """States (N + 1, n) and normalized inputs (N, m) over a horizon."""

    states: Array
    inputs: Array


class Answer(NamedTuple):
    """A plan or None, and the solver's return status."""

    course: Course | None
    status: str


@final
class Horizon:
    """The quadratic programs of one model, limits and weights, for any start and targets.

    Variables are v_0, x_1, v_1, ..., x_N. The start is data, so that no equation is needed for it,
    which interior-point solvers could not meet.
    """

    def __init__(self, model: ControlAffine, mpc: MPC, steps: int, dt: float, limits: bool) -> None:
        """Build the quadratic program for a grid of `steps` of dt (s)."""
        self.steps, self.dt = steps, dt
        self.n, self.m = len(model.state_names), len(model.input_names)
        Q, R = mpc.weights(model)
        with precision("float64"):
            last = _cost_to_go(model, Q, R, dt)
        # Times dt: the sum stands for the integral, so that the weights are those of the gains.
        blocks = [np.diag(dt * R), *[np.diag(dt * Q), np.diag(dt * R)] * (steps - 1), last]
        hessian = scipy.linalg.block_diag(*blocks)
        self._weight = scipy.sparse.csr_matrix(hessian)
        ca = casadi()
        # Made once: of the cost, only the vector g changes from plan to plan.
        self._hessian = ca.sparsify(ca.DM(hessian))
        rows, self._low, self._high = _limit_rows(model, limits)
        self._flow, self._matrix = _assembly(model, steps, dt, rows)
        self._solve = _program(ca, mpc, self._hessian, self._matrix.sparsity_out(0))

    def solve(self, start: Array, targets: Course, guess: Course) -> Answer:
        """Return the plan from a start (n,), linearized along a guess."""
        n, m, N = self.n, self.m, self.steps
        # About the measured start, so that the equations are exact in x_0, which is no variable.
        states = np.vstack([start, guess.states[1:]])
        matrix, constants = self._matrix(states[:N].T, guess.inputs.T)
        desired = _interleave(targets.inputs, targets.states[1:])
        equal = np.array(constants).T
        # Both bounds of an equation are alike; the rows of a step are its motion, then its limits.
        low = np.hstack([equal, np.tile(self._low, (N, 1))]).ravel()
        high = np.hstack([equal, np.tile(self._high, (N, 1))]).ravel()
        # Checked here, since each solver fails on such data in its own way.
        if not (np.isfinite(equal).all() and np.isfinite(desired).all()):
            return Answer(None, "its data is not finite")
        solution = self._solve(
            h=self._hessian,
            # 1/2 (w - w*)'H (w - w*) = 1/2 w'H w - (H w*)'w + a constant.
            g=-(self._weight @ desired),
            a=matrix,
            lba=low,
            uba=high,
            x0=_interleave(guess.inputs, guess.states[1:]),
        )
        stats = self._solve.stats()
        w = np.array(solution["x"]).reshape(N, m + n)
        if not stats["success"] or not np.isfinite(w).all():
            return Answer(None, str(stats["return_status"]))
        return Answer(Course(np.vstack([start, w[:, m:]]), w[:, :m]), "")

    def shift(self, course: Course, last: Array) -> Course:
        """Return a course shifted by one step, with a new last input (m,)."""
        end = np.array(self._flow(course.states[-1], last)).ravel()
        # A guess must be finite; the next solution corrects it.
        end = end if np.isfinite(end).all() else course.states[-1]
        return Course(np.vstack([course.states[1:], end]), np.vstack([course.inputs[1:], last]))


def _interleave(inputs: Array, states: Array) -> Array:
    return np.hstack([inputs, states]).ravel()


def _cost_to_go(model: ControlAffine, Q: Array, R: Array, dt: float) -> Array:
    """Return the cost matrix of the LQR about the trim in discrete time."""
    step = discretize(*linearize(model), dt)
    try:
        with without_warnings():
            return scipy.linalg.solve_discrete_are(*step, np.diag(dt * Q), np.diag(dt * R))
    except (np.linalg.LinAlgError, ValueError) as error:
        raise PlanError(
            f"the cost from the horizon's end on does not exist for `{type(model).__name__}`: "
            f"{str(error).rstrip('.').lower()}; weigh every state that does not decay by itself."
        ) from error


def _limit_rows(model: ControlAffine, limits: bool) -> tuple[Array, Array, Array]:
    """Return low <= G v <= high on normalized inputs, each row divided by its size."""
    if not limits or model.input_limits is None:
        return np.zeros((0, len(model.input_names))), np.zeros(0), np.zeros(0)
    G, low, high = (np.asarray(part, float) for part in model.input_limits)
    # low <= G (u* + S v) <= high, each row by its size: solvers forgive all rows alike.
    at_trim = G @ np.asarray(model.trim[1], float)
    rows = G @ np.asarray(model.input_scale, float)
    size = np.abs(rows).max(axis=1)
    return rows / size[:, None], (low - at_trim) / size, (high - at_trim) / size


def _assembly(
    model: ControlAffine, steps: int, dt: float, rows: Array
) -> "tuple[Function, Function]":
    """Return the flow (x, v) -> x, and (states (n, N), inputs (m, N)) -> matrix and rhs (n, N)."""
    ca, n, m = casadi(), len(model.state_names), len(model.input_names)
    x, v = ca.SX.sym("x", n), ca.SX.sym("v", m)
    owner = type(model).__name__
    # `rk4` is annotated for JAX, and needs arithmetic alone.
    field: Any = casadi_function("velocity", model.velocity, n, m, owner=owner)
    physical = casadi_function("physical", model.physical, m, owner=owner)
    # One Runge-Kutta step a period, which is short: the next plan begins from what is measured.
    after = rk4(field, x, physical(v), dt)
    flow = ca.Function("flow", [x, v], [after])
    slopes = ca.Function("slopes", [x, v], [after, ca.jacobian(after, x), ca.jacobian(after, v)])
    X, V = ca.MX.sym("X", n, steps), ca.MX.sym("V", m, steps)
    ends, by_state, by_input = slopes.map(steps)(X, V)
    As, Bs = ca.horzsplit(by_state, n), ca.horzsplit(by_input, m)
    width, limit = steps * (n + m), ca.MX(ca.DM(rows))
    blocks, constants = [], []
    for k in range(steps):
        # x_k stands in the n columns before v_k, and x_0 in none.
        before = max(0, k * (n + m) - n)
        row = [ca.MX(n, before), *([As[k]] if k else []), Bs[k], -ca.MX.eye(n)]
        blocks += [ca.horzcat(*row, ca.MX(n, width - (k + 1) * (n + m)))]
        left, free = k * (n + m), len(rows)
        blocks += [ca.horzcat(ca.MX(free, left), limit, ca.MX(free, width - left - m))]
        # A x + B v - x_next = A x' + B v' - flow(x', v') about the last plan (x', v'); without the
        # terms in x_0, which is x'_0.
        constant = Bs[k] @ V[:, k] - ends[:, k]
        constants += [constant + As[k] @ X[:, k] if k else constant]
    return flow, ca.Function("equations", [X, V], [ca.vertcat(*blocks), ca.horzcat(*constants)])


def _program(ca: ModuleType, mpc: MPC, hessian: "DM", matrix: "Sparsity") -> "Function":
    # A failure comes back as a status: the run goes on with the last plan.
    options = {"print_time": False, "error_on_fail": False, **_SILENT.get(mpc.solver, {})}
    try:
        return ca.conic(
            "step",
            mpc.solver,
            {"h": hessian.sparsity(), "a": matrix},
            options | dict(mpc.options),
        )
    except RuntimeError as error:
        reason = str(error).strip().splitlines()[-1].rstrip(".")
        raise PlanError(f"`{mpc.solver}` refuses the problem or its options: {reason}.") from error
