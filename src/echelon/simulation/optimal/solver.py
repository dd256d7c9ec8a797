"""Solves optimal control problems by CasADi, and says in words how the solver ended."""

import dataclasses
import time
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from echelon.agents.models.model_check import check_model
from echelon.core.errors import PlanError, listing
from echelon.core.numerics import precision
from echelon.core.types import Array
from echelon.simulation.optimal.casadi import casadi
from echelon.simulation.optimal.problem import OptimalControl
from echelon.simulation.optimal.transcription import NonlinearProgram, transcribe

if TYPE_CHECKING:  # it comes with an extra
    from casadi import DM

_TOLERANCE = 1e-6
"""A constraint that is violated by less than this counts as met."""


class Violation(NamedTuple):
    """The largest violation of a constraint, in the constraint's units, and its time (s)."""

    name: str
    amount: float
    time: float


def violations(program: NonlinearProgram, g: Array) -> tuple[Violation, ...]:
    """Return the largest violation of each kind of constraint, the largest first."""
    sizes = np.array([row.size for row in program.rows])
    amounts = sizes * np.maximum(program.low - g, g - program.high)
    worst: dict[str, Violation] = {}
    # `~(<=)` and not `>`, so that NaN counts as violated. By size, since the program's rows are
    # divided by it and the solver's tolerance is the same for all of them.
    for k in np.flatnonzero(~(amounts <= _TOLERANCE * sizes)):
        name, amount = program.rows[k].name, float(amounts[k])
        if name not in worst or not amount <= worst[name].amount:
            worst[name] = Violation(name, amount, program.rows[k].time)
    return tuple(sorted(worst.values(), key=lambda v: -v.amount))


def least_violations(program: NonlinearProgram, w: Array, p: Array) -> tuple[Violation, ...]:
    """Return the violations at the point of least total violation of the problem's constraints.

    The motion, the start and the actuators' limits are met. The result is empty if these alone
    contradict each other, or the solver finds no such point.

    Args:
        program: has no feasible point.
        w: the initial guess.
        p: the program's data.
    """
    ca = casadi()
    relaxed = np.flatnonzero([row.of_problem for row in program.rows])
    if not len(relaxed):
        return ()
    above, below = ca.MX.sym("a", len(relaxed)), ca.MX.sym("b", len(relaxed))
    place = ca.DM(np.eye(len(program.rows))[:, relaxed])
    elastic = {
        "x": ca.vertcat(program.problem["x"], above, below),
        # The sum of violations and not of squares: it leaves most of them at zero, and so names
        # the few constraints that contradict each other.
        "f": ca.sum1(above) + ca.sum1(below),
        "g": program.problem["g"] + ca.mtimes(ca.sparsify(place), below - above),
        "p": program.problem["p"],
    }
    quiet = {"print_time": False, "error_on_fail": False, "ipopt.print_level": 0, "ipopt.sb": "yes"}
    solver = ca.nlpsol("elastic", "ipopt", elastic, quiet)
    # Slacks begin at 1, since an interior-point solver starts inside of the bounds.
    free, slack = np.full(len(w), np.inf), np.ones(2 * len(relaxed))
    solution: dict[str, DM] = solver(
        x0=np.concatenate([w, slack]),
        lbx=np.concatenate([-free, 0.0 * slack]),
        lbg=program.low,
        ubg=program.high,
        p=p,
    )
    if not solver.stats()["success"]:
        return ()
    slacks = np.array(solution["x"]).ravel()[len(w) :]
    g = np.array(solution["g"]).ravel()
    # The elastic row is g - above + below; this is g again.
    g[relaxed] -= slacks[len(relaxed) :] - slacks[: len(relaxed)]
    return violations(program, g)


@dataclasses.dataclass(frozen=True)
class Trajectory:
    """A trajectory of one agent, and how its solver ended.

    Attributes:
        times: (N + 1,) s.
        states: (N + 1, n).
        inputs: physical; (N, m) held over each step, or (N + 1, m) at the times (collocation).
        cost: the value of the cost.
        solved: whether the solver reached its tolerance.
        message: how it ended, with the largest violations of constraints if there are any.
        violations: those above 1e-6, the largest first; if the solver found a contradiction, the
            smallest violations that are possible with all else met.
        iterations: of the solver.
        seconds: of solving.
        multipliers: of the variables' bounds and of the constraints, for a warm start.
    """

    times: Array
    states: Array
    inputs: Array
    cost: float
    solved: bool
    message: str
    violations: tuple[Violation, ...]
    iterations: int
    seconds: float
    multipliers: tuple[Array, Array]


