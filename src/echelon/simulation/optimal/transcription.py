"""An optimal control problem as a nonlinear program: states and inputs on a grid of times.

Multiple shooting holds the input over a step and integrates as `simulate` does, so that the plan of
an undisturbed agent is its run. Trapezoidal collocation lets the input vary linearly.
"""

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from echelon.core.errors import PlanError
from echelon.core.numerics import rk4
from echelon.core.types import Array
from echelon.simulation.optimal.casadi import casadi, casadi_function
from echelon.simulation.optimal.problem import Constraint, OptimalControl

if TYPE_CHECKING:  # it comes with an extra
    from casadi import MX, SX, Function


class ConstraintRow(NamedTuple):
    """One row of the program's constraints.

    Attributes:
        name: of the constraint.
        time: at which it holds, s.
        size: by which it is divided, since a solver's tolerance is the same for all rows, and would
            be large for a torque in N m.
        of_problem: whether it is a constraint of the problem, not of the agent.
    """

    name: str
    time: float = 0.0
    size: float = 1.0
    of_problem: bool = False


class NonlinearProgram(NamedTuple):
    """A nonlinear program min f(w, p) subject to low <= g(w, p) <= high.

    w holds (x_k, v_k) step by step with u = u* + S v, so that its entries are of like size; g holds
    step by step the gap in the motion and then the constraints at the step's beginning.
    p is the start state and then the parameters of each time.
    """

    problem: dict[str, "MX"]
    low: Array
    high: Array
    rows: tuple[ConstraintRow, ...]


class _Parts(NamedTuple):
    """The problem's functions of x (n,), v (m,) and p (k,) at one time, as `casadi.Function`."""

    move: "Function"
    stage: "Function"
    terminal: "Function"
    limit: "Function"
    path: "Function"
    end: "Function"


def transcribe(problem: OptimalControl) -> NonlinearProgram:
    """Return the program of a problem.

    Raises:
        MissingExtraError: casadi is not installed.
        ModelError: model, cost or constraint uses a primitive that no solver's expression has.
        PlanError: a cost is no single number, or the bounds of a constraint do not fit it.
    """
    ca, parts = casadi(), _parts(problem)
    n, m = len(problem.model.state_names), len(problem.model.input_names)
    N, dt = problem.steps, problem.dt
    # MX, whose nodes are whole functions: `map` calls one for all steps, so that the expression
    # does not grow with the horizon. In the order of steps, its matrices are banded.
    body = ca.MX.sym("w", n + m, N)
    tail = ca.MX.sym("t", n + (m if problem.nodes > N else 0))
    start, p = ca.MX.sym("s", n), ca.MX.sym("p", problem.parameters, N + 1)
    x = ca.horzcat(body[:n, :], tail[:n])
    v = ca.horzcat(body[n:, :], tail[n:]) if problem.nodes > N else body[n:, :]
    after = v[:, 1:] if problem.nodes > N else v
    ends = (x[:, :-1], v[:, :N], x[:, 1:], after)
    # Half of dt for each end of a step; in shooting both ends have the step's own held input.
    cost = 0.5 * dt * ca.sum2(parts.stage.map(N)(*ends[:2], p[:, :-1]))
    cost += 0.5 * dt * ca.sum2(parts.stage.map(N)(*ends[2:], p[:, 1:]))
    cost += parts.terminal(x[:, -1], p[:, -1])
    gaps = parts.move.map(N)(*ends)
    limits = parts.limit.map(problem.nodes)(v)
    path = parts.path.map(N)(x[:, 1:], p[:, 1:])
    # The first state is data, so that no constraint of the problem applies to it.
    first = ca.vertcat(gaps[:, 0], x[:, 0] - start, limits[:, 0])
    middle = ca.vec(ca.vertcat(gaps[:, 1:], limits[:, 1:N], path[:, :-1]))
    closing = [limits[:, -1]] if problem.nodes > N else []
    last = ca.vertcat(*closing, path[:, -1], parts.end(x[:, -1], p[:, -1]))
    low, high, rows = _rows(problem)
    return NonlinearProgram(
        {
            "x": ca.vertcat(ca.vec(body), tail),
            "f": cost,
            "g": ca.vertcat(first, middle, last),
            "p": ca.vertcat(start, ca.vec(p)),
        },
        low,
        high,
        rows,
    )


