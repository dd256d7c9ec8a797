"""Plans for a whole formation, made agent by agent outward from the leaders."""

import time
from collections.abc import Callable
from typing import NamedTuple, final

import numpy as np

from echelon.agents.models.model import ControlAffine
from echelon.agents.network.formation import Formation
from echelon.agents.network.graph import Graph
from echelon.agents.network.matrices import shares
from echelon.agents.references.flatness import (
    Targets,
    mean_targets,
    reference_targets,
    shifted_targets,
)
from echelon.agents.references.reference import LeaderPath
from echelon.core.errors import PlanError
from echelon.core.types import Array
from echelon.simulation.optimal.objectives import (
    PlanTimes,
    TrackingOptions,
    coarse,
    spacing,
    tracking,
)
from echelon.simulation.optimal.problem import OptimalControl
from echelon.simulation.optimal.solver import Solver, Trajectory

_INPUT_WEIGHT_FACTORS = (1e2, 1e4)
"""Factors on the input weight of easier problems, solved when the solver fails on the original."""

_ITERATION_LIMIT = {"ipopt.max_iter": 300}
"""Beyond this, another initial guess helps more than more iterations."""

_WARM_START = {
    "ipopt.warm_start_init_point": "yes",
    "ipopt.mu_init": 1e-6,
    "ipopt.warm_start_bound_push": 1e-9,
    "ipopt.warm_start_bound_frac": 1e-9,
    "ipopt.warm_start_slack_bound_push": 1e-9,
    "ipopt.warm_start_slack_bound_frac": 1e-9,
    "ipopt.warm_start_mult_bound_push": 1e-9,
}
"""Options by which IPOPT starts at a solution, instead of first moving off the limits."""


class FormationPlan(NamedTuple):
    """The plans of all agents, and the work of the solvers.

    Attributes:
        grid: the times.
        plans: one for each agent; states on the grid and inputs held between.
        seconds: of solving, for each agent.
        iterations: of the solver, for each agent.
        failures: number of failed attempts, each followed by another one.
        setup_seconds: of building the solvers.
    """

    grid: PlanTimes
    plans: tuple[Trajectory, ...]
    seconds: tuple[float, ...]
    iterations: tuple[int, ...]
    failures: int
    setup_seconds: float


def plan_formation(
    model: ControlAffine,
    graph: Graph,
    formation: Formation,
    states: Array,
    grid: PlanTimes,
    *,
    reference: LeaderPath | None,
    planning: TrackingOptions,
    limits: bool,
) -> FormationPlan:
    """Return the plans of all agents from their states (N, n), leaders first.

    Agents plan breadth first from the leaders; each follower uses the plans of the neighbours that
    planned before it. A leader without a reference keeps its trim.

    Raises:
        PlanError: an agent's plan violates a constraint; the message names it and the amount.
        MissingExtraError: casadi is not installed.
    """
    targets = reference_targets(model, reference, grid.times)
    planner = _Planner(model, planning, grid, limits)
    plans: dict[int, Trajectory] = {}
    for agent, earlier in graph.outward():
        if not earlier:
            goals = shifted_targets(model, targets, formation.offsets[agent])
            plans[agent] = planner.follow(agent, states[agent], goals)
            continue
        goals = _neighbour_targets(model, graph, formation, agent, {j: plans[j] for j in earlier})
        if planning.specification == "offset":
            plans[agent] = planner.follow(agent, states[agent], goals)
        else:
            neighbours = [plans[j].states for j in earlier]
            displacements = [formation.displacement(j, agent) for j in earlier]
            plans[agent] = planner.keep_distances(
                agent, states[agent], goals, neighbours, displacements
            )
    order = range(graph.agents)
    return FormationPlan(
        grid,
        tuple(plans[agent] for agent in order),
        tuple(planner.seconds[agent] for agent in order),
        tuple(planner.iterations[agent] for agent in order),
        planner.failures,
        planner.setup_seconds,
    )


def plan_tracking(
    model: ControlAffine,
    start: Array,
    targets: Targets,
    grid: PlanTimes,
    planning: TrackingOptions,
    limits: bool,
) -> Trajectory:
    """Return an agent's plan to its targets; `PlanError` names a violated constraint."""
    return _Planner(model, planning, grid, limits).follow(0, start, targets)


def _neighbour_targets(
    model: ControlAffine,
    graph: Graph,
    formation: Formation,
    agent: int,
    plans: dict[int, Trajectory],
) -> Targets:
    """Return the targets of an agent: the mean of its earlier neighbours' plans plus offsets."""
    states = np.stack([p.states - formation.displacement(agent, j) for j, p in plans.items()])
    inputs = np.stack([model.normalized(p.inputs) for p in plans.values()])
    # Targets have an input at each time, plans one per interval: the last one is repeated.
    last = np.concatenate([inputs, inputs[:, -1:]], axis=1)
    return mean_targets(model, states, last, shares(graph, agent, tuple(plans)))