_DEFAULTS: dict[str, dict[str, object]] = {
    # IPOPT would widen every bound by 1e-8, and a plan then leave the actuators' limits.
    "ipopt": {"ipopt.print_level": 0, "ipopt.sb": "yes", "ipopt.bound_relax_factor": 0.0},
    "fatrop": {"structure_detection": "auto", "fatrop.print_level": 0},
}
"""Options that silence a solver, make limits exact, and let it use the structure."""


class Solver:
    """A problem transcribed for a solver, to be solved many times with different data.

    Args:
        problem: what to solve.
        solver: a nonlinear solver of CasADi: `ipopt`, `fatrop`, `sqpmethod`, ...
        options: for it, by CasADi's names, in addition to the defaults.

    Raises:
        EchelonError: the model or the problem is malformed, or casadi is missing.
    """

    def __init__(
        self,
        problem: OptimalControl,
        solver: str = "ipopt",
        options: Mapping[str, object] | None = None,
    ) -> None:
        self.problem, self.solver = problem, solver
        ca = casadi()
        if not ca.has_nlpsol(solver):
            common = ("ipopt", "fatrop", "sqpmethod")
            raise PlanError(f"`solver` is `{solver}`, which CasADi lacks; try {listing(common)}.")
        with precision("float64"):
            check_model(problem.model)
            self.program: NonlinearProgram = transcribe(problem)
        merged: dict[str, object] = {
            "print_time": False,
            "error_on_fail": False,
            **_DEFAULTS.get(solver, {}),
        }
        # It treats equations and inequalities differently, and cannot tell them apart itself.
        if solver == "fatrop":
            merged["equality"] = (self.program.low == self.program.high).tolist()
        merged |= options or {}
        try:
            self._solve = ca.nlpsol("plan", solver, self.program.problem, merged)
        except RuntimeError as error:
            raise PlanError(
                f"`{solver}` refuses the problem or its options: {_complaint(error)}."
            ) from error

    def solve(
        self,
        start: ArrayLike,
        parameters: ArrayLike | None = None,
        guess: "Trajectory | tuple[Array, Array] | None" = None,
    ) -> Trajectory:
        """Return the plan from a start state.

        Args:
            start: (n,).
            parameters: p at each time, (steps + 1, k) or (k,) for all times alike.
            guess: a plan, whose multipliers are used as well, or states and inputs in the shapes of
                a plan; by default the start state with the trim's input at all times.

        Raises:
            PlanError: the data has a wrong shape or is not finite. A failing solver is no error:
                the plan says so, and contains the point where the solver stopped.
        """
        problem, program = self.problem, self.program
        n, N, k = len(problem.model.state_names), problem.steps, problem.parameters
        x = _numbers("start", start, (n,))
        p = _numbers("parameters", parameters if k else np.zeros(0), (N + 1, k), repeat=True)
        data = {"p": np.concatenate([x, p.ravel()]), "lbg": program.low, "ubg": program.high}
        data |= self._begin(x, guess)
        began = time.perf_counter()
        solution = self._solve(**data)
        seconds = time.perf_counter() - began
        return self._plan(solution, data["p"], self._solve.stats(), seconds)

    def _begin(self, x: Array, guess: Trajectory | tuple[Array, Array] | None) -> dict[str, Array]:
        problem = self.problem
        shapes = (problem.steps + 1, len(x)), (problem.nodes, len(problem.model.input_names))
        # Only a plan of the same problem has multipliers.
        multipliers = {}
        if guess is None:
            states, inputs = (
                np.tile(x, (shapes[0][0], 1)),
                np.tile(problem.model.trim[1], (problem.nodes, 1)),
            )
        elif isinstance(guess, Trajectory):
            states, inputs = guess.states, guess.inputs
            multipliers = dict(zip(("lam_x0", "lam_g0"), guess.multipliers, strict=True))
        else:
            states, inputs = guess
        states = _numbers("guess.states", states, shapes[0])
        inputs = _numbers("guess.inputs", inputs, shapes[1])
        v, N = problem.model.normalized(inputs), problem.steps
        # In the order of the program's variables: (x_k, v_k) step by step, the rest at the end.
        body = np.hstack([states[:N], v[:N]]).ravel()
        return {"x0": np.concatenate([body, states[N], v[N:].ravel()]), **multipliers}

    def _plan(
        self, solution: "dict[str, DM]", data: Array, stats: Mapping[str, Any], seconds: float
    ) -> Trajectory:
        problem = self.problem
        n, m, N = len(problem.model.state_names), len(problem.model.input_names), problem.steps
        w, g = np.array(solution["x"]).ravel(), np.array(solution["g"]).ravel()
        body, tail = w[: N * (n + m)].reshape(N, n + m), w[N * (n + m) :]
        v = np.vstack([body[:, n:], tail[n:].reshape(-1, m)])
        solved, status = bool(stats["success"]), str(stats["return_status"])
        amounts, least = violations(self.program, g), ()
        # The point where it stopped does not show what is wrong: another may violate much less.
        if status in _CONTRADICTION:
            least = least_violations(self.program, w, data)
        return Trajectory(
            times=problem.dt * np.arange(N + 1),
            states=np.vstack([body[:, :n], tail[:n]]),
            inputs=problem.model.physical(v),
            cost=float(solution["f"]),
            solved=solved,
            message=_message(self.solver, status, solved, least or amounts, bool(least)),
            violations=least or amounts,
            iterations=int(stats.get("iter_count", 0)),
            seconds=seconds,
            multipliers=(
                np.array(solution["lam_x"]).ravel(),
                np.array(solution["lam_g"]).ravel(),
            ),
        )