def _parts(problem: OptimalControl) -> _Parts:
    ca, model, owner = casadi(), problem.model, type(problem.model).__name__
    n, m, k = len(model.state_names), len(model.input_names), problem.parameters
    x, v, y, w = (ca.SX.sym(c, size) for c, size in (("x", n), ("v", m), ("y", n), ("w", m)))
    p = ca.SX.sym("p", k)
    field = casadi_function("velocity", model.velocity, n, m, owner=owner)
    physical = casadi_function("physical", model.physical, m, owner=owner)
    u = physical(v)
    stage = _scalar("stage", casadi_function("stage", problem.stage, n, m, k))
    terminal = _scalar("terminal", casadi_function("terminal", problem.terminal, n, k))
    matrix = problem.bounds.matrix if problem.bounds else np.zeros((0, m))
    # By size, since a solver's tolerance is the same for all rows: 1e-8 is 0.2 % of a torque limit
    # of 5e-6 N m (theory page).
    matrix = np.array(matrix, float) / np.array([size for _, _, size in _limits(problem)])[:, None]

    def join(name: str, end: bool) -> "Function":
        values = [f(x, p) for one, f in _constraints(problem) if one.end is end]
        return ca.Function(name, [x, p], [ca.vertcat(ca.SX(0, 1), *values)])

    if problem.transcription == "shooting":
        # Solved by x_next = flow(x, u): as `simulate` steps, and so the plan is the run.
        gap = y - _flow(field, problem.substeps, problem.dt)(x, u)
    else:
        gap = y - x - 0.5 * problem.dt * (field(x, u) + field(y, physical(w)))
    return _Parts(
        ca.Function("move", [x, v, y, w], [gap]),
        ca.Function("stage", [x, v, p], [stage(x, u, p)]),
        terminal,
        ca.Function("limit", [v], [ca.DM(matrix) @ u]),
        join("path", False),
        join("end", True),
    )


def _constraints(problem: OptimalControl) -> list[tuple[Constraint, "Function"]]:
    n, k = len(problem.model.state_names), problem.parameters
    return [
        (one, casadi_function(f"c{i}", one.function, n, k, owner=one.name))
        for i, one in enumerate(problem.constraints)
    ]


def _flow(field: Any, substeps: int, dt: float) -> Callable[["SX", "SX"], "SX"]:
    """Return the state after dt with the input held, by the same steps as those of `simulate`."""

    def flow(x: Any, u: Any) -> Any:
        for _ in range(substeps):
            x = rk4(field, x, u, dt / substeps)
        return x

    return flow


def _scalar(name: str, function: "Function") -> "Function":
    if function.numel_out() != 1:
        raise PlanError(
            f"`{name}` returns {function.numel_out()} numbers, and must return one: a cost."
        )
    return function


def _rows(problem: OptimalControl) -> tuple[Array, Array, tuple[ConstraintRow, ...]]:
    motion = [(0.0, 0.0, ConstraintRow(f"motion of {name}")) for name in problem.model.state_names]
    begin = [(0.0, 0.0, ConstraintRow(f"start of {name}")) for name in problem.model.state_names]
    limits = [
        (low / size, high / size, ConstraintRow(f"actuator limit {j + 1}", size=size))
        for j, (low, high, size) in enumerate(_limits(problem))
    ]
    path_rows, ending = (
        [
            (low, high, ConstraintRow(one.name, of_problem=True))
            for one, f in _constraints(problem)
            if one.end is end
            for low, high in _bounds(one, f.numel_out())
        ]
        for end in (False, True)
    )
    steps = [motion + begin + limits]
    steps += [motion + limits + path_rows for _ in range(problem.steps - 1)]
    steps += [(limits if problem.nodes > problem.steps else []) + path_rows + ending]
    table = [
        (low, high, row._replace(time=step * problem.dt))
        for step, rows in enumerate(steps)
        for low, high, row in rows
    ]
    low, high, rows = zip(*table, strict=True)
    return np.array(low, float), np.array(high, float), tuple(rows)


def _limits(problem: OptimalControl) -> list[tuple[float, float, float]]:
    """Return the bounds of each row of the input limits, and the larger one's size."""
    if problem.bounds is None:
        return []
    pairs = zip(problem.bounds.low, problem.bounds.high, strict=True)
    sizes = (
        (low, high, max(abs(b) for b in (low, high, 0.0) if np.isfinite(b))) for low, high in pairs
    )
    # Infinite bounds have no size, and limits that are both zero leave the row as it is.
    return [(low, high, size or 1.0) for low, high, size in sizes]


def _bounds(constraint: Constraint, count: int) -> list[tuple[float, float]]:
    try:
        low = np.broadcast_to(np.asarray(constraint.low, float), (count,))
        high = np.broadcast_to(np.asarray(constraint.high, float), (count,))
    except (TypeError, ValueError):
        low = high = np.full(1, np.nan)
    if not (low <= high).all():
        raise PlanError(
            f"the bounds of the constraint `{constraint.name}` are {constraint.low} and "
            f"{constraint.high}, and must be a number or {count} numbers each, the lower first."
        )
    return list(zip(low.tolist(), high.tolist(), strict=True))