@final
class _Planner:
    """Plans agent by agent; agents whose problems have the same form share the solvers."""

    def __init__(
        self, model: ControlAffine, planning: TrackingOptions, grid: PlanTimes, limits: bool
    ) -> None:
        self.model, self.planning, self.grid, self.limits = model, planning, grid, limits
        self.seconds: dict[int, float] = {}
        self.iterations: dict[int, int] = {}
        self.failures, self.setup_seconds = 0, 0.0
        self._solvers: dict[tuple[object, ...], tuple[Solver, Solver | None]] = {}

    def follow(self, agent: int, start: Array, targets: Targets) -> Trajectory:
        """Return the plan of an agent that follows targets."""
        key = ("targets",)
        self._prepare(
            key, lambda fine: tracking(self.model, self.planning, self.grid, self.limits, fine)
        )
        return self._plan(agent, key, start, targets.outputs, targets)

    def keep_distances(
        self,
        agent: int,
        start: Array,
        targets: Targets,
        neighbours: list[Array],
        displacements: list[Array],
    ) -> Trajectory:
        """Return a plan that keeps the lengths of displacements (n,) to neighbours (T, n) each."""
        axes = list(self.model.position_indices())
        distances = np.array([np.linalg.norm(d[axes]) for d in displacements])
        # In the key, since the distances are constants of the problem; all else is its data.
        key = ("distances", *distances.tolist())
        self._prepare(
            key, lambda fine: spacing(self.model, self.grid, self.limits, fine, distances)
        )
        positions = np.hstack([p[:, axes] for p in neighbours])
        return self._plan(agent, key, start, positions, targets)

    def _prepare(self, key: tuple[object, ...], pose: Callable[[bool], OptimalControl]) -> None:
        if key in self._solvers:
            return
        began, solver = time.perf_counter(), self.planning.solver
        # These are IPOPT's own names; any other solver keeps its defaults.
        cold, warm = (
            (_ITERATION_LIMIT, _ITERATION_LIMIT | _WARM_START)
            if solver == "ipopt"
            else (None, None)
        )
        finer = self.grid.hold > coarse(self.grid)
        fine_solver = Solver(pose(True), solver, warm) if finer else None
        self._solvers[key] = Solver(pose(False), solver, cold), fine_solver
        self.setup_seconds += time.perf_counter() - began

    def _plan(
        self,
        agent: int,
        key: tuple[object, ...],
        start: Array,
        parameters: Array,
        targets: Targets,
    ) -> Trajectory:
        """Solve on coarse steps, which take most iterations, and then on fine ones."""
        coarse_solver, fine_solver = self._solvers[key]
        self.seconds[agent], self.iterations[agent] = 0.0, 0
        # The targets, after the start, are near the solution.
        guess = (
            np.vstack([start, targets.states[1:]]),
            self.model.physical(targets.inputs[:-1]),
        )
        plan = self._attempt(agent, coarse_solver, start, parameters, targets, guess, 1.0)
        # A larger input weight keeps the plan near the targets' inputs, where the problem is nearly
        # quadratic; its solution is then a better guess.
        for factor in () if plan.solved else _INPUT_WEIGHT_FACTORS:
            easier = self._attempt(agent, coarse_solver, start, parameters, targets, guess, factor)
            guess = (easier.states, easier.inputs)
            plan = self._attempt(agent, coarse_solver, start, parameters, targets, guess, 1.0)
            if plan.solved:
                break
        if fine_solver is not None:
            plan = self._attempt(agent, fine_solver, start, parameters, targets, plan, 1.0)
        # Judged by the constraints, not by the status of the solver: it may have stopped short of
        # its tolerance with a valid plan.
        if plan.violations:
            raise PlanError(f"there is no plan for agent {agent}: {plan.message}")
        return plan

    def _attempt(
        self,
        agent: int,
        solver: Solver,
        start: Array,
        parameters: Array,
        targets: Targets,
        guess: Trajectory | tuple[Array, Array],
        factor: float,
    ) -> Trajectory:
        # The factor is data, so that the easier problems need no solvers of their own.
        weight = np.full((len(parameters), 1), factor * self.planning.input_weight)
        plan = solver.solve(start, np.hstack([parameters, targets.inputs, weight]), guess)
        self.seconds[agent] += plan.seconds
        self.iterations[agent] += plan.iterations
        self.failures += not plan.solved
        return plan