def solve(
    problem: OptimalControl,
    start: ArrayLike,
    parameters: ArrayLike | None = None,
    *,
    guess: Trajectory | tuple[Array, Array] | None = None,
    solver: str = "ipopt",
    options: Mapping[str, object] | None = None,
) -> Trajectory:
    """Solve an optimal control problem once; see `Solver` for solving it again with other data.

    Args:
        problem: what to solve.
        start: state, (n,).
        parameters: p at each time, (steps + 1, k) or (k,) for all times alike.
        guess: the initial guess.
        solver: of CasADi.
        options: for it.

    Raises:
        EchelonError: the model, the problem or its data is malformed, or casadi is missing.
    """
    return Solver(problem, solver, options).solve(start, parameters, guess)


def _numbers(name: str, value: object, shape: tuple[int, ...], repeat: bool = False) -> Array:
    try:
        array = np.asarray(value, np.float64)
    except (TypeError, ValueError):
        array = np.zeros(())
    if repeat and array.shape == shape[1:]:
        array = np.tile(array, (shape[0], 1))
    if array.shape != shape:
        received = getattr(value, "shape", None)
        received = value if received is None else f"of shape {received}"
        raise PlanError(f"`{name}` is {received}, and must be numbers of shape {shape}.")
    if not np.isfinite(array).all():
        raise PlanError(f"`{name}` holds a number that is not finite.")
    return array


def _complaint(error: RuntimeError) -> str:
    """Return the line of a CasADi message that names an option, or else its last line."""
    lines = str(error).strip().splitlines()
    line = next((line for line in lines if "option: " in line), lines[-1])
    return line.partition(": ")[2].rstrip(".") or line.rstrip(".")


# ---- return statuses in words --------------------------------------------------------------------

_WORDS = {
    "Solve_Succeeded": "it reached its tolerance",
    "Solved_To_Acceptable_Level": "it came close to its tolerance and no further",
    "Feasible_Point_Found": "it found a point that meets all constraints",
    "Infeasible_Problem_Detected": "it found that the constraints contradict each other nearby",
    "Search_Direction_Becomes_Too_Small": "its steps became too small to get further",
    "Diverging_Iterates": "its variables grew without bound, as where the cost has no minimum",
    "User_Requested_Stop": "it was interrupted",
    "Maximum_Iterations_Exceeded": "it used up its iterations",
    "Maximum_CpuTime_Exceeded": "it used up its time",
    "Maximum_WallTime_Exceeded": "it used up its time",
    "Restoration_Failed": "it lost the constraints and did not find back to them",
    "Error_In_Step_Computation": "its linear equations could not be solved",
    "Invalid_Number_Detected": "the cost, a constraint or a slope of theirs is not a finite number",
    "Not_Enough_Degrees_Of_Freedom": "there are more equations than variables",
    "Insufficient_Memory": "it ran out of memory",
}


_CONTRADICTION = ("Infeasible_Problem_Detected", "Restoration_Failed")


def _message(
    solver: str, status: str, solved: bool, amounts: tuple[Violation, ...], least: bool
) -> str:
    fallback = "Solve_Succeeded" if solved else status
    words = _WORDS.get(status, _WORDS.get(fallback, f"it ended with the status `{status}`"))
    ending = f"{solver} {'solved' if solved else 'failed to solve'} the problem: {words}"
    if solved or not amounts:
        return f"{ending}."
    largest = "; ".join(f"`{v.name}` by {v.amount:.3g} at {v.time:.3g} s" for v in amounts[:3])
    what = "smallest possible violations" if least else "largest violations"
    return f"{ending}; {what}: {largest}."
